//! Test sets, parameters and success rules from the command line. Their names may be written in any case.

use std::collections::BTreeMap;
use std::path::Path;

use perturb_files::read;
use perturb_learner::proto::Environment;
use perturb_protocol::{Version, names};
use perturb_records::success::{Criterion, Rule, Threshold};
use perturb_settings::ValueError;
use perturb_settings::sets::{Assignment, Contexts, TestSet, known_names, set_of, set_of_csv};

use super::args::SetArgs;
use super::error::{CommandError, Result};
use super::require_file;

/// Name of the test set that --parameters makes.
const PARAMETERS_SET: &str = "parameters";

/// Returns the sets to test on: `versions`, and the set of --parameters or --contexts. Returns D, R and E if none of
/// these is given.
pub(super) fn test_sets(versions: &[Version], args: &SetArgs) -> Result<Vec<TestSet>> {
    let mut versions = versions.to_vec();
    versions.sort_unstable();
    versions.dedup();
    let mut sets: Vec<TestSet> = versions.into_iter().map(TestSet::from).collect();
    if !args.parameters.is_empty() {
        sets.push(set_of(PARAMETERS_SET, args.base_version, args.parameters.clone())?);
    }
    if let Some(path) = &args.contexts {
        let set = listed_set(args.base_version, path)?;
        if set.name.parse::<Version>().is_ok() {
            let message = format!("{}: rename the file, because {} is the name of a version", path.display(), set.name);
            return Err(CommandError::Usage(message));
        }
        sets.push(set);
    }
    Ok(if sets.is_empty() { Version::ALL.map(TestSet::from).to_vec() } else { sets })
}

/// Reads the set of --contexts from a CSV file. The file determines the set's name.
pub(super) fn listed_set(version: Version, path: &Path) -> Result<TestSet> {
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    require_file(path, "give a CSV file whose header names parameters, with a row for each context")?;
    Ok(set_of_csv(&name, version, &read(path)?)?)
}

/// Returns the set of `version` in which the values of --parameters replace those of the version. Refuses grids.
pub(super) fn drawn_set(version: Version, parameters: &[Assignment]) -> Result<TestSet> {
    if parameters.is_empty() {
        return Ok(version.into());
    }
    let set = set_of(PARAMETERS_SET, version, parameters.to_vec())?;
    match set.contexts {
        Contexts::Drawn(_) => Ok(set),
        Contexts::Listed(_) => Err(CommandError::Usage(
            "--parameters must not have the points of a grid here; give values or intervals, e.g. length=0.8..0.9"
                .into(),
        )),
    }
}

/// Returns the name of an environment's parameter. `written` may be in any case. `option` is the option's name in the
/// error message.
///
/// # Errors
/// [`ValueError`] if there is no such parameter. The message suggests a similar name.
pub(super) fn parameter<'a>(option: &str, written: &str, environment: &'a Environment) -> Result<&'a str, ValueError> {
    let all = environment.parameters.iter().chain(&environment.disturbances);
    let known = all.map(|parameter| parameter.name.as_str());
    names::find(written, known.clone()).and_then(|index| known.clone().nth(index)).ok_or_else(|| {
        let hint = names::did_you_mean(written, known);
        ValueError {
            what: format!("{option}: a parameter of {}", environment.name),
            got: format!("`{written}`"),
            expected: format!("one of {}{hint}", known_names(environment)),
        }
    })
}

/// Returns `values` with the parameters' names as `environment` spells them.
///
/// # Errors
/// See [`parameter`]. Also if a parameter is given twice in different spellings.
pub(super) fn normalize<T>(
    option: &str,
    values: BTreeMap<String, T>,
    environment: &Environment,
) -> Result<BTreeMap<String, T>, ValueError> {
    let mut normalized = BTreeMap::new();
    for (written, value) in values {
        let name = parameter(option, &written, environment)?;
        if normalized.insert(name.to_owned(), value).is_some() {
            let got = "given twice".into();
            let expected = "given once".into();
            return Err(ValueError { what: format!("{option}: {name}"), got, expected });
        }
    }
    Ok(normalized)
}

