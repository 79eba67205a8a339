//! Parameter sets: the parameter values that a policy is trained or tested on. A set is one of an environment's
//! versions D (deterministic), R (random), E (extreme) and R+E, possibly with other values for some parameters.

mod rows;

use std::collections::BTreeMap;
use std::str::FromStr;

use perturb_protocol::limits::DEFAULT_MAX_ENVS;
use perturb_protocol::proto::Interval;
use perturb_protocol::region::Region;
use perturb_protocol::{Distribution, DistributionError, Version, decimal_comma, proto};
use serde::{Deserialize, Serialize};

pub use self::rows::set_of_csv;
use crate::value_error::{ValueError, require};

/// Distributions of parameters by name. Parameters that are not listed have the distribution of their version.
pub type Parameters = BTreeMap<String, Distribution>;
/// A context: fixed values of some parameters, by name. Parameters that are not listed have the distribution of their
/// version.
pub type Context = BTreeMap<String, f64>;

/// Maximal number of contexts in a set for tests. It is limited because the environments of all contexts run together.
pub const MAX_CONTEXTS: usize = DEFAULT_MAX_ENVS;

/// A parameter set that a policy is trained or tested on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TestSet {
    /// The name of the set in results.
    pub name: String,
    /// The version. It has the distributions of all parameters that `contexts` does not list.
    pub version: Version,
    /// The parameters whose values the set determines itself.
    pub contexts: Contexts,
}

/// The parameters that a set lists, with their values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Contexts {
    /// Values are drawn from these distributions for each episode (with RL², for each trial).
    Drawn(Parameters),
    /// Tests use each of these contexts for the same number of episodes. Trainings draw a context for each trial, all
    /// with equal probability. Contexts are the points of a grid or the rows of a file.
    Listed(Vec<Context>),
}

impl From<Version> for TestSet {
    fn from(version: Version) -> Self {
        Self { name: version.to_string(), version, contexts: Contexts::Drawn(Parameters::new()) }
    }
}

impl TestSet {
    /// Returns the set's version if the set lists no parameters of its own, else `None`.
    pub fn plain(&self) -> Option<Version> {
        match &self.contexts {
            Contexts::Drawn(parameters) if parameters.is_empty() => Some(self.version),
            _ => None,
        }
    }

    /// Returns the distributions that replace those of the version in every episode. Empty if the set lists contexts.
    pub fn drawn(&self) -> Parameters {
        match &self.contexts {
            Contexts::Drawn(parameters) => parameters.clone(),
            Contexts::Listed(_) => Parameters::new(),
        }
    }

    /// Returns the distributions that replace those of the version in `context`.
    pub fn parameters(&self, context: &Context) -> Parameters {
        let mut parameters = self.drawn();
        parameters.extend(context.iter().map(|(name, value)| (name.clone(), Distribution::fixed(*value))));
        parameters
    }

    /// Returns the names of the parameters that the set lists. Names may occur several times.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        let (drawn, listed) = match &self.contexts {
            Contexts::Drawn(parameters) => (Some(parameters), None),
            Contexts::Listed(contexts) => (None, Some(contexts)),
        };
        let drawn = drawn.into_iter().flat_map(BTreeMap::keys);
        drawn.chain(listed.into_iter().flatten().flat_map(BTreeMap::keys)).map(String::as_str)
    }

    /// Returns the contexts of the set. If it lists none, returns one empty context.
    pub fn listed(&self) -> Vec<Context> {
        match &self.contexts {
            Contexts::Drawn(_) => vec![Context::new()],
            Contexts::Listed(contexts) => contexts.clone(),
        }
    }

    /// Returns the region of parameter values that the set has in `environment`.
    pub fn region(&self, environment: &proto::Environment) -> Region {
        let of = |context| Region::from_version(environment, self.version, &self.parameters(context));
        Region::new(self.listed().iter().flat_map(|context| of(context).boxes().to_vec()).collect())
    }

    /// Checks that `environment` has the set's parameters and accepts all their values.
    ///
    /// # Errors
    /// [`ValueError`] with the name of the parameter and the accepted values.
    pub fn check(&self, environment: &proto::Environment) -> Result<(), ValueError> {
        match &self.contexts {
            Contexts::Drawn(parameters) => check(&self.name, parameters, environment),
            Contexts::Listed(contexts) => contexts.iter().try_for_each(|context| {
                let fixed = |(name, value): (&String, &f64)| (name.clone(), Distribution::fixed(*value));
                check(&self.name, &context.iter().map(fixed).collect(), environment)
            }),
        }
    }
}

