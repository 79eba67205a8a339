//! `perturb rates`.

use std::io::Write;
use std::path::{Path, PathBuf};

use serde_json::json;

use perturb_records::success::Criterion;
use perturb_records::{FILE, Records, TestResult};
use perturb_text::Table;

use super::args::RatesArgs;
use super::error::{CommandError, Result};
use super::require_file;
use super::sets::spelled_rule;

/// What to give.
const REMEDY: &str = "give the --records of `perturb evaluate`, or a cell of `perturb run`";

pub(super) fn run(args: &RatesArgs) -> Result<()> {
    args.json.check()?;
    let file = file_in(&args.file);
    require_file(&file, REMEDY)?;
    let records = Records::read(&file)?;
    let about = &records.about;
    let Some(own) = &about.success else {
        let message = format!("{} does not say what its episodes achieved: test again", args.file.display());
        return Err(CommandError::Failed(message));
    };
    let criteria: Vec<Criterion> = match &args.success[..] {
        [] => vec![own.clone()],
        rules => {
            let (text, code) = (about.text_success.as_ref().unwrap_or(own), about.code_success.as_ref());
            let criterion = |rule| about.criterion(&spelled_rule(rule, Some(text), code)?);
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
    let table = Table::of("", &rows)
        .text("tested on", |(set, ..)| set)
        .text("success", |(_, criterion, _)| criterion)
        .number("episodes", |(.., result)| result.episodes)
        .number("success, %", |(.., result)| format!("{:.1}", result.success_percent))
        .number("95 % interval", |(.., result)| {
            let [low, high] = result.success_percent_95;
            format!("{low:.1} … {high:.1}")
        });
    writeln!(std::io::stdout(), "{}, policy {}\n{}", about.environment, about.policy, table.build().to_text())?;
    Ok(())
}

/// The recorded episodes in `path`, which may be the folder that holds them.
pub(super) fn file_in(path: &Path) -> PathBuf {
    if path.is_dir() { path.join(FILE) } else { path.to_owned() }
}
