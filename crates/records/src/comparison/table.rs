//! Comparison of conditions whose tests are rows of a results table.

use std::collections::{BTreeMap, BTreeSet};

use perturb_protocol::Version;
use perturb_settings::{ValueError, require};

use super::scores::TestScores;
use super::{ComparedScore, ConditionComparison, TestedCondition, check, compared};
use crate::results_table::{SELECTION_TEST, TableRow};

/// A condition whose tests are rows of a results table. Each training (cell of an experiment) that these rows test
/// gives one policy of the condition. The policies differ only in their seed.
#[derive(Clone, Debug)]
pub struct TableCondition<'a> {
    /// The condition's name. It is freely chosen, but no two conditions may have the same name.
    pub name: String,
    /// The rows. The comparison ignores rows of failed cells, of tests that select a configuration, and of policies
    /// from before the end of their training.
    pub rows: Vec<&'a TableRow>,
}

/// A test of a policy at the end of its training.
#[derive(Clone, Copy)]
struct RowTest<'a> {
    set: &'a str,
    row: &'a TableRow,
}

/// Compares the scores of conditions in the tests on `sets`. With a `baseline`, compares every other condition with the
/// condition of this name. Otherwise compares every pair of conditions.
///
/// If `sets` is `None`, compares on every test set that all policies were tested on. If the rows are from several
/// studies, only tests on versions are compared, because two studies may call different sets by the same name.
///
/// # Errors
/// [`ValueError`] if a condition has no results, two conditions have the same name, or two policies of a condition have
/// the same seed. Also if rows are of several environments or models, a policy was not tested on a set of `sets`, or the
/// baseline is unknown.
pub fn compare_rows(
    conditions: &[TableCondition<'_>],
    sets: Option<&[String]>,
    score: ComparedScore,
    baseline: Option<&str>,
) -> Result<ConditionComparison, ValueError> {
    let tests: Vec<Vec<RowTest<'_>>> = conditions.iter().map(final_tests).collect();
    let names: Vec<_> = conditions.iter().zip(&tests).map(|(it, tests)| (it.name.as_str(), tests.len())).collect();
    check::names(&names, baseline)?;
    one_environment(&tests)?;
    for (condition, tests) in conditions.iter().zip(&tests) {
        one_policy_for_each_seed(&condition.name, tests)?;
    }
    let common = common_sets(&tests);
    let sets = match sets {
        None => common,
        Some(sets) => {
            let unknown = sets.iter().find(|set| !common.contains(set));
            let expected = format!("sets that all policies were tested on: {}", common.join(", "));
            require(unknown.is_none(), "the tests", unknown.map_or("", String::as_str), expected)?;
            sets.to_vec()
        }
    };
    check::sets(&sets)?;
    let tested = |set: &str| {
        conditions.iter().zip(&tests).map(|(it, tests)| condition_tested_on(&it.name, tests, set, score)).collect()
    };
    Ok(ConditionComparison { from_counts: true, ..compared(&sets, score, baseline, tested) })
}

/// Returns a condition's tests of policies at the end of their training. If a cell was tested several times on a set
/// during its training, takes the last test.
fn final_tests<'a>(condition: &TableCondition<'a>) -> Vec<RowTest<'a>> {
    let mut places: BTreeMap<(&str, &str, &str), usize> = BTreeMap::new();
    let mut found: Vec<RowTest<'a>> = Vec::new();
    for &row in &condition.rows {
        let Some(set) = row.tested_on.as_deref().filter(|set| *set != SELECTION_TEST) else { continue };
        let place = *places.entry((&row.study, &row.cell, set)).or_insert(found.len());
        match found.get_mut(place) {
            Some(test) if row.after_episodes > test.row.after_episodes => *test = RowTest { set, row },
            Some(test) if row.after_episodes < test.row.after_episodes => {}
            // If two rows are of the same test, for example from two tables, both are added. `one_policy_for_each_seed`
            // then returns an error.
            _ => found.push(RowTest { set, row }),
        }
    }
    found
}