/// Checks that `environment` has these `parameters` and accepts all their values. `set` is the name of the set in error
/// messages.
///
/// # Errors
/// [`ValueError`] with the name of the parameter and the accepted values.
pub fn check(set: &str, parameters: &Parameters, environment: &proto::Environment) -> Result<(), ValueError> {
    for (name, distribution) in parameters {
        let Some(known) = environment.parameter(name) else {
            let what = format!("{set}: a parameter of {}", environment.name);
            return Err(ValueError::new(what, format!("`{name}`"), format!("one of {}", known_names(environment))));
        };
        let (low, high) = distribution.range();
        let what = format!("{set}: {name} of {}", environment.name);
        let expected = format!("within {} … {} {}", known.low, known.high, known.unit);
        require(low >= known.low && high <= known.high, &what, distribution, expected)?;
        let is_empty = |interval: &Interval| interval.low.ceil() > interval.high;
        let is_whole = !known.integer || !distribution.intervals().iter().any(is_empty);
        require(is_whole, what, distribution, "whole numbers, such as 2 or 0..4")?;
    }
    Ok(())
}

/// Lists the names of an environment's parameters and disturbances, for error messages.
pub fn known_names(environment: &proto::Environment) -> String {
    let list = |parameters: &[proto::Parameter]| {
        parameters.iter().map(|parameter| parameter.name.as_str()).collect::<Vec<_>>().join(", ")
    };
    let disturbances = list(&environment.disturbances);
    let own = list(&environment.parameters);
    if disturbances.is_empty() { own } else { format!("{own}, or a disturbance: {disturbances}") }
}

/// Checks that all sets have different names, because results are identified by the name of their set.
///
/// # Errors
/// [`ValueError`] with the name that occurs twice.
pub fn distinct(sets: &[TestSet]) -> Result<(), ValueError> {
    sets.iter().enumerate().try_for_each(|(index, TestSet { name, .. })| {
        let is_new = sets[..index].iter().all(|earlier| earlier.name != *name);
        require(is_new, "a set's name", format!("`{name}` twice"), "another for each set")
    })
}

/// The values of one parameter, as the user writes them: a distribution (`length=0.3..0.4,0.8..0.9` or `mass=0.1`), or
/// points of a grid (`length=0.1..1.0/10` or `length=0.1,0.2,0.5`).
///
/// Two whole numbers without a space, as in `force=7,5`, are rejected, because 7,5 may be a number with a decimal
/// comma. `force=7, 5` has two values.
#[derive(Clone, Debug, PartialEq)]
pub struct Assignment {
    /// The name of the parameter in the catalogue.
    pub parameter: String,
    /// The values of the parameter.
    pub values: Values,
}

/// The values of a parameter: a distribution or a list of points.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// A distribution from which a value is drawn for each episode.
    Drawn(Distribution),
    /// The points of a grid along this parameter.
    Points(Vec<f64>),
}

impl FromStr for Assignment {
    type Err = ValueError;

    fn from_str(text: &str) -> Result<Self, ValueError> {
        let expected = "PARAMETER=VALUES, e.g. length=0.3..0.4,0.8..0.9, mass=0.1 or length=0.1..1.0/10";
        let wrong = || ValueError::new("a set of parameters", format!("`{text}`"), expected);
        let (parameter, values) = text.split_once('=').ok_or_else(wrong)?;
        Ok(Self { parameter: parameter.trim().into(), values: Values::parse(parameter.trim(), values.trim())? })
    }
}

impl Values {
    /// Parses the values of `parameter`.
    fn parse(parameter: &str, text: &str) -> Result<Self, ValueError> {
        if let Some((range, count)) = text.split_once('/') {
            return grid_points(parameter, text, range, count);
        }
        if let Some(decimal) = decimal_comma(text) {
            let expected = format!("{decimal} for one number, or `{}` for two", text.replace(',', ", "));
            return Err(ValueError::new(parameter, format!("`{text}`, which may be one number or two"), expected));
        }
        let points: Option<Vec<f64>> = text.split(',').map(|value| value.trim().parse().ok()).collect();
        match points {
            Some(points) if points.len() > 1 => finite(parameter, text, points).map(Self::Points),
            _ => {
                let refused = |error: DistributionError| ValueError::new(parameter, error.got, error.expected);
                text.parse().map(Self::Drawn).map_err(refused)
            }
        }
    }
}

