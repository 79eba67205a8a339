//! Pictures of the heatmaps of an experiment and of agents that were trained outside of the experiment: one for each
//! environment, [kind of heatmap](HeatmapKind) and method.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;

use perturb_experiment::{
    ExperimentFolder, FolderError, HeatmapPlace, HeatmapRecord, MethodResults, NoHeatmap, Reported, distinct,
    heatmap_kinds, heatmap_places,
};
use perturb_files::{delete, list};
use perturb_protocol::Version;
use perturb_records::{Heatmap, HeatmapKind, HeatmapPoint, TrainedOn};
use perturb_settings::Method;
use perturb_text::{Table, count};

use super::pictures::{Picture, PictureDrawing, file_name};
use crate::heatmap_policies::points_table;
use crate::plot::{HeatmapColumn, HeatmapPanels, PlotError, common_returns};

/// The pictures of all heatmaps of a report. There is a picture for each environment, [kind of heatmap](HeatmapKind)
/// and method. A picture has a column for each training distribution, which shows the mean over runs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HeatmapPictures {
    /// The pictures that have at least one heatmap.
    pub pictures: Vec<Picture>,
    /// Number of heatmaps, including missing ones.
    pub total: usize,
    /// The reason for each missing heatmap.
    pub missing: Vec<NoHeatmap>,
}

/// A picture without its colour scale. All pictures of an environment share a colour scale, which depends on all of
/// their heatmaps. The scale is therefore known only after all drafts are made.
struct Draft<'a> {
    environment: &'a str,
    method: &'a Method,
    kind: Option<&'a HeatmapKind>,
    columns: Vec<PictureColumn<'a>>,
}

/// The policies of a picture with the same training distribution, and the mean of their heatmaps.
struct PictureColumn<'a> {
    trained_on: TrainedOn<'a>,
    /// Number of policies, including those without a heatmap.
    policies: usize,
    origins: Vec<Origin>,
    missing: Vec<(u32, NoHeatmap)>,
    mean: Option<Heatmap>,
}

/// The heatmap of a policy, or the reason why there is none.
#[derive(Clone)]
struct ShownPolicy<'a> {
    trained_on: TrainedOn<'a>,
    run: u32,
    content: Result<(Heatmap, Origin), NoHeatmap>,
}

/// The seed of the test and the program that made a heatmap, for the caption.
#[derive(Clone)]
struct Origin {
    seed: u64,
    /// The program's version and commit; `None` if they are not known.
    commit: Option<String>,
}

/// Returns the pictures of all heatmaps of the policies in `selections`. Heatmaps of cells are read from `folder`, an
/// experiment's folder. Heatmaps of agents that were trained outside of the experiment come from their recorded tests.
/// A picture without any heatmap is left out.
///
/// # Errors
/// [`FolderError`] if a file exists but cannot be read.
pub fn heatmap_pictures(
    selections: &[MethodResults<'_>],
    folder: Option<&ExperimentFolder>,
) -> Result<HeatmapPictures, FolderError> {
    let places = heatmap_places(selections);
    let of_cells = folder.map_or_else(|| Ok(BTreeMap::new()), |folder| heatmap_kinds(folder, &places))?;
    let mut all = HeatmapPictures::default();
    for rows in selections.chunk_by(|a, b| a.environment == b.environment) {
        let environment = rows[0].environment;
        let places: Vec<_> = places.iter().filter(|place| place.environment == environment).collect();
        let elsewhere: Vec<_> = rows.iter().map(|row| (&row.method, shown_elsewhere(row))).collect();
        let kinds_elsewhere = elsewhere.iter().flat_map(|(_, shown)| shown.iter().map(|(kind, _)| kind));
        // Collects the kinds of all heatmaps in this environment.
        let kinds: BTreeSet<&HeatmapKind> =
            of_cells.get(environment).into_iter().flatten().chain(kinds_elsewhere).collect();
        let mut kinds: Vec<Option<&HeatmapKind>> = kinds.into_iter().map(Some).collect();
        if kinds.is_empty() {
            kinds.push(None);
        }
        let mut drafts = Vec::new();
        for kind in kinds {
            for places in places.chunk_by(|a, b| a.method == b.method) {
                let shown =
                    places.iter().map(|place| read_heatmap(place, folder, kind)).collect::<Result<Vec<_>, _>>()?;
                drafts.push(Draft::new((environment, places[0].method), kind, shown));
            }
            for (method, shown) in &elsewhere {
                let shown = shown.iter().filter(|(of, _)| Some(of) == kind).map(|(_, shown)| shown.clone());
                drafts.push(Draft::new((environment, method), kind, shown.collect()));
            }
        }
        // All pictures of an environment have the same colour scale for returns.
        drafts.retain(|draft| !draft.columns.is_empty());
        let means = drafts.iter().flat_map(|draft| &draft.columns).filter_map(|column| column.mean.as_ref());
        let returns = common_returns(environment, means);
        all.pictures.extend(drafts.iter().filter_map(|draft| draft.picture(&returns)));
        let columns = || drafts.iter().flat_map(|draft| &draft.columns);
        all.total += columns().map(|column| column.policies).sum::<usize>();
        all.missing.extend(columns().flat_map(|column| column.missing.iter().map(|(_, why)| *why)));
    }
    Ok(all)
}

/// Reads the heatmap of a cell's policy.
fn read_heatmap<'a>(
    place: &HeatmapPlace<'a>,
    folder: Option<&ExperimentFolder>,
    kind: Option<&HeatmapKind>,
) -> Result<ShownPolicy<'a>, FolderError> {
    let read = match folder.zip(kind) {
        Some((folder, kind)) => place.read(folder, kind)?,
        None => Err(if place.selected.is_some() { NoHeatmap::NotMade } else { NoHeatmap::NoResult }),
    };
    let origin = |record: HeatmapRecord| Origin { seed: record.options.seed, commit: Some(record.commit) };
    let content = read.map(|stored| (stored.heatmap, origin(stored.record)));
    Ok(ShownPolicy { trained_on: place.trained_on, run: place.run, content })
}

