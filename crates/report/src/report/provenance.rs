//! The sentences of a report's last section: the scope of the results, and how they were made.

use std::collections::BTreeSet;

use perturb_experiment::{
    Cell, FailureRecord, MethodResults, Plan, Recorded, Results, Selection, Tuned, distinct, elsewhere,
};
use perturb_records::ParameterCheck;
use perturb_records::success::Rule;
use perturb_text::count;

use super::external;
use super::finding::listed;

/// The paper's number of training episodes.
const PAPER_EPISODES: u64 = 15_000;
/// The paper's number of episodes of each test.
const PAPER_TEST_EPISODES: u64 = 1000;
/// Maximum number of failures whose reasons the report shows.
const MAX_REASONS: usize = 3;

/// Returns the sentences of the report's last section. Words of code are between backticks.
pub(super) fn sentences(
    results: &Results<'_>,
    selections: &[MethodResults<'_>],
    recorded: &Recorded,
    checks: &[ParameterCheck],
) -> Vec<String> {
    let (cells, done, failed) = (results.plan.cells.len(), results.done().count(), results.failures().count());
    let mut lines = Vec::new();
    // Adds sentences on finished and failed cells, on the selection of configurations, and on the plan's settings.
    if cells > 0 {
        lines
            .push(format!("{done} of {cells} cells are done, {failed} failed, {} are missing.", cells - done - failed));
        let reason =
            |failure: &FailureRecord| format!("`{}` failed: {}.", failure.id, failure.reason.replace('\n', " "));
        lines.extend(results.failures().take(MAX_REASONS).map(reason));
        if failed > MAX_REASONS {
            lines.push(format!("The table of results has the reasons of all {failed} failures."));
        }
        lines.push(rule(results.plan));
        if results.plan.selection == Selection::Clean {
            lines.extend(selected(&results.tuned()));
        }
        lines.push(settings(results.plan));
    }
    lines.extend(external::sentences(results, selections));
    // Adds a sentence on the table rows for which cells are missing.
    let incomplete = selections.iter().filter(|selection| selection.done < selection.cells).count();
    if incomplete > 0 {
        let rows = selections.iter().filter(|row| !row.method.external).count();
        let (lack, their) = if incomplete == 1 { ("lacks", "its") } else { ("lack", "their") };
        let selected = match results.plan.selection {
            Selection::Paper if results.plan.selects() => {
                format!(", so {their} configurations were selected from incomplete results")
            }
            Selection::Paper | Selection::Clean => String::new(),
        };
        lines.push(format!(
            "{incomplete} of {} {lack} cells{selected}; the column `cells` says which.",
            count(rows, "row")
        ));
    }
    // Adds sentences on the versions of the program, on the checked parameters, and on recorded episodes.
    let commits: BTreeSet<&str> = results.done().flat_map(|result| result.commits()).collect();
    if !commits.is_empty() {
        lines.push(format!("Done by perturb {}.", commits.into_iter().collect::<Vec<_>>().join(", ")));
    }
    lines.extend(agreement(results, selections, checks));
    let (known, selected) = recorded.count();
    if known < selected {
        lines.push(format!(
            "{known} of {selected} selected cells have recorded episodes. Success over a parameter is computed from these."
        ));
    }
    lines.push(
        "Numbers are success rates in percent: mean ± standard deviation over runs; a single run has no standard \
         deviation. The paper's numbers are means over its five runs. A difference is our number minus the paper's. \
         Hopper and HalfCheetah have no differences, because they run on a different physics engine than in the paper."
            .into(),
    );
    lines
}

/// Returns a sentence on the selection rule and the seeds.
fn rule(plan: &Plan) -> String {
    let tuning = seeds(plan.cells.iter().filter(|cell| cell.tuned_as.is_none()));
    match plan.selection {
        Selection::Paper if !plan.selects() => {
            format!("Nothing is selected: each method has one configuration in each environment; {tuning}.")
        }
        Selection::Paper => format!(
            "Selection: `paper`, as published. In each run, the test that selects a configuration is the test that is \
             reported; {tuning}."
        ),
        Selection::Clean => format!(
            "Selection: `clean`. Configurations were selected by {} selection episodes of every training on {tuning}; \
             the reported configurations were trained anew on {}, and tested on other episodes.",
            plan.cells.iter().find_map(|cell| cell.tests.selection).unwrap_or_default(),
            seeds(plan.candidates.iter())
        ),
    }
}

/// Describes the seeds of cells, e.g. "seeds 1 to 5".
fn seeds<'a>(cells: impl Iterator<Item = &'a Cell>) -> String {
    let seeds: BTreeSet<u64> = cells.map(|cell| cell.config.common.seed).collect();
    match (seeds.first(), seeds.last()) {
        (Some(first), Some(last)) if first < last => format!("seeds {first} to {last}"),
        (first, _) => format!("seed {}", first.copied().unwrap_or_default()),
    }
}