/// Calls [`normalize`] for the parameters or the contexts of a set.
pub(super) fn normalize_set(set: TestSet, environment: &Environment) -> Result<TestSet, ValueError> {
    let TestSet { name, version, contexts } = set;
    let contexts = match contexts {
        Contexts::Drawn(parameters) => Contexts::Drawn(normalize(&name, parameters, environment)?),
        Contexts::Listed(contexts) => {
            let contexts = contexts.into_iter().map(|context| normalize(&name, context, environment));
            Contexts::Listed(contexts.collect::<Result<_, _>>()?)
        }
    };
    Ok(TestSet { name, version, contexts })
}

/// Returns the rule with its quantity spelled as in `text` or `code`, the two success rules of the environment.
///
/// # Errors
/// [`ValueError`] if neither rule has such a quantity. The message suggests a similar name.
pub(super) fn normalize_rule(
    rule: &Rule,
    text: Option<&Criterion>,
    code: Option<&Criterion>,
) -> Result<Rule, ValueError> {
    let Rule::At(Threshold { quantity, value }) = rule else { return Ok(rule.clone()) };
    let known = text.into_iter().chain(code).map(|criterion| criterion.quantity.as_str());
    if let Some(name) = names::find(quantity, known.clone()).and_then(|index| known.clone().nth(index)) {
        return Ok(Rule::At(Threshold { quantity: name.to_owned(), value: *value }));
    }
    let hint = names::did_you_mean(quantity, known);
    let with_hint = |error: ValueError| ValueError { expected: format!("{}{hint}", error.expected), ..error };
    rule.criterion(text, code).map(|_| rule.clone()).map_err(with_hint)
}

#[cfg(test)]
mod tests {
    use perturb_learner::proto::Parameter;
    use perturb_records::success::Side;

    use super::*;

    fn cart_pole() -> Environment {
        let parameters = ["force", "length", "mass"].map(|name| Parameter { name: name.into(), ..Default::default() });
        Environment { name: "CartPole".into(), parameters: parameters.into(), ..Default::default() }
    }

    #[test]
    fn parameters_may_be_spelled_in_any_case() {
        let set = |texts: &[&str]| {
            let assignments = texts.iter().map(|text| text.parse().unwrap()).collect();
            normalize_set(set_of("own", Version::D, assignments).unwrap(), &cart_pole())
        };
        assert_eq!(set(&["Length=0.5", "MASS=1, 2"]).unwrap(), set(&["length=0.5", "mass=1, 2"]).unwrap());
        assert_eq!(set(&["Length=0.5..1"]).unwrap(), set(&["length=0.5..1"]).unwrap());
        let refused = set(&["lenght=1"]).unwrap_err().to_string();
        let words = "own: a parameter of CartPole is `lenght`, but must be one of force, length, mass";
        assert_eq!(refused, format!("{words} (did you mean `length`?)"));
        let twice = set(&["Length=1", "length=2"]).unwrap_err().to_string();
        assert_eq!(twice, "own: length is given twice, but must be given once");
    }

    #[test]
    fn thresholds_may_be_spelled_in_any_case() {
        let quantity = "steps".to_owned();
        let unit = "1".into();
        let side = Side::AtLeast;
        let text = Criterion { quantity, unit, side, threshold: 100.0, most: None };
        let code = Criterion { quantity: "steps_in_a_row".into(), ..text.clone() };
        let read =
            |rule: &str| normalize_rule(&rule.parse().unwrap(), Some(&text), Some(&code)).map(|rule| rule.to_string());
        for (written, rule) in [("STEPS=90", "steps=90"), ("Steps-in-a-row=9", "steps_in_a_row=9"), ("code", "code")] {
            assert_eq!(read(written).unwrap(), rule);
        }
        let refused = read("step=3").unwrap_err().to_string();
        assert_eq!(
            refused,
            "the success threshold is step=3, but must be a threshold for steps, e.g. steps=100 (did you mean `steps`?)"
        );
        let unknown = normalize_rule(&"steps=3".parse().unwrap(), None, None).unwrap_err().to_string();
        assert!(unknown.contains("does not report the quantity of its success rule"), "{unknown}");
    }
}