/// Returns the heatmaps of an agent that was trained outside of the experiment, ordered by training distribution, then
/// run. Returns an empty list if the row is not of such an agent.
fn shown_elsewhere<'a>(row: &MethodResults<'a>) -> Vec<(HeatmapKind, ShownPolicy<'a>)> {
    let mut all = Vec::new();
    for (&run, of_run) in &row.runs {
        for (&trained_on, reported) in &of_run.selected {
            let Some(Reported::External(_, policy)) = reported else { continue };
            let Some(heatmap) = Heatmap::from_recorded_test(&policy.records) else { continue };
            let origin = Origin { seed: policy.known.seed, commit: None };
            all.push((heatmap.kind(), ShownPolicy { trained_on, run, content: Ok((heatmap, origin)) }));
        }
    }
    all.sort_by_key(|(_, shown)| (shown.trained_on, shown.run));
    all
}

impl<'a> Draft<'a> {
    /// Returns the draft of a picture. `shown` must be ordered by training distribution.
    fn new(
        (environment, method): (&'a str, &'a Method),
        kind: Option<&'a HeatmapKind>,
        shown: Vec<ShownPolicy<'a>>,
    ) -> Self {
        let mut columns: Vec<PictureColumn<'a>> = Vec::new();
        // All heatmaps of a picture must have the same points as the first one.
        let mut first: Option<Heatmap> = None;
        for shown in shown.chunk_by(|a, b| a.trained_on == b.trained_on) {
            let (trained_on, policies) = (shown[0].trained_on, shown.len());
            let (mut origins, mut missing, mut heatmaps) = (Vec::new(), Vec::new(), Vec::new());
            for ShownPolicy { run, content, .. } in shown.iter().cloned() {
                match content {
                    Ok((heatmap, origin)) => {
                        let alike = [first.get_or_insert_with(|| heatmap.clone()).clone(), heatmap.clone()];
                        if Heatmap::mean(&alike).is_some() {
                            origins.push(origin);
                            heatmaps.push(heatmap);
                        } else {
                            missing.push((run, NoHeatmap::NotAlike));
                        }
                    }
                    Err(why) => missing.push((run, why)),
                }
            }
            columns.push(PictureColumn { trained_on, policies, origins, missing, mean: Heatmap::mean(&heatmaps) });
        }
        Self { environment, method, kind, columns }
    }

    /// Finishes the picture with the colour scale `returns` for mean returns. Returns `None` if there is no heatmap.
    fn picture(&self, returns: &Range<f64>) -> Option<Picture> {
        let Self { environment, method, kind, columns } = self;
        let kind = (*kind)?;
        let first = columns.iter().find_map(|column| column.mean.as_ref())?;
        let HeatmapKind { parameters: [x, y], base } = kind;
        let drawn = if *base == Version::D { String::new() } else { format!(", the others drawn from {base}") };
        let name = format!("{environment}, {method}: mean return and success over {x} and {y}{drawn}");
        let tested = format!("{0} × {0} points of {1}", first.grid, count(first.episodes as usize, "episode"));
        Some(Picture {
            environment: (*environment).to_owned(),
            file: format!("{environment}-{}-heatmap-{kind}", file_name(method)),
            caption: self.caption(&name, &tested),
            name,
            drawing: PictureDrawing::Heatmaps(HeatmapPanels {
                title: vec![format!("{environment}, {method}"), format!("{tested} of each policy; {}", first.others())],
                axes: first.axes.clone(),
                returns: returns.clone(),
                columns: columns.iter().map(PictureColumn::panel).collect(),
            }),
            data: self.table(kind),
        })
    }