/// Returns the number that `of` returns for all cells, or the range of these numbers, e.g. "5 to 9".
fn range(cells: &[Cell], of: fn(&Cell) -> u64) -> String {
    let numbers: BTreeSet<u64> = cells.iter().map(of).collect();
    match (numbers.first(), numbers.last()) {
        (Some(least), Some(most)) if least < most => format!("{least} to {most}"),
        (least, _) => least.map(u64::to_string).unwrap_or_default(),
    }
}

/// Returns sentences about selections that are incomplete: waiting, without a result, or with failed tuning cells.
fn selected(tuned: &[Tuned<'_>]) -> Vec<String> {
    let all = tuned.len();
    let name = |tuned: &Tuned<'_>| format!("{} {} on {}", tuned.environment, tuned.method, tuned.trained_on);
    let names = |of: &dyn Fn(&&Tuned<'_>) -> bool| tuned.iter().filter(of).map(name).collect::<Vec<_>>();
    let waiting = names(&|tuned| !tuned.is_complete());
    let none = names(&|tuned| tuned.is_complete() && tuned.chosen.is_none());
    let partly = tuned.iter().filter_map(|tuned| {
        let chosen = tuned.chosen.filter(|chosen| chosen.seeds < tuned.seeds)?;
        Some(format!("{} ({} of {} tuning seeds)", name(tuned), chosen.seeds, tuned.seeds))
    });
    let partly: Vec<String> = partly.collect();
    let notes = [
        ("wait for tuning cells", waiting),
        ("have nothing to select, since all their tuning cells failed", none),
        ("chose a configuration with failed tuning cells", partly),
    ];
    let notes = notes.into_iter().filter(|(_, names)| !names.is_empty());
    notes.map(|(what, names)| format!("{} of {all} selections {what}: {}.", names.len(), names.join(", "))).collect()
}

/// Returns a sentence on the comparison of requested and applied parameters in recorded test episodes. Returns `None`
/// if no episodes were compared.
fn agreement(results: &Results<'_>, selections: &[MethodResults<'_>], checks: &[ParameterCheck]) -> Option<String> {
    let of_cells: u64 = results.done().flat_map(|result| result.results.values()).map(|test| test.episodes).sum();
    let others: Vec<_> = elsewhere(selections).into_iter().map(|(_, policy, _)| &policy.records).collect();
    let of_others: Vec<_> = others.iter().map(|records| records.agreement()).collect();
    let tested = of_cells + others.iter().map(|records| records.episodes.len() as u64).sum::<u64>();
    let checks = || checks.iter().chain(&of_others);
    let compared: u64 = checks().map(|check| check.episodes).sum();
    let largest = checks().filter_map(|check| check.largest.as_ref());
    let largest = largest.max_by(|a, b| a.relative.total_cmp(&b.relative)).map(|largest| match largest.relative {
        0.0 => "; they were equal".to_owned(),
        relative => format!("; the largest relative difference is {relative:.1e}, of {}", largest.parameter),
    });
    (compared > 0).then(|| {
        let largest = largest.unwrap_or_default();
        format!("Requested and applied parameters were compared in {compared} of {tested} test episodes{largest}.")
    })
}

/// Returns a sentence on budgets, training distributions, presets, test sets and success rules.
fn settings(plan: &Plan) -> String {
    let all = || plan.cells.iter().chain(&plan.candidates);
    let budget = |of: fn(&Cell) -> u64, papers: u64| match range(&plan.cells, of) {
        budget if budget == papers.to_string() => format!("{budget} episodes (as in the paper)"),
        budget => format!("{budget} episodes (the paper's: {papers})"),
    };
    let rule = |cell: &Cell| match &cell.tests.success {
        None | Some(Rule::Text) => "as the paper's text says".to_owned(),
        Some(Rule::Code) => "as the paper's published code judges".to_owned(),
        Some(rule) => format!("by `{rule}`"),
    };
    let names = |of: &dyn Fn(&Cell) -> Vec<String>| listed(&distinct(all().flat_map(of)));
    format!(
        "Trainings of {} on {} with the preset `{}`; tests of {} each on {}; success {}.",
        budget(|cell| cell.config.common.episodes, PAPER_EPISODES),
        names(&|cell| vec![cell.trained_on().to_string()]),
        names(&|cell| vec![cell.method().preset.to_string()]),
        budget(|cell| cell.tests.episodes, PAPER_TEST_EPISODES),
        names(&|cell| cell.tests.sets.iter().map(|set| set.name.clone()).collect()),
        names(&|cell| vec![rule(cell)]),
    )
}