/// Parses `low..high/count`: `count` points at equal distances from `low` to `high`, both included. The points in
/// between are rounded to twelve significant digits, to get 0.4 and not 0.39999999999999997.
fn grid_points(parameter: &str, text: &str, range: &str, count: &str) -> Result<Values, ValueError> {
    let wrong = || ValueError::new(parameter, format!("`{text}`"), "a grid such as 0.1..1.0/10, of at least 1 point");
    let (low, high) = range.split_once("..").ok_or_else(wrong)?;
    let number = |text: &str| text.trim().parse::<f64>().ok().filter(|number| number.is_finite()).ok_or_else(wrong);
    let (low, high) = (number(low)?, number(high)?);
    let count: usize =
        count.trim().parse().ok().filter(|count| (1..=MAX_CONTEXTS).contains(count)).ok_or_else(wrong)?;
    let point = |index: usize| match index {
        0 => low,
        last if last + 1 == count => high,
        between => rounded(low + (high - low) * (between as f64 / (count - 1) as f64)),
    };
    finite(parameter, text, (0..count).map(point).collect()).map(Values::Points)
}

/// Rounds to twelve significant digits.
fn rounded(number: f64) -> f64 {
    format!("{number:.11e}").parse().unwrap_or(number)
}

fn finite(parameter: &str, text: &str, points: Vec<f64>) -> Result<Vec<f64>, ValueError> {
    require(points.iter().all(|point| point.is_finite()), parameter, format!("`{text}`"), "finite numbers")?;
    Ok(points)
}

