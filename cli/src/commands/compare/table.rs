//! `perturb compare` of results tables.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use perturb_experiment::Plan;
use perturb_records::comparison::{ComparedScore, TableCondition, compare_rows};
use perturb_records::{ResultsTable, StudyPlan, TableError, TableRow};
use perturb_report::EnvironmentComparison;

use super::{ComparisonWithRule, default_name, split};
use crate::commands::args::CompareArgs;
use crate::commands::display::note;
use crate::commands::error::{CommandError, Result};

/// A table, and the study whose rows are compared; `None` means all studies.
type StudyTable = (ResultsTable, Option<String>);

/// Compares rows of results tables. Returns `None` if no path of the conditions is a results table.
pub(super) fn comparison(args: &CompareArgs, score: ComparedScore) -> Result<Option<ComparisonWithRule>> {
    let mut others = 0;
    let mut conditions = Vec::new();
    for text in &args.conditions {
        let (name, paths) = split(text);
        let tables = paths.iter().map(|path| table_at(path)).collect::<Result<Vec<_>>>()?;
        others += tables.iter().filter(|table| table.is_none()).count();
        let is_named = name.is_some();
        let name = name.map_or_else(|| default_name(&paths), str::to_owned);
        conditions.push((name, is_named, tables.into_iter().flatten().collect::<Vec<StudyTable>>()));
    }
    check_options(args, conditions.iter().any(|(_, _, tables)| !tables.is_empty()), others > 0)?;
    if others > 0 {
        return Ok(None);
    }
    let is_only = conditions.len() == 1;
    let mut compared: Vec<TableCondition<'_>> = Vec::new();
    let mut chosen: Vec<(&ResultsTable, &TableRow)> = Vec::new();
    for (name, is_named, tables) in &conditions {
        let mut groups: BTreeMap<String, usize> = BTreeMap::new();
        for (table, study) in tables {
            for (group, rows) in table.choose(study.as_deref(), &args.filters, &args.by)? {
                let name = match &group[..] {
                    "" => name.clone(),
                    group if is_only && !is_named => group.to_owned(),
                    group => format!("{name} {group}"),
                };
                chosen.extend(rows.iter().map(|&row| (table, row)));
                let place = *groups.entry(group).or_insert(compared.len());
                match compared.get_mut(place) {
                    Some(known) => known.rows.extend(rows),
                    None => compared.push(TableCondition { name, rows }),
                }
            }
        }
        if groups.is_empty() {
            let studies: BTreeSet<&str> =
                tables.iter().flat_map(|(it, _)| it.studies.keys()).map(String::as_str).collect();
            let studies = studies.into_iter().collect::<Vec<_>>().join(", ");
            return Err(CommandError::Usage(format!(
                "no row of {name} is chosen; the studies of the table are {studies}"
            )));
        }
    }
    let rows = || compared.iter().flat_map(|condition| &condition.rows);
    let failed = rows().filter(|row| row.failure.is_some()).count();
    if failed > 0 {
        note(format!("{failed} failed cells are left out"));
    }
    let success = success_rule(&chosen, !args.versions.is_empty())?;
    let environment = rows().next().map(|row| row.environment.clone()).unwrap_or_default();
    let sets: Vec<String> = args.versions.iter().map(ToString::to_string).collect();
    let sets = (!sets.is_empty()).then_some(&sets[..]);
    let comparison = compare_rows(&compared, sets, score, args.baseline.as_deref())?;
    Ok(Some((EnvironmentComparison { environment, comparison }, success)))
}

/// Returns the results table that `path` names. Returns `None` for any other path, also for a Parquet file of recorded
/// episodes.
fn table_at(path: &Path) -> Result<Option<StudyTable>> {
    match ResultsTable::find(path) {
        Ok(found) => Ok(found.map(|(_, table, study)| (table, Some(study).filter(|study| !study.is_empty())))),
        Err(TableError::Damaged { path: file, .. }) if file == path => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Refuses a mixture of results tables and other paths, and options that do not apply to the kind of the given paths.
fn check_options(args: &CompareArgs, has_tables: bool, has_others: bool) -> Result<()> {
    let refused = |message: &str| Err(CommandError::Usage(message.into()));
    if has_tables && has_others {
        return refused("results tables have no episodes; compare them with results tables alone");
    }
    if has_others && !(args.filters.is_empty() && args.by.is_empty()) {
        return refused("--where and --by choose rows of results tables, and other policies were given");
    }
    let tests = args.success.is_some() || !args.set.parameters.is_empty() || args.set.contexts.is_some();
    if has_tables && tests {
        return refused(
            "rows of results tables are not tested again; leave out --success, --parameters and --contexts",
        );
    }
    Ok(())
}

/// Returns the success rule of the cells of `rows`; `None` if it is the environment's default rule. `rows` pairs each
/// row with its table, because two tables may contain different studies of the same name. `names_sets` tells whether
/// the user has named the sets to compare.
///
/// # Errors
/// [`CommandError::Usage`] if the rules differ, or if the tables have different plans of one study and `names_sets` is
/// false.
fn success_rule(rows: &[(&ResultsTable, &TableRow)], names_sets: bool) -> Result<Option<String>> {
    let mut plans: Vec<(&str, &StudyPlan, Plan)> = Vec::new();
    let mut rules = BTreeSet::new();
    for (table, row) in rows {
        let Some(text) = table.studies.get(&row.study) else { continue };
        let known = plans.iter().position(|(study, known, _)| *study == row.study && *known == text);
        if known.is_none() {
            plans.push((&row.study, text, Plan::of_study(&row.study, text)?));
        }
        let (.., plan) = &plans[known.unwrap_or(plans.len() - 1)];
        let cell = plan.cells.iter().chain(&plan.candidates).find(|cell| cell.id == row.cell);
        rules.insert(cell.and_then(|cell| cell.tests.success.as_ref()).map(ToString::to_string));
    }
    let studies: BTreeSet<&str> = plans.iter().map(|(study, ..)| *study).collect();
    if rules.len() > 1 {
        let studies = studies.into_iter().collect::<Vec<_>>().join(", ");
        return Err(CommandError::Usage(format!("the studies {studies} have different rules of success")));
    }
    if plans.len() > studies.len() && !names_sets {
        return Err(CommandError::Usage(
            "the tables have different plans of one study, whose sets may differ; name the versions to compare with \
             --versions, such as --versions D,R,E"
                .into(),
        ));
    }
    Ok(rules.into_iter().next().flatten())
}
