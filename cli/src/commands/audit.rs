//! `perturb audit`: replays recorded episodes, or checks ledgers (servers' logs of everything that sessions drew).

mod ledgers;
mod table;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use serde_json::{Value, json};

use perturb_experiment::{ExperimentFolder, Plan};
use perturb_files as files;
use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::Servers;
use perturb_learner::evaluation::{Audit, audit};
use perturb_records::{ExternalEvaluation, FILE, Records};

use super::args::{AuditArgs, ServerArgs};
use super::display::{Display, output, say};
use super::error::{CommandError, Result, system};
use super::rescore::records_file;
use super::{plan_in, reconnecting_servers, with_tasks_of};

/// Maximum number of printed differences of each policy.
const MAX_SHOWN: usize = 3;

/// Number of folders from a cell's folder up to its experiment's folder, both included.
const MAX_DEPTH: usize = 3;

/// A policy with the file of its recorded test episodes.
#[derive(Clone)]
struct RecordedPolicy {
    name: String,
    records: PathBuf,
    checkpoint: PathBuf,
}

/// A policy to audit.
enum AuditedPolicy {
    /// A policy whose recorded episodes are replayed.
    Recorded(RecordedPolicy),
    /// A policy whose tests are repeated and compared with the checksums in a table.
    Stored(Box<table::ChecksummedPolicy>),
}

impl AuditedPolicy {
    fn name(&self) -> &str {
        match self {
            Self::Recorded(policy) => &policy.name,
            Self::Stored(policy) => &policy.name,
        }
    }

    fn audit(&self, servers: &Servers, max_episodes: usize, stop: &StopFlag) -> Result<Audit> {
        match self {
            Self::Recorded(policy) => policy.audit(servers, max_episodes, stop),
            Self::Stored(policy) => policy.audit(servers, stop),
        }
    }
}

