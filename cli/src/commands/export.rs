//! `perturb export`: adds the results of experiments to a table, and stores their policies beside the table.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

use perturb_experiment::{ExperimentFolder, export};
use perturb_files::{require_writable, write_atomically};
use perturb_learner::checkpoint::Checkpoint;
use perturb_records::{MergeCounts, Records, ResultsTable, StudyEpisodes};
use perturb_text::count;

use super::args::ExportArgs;
use super::display::{note, output};
use super::error::{CommandError, Result, system};
use super::plan_in;

/// The name of the folder with stored policies, which is beside a results table.
pub(super) const POLICIES: &str = "policies";

pub(super) fn run(args: &ExportArgs) -> Result<()> {
    let mut table = if args.dirs.is_empty() {
        ResultsTable::read(&args.into)?
    } else {
        require_writable(&args.into)?;
        ResultsTable::read_if_exists(&args.into)?.unwrap_or_default()
    };
    // The folder of each study, by the study's name.
    let mut folders: BTreeMap<String, &Path> = BTreeMap::new();
    for dir in &args.dirs {
        let study = study(args, dir)?;
        if let Some(first) = folders.insert(study.clone(), dir) {
            let message = format!(
                "{} and {} would both be the study {study}: export them one at a time, with --study",
                first.display(),
                dir.display()
            );
            return Err(CommandError::Usage(message));
        }
    }
    for (study, dir) in folders {
        let MergeCounts { added, replaced, unchanged } = add(args, &mut table, &study, dir)?;
        note(format_args!("{study}: {}, {replaced} replaced, {unchanged} unchanged", count(added, "new cell")));
    }
    if !args.dirs.is_empty() {
        table.write(&args.into)?;
    }
    if let Some(path) = &args.csv {
        let failed = |error: perturb_files::AnyError| CommandError::Failed(format!("cannot write CSV: {error}"));
        let csv = table.to_csv().map_err(failed)?;
        if path == Path::new("-") {
            return Ok(std::io::stdout().write_all(&csv)?);
        }
        write_atomically(path, &csv)?;
    }
    let rows = count(table.rows().len(), "row");
    Ok(writeln!(output(), "{} has {rows} of {}", args.into.display(), count_studies(table.studies.len()))?)
}

fn count_studies(studies: usize) -> String {
    if studies == 1 { "1 study".into() } else { format!("{studies} studies") }
}

/// Returns the name of the study for the results in `dir`: --study, or the folder's name.
fn study(args: &ExportArgs, dir: &Path) -> Result<String> {
    if let Some(study) = &args.study {
        return Ok(study.clone());
    }
    let path = dir.canonicalize().map_err(system("find the folder's name"))?;
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
    name.ok_or_else(|| CommandError::Usage(format!("{} has no name: give --study", dir.display())))
}

/// Adds the results of the cells in `dir` to the table. With --policies it also stores their policies and episodes.
fn add(args: &ExportArgs, table: &mut ResultsTable, study: &str, dir: &Path) -> Result<MergeCounts> {
    let folder = ExperimentFolder::new(dir);
    let plan = plan_in(&folder)?;
    let beside = args.into.parent().unwrap_or(Path::new(""));
    let path = StudyEpisodes::path(beside, study);
    let mut episodes = StudyEpisodes::default();
    if args.policies {
        episodes = StudyEpisodes::read_if_exists(&path)?.unwrap_or_default();
    }
    let before = episodes.policies();
    let keep = |id: &str, records: Records| {
        if args.policies && folder.cell(id).training().is_dir() {
            episodes.insert(id, records);
        }
    };
    let rows = export(&plan, &folder, study, keep)?;
    if args.policies {
        let policies = beside.join(POLICIES);
        for cell in plan.cells.iter().chain(&plan.candidates) {
            let training = folder.cell(&cell.id).training();
            if folder.cell(&cell.id).is_settled(false) && training.is_dir() {
                Checkpoint::load(&training)?.save_file(&policies.join(format!("{}.safetensors", cell.id)))?;
            }
        }
        if episodes.policies() > 0 {
            episodes.write(&path)?;
            tracing::debug!("{}: {} policies, {before} before", path.display(), episodes.policies());
        }
    }
    Ok(table.merge(study, plan.for_table(), rows))
}