    /// Returns the caption. It names the subject, the runs, the seeds of the tests, and the programs that made the
    /// heatmaps.
    fn caption(&self, of: &str, tested: &str) -> String {
        let origins = || self.columns.iter().flat_map(|column| &column.origins);
        let seeds: BTreeSet<u64> = origins().map(|origin| origin.seed).collect();
        let commits: BTreeSet<&str> = origins().filter_map(|origin| origin.commit.as_deref()).collect();
        let columns: Vec<String> = self.columns.iter().map(PictureColumn::description).collect();
        format!(
            "{of}. Means over runs: {}. {tested} of each policy, test {} {}.{}",
            columns.join("; "),
            if seeds.len() == 1 { "seed" } else { "seeds" },
            listed(seeds),
            if commits.is_empty() { String::new() } else { format!(" perturb {}.", listed(commits)) }
        )
    }

    /// Returns the numbers of the picture as a table with a row for each column and grid point.
    fn table(&self, kind: &HeatmapKind) -> Table {
        let of_column = |column: &'_ PictureColumn<'a>| {
            let (trained_on, runs) = (column.trained_on.to_string(), column.origins.len());
            let points = column.mean.iter().flat_map(|mean| mean.points.clone());
            points.map(move |point| (trained_on.clone(), runs, point)).collect::<Vec<_>>()
        };
        let lines: Vec<(String, usize, HeatmapPoint)> = self.columns.iter().flat_map(of_column).collect();
        points_table(["train", "runs"], kind.parameters.clone(), &lines)
    }
}

impl PictureColumn<'_> {
    /// Returns the column for drawing.
    fn panel(&self) -> HeatmapColumn {
        let content = self.mean.clone().ok_or_else(|| joined_reasons(self.missing.iter()));
        HeatmapColumn { caption: format!("trained on {}, {}", self.trained_on, self.runs()), content }
    }

    /// Returns the number of averaged runs as text, e.g. "2 of 3 runs".
    fn runs(&self) -> String {
        match (self.origins.len(), self.policies) {
            (there, all) if there == all => count(all, "run"),
            (there, all) => format!("{there} of {}", count(all, "run")),
        }
    }

    /// Describes the column's runs, with the reasons for missing heatmaps.
    fn description(&self) -> String {
        let runs = format!("{} trained on {}", self.runs(), self.trained_on);
        let why = |(run, why): &(u32, NoHeatmap)| format!("run {run}: {why}");
        match self.missing.iter().map(why).collect::<Vec<_>>() {
            missing if missing.is_empty() => runs,
            missing => format!("{runs} ({})", missing.join(", ")),
        }
    }
}

impl HeatmapPictures {
    /// Returns sentences that say how many heatmaps are missing and how to make them.
    pub(super) fn advice(&self) -> Vec<String> {
        let waiting = self.missing.iter().filter(|why| **why == NoHeatmap::NoResult).count();
        let (makeable, all) = (self.missing.len() - waiting, self.total);
        let make = format!(
            "Missing heatmaps: {makeable} of {all}. `perturb heatmap DIR` makes them, where DIR is the folder \
             of these results; `--x` and `--y` choose the parameters, `--base-version` the version of the others."
        );
        let wait = format!("Heatmaps that wait for the results of their trainings: {waiting} of {all}.");
        let notes = [(makeable, make), (waiting, wait)].into_iter().filter(|(count, _)| *count > 0);
        notes.map(|(_, advice)| advice).collect()
    }
}

/// Writes all pictures into the folder `out`. Deletes old heatmap pictures in `out` that are not among the new ones.
/// Returns the names of the written files without extensions.
///
/// # Errors
/// [`PlotError`] if a picture cannot be drawn or a file cannot be written.
pub fn save_heatmaps<'a>(all: &'a HeatmapPictures, out: &Path) -> Result<Vec<&'a str>, PlotError> {
    all.pictures.iter().try_for_each(|picture| picture.save(out))?;
    let written: Vec<&str> = all.pictures.iter().map(|picture| picture.file.as_str()).collect();
    for path in list(out)? {
        let name = path.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        if name.contains("-heatmap-") && !written.contains(&name.as_str()) {
            delete(&path)?;
        }
    }
    Ok(written)
}

/// Joins the different reasons for missing heatmaps.
fn joined_reasons<'a>(missing: impl Iterator<Item = &'a (u32, NoHeatmap)>) -> String {
    distinct(missing.map(|(_, why)| why.to_string())).join("; ")
}

/// Joins items with commas.
fn listed(items: impl IntoIterator<Item = impl ToString>) -> String {
    items.into_iter().map(|item| item.to_string()).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
#[path = "heatmap_pictures_tests.rs"]
mod tests;