pub(super) fn run(args: &AuditArgs) -> Result<ExitCode> {
    args.json.check()?;
    let table = if args.checkpoint.is_empty() { table::table_of(&args.dir)? } else { None };
    let policies: Vec<AuditedPolicy> = match &table {
        Some(_) if !args.ledger.is_empty() => {
            let message =
                "--ledger needs recorded episodes: give the --out folder of `perturb run`, not a results table";
            return Err(CommandError::Usage(message.into()));
        }
        Some((table, cell)) => table::stored_policies(table, cell.as_deref())?
            .into_iter()
            .map(|policy| AuditedPolicy::Stored(Box::new(policy)))
            .collect(),
        None => {
            let recorded = recorded_policies(args)?;
            if !args.ledger.is_empty() {
                return ledgers::prove(args, &recorded);
            }
            recorded.into_iter().map(AuditedPolicy::Recorded).collect::<Vec<_>>()
        }
    };
    // Audit one policy after the other, and print the differences that each audit finds.
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = reconnecting_servers(&server_args(args)?, args.wait, &stop)?;
    let max_episodes = if args.all { usize::MAX } else { args.episodes };
    let mut audits = Vec::new();
    for policy in &policies {
        match policy.audit(&servers, max_episodes, &stop) {
            // If the audit of one of several policies fails, the command goes on with the other policies. An error ends
            // the command if there is only one policy, or if a signal came.
            Err(error) if policies.len() == 1 || stop.signal().is_some() => return Err(error),
            audit => audits.push((policy.name(), audit.map_err(|error| error.to_string()))),
        }
        if !args.json.is_printed() {
            audits.last().map_or(Ok(()), |(name, audit)| print(name, audit))?;
        }
    }
    // Print the totals.
    let finished = || audits.iter().filter_map(|(_, audit)| audit.as_ref().ok());
    let replayed: u64 = finished().map(|audit| audit.episodes).sum();
    let different: usize = finished().map(|audit| audit.different.len()).sum();
    // Each checksum covers a whole test, so the number of differing episodes is not known.
    let same = if table.is_some() && different > 0 { None } else { Some(replayed - different as u64) };
    let documents: Vec<_> = audits.iter().map(|(name, audit)| document(name, audit)).collect();
    args.json.write(json!({ "episodes": replayed, "same": same, "policies": documents }))?;
    if !args.json.is_printed() {
        let count = if policies.len() == 1 { "1 policy".to_owned() } else { format!("{} policies", policies.len()) };
        match same {
            Some(same) => writeln!(output(), "{same} of {replayed} episodes of {count} have the same bytes")?,
            None => writeln!(output(), "{different} tests of {count} differ from the recorded tests")?,
        }
    }
    Ok(if different == 0 && finished().count() == policies.len() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Returns the options of the servers. If the records belong to an experiment, adds the task folders of its plan.
fn server_args(args: &AuditArgs) -> Result<ServerArgs> {
    let path = std::path::absolute(&args.dir).map_err(system("find the absolute path of the records"))?;
    let mut folders = path.ancestors().take(MAX_DEPTH).map(|path| ExperimentFolder::new(path).plan_path());
    match folders.find(|plan| plan.is_file()) {
        Some(plan) => with_tasks_of(&args.server, &Plan::load(&plan)?),
        None => Ok(args.server.clone()),
    }
}

/// The result of auditing a policy, or the reason why its episodes could not be replayed.
type AuditOutcome = Result<Audit, String>;

/// Prints the first differences from the records, or the reason why the episodes could not be replayed.
fn print(name: &str, audit: &AuditOutcome) -> std::io::Result<()> {
    let lines = match audit {
        Ok(audit) => &audit.different[..audit.different.len().min(MAX_SHOWN)],
        Err(error) => std::slice::from_ref(error),
    };
    lines.iter().try_for_each(|line| writeln!(output(), "{name}: {line}"))
}

fn document(name: &str, audit: &AuditOutcome) -> Value {
    match audit {
        Ok(audit) => json!({ "policy": name, "episodes": audit.episodes, "different": audit.different }),
        Err(error) => json!({ "policy": name, "error": error }),
    }
}

impl RecordedPolicy {
    fn audit(&self, servers: &Servers, max_episodes: usize, stop: &StopFlag) -> Result<Audit> {
        let records = Records::read(&self.records)?;
        let checkpoint = Checkpoint::load(&self.checkpoint)?;
        let episodes = max_episodes.min(records.episodes.len()) as u64;
        let mut display = Display::for_episodes(format!("replaying {}", self.name), episodes);
        Ok(audit(servers, &checkpoint, &records, max_episodes, stop, &mut |episodes| display.episodes(episodes))?)
    }
}

/// Finds the policies with recorded episodes that `args` names: those of an assessment, of a file of records, of a
/// cell, or of all finished cells of an experiment.
fn recorded_policies(args: &AuditArgs) -> Result<Vec<RecordedPolicy>> {
    let path = &args.dir;
    let cell = |path: &Path| RecordedPolicy {
        name: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        records: path.join(FILE),
        checkpoint: path.join("training"),
    };
    if ExternalEvaluation::is_in(path) {
        return policies_of_assessment(path, &args.checkpoint);
    }
    if let [_, second, ..] = &args.checkpoint[..] {
        let message =
            format!("--checkpoint has a second path, {}, but these records are of one policy", second.display());
        return Err(CommandError::Usage(message));
    }
    if let Some(checkpoint) = args.checkpoint.first() {
        let name = path.display().to_string();
        return Ok(vec![RecordedPolicy { name, records: records_file(path), checkpoint: checkpoint.clone() }]);
    }
    // Returns the policies of a cell's intermediate evaluations, and then its final policy.
    let policies_of_cell = |path: &Path| -> Result<Vec<RecordedPolicy>> {
        let intermediate = |records: PathBuf| {
            let mark = records.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let name = format!("{} after {mark} episodes", cell(path).name);
            RecordedPolicy { name, records: records.join(FILE), checkpoint: path.join("training/marks").join(mark) }
        };
        let marks = files::list(&path.join("marks"))?.into_iter().map(intermediate);
        Ok(marks.chain([cell(path)]).collect())
    };
    if path.join(FILE).is_file() {
        return policies_of_cell(path);
    }
    if !path.exists() {
        return Err(CommandError::Usage(format!(
            "there is no {}: give the --out folder of `perturb run`, or the --records file of `perturb evaluate`",
            path.display()
        )));
    }
    if !path.is_dir() {
        let message = format!("{} is a file of records: give the tested policy with --checkpoint", path.display());
        return Err(CommandError::Usage(message));
    }
    let folder = ExperimentFolder::new(path);
    let plan = plan_in(&folder)?;
    let finished = plan.cells.iter().map(|cell| folder.cell(&cell.id)).filter(|cell| cell.is_settled(false));
    let paths = finished.map(|cell| cell.path().to_owned()).filter(|path| path.join(FILE).is_file());
    let policies = paths.map(|path| policies_of_cell(&path)).collect::<Result<Vec<_>>>()?.concat();
    if policies.is_empty() {
        return Err(CommandError::Failed(format!("no cell of {} has recorded episodes", path.display())));
    }
    Ok(policies)
}

/// Returns the policies of an assessment that have a checkpoint in `checkpoints`. Prints a line about each other
/// policy.
fn policies_of_assessment(path: &Path, checkpoints: &[PathBuf]) -> Result<Vec<RecordedPolicy>> {
    let assessed = ExternalEvaluation::read(path)?;
    let id = |path: &PathBuf| -> Result<(PathBuf, String)> {
        let id = Checkpoint::load(path)?.id().map_err(|reason| CommandError::Failed(format!("{path:?}: {reason}")))?;
        Ok((path.clone(), id))
    };
    let ids = checkpoints.iter().map(id).collect::<Result<Vec<_>>>()?;
    let mut policies = Vec::new();
    for policy in assessed.policies() {
        let recorded = &policy.records.about.policy;
        let name = format!("trained on {}", policy.trained_on());
        match ids.iter().find(|(_, id)| id == recorded) {
            Some((checkpoint, _)) => {
                policies.push(RecordedPolicy {
                    name,
                    records: path.join(policy.file_name()),
                    checkpoint: checkpoint.clone(),
                });
            }
            None => say(format_args!(
                "{name}: no --checkpoint has the id {recorded}; Assessment.audit(policy) replays it in Python"
            )),
        }
    }
    if policies.is_empty() {
        let message = format!(
            "no policy of {} can be replayed: give the checkpoints of the policies that perturb trained with --checkpoint",
            path.display()
        );
        return Err(CommandError::Usage(message));
    }
    Ok(policies)
}