/// Makes a set called `name` of the parameters in `assignments`. All other parameters have the distributions of
/// `version`. If a parameter has points, the set is the grid of all combinations, and the first parameter varies
/// fastest. Each of the grid's parameters must then have points or a single value.
///
/// # Errors
/// [`ValueError`] if a parameter occurs twice, a grid contains a parameter that is drawn, or there are more contexts
/// than a server accepts.
pub fn set_of(name: &str, version: Version, assignments: Vec<Assignment>) -> Result<TestSet, ValueError> {
    let is_grid = assignments.iter().any(|assignment| matches!(assignment.values, Values::Points(_)));
    let mut drawn = Parameters::new();
    let mut contexts = vec![Context::new()];
    for Assignment { parameter, values } in assignments {
        let what = format!("{name}: {parameter}");
        let is_new = !drawn.contains_key(&parameter) && !contexts[0].contains_key(&parameter);
        require(is_new, &what, "given twice", "given once")?;
        // The points of this parameter in the grid. Without a grid, the parameter is drawn.
        let points = match values {
            Values::Drawn(distribution) if !is_grid => {
                drawn.insert(parameter, distribution);
                continue;
            }
            Values::Drawn(distribution) => {
                let (low, high) = distribution.range();
                require(low == high, what, distribution, "a value or points, like the grid's other parameters")?;
                vec![low]
            }
            Values::Points(points) => points,
        };
        let count = contexts.len().saturating_mul(points.len());
        let expected = format!("a grid of at most {MAX_CONTEXTS} points");
        require(count <= MAX_CONTEXTS, name, format!("{count} points"), expected)?;
        // Copies every context so far once for each point of this parameter.
        let with = |point: &f64| {
            let add = |context: &Context| {
                let mut context = context.clone();
                context.insert(parameter.clone(), *point);
                context
            };
            contexts.iter().map(add).collect::<Vec<_>>()
        };
        contexts = points.iter().flat_map(with).collect();
    }
    let contexts = if is_grid { Contexts::Listed(contexts) } else { Contexts::Drawn(drawn) };
    Ok(TestSet { name: name.into(), version, contexts })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(texts: &[&str]) -> Result<TestSet, ValueError> {
        let assignments = texts.iter().map(|text| text.parse()).collect::<Result<_, _>>()?;
        set_of("mine", Version::D, assignments)
    }

    fn context(pairs: &[(&str, f64)]) -> Context {
        pairs.iter().map(|&(name, value)| (name.to_owned(), value)).collect()
    }

    #[test]
    fn intervals_are_drawn_from() {
        let set = set(&["length=0.3..0.4,0.8..0.9", "mass=0.1"]).unwrap();
        let Contexts::Drawn(parameters) = &set.contexts else { panic!("{set:?}") };
        assert_eq!(parameters["length"].intervals().len(), 2);
        assert_eq!(parameters["mass"], Distribution::fixed(0.1));
        assert_eq!(set.plain(), None);
        assert_eq!(TestSet::from(Version::E).plain(), Some(Version::E));
    }

    #[test]
    fn points_make_a_grid_of_all_combinations() {
        let set = set(&["length=0.5..1.0/2", "mass=0.1,0.2", "force=7"]).unwrap();
        let expected: Vec<Context> = [(0.5, 0.1), (1.0, 0.1), (0.5, 0.2), (1.0, 0.2)]
            .iter()
            .map(|&(length, mass)| context(&[("length", length), ("mass", mass), ("force", 7.0)]))
            .collect();
        assert_eq!(set.listed(), expected);
        assert_eq!(super::tests::set(&["length=0.5..1.0/1"]).unwrap().listed(), [context(&[("length", 0.5)])]);
    }

    #[test]
    fn points_of_a_grid_are_the_numbers_that_people_mean() {
        let points = |text: &str| match Values::parse("length", text).unwrap() {
            Values::Points(points) => points,
            Values::Drawn(_) => Vec::new(),
        };
        assert_eq!(points("0.1..1.0/10"), [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]);
        assert_eq!(points("0.05..0.5/4"), [0.05, 0.2, 0.35, 0.5]);
        assert_eq!(points("0..1/3"), [0.0, 0.5, 1.0]);
        assert_eq!(points("0.1234567890123456..1/2")[0], 0.1234567890123456, "the ends are what was written");
        assert_eq!(points("2..3/1"), [2.0]);
    }

    #[test]
    fn what_is_no_set_is_refused_with_what_would_be() {
        for (texts, part) in [
            (&["length"][..], "PARAMETER=VALUES"),
            (&["length=x"], "a value, an interval"),
            (&["length=1..2/0"], "a grid such as"),
            (&["length=1/3"], "a grid such as"),
            (&["length=1", "length=2"], "given twice"),
            (&["length=1..2/3", "mass=1..2"], "like the grid's other"),
            (&["length=1..2/200", "mass=1..2/200"], "at most 16384 points"),
            (&["length=1,inf"], "finite"),
            (&["length=-1e308..1e308/3"], "finite"),
        ] {
            let error = set(texts).unwrap_err().to_string();
            assert!(error.contains(part), "{texts:?}: {error}");
        }
    }

    #[test]
    fn decimal_commas_are_refused() {
        for (text, number) in
            [("7,5", "7.5"), ("0,25", "0.25"), ("-7,5", "-7.5"), ("7,5e2", "7.5e2"), ("10,20", "10.20")]
        {
            let error = set(&[&format!("force={text}")]).unwrap_err().to_string();
            let part =
                format!("force is `{text}`, which may be one number or two, but must be {number} for one number");
            assert!(error.contains(&part), "{error}");
        }
        for text in ["7, 5", "7.0,5.0", "7,5,3", "0.1,5", "7,0.5", "1e3,2.5"] {
            assert!(matches!(set(&[&format!("force={text}")]).unwrap().contexts, Contexts::Listed(_)), "{text}");
        }
        for text in ["7,5..8,5", "7..8,5", "0,5..1"] {
            let error = set(&[&format!("force={text}")]).unwrap_err().to_string();
            assert!(error.contains("a decimal point"), "{error}");
        }
    }

    #[test]
    fn names_and_bounds_are_the_catalogues() {
        let length =
            proto::Parameter { name: "length".into(), low: 0.1, high: 2.0, unit: "m".into(), ..Default::default() };
        let environment =
            proto::Environment { name: "CartPole".into(), parameters: vec![length], ..Default::default() };
        assert_eq!(set(&["length=0.1..2"]).unwrap().check(&environment), Ok(()));
        for (text, part) in [
            ("size=1", "`size`, but must be one of length"),
            ("length=1..3", "within 0.1 … 2 m"),
            ("length=1, 3", "is 3, but"),
        ] {
            let error = set(&[text]).unwrap().check(&environment).unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
