//! Heatmaps: mean return and success rate of policies on a grid of values of two parameters.

use serde::{Deserialize, Serialize};

use perturb_protocol::{Version, proto};
use perturb_settings::ValueError;
use perturb_settings::sets::{Context, TestSet};
use perturb_text::Table;

use crate::axis::Axis;
use crate::records::{EpisodeRecord, Records};
use crate::statistics::mean;

/// Maximum number of points along an axis. It is limited because the environments of all points run together.
pub const MAX_POINTS: usize = 100;

/// The options of a heatmap.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeatmapOptions {
    /// The names of the parameters along x and along y.
    pub parameters: [String; 2],
    /// The version from which all other parameters are drawn. In version D (deterministic) they have their defaults. In
    /// R (random) and E (extreme) they are drawn for each episode (with RL², for each trial).
    pub base: Version,
    /// The number of points along each axis, 1 … 100.
    pub grid: usize,
    /// The number of episodes at each point, at least 1.
    pub episodes: u64,
    /// The seed of all random numbers.
    pub seed: u64,
    /// Fixed values of other parameters, which take precedence over `base`.
    #[serde(default, skip_serializing_if = "Context::is_empty")]
    pub fixed: Context,
}

impl HeatmapOptions {
    /// Returns the total number of episodes at all points.
    ///
    /// # Errors
    /// [`ValueError`] if the number is 2^64 or more.
    pub fn total_episodes(&self) -> Result<u64, ValueError> {
        let total =
            (self.grid as u64).checked_mul(self.grid as u64).and_then(|points| points.checked_mul(self.episodes));
        let what = "the number of episodes at each point of a heatmap";
        let expected = format!("so small that {} × {} points have fewer than 2^64 episodes", self.grid, self.grid);
        total.ok_or_else(|| ValueError::new(what, self.episodes, expected))
    }
}

/// The parameters along the axes of a heatmap, and the version (distribution) from which the other parameters are
/// drawn. Only heatmaps of the same kind can be compared.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct HeatmapKind {
    /// The names of the parameters along x and along y.
    pub parameters: [String; 2],
    /// The version from which the other parameters are drawn.
    pub base: Version,
}

/// The mean return and success rate at each point of a grid of two parameters: of one policy, or averaged over several
/// policies.
#[derive(Clone, Debug, PartialEq)]
pub struct Heatmap {
    /// The environment's name in the catalogue.
    pub environment: String,
    /// The axes x and y.
    pub axes: [Axis; 2],
    /// The version from which the other parameters are drawn, see [`HeatmapOptions::base`].
    pub base: Version,
    /// The other parameters that have a fixed value.
    pub fixed: Context,
    /// G, the number of points along each axis.
    pub grid: usize,
    /// The number of episodes of each policy at each point.
    pub episodes: u64,
    /// The points `[G, G]`, by y, then x, both ascending.
    pub points: Vec<HeatmapPoint>,
}

/// A point of a heatmap: the results for one pair of parameter values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeatmapPoint {
    /// The value of the parameter along x.
    pub x: f64,
    /// The value of the parameter along y.
    pub y: f64,
    /// The mean undiscounted return.
    pub mean_return: f64,
    /// The success rate, in %.
    pub success_percent: f64,
}

impl HeatmapOptions {
    /// Returns the kind of the heatmap: its two parameters, and the version from which the others are drawn.
    pub fn kind(&self) -> HeatmapKind {
        HeatmapKind { parameters: self.parameters.clone(), base: self.base }
    }
}

impl std::fmt::Display for HeatmapKind {
    /// Formats the kind as it appears in file names.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { parameters: [x, y], base } = self;
        write!(f, "{x}-{y}")?;
        if *base == Version::D { Ok(()) } else { write!(f, "-{}", base.file_name()) }
    }
}

impl Heatmap {
    /// The name of the test set whose records make up a heatmap.
    pub const SET: &str = "heatmap";

