//! `perturb audit`: episodes played again, or ledgers read.

mod ledgers;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use serde_json::{Value, json};

use perturb_experiment::Folder;
use perturb_files as files;
use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::Servers;
use perturb_learner::evaluation::{Audit, audit};
use perturb_records::{Assessed, FILE, Records};

use super::args::AuditArgs;
use super::display::{Display, say};
use super::error::{CommandError, Result, system};
use super::rates::file_in;
use super::{lasting_servers, plan_in};

/// So many differences are told of each policy.
const SHOWN: usize = 3;

/// Recorded episodes and the policy that they are of.
#[derive(Clone)]
struct Tested {
    name: String,
    records: PathBuf,
    checkpoint: PathBuf,
}

pub(super) fn run(args: &AuditArgs) -> Result<ExitCode> {
    args.json.check()?;
    let tested = tested(args)?;
    if !args.ledger.is_empty() {
        return ledgers::prove(args, &tested);
    }
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = lasting_servers(&args.server, args.wait)?;
    let most = if args.all { usize::MAX } else { args.episodes };
    let mut audits = Vec::new();
    for one in &tested {
        match one.audit(&servers, most, &stop) {
            // Of one policy, and of one that was stopped, it is the command's error.
            Err(error) if tested.len() == 1 || stop.signal().is_some() => return Err(error),
            audit => audits.push((one.name.as_str(), audit.map_err(|error| error.to_string()))),
        }
        if !args.json.is_printed() {
            audits.last().map_or(Ok(()), |(name, audit)| print(name, audit))?;
        }
    }
    let done = || audits.iter().filter_map(|(_, audit)| audit.as_ref().ok());
    let played: u64 = done().map(|audit| audit.episodes).sum();
    let different: usize = done().map(|audit| audit.different.len()).sum();
    let same = played - different as u64;
    let policies: Vec<_> = audits.iter().map(|(name, audit)| document(name, audit)).collect();
    args.json.write(json!({ "episodes": played, "same": same, "policies": policies }))?;
    if !args.json.is_printed() {
        let recorded = if tested.len() == 1 { "1 policy".to_owned() } else { format!("{} policies", tested.len()) };
        writeln!(std::io::stdout(), "{same} of {played} episodes of {recorded} have the same bytes")?;
    }
    Ok(if different == 0 && done().count() == tested.len() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// What came of a policy, or why it could not be played again.
type Outcome = Result<Audit, String>;

/// Says what is not as it was recorded.
fn print(name: &str, audit: &Outcome) -> std::io::Result<()> {
    let lines = match audit {
        Ok(audit) => &audit.different[..audit.different.len().min(SHOWN)],
        Err(error) => std::slice::from_ref(error),
    };
    lines.iter().try_for_each(|line| writeln!(std::io::stdout(), "{name}: {line}"))
}

fn document(name: &str, audit: &Outcome) -> Value {
    match audit {
        Ok(audit) => json!({ "policy": name, "episodes": audit.episodes, "different": audit.different }),
        Err(error) => json!({ "policy": name, "error": error }),
    }
}

impl Tested {
    fn audit(&self, servers: &Servers, most: usize, stop: &StopFlag) -> Result<Audit> {
        let records = Records::read(&self.records)?;
        let checkpoint = Checkpoint::load(&self.checkpoint)?;
        let episodes = most.min(records.episodes.len()) as u64;
        let mut display = Display::of_episodes(format!("playing {} again", self.name), episodes);
        Ok(audit(servers, &checkpoint, &records, most, stop, &mut |episodes| display.episodes(episodes))?)
    }
}

/// Whatever `args` names.
fn tested(args: &AuditArgs) -> Result<Vec<Tested>> {
    let path = &args.dir;
    let cell = |path: &Path| Tested {
        name: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        records: path.join(FILE),
        checkpoint: path.join("training"),
    };
    if Assessed::is_in(path) {
        return of_assessment(path, &args.checkpoint);
    }
    if let [_, second, ..] = &args.checkpoint[..] {
        let message = format!("--checkpoint has {} beside another: these records are of one policy", second.display());
        return Err(CommandError::Usage(message));
    }
    if let Some(checkpoint) = args.checkpoint.first() {
        let name = path.display().to_string();
        return Ok(vec![Tested { name, records: file_in(path), checkpoint: checkpoint.clone() }]);
    }
    // Of the cell in `path`: its policy, and those of earlier moments.
    let cells = |path: &Path| -> Result<Vec<Tested>> {
        let of_mark = |records: PathBuf| {
            let mark = records.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let name = format!("{} after {mark} episodes", cell(path).name);
            Tested { name, records: records.join(FILE), checkpoint: path.join("training/marks").join(mark) }
        };
        let marks = files::list(&path.join("marks"))?.into_iter().map(of_mark);
        Ok(marks.chain([cell(path)]).collect())
    };
    if path.join(FILE).is_file() {
        return cells(path);
    }
    if !path.exists() {
        return Err(CommandError::Usage(format!(
            "there is no {}: give the --out of `perturb run`, or the --records of `perturb evaluate`",
            path.display()
        )));
    }
    if !path.is_dir() {
        let message = format!("{} is a file of records: give --checkpoint, the policy that was tested", path.display());
        return Err(CommandError::Usage(message));
    }
    let folder = Folder::new(path);
    let plan = plan_in(&folder)?;
    let done = plan.cells.iter().map(|found| folder.cell(&found.id)).filter(|place| place.is_settled(false));
    let paths = done.map(|place| place.path().to_owned()).filter(|path| path.join(FILE).is_file());
    let tested = paths.map(|path| cells(&path)).collect::<Result<Vec<_>>>()?.concat();
    if tested.is_empty() {
        return Err(CommandError::Failed(format!("no cell of {} has recorded episodes", path.display())));
    }
    Ok(tested)
}

/// The policies of an assessment that `checkpoints` have; the others are told.
fn of_assessment(path: &Path, checkpoints: &[PathBuf]) -> Result<Vec<Tested>> {
    let assessed = Assessed::read(path)?;
    let id = |path: &PathBuf| -> Result<(PathBuf, String)> {
        let id = Checkpoint::load(path)?.id().map_err(|reason| CommandError::Failed(format!("{path:?}: {reason}")))?;
        Ok((path.clone(), id))
    };
    let ids = checkpoints.iter().map(id).collect::<Result<Vec<_>>>()?;
    let mut tested = Vec::new();
    for policy in assessed.policies() {
        let (recorded, name) = (&policy.records.about.policy, format!("trained on {}", policy.trained_on()));
        match ids.iter().find(|(_, id)| id == recorded) {
            Some((checkpoint, _)) => {
                tested.push(Tested { name, records: path.join(policy.file_name()), checkpoint: checkpoint.clone() });
            }
            None => say(format_args!(
                "{name}: {recorded} is no checkpoint that was given; Assessment.audit(policy) replays it in Python"
            )),
        }
    }
    if tested.is_empty() {
        let message = format!(
            "no policy of {} can be played here: give the checkpoints of those that perturb trained with --checkpoint",
            path.display()
        );
        return Err(CommandError::Usage(message));
    }
    Ok(tested)
}