fn one_environment(tests: &[Vec<RowTest<'_>>]) -> Result<(), ValueError> {
    let of = |row: &TableRow| format!("{} (revision {})", row.environment, row.revision.unwrap_or_default());
    let environments: BTreeSet<String> = tests.iter().flatten().map(|test| of(test.row)).collect();
    let models: BTreeSet<&Option<String>> = tests.iter().flatten().map(|test| &test.row.model_hash).collect();
    let named = environments.iter().cloned().collect::<Vec<_>>().join(", ");
    let expected = "one environment; choose its rows, such as those where environment=CartPole";
    require(environments.len() == 1, "a comparison", format!("in {named}"), expected)?;
    require(models.len() == 1, "a comparison", format!("in several models of {named}"), "in one model")
}

fn one_policy_for_each_seed(condition: &str, tests: &[RowTest<'_>]) -> Result<(), ValueError> {
    let mut seen: BTreeMap<(&str, u64), &TableRow> = BTreeMap::new();
    for RowTest { set, row } in tests {
        let seed = row.seed;
        let Some(other) = seen.insert((set, seed), row) else { continue };
        let what = if condition.is_empty() { "the condition".into() } else { format!("the condition {condition}") };
        let got =
            format!("several policies of seed {seed}, which differ by {}", differing_columns(other, row).join(", "));
        let expected = "one policy for each seed; select fewer rows, or compare by the columns in which they differ";
        return Err(ValueError::new(what, got, expected));
    }
    Ok(())
}

/// Returns the names of the settings in which two policies differ. If all settings are equal, returns `study`.
fn differing_columns(one: &TableRow, other: &TableRow) -> Vec<String> {
    let settings = |row: &TableRow| -> BTreeMap<String, serde_json::Value> {
        serde_json::from_str(&row.settings).unwrap_or_default()
    };
    let [one_settings, other_settings] = [settings(one), settings(other)];
    let names: BTreeSet<&String> = one_settings.keys().chain(other_settings.keys()).collect();
    let differs = |name: &&&String| one_settings.get(**name) != other_settings.get(**name);
    let mut names: Vec<String> = names.iter().filter(differs).map(|name| (**name).clone()).collect();
    if one.trained_on != other.trained_on {
        names.push("trained_on".into());
    }
    if names.is_empty() { vec!["study".into()] } else { names }
}

/// Returns the sets that every policy was tested on: first versions, then other sets in the order of the first
/// condition. If the tests are from several studies, returns only versions, because two studies may call different sets
/// by the same name.
fn common_sets(tests: &[Vec<RowTest<'_>>]) -> Vec<String> {
    let studies: BTreeSet<&str> = tests.iter().flatten().map(|test| test.row.study.as_str()).collect();
    let is_comparable = |set: &str| studies.len() == 1 || set.parse::<Version>().is_ok();
    let is_common = |set: &str| {
        tests.iter().all(|tests| {
            let seeds: BTreeSet<u64> = tests.iter().map(|test| test.row.seed).collect();
            let tested = tests.iter().filter(|test| test.set == set).map(|test| test.row.seed);
            seeds == tested.collect()
        })
    };
    let mut sets: Vec<String> = Vec::new();
    for RowTest { set, .. } in &tests[0] {
        if !sets.iter().any(|known| known == set) && is_comparable(set) && is_common(set) {
            sets.push((*set).to_owned());
        }
    }
    sets.sort_by_key(|set| set.parse::<Version>().map_or(Version::KNOWN.len(), |version| version as usize));
    sets
}

fn condition_tested_on<'a>(
    name: &'a str,
    tests: &[RowTest<'_>],
    set: &str,
    score: ComparedScore,
) -> TestedCondition<'a> {
    let own = tests.iter().filter(|test| test.set == set);
    let (keys, policies) =
        own.filter_map(|test| Some((test.row.seed.to_string(), TestScores::of_row(test.row, score)?))).unzip();
    TestedCondition { name, keys, policies }
}