    /// Returns the axes of a heatmap's test set: x is the parameter that varies faster from context to context, and y
    /// is the other parameter that varies. Returns `None` if `set` is not the test set of a heatmap.
    pub(crate) fn axes_of(set: &TestSet, environment: &proto::Environment) -> Option<[Axis; 2]> {
        let contexts = set.listed();
        let [first, second, ..] = contexts.as_slice() else { return None };
        // Collects the parameters that vary. The parameter along x varies faster: it already differs between the first
        // two contexts.
        let (mut varying, mut faster) = (Vec::new(), None);
        for parameter in environment.parameters.iter().filter(|_| set.name == Self::SET) {
            let value = |context: &Context| context.get(&parameter.name).copied();
            if contexts.iter().any(|context| value(context) != value(first)) {
                if value(first) != value(second) {
                    faster = Some(varying.len());
                }
                varying.push(Axis::new(parameter));
            }
        }
        let [one, other]: [Axis; 2] = varying.try_into().ok()?;
        Some(if faster? == 0 { [one, other] } else { [other, one] })
    }

    /// Computes the heatmap from a policy's records, with the axes that the records contain. Returns `None` if the
    /// records contain no test of a heatmap.
    pub fn from_recorded_test(records: &Records) -> Option<Self> {
        let axes = records.about.tests.iter().find_map(|test| test.axes.clone())?;
        Self::from_records(records, axes)
    }

    /// Returns the contexts (parameter values) of all points over `axes`, with `grid` points along each axis. Other
    /// parameters have the values of `fixed`.
    pub fn contexts(axes: &[Axis; 2], grid: usize, fixed: &Context) -> Vec<Context> {
        let context = |point: usize| {
            let places = [point % grid, point / grid];
            let value = |i: usize| (axes[i].name.clone(), axes[i].value(places[i], grid));
            fixed.clone().into_iter().chain([value(0), value(1)]).collect()
        };
        (0..grid * grid).map(context).collect()
    }

    /// Returns the kind of the heatmap.
    pub fn kind(&self) -> HeatmapKind {
        HeatmapKind { parameters: self.axes.clone().map(|axis| axis.name), base: self.base }
    }

    /// Returns the version from which the parameters that are not axes were drawn in a recorded heatmap. Returns `None`
    /// if the records contain no test of a heatmap.
    pub fn base_of(records: &Records) -> Option<Version> {
        records.about.tests.iter().find(|test| test.set.name == Self::SET).map(|test| test.set.version)
    }

    /// Computes the heatmap from a policy's records, for given `axes`. The test's contexts are the points, by y, then
    /// x. Returns `None` if the records contain no test of a heatmap, or if its contexts do not fit the axes.
    pub fn from_records(records: &Records, axes: [Axis; 2]) -> Option<Self> {
        let test = records.about.tests.iter().find(|test| test.set.name == Self::SET)?;
        let contexts = test.set.listed();
        let fixed_of = |context: &Context| -> Context {
            let is_axis = |name: &String| axes.iter().any(|axis| axis.name == *name);
            context.iter().filter(|(name, _)| !is_axis(name)).map(|(name, value)| (name.clone(), *value)).collect()
        };
        let fixed = fixed_of(contexts.first()?);
        if contexts.iter().any(|context| fixed_of(context) != fixed) {
            return None;
        }
        let grid = contexts.len().isqrt();
        let [x, y] = &axes;
        let value = |context: &Context, axis: &Axis| context.get(&axis.name).copied().unwrap_or(f64::NAN);
        let mut by_point: Vec<Vec<&EpisodeRecord>> = vec![Vec::new(); contexts.len()];
        let place = |episode: &EpisodeRecord| episode.environment_index as usize % contexts.len();
        records.episodes_on(Self::SET).for_each(|episode| by_point[place(episode)].push(episode));
        let figures = |(context, episodes): (&Context, &Vec<&EpisodeRecord>)| HeatmapPoint {
            x: value(context, x),
            y: value(context, y),
            mean_return: mean(episodes.iter().map(|episode| episode.episode_return)),
            success_percent: mean(episodes.iter().map(|episode| if episode.success { 100.0 } else { 0.0 })),
        };
        let heatmap = Self {
            environment: records.about.environment.clone(),
            base: test.set.version,
            fixed,
            grid,
            episodes: by_point.first()?.len() as u64,
            points: contexts.iter().zip(&by_point).map(figures).collect(),
            axes,
        };
        heatmap.is_whole().then_some(heatmap)
    }

