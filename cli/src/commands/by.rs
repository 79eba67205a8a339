//! Option --by: tables of test results by context or by the value of a parameter, the worst first.

use perturb_learner::proto::Environment;
use perturb_records::outcomes::{Outcomes, bins};
use perturb_records::statistics::{mean, wilson};
use perturb_records::success::Criterion;
use perturb_records::{EpisodeRecord, Records};
use perturb_settings::ValueError;
use perturb_settings::sets::Contexts;
use perturb_text::Table;

use super::error::{CommandError, Result};
use super::sets::parameter;

/// Value of --by that groups the episodes of a grid or a list by their contexts.
const CONTEXT: &str = "context";

/// The episodes of a test in one context, or with one value or bin of a parameter.
struct ValueGroup<'a> {
    set: &'a str,
    label: String,
    episodes: Vec<&'a EpisodeRecord>,
    successes: u64,
}

/// Returns the value of --by with the parameter's name as `environment` spells it.
///
/// # Errors
/// [`ValueError`] if it is neither a parameter nor `context`.
pub(super) fn checked_by(by: &str, environment: &Environment) -> Result<String, ValueError> {
    if by == CONTEXT { Ok(by.to_owned()) } else { Ok(parameter("--by", by, environment)?.to_owned()) }
}

/// Returns a table of the success in each test, grouped by `by`: a parameter's name, or `context`.
///
/// A grid or a list has a row for each value of the parameter. If the parameter is drawn, its range is divided into
/// about ten equal bins, and each bin with episodes has a row. Tests in which the parameter has a single value are left
/// out. The rows of a test are ordered by success rate and then by mean return, lowest first.
///
/// # Errors
/// [`CommandError::Usage`] if there is no such parameter, or if no test is left. For `context`, no test is left if none
/// is on a grid or a list.
pub(super) fn table_by(records: &Records, criterion: Option<&Criterion>, by: &str) -> Result<Table> {
    let mut rows = Vec::new();
    for test in &records.about.tests {
        let set = test.set.name.as_str();
        let episodes: Vec<&EpisodeRecord> = records.episodes_on(set).collect();
        let mut groups: Vec<ValueGroup<'_>> = labels(records, set, by, &test.set.contexts)?
            .into_iter()
            .map(|(label, places)| {
                let episodes: Vec<_> = places.into_iter().map(|place| episodes[place]).collect();
                let is_success = |episode: &&&EpisodeRecord| {
                    criterion.map_or(episode.success, |it| it.holds(records.achieved(episode, it)))
                };
                let successes = episodes.iter().filter(is_success).count() as u64;
                ValueGroup { set, label, episodes, successes }
            })
            .collect();
        groups.sort_by(|a, b| a.rate().total_cmp(&b.rate()).then(a.mean_return().total_cmp(&b.mean_return())));
        rows.append(&mut groups);
    }
    if rows.is_empty() {
        let hint = match by {
            CONTEXT => "name a parameter, or test on a grid or a list",
            _ => "it has one value in each test",
        };
        return Err(CommandError::Usage(format!("--by {by}: no test can be divided by it: {hint}")));
    }
    let table = Table::builder("", &rows)
        .text("tested on", |row| row.set)
        .text(by, |row| &row.label)
        .number("episodes", |row| row.episodes.len())
        .number("success, %", |row| format!("{:.1}", row.rate()))
        .number("95 % interval", |row| {
            let (low, high) = wilson(row.successes, row.episodes.len() as u64);
            format!("{:.1} … {:.1}", 100.0 * low, 100.0 * high)
        })
        .number("mean return", |row| format!("{:.2}", row.mean_return()));
    Ok(table.build())
}

impl ValueGroup<'_> {
    fn rate(&self) -> f64 {
        100.0 * self.successes as f64 / self.episodes.len() as f64
    }

    fn mean_return(&self) -> f64 {
        mean(self.episodes.iter().map(|episode| episode.episode_return))
    }
}

/// Groups the episodes of a test by `by`. Returns the label of each group with the positions of its episodes in the
/// test, in the order of the values. The result is empty if all episodes have the same value of the parameter. For
/// `context`, it is empty if the test is not on a grid or a list.
fn labels(records: &Records, set: &str, by: &str, contexts: &Contexts) -> Result<Vec<(String, Vec<usize>)>> {
    let outcomes = Outcomes::new(records, set);
    if by == CONTEXT {
        let Contexts::Listed(listed) = contexts else { return Ok(Vec::new()) };
        let label = |index: usize| {
            let values = listed[index].iter().map(|(name, value)| format!("{name} {value}"));
            values.collect::<Vec<_>>().join(", ")
        };
        let of_context = outcomes.contexts.unwrap_or_default();
        let places = |index: usize| (0..of_context.len()).filter(|place| of_context[*place] == index).collect();
        return Ok((0..listed.len()).map(|index| (label(index), places(index))).collect());
    }
    let names: Vec<&str> = records.about.parameters.iter().map(|it| it.name.as_str()).collect();
    let Some(parameter) = names.iter().position(|name| *name == by) else {
        let message = format!("--by {by}: there is no such parameter; give context or one of {}", names.join(", "));
        return Err(CommandError::Usage(message));
    };
    let values = &outcomes.parameters[parameter];
    let within = |low: f64, high: f64| -> Vec<usize> {
        (0..values.len()).filter(|&place| low <= values[place] && values[place] <= high).collect()
    };
    if matches!(contexts, Contexts::Listed(_)) {
        let mut distinct = values.clone();
        distinct.sort_by(f64::total_cmp);
        distinct.dedup();
        let several = if distinct.len() > 1 { distinct } else { Vec::new() };
        return Ok(several.into_iter().map(|value| (value.to_string(), within(value, value))).collect());
    }
    let mut counted = vec![false; values.len()];
    let mut found = Vec::new();
    for bin in bins(std::iter::once(&outcomes), parameter) {
        // A value on the edge between two bins belongs to the lower bin, so that each episode counts once.
        let mut places = within(bin.low, bin.high);
        places.retain(|&place| !counted[place]);
        places.iter().for_each(|&place| counted[place] = true);
        if !places.is_empty() {
            found.push((format!("{:.4} … {:.4}", bin.low, bin.high), places));
        }
    }
    Ok(found)
}
