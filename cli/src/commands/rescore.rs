//! `perturb rescore`: applies other success rules to recorded test episodes.

use std::io::Write;
use std::path::{Path, PathBuf};

use serde_json::json;

use perturb_records::success::Criterion;
use perturb_records::{FILE, Records, TestResult};
use perturb_text::Table;

use super::args::RescoreArgs;
use super::by::table_by;
use super::display::output;
use super::error::{CommandError, Result};
use super::require_file;
use super::sets::normalize_rule;

/// Advice in the error about a missing file.
const REMEDY: &str = "give the --records of `perturb evaluate`, or a cell of `perturb run`";

pub(super) fn run(args: &RescoreArgs) -> Result<()> {
    args.json.check()?;
    let file = records_file(&args.file);
    require_file(&file, REMEDY)?;
    let records = Records::read(&file)?;
    let about = &records.about;
    let Some(tested) = &about.success else {
        let message =
            format!("{} does not record what its episodes achieved; test again with this version", args.file.display());
        return Err(CommandError::Failed(message));
    };
    // The success rules to apply: those of --success, or else the rule of the test.
    let criteria: Vec<Criterion> = match &args.success[..] {
        [] => vec![tested.clone()],
        rules => {
            let text = about.text_success.as_ref().unwrap_or(tested);
            let code = about.code_success.as_ref();
            let criterion = |rule| about.criterion(&normalize_rule(rule, Some(text), code)?);
            rules.iter().map(criterion).collect::<Result<_, _>>()?
        }
    };
    let mut rows: Vec<(&str, &Criterion, TestResult)> = Vec::new();
    for test in &about.tests {
        let name = test.set.name.as_str();
        rows.extend(criteria.iter().map(|criterion| (name, criterion, records.result(name, Some(criterion)))));
    }
    if args.json.json.is_some() {
        let rows =
            rows.iter().map(|(set, success, result)| json!({ "set": set, "success": success, "result": result }));
        let rates: Vec<_> = rows.collect();
        let document = json!({ "environment": about.environment, "policy": about.policy, "rates": rates });
        args.json.write(document)?;
    }
    if args.json.is_printed() {
        return Ok(());
    }
    let table = Table::builder("", &rows)
        .text("tested on", |(set, ..)| set)
        .text("success", |(_, criterion, _)| criterion)
        .number("episodes", |(.., result)| result.episodes)
        .number("success, %", |(.., result)| format!("{:.1}", result.success_percent))
        .number("95 % interval", |(.., result)| {
            let [low, high] = result.success_percent_95;
            format!("{low:.1} … {high:.1}")
        });
    let mut out = output();
    writeln!(out, "{}, policy {}\n{}", about.environment, about.policy, table.build().to_text())?;
    if let Some(by) = &args.by {
        for criterion in &criteria {
            writeln!(out, "\nsuccess: {criterion}\n{}", table_by(&records, Some(criterion), by)?.to_text())?;
        }
    }
    Ok(())
}

/// Returns the file of recorded episodes at `path`. If `path` is a folder, the file is in it.
pub(super) fn records_file(path: &Path) -> PathBuf {
    if path.is_dir() { path.join(FILE) } else { path.to_owned() }
}