    /// Averages heatmaps of several policies, point by point. Returns `None` if there are none, or if their axes, grids
    /// or other options differ.
    pub fn mean(heatmaps: &[Self]) -> Option<Self> {
        let first = heatmaps.first()?;
        let about = |of: &Self| Self { points: Vec::new(), ..of.clone() };
        if heatmaps.iter().any(|other| about(other) != about(first)) {
            return None;
        }
        let over =
            |point: usize, figure: fn(&HeatmapPoint) -> f64| mean(heatmaps.iter().map(|of| figure(&of.points[point])));
        let point = |(index, point): (usize, &HeatmapPoint)| HeatmapPoint {
            mean_return: over(index, |point| point.mean_return),
            success_percent: over(index, |point| point.success_percent),
            ..*point
        };
        Some(Self { points: first.points.iter().enumerate().map(point).collect(), ..about(first) })
    }

    /// Replaces the points by the points in `csv`, a table as CSV that [`heatmap_table`] made. Returns `None` if the
    /// new points do not fit the axes and the grid.
    pub fn with_points(self, csv: &[u8]) -> Option<Self> {
        let mut reader = csv::Reader::from_reader(csv);
        let rows: Result<Vec<[f64; 4]>, _> = reader.deserialize().collect();
        let point =
            |[x, y, mean_return, success_percent]: [f64; 4]| HeatmapPoint { x, y, mean_return, success_percent };
        let read = Self { points: rows.ok()?.into_iter().map(point).collect(), ..self };
        read.is_whole().then_some(read)
    }

    /// Returns whether every point has the parameter values of its position in the grid.
    fn is_whole(&self) -> bool {
        let ([x, y], grid) = (&self.axes, self.grid);
        let fits = |(index, point): (usize, &HeatmapPoint)| {
            (point.x, point.y) == (x.value(index % grid, grid), y.value(index / grid, grid))
        };
        // A file that another program wrote may have no points, or a grid whose number of points overflows.
        grid > 0 && grid.checked_mul(grid) == Some(self.points.len()) && self.points.iter().enumerate().all(fits)
    }

    /// Describes in words the values of the parameters that are not axes.
    pub fn others(&self) -> String {
        let fixed: String = self.fixed.iter().map(|(name, value)| format!("{name} = {value}, ")).collect();
        match self.base {
            Version::D => format!("{fixed}other parameters at their defaults"),
            base => format!("{fixed}other parameters drawn from {base}"),
        }
    }
}

/// Returns a table with a row for each point.
pub fn heatmap_table(heatmap: &Heatmap) -> Table {
    let [x, y] = &heatmap.axes;
    Table::builder("", &heatmap.points)
        .number(&x.name, |point| point.x)
        .number(&y.name, |point| point.y)
        .number("mean_return", |point| point.mean_return)
        .number("success_percent", |point| point.success_percent)
        .build()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture;

    #[test]
    fn total_episodes_never_wrap() {
        let options = |grid, episodes| HeatmapOptions {
            parameters: ["length".into(), "mass".into()],
            base: Version::D,
            grid,
            episodes,
            seed: 1,
            fixed: Context::new(),
        };
        assert_eq!(options(10, 7).total_episodes(), Ok(700));
        assert_eq!(options(2, u64::MAX / 4).total_episodes(), Ok(u64::MAX - 3));
        for (grid, episodes) in [(2, 1 << 62), (2, u64::MAX), (usize::MAX, 1)] {
            let error = options(grid, episodes).total_episodes().unwrap_err().to_string();
            assert!(error.contains("fewer than 2^64 episodes"), "{error}");
        }
    }

    #[test]
    fn mean_is_over_policies_with_equal_points() {
        let [a, b] = [0.0, 100.0].map(|success| fixture::heatmap(2, |x, y| (10.0 * x + y + success, success)));
        let both = Heatmap::mean(&[a.clone(), b.clone()]).unwrap();
        for (index, point) in both.points.iter().enumerate() {
            assert_eq!((point.x, point.y), (a.points[index].x, a.points[index].y));
            assert_eq!(point.mean_return, a.points[index].mean_return + 50.0);
            assert_eq!(point.success_percent, 50.0);
        }
        assert_eq!(Heatmap::mean(&[]), None);
        let others: [fn(Heatmap) -> Heatmap; 4] = [
            |it| Heatmap { base: Version::R, ..it },
            |it| Heatmap { episodes: 7, ..it },
            |it| Heatmap { fixed: [("gravity".to_owned(), 9.81)].into(), ..it },
            |it| Heatmap { environment: "Elsewhere".into(), ..it },
        ];
        assert!(others.iter().all(|other| Heatmap::mean(&[a.clone(), other(b.clone())]).is_none()));
        assert_eq!(Heatmap::mean(&[a, fixture::heatmap(3, |_, _| (0.0, 0.0))]), None, "of other grids");
    }

    #[test]
    fn figures_are_read_back_to_the_last_digit_or_not_at_all() {
        let heatmap = fixture::heatmap(3, |x, y| (x / 3.0 - y, 100.0 / 3.0 * y));
        let csv = heatmap_table(&heatmap).to_csv();
        let empty = || Heatmap { points: Vec::new(), ..heatmap.clone() };
        assert_eq!(empty().with_points(&csv), Some(heatmap.clone()));
        let text = String::from_utf8(csv.clone()).unwrap();
        let line = text.lines().nth(4).unwrap();
        for other in
            [text.replace(line, ""), text.replace(line, "1,2,3,4"), text.replace(line, "1,2,3,many"), String::new()]
        {
            assert_eq!(empty().with_points(other.as_bytes()), None, "{other}");
        }
        let head = text.lines().next().unwrap();
        for grid in [0, usize::MAX] {
            assert_eq!(Heatmap { grid, ..empty() }.with_points(head.as_bytes()), None, "{grid}");
        }
    }

    #[test]
    fn recorded_axes_are_varying_parameters_faster_one_along_x() {
        let heatmap = fixture::heatmap(2, |_, _| (0.0, 0.0));
        let parameter = |axis: &Axis| {
            let distribution = |pairs: &[(f64, f64)]| proto::Distribution {
                intervals: pairs.iter().map(|&(low, high)| proto::Interval { low, high }).collect(),
            };
            proto::Parameter {
                name: axis.name.clone(),
                unit: axis.unit.clone(),
                default_value: axis.default,
                random: Some(distribution(&axis.random)),
                extreme: Some(distribution(&axis.extreme)),
                ..proto::Parameter::default()
            }
        };
        let [mass, length] = &heatmap.axes;
        let gravity = Axis { name: "gravity".into(), ..mass.clone() };
        let parameters = [length, &gravity, mass].map(parameter).into();
        let environment = proto::Environment { parameters, ..proto::Environment::default() };
        let fixed: Context = [("gravity".to_owned(), 1.0)].into();
        let set = |name: &str, contexts| TestSet {
            name: name.into(),
            version: Version::D,
            contexts: perturb_settings::sets::Contexts::Listed(contexts),
        };
        let over = |axes: &[Axis; 2]| set(Heatmap::SET, Heatmap::contexts(axes, 2, &fixed));
        assert_eq!(Heatmap::axes_of(&over(&heatmap.axes), &environment), Some(heatmap.axes.clone()));
        let turned = [length.clone(), mass.clone()];
        assert_eq!(Heatmap::axes_of(&over(&turned), &environment), Some(turned.clone()));
        let others = set("others", Heatmap::contexts(&heatmap.axes, 2, &fixed));
        assert_eq!(Heatmap::axes_of(&others, &environment), None, "a set of another name");
        let one = set(Heatmap::SET, vec![fixed.clone(), [("gravity".to_owned(), 2.0)].into()]);
        assert_eq!(Heatmap::axes_of(&one, &environment), None, "of one parameter");
        let single = set(Heatmap::SET, vec![fixed.clone()]);
        assert_eq!(Heatmap::axes_of(&single, &environment), None, "of one point");
    }

    #[test]
    fn others_names_the_source_of_the_other_parameters() {
        let heatmap = fixture::heatmap(1, |_, _| (0.0, 0.0));
        assert_eq!(heatmap.others(), "other parameters at their defaults");
        let drawn = Heatmap { base: Version::R, fixed: [("force".to_owned(), 7.5)].into(), ..heatmap };
        assert_eq!(drawn.others(), "force = 7.5, other parameters drawn from R");
    }
}
