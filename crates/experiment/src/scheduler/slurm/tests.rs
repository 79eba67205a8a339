//! Tests of the Slurm backend with a simulated clock and fake Slurm commands. Tests with a real Slurm are in
//! `cli/tests/cli/slurm`.

use std::cell::Cell;
use std::collections::HashMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use perturb_files::interrupt::StopFlag;
use tempfile::TempDir;

use super::super::{Backend, ProgressEvent, RunEnd, RunError, Scheduler};
use super::submission::{self, Submission};
use super::{JobCommand, Jobs, Slurm, SlurmOptions};
use crate::folder::{ExperimentFolder, FailureRecord};
use crate::plan::Plan;

/// A plan with four cells of two kinds.
const PLAN: &str = "environments = ['CartPole', 'Hopper']\nversions = ['D']\nruns = 2
    [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";

/// Returns a plan with four cells of one kind.
fn of_one_kind() -> Plan {
    Plan::parse("test", PLAN.replace(", 'Hopper'", "").replace("runs = 2", "runs = 4")).unwrap()
}

/// The fake `sbatch`. It numbers submissions and adds their jobs to the file `queue`. Then it runs the test's
/// `hook.sh` if there is one. `hook.sh` may change results and the queue. In `hook.sh`, $script is the job script, and
/// $number is the array's number.
const SBATCH: &str = r#"
[ ! -f refusal ] || { cat refusal >&2; exit 1; }
for argument in "$@"; do
    case "$argument" in
        --job-name=*) name=${argument#*=} ;;
        --array=*) last=${argument#*=0-} ;;
    esac
    script=$argument
done
number=$(($(cat number 2>/dev/null || echo 0) + 1))
echo $number >number
for index in $(seq 0 "$last"); do echo "$number|$index|PENDING|Resources||$name" >>queue; done
submission=$(dirname "$script")
[ ! -f hook.sh ] || . ./hook.sh
echo $number"#;

/// Returns options for tests: one cell per job.
pub(super) fn options() -> SlurmOptions {
    SlurmOptions {
        partition: None,
        time: None,
        array_limit: None,
        cells_per_job: Some(1),
        task: JobCommand {
            tasks: Vec::new(),
            program: "/bin/true".into(),
            jobs: 1,
            group: 36,
            workers: 1,
            servers: Vec::new(),
            server_wait: 0,
        },
        queue_interval: Duration::from_secs(15),
    }
}

struct Fake {
    directory: TempDir,
    folder: ExperimentFolder,
    plan: Plan,
    options: SlurmOptions,
    limit: Duration,
    retry_failed: bool,
    /// Number of times that the backend has asked for estimated costs.
    costs: Cell<u32>,
}

/// Writes an executable script with the help of a child process. If this process had the file open for writing, a child
/// process that another test starts at the same moment would inherit the open file, and Linux would refuse to execute
/// it.
pub(super) fn install(path: &Path, text: &str) {
    let mut shell = Command::new("sh")
        .args(["-c", "cat >\"$0.new\" && chmod +x \"$0.new\" && mv \"$0.new\" \"$0\""])
        .arg(path)
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    shell.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
    assert!(shell.wait().unwrap().success());
}

impl Fake {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(&directory.path().join("out"));
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let limit = Duration::from_secs(60);
        let fake =
            Self { directory, folder, plan, options: options(), limit, retry_failed: false, costs: Cell::new(0) };
        fs::create_dir(fake.bin()).unwrap();
        fake.command("sbatch", SBATCH);
        fake.command("squeue", "cat queue 2>/dev/null; true");
        fake.command("scontrol", "echo 'MaxArraySize = 1001'");
        fake
    }

    fn bin(&self) -> PathBuf {
        self.directory.path().join("bin")
    }

    fn command(&self, name: &str, script: &str) {
        let text = format!("#!/bin/sh\n[ \"$1\" != --version ] || exit 0\ncd '{}'\n{script}\n", self.bin().display());
        install(&self.bin().join(name), &text);
    }

    fn hook(&self, script: &str) {
        let done = "done_() { for id in $(echo \"$1\" | tr , ' '); do mkdir -p ../out/cells/$id; \
                    echo x >../out/cells/$id/result.json; done; }
                    says() { echo '{\"cell\":\"'$2'\",\"event\":\"'$3'\"'$4'}' >>\"$submission/$1.jsonl\"; }";
        fs::write(self.bin().join("hook.sh"), format!("{done}\n{script}\n")).unwrap();
    }

    fn slurm(&self) -> Slurm {
        Slurm::in_directory(self.bin(), self.limit)
    }

    /// Runs the scheduler with simulated steps of one second. Calls `watch` for every progress event.
    fn run_with(&self, stop: &StopFlag, watch: &mut dyn FnMut(ProgressEvent<'_>)) -> Result<RunEnd, RunError> {
        let costs = || {
            self.costs.set(self.costs.get() + 1);
            Ok(vec![100.0; self.plan.cells.len()])
        };
        let slurm = self.slurm();
        let mut jobs = Jobs::new(&self.plan, &self.folder, &slurm, &self.options, &costs, stop);
        let retryable = if self.retry_failed { self.folder.failures().unwrap() } else { HashMap::new() };
        let mut scheduler = Scheduler::new(&self.plan, &self.folder, &mut jobs, &retryable, watch);
        let start = Instant::now();
        for second in 0..1000 {
            let stepped = scheduler.step(start + Duration::from_secs(second))?;
            match (stepped, stop.signal()) {
                (Some(failed), _) => return Ok(RunEnd::Finished { failed }),
                (None, Some(signal)) => return Ok(RunEnd::Stopped { signal, left: jobs.stop() }),
                (None, None) => {}
            }
        }
        panic!("it does not end");
    }

    fn run(&self) -> Result<RunEnd, RunError> {
        self.run_with(&StopFlag::default(), &mut |_| {})
    }

    /// Runs until a note contains these words.
    fn run_until(&self, words: &str) -> Result<RunEnd, RunError> {
        let stop = StopFlag::default();
        let raised = stop.clone();
        self.run_with(&stop, &mut |report| match report {
            ProgressEvent::Note(sentence) if sentence.contains(words) => raised.raise(2),
            _ => {}
        })
    }

    fn submissions(&self) -> Vec<Submission> {
        submission::list(&self.folder).unwrap()
    }

    fn ids(&self) -> Vec<String> {
        self.plan.cells.iter().map(|cell| cell.id.clone()).collect()
    }

    fn finish(&self, id: &str) {
        let path = self.folder.cell(id).path().to_owned();
        fs::create_dir_all(&path).unwrap();
        fs::write(path.join("result.json"), "x").unwrap();
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.bin().join(name), text).unwrap();
    }
}

fn finished() -> RunEnd {
    RunEnd::Finished { failed: Vec::new() }
}

fn stopped(arrays: &[&str]) -> RunEnd {
    RunEnd::Stopped { signal: 2, left: arrays.iter().map(|&array| array.to_owned()).collect() }
}

fn singles(ids: &[String]) -> Vec<Vec<String>> {
    ids.iter().map(|id| vec![id.clone()]).collect()
}

#[test]
fn a_second_call_watches_and_submits_only_what_is_new() {
    let mut fake = Fake::new();
    let ids = fake.ids();
    assert_eq!(fake.run_until("submitted 4 cells as Slurm job 1: 4 jobs").unwrap(), stopped(&["1"]));
    assert_eq!(fake.run_until("Slurm job 1 is in the queue, with 4 jobs").unwrap(), stopped(&["1"]));
    assert_eq!(fake.submissions().len(), 1);
    assert_eq!(fake.submissions()[0].jobs, singles(&ids));

    fake.plan = Plan::parse("test", PLAN.replace("runs = 2", "runs = 3")).unwrap();
    assert_eq!(fake.run_until("submitted 2 cells as Slurm job 2").unwrap(), stopped(&["1", "2"]));
    let new: Vec<String> = fake.ids().into_iter().filter(|id| !ids.contains(id)).collect();
    assert_eq!(fake.submissions()[1].jobs, singles(&new));
    let plan = |number: usize| fs::read_to_string(fake.submissions()[number].path.join("plan.toml")).unwrap();
    assert!(plan(0) == PLAN && plan(1) == fake.plan.text, "each array has its own plan");

    fake.ids().iter().for_each(|id| fake.finish(id));
    assert_eq!(fake.run().unwrap(), finished());
    assert_eq!(fake.submissions().len(), 2);
    assert_eq!(fake.costs.get(), 0, "with --cells-per-job nothing is measured");
}

#[test]
fn cells_of_lost_jobs_are_submitted_again() {
    let mut fake = Fake::new();
    (fake.options.cells_per_job, fake.plan) = (None, of_one_kind());
    let ids = fake.ids();
    // Each cell takes an estimated 100 s, so a job gets three cells. The first job loses its node after one cell, and
    // the second job vanishes.
    fake.hook(&format!(
        "if [ $number = 1 ]; then done_ {0}; says 0 {0} done; echo \"1|0|NODE_FAIL|NodeDown|n1|$name\" >queue
         else for cells in $(cat \"$submission/cells.txt\"); do done_ $cells; done; fi",
        ids[0]
    ));
    let mut said = Vec::new();
    let end = fake.run_with(&StopFlag::default(), &mut |report| {
        if let ProgressEvent::Note(sentence) = report {
            said.push(sentence.to_owned());
        }
    });
    assert_eq!(end.unwrap(), finished());
    let jobs: Vec<_> = fake.submissions().into_iter().map(|submission| submission.jobs).collect();
    assert_eq!(jobs, [vec![ids[..3].to_vec(), ids[3..].to_vec()], vec![ids[1..3].to_vec(), ids[3..].to_vec()]]);
    let lost = "3 cells left Slurm's queue without a result (1_0 NODE_FAIL, 1_1 gone)";
    assert!(said.iter().any(|sentence| sentence == lost), "{said:?}");
    assert_eq!(fake.costs.get(), 1);
}

#[test]
fn a_job_has_cells_of_one_kind() {
    let mut fake = Fake::new();
    fake.options.cells_per_job = Some(9);
    let ids = fake.ids();
    fake.hook("for cells in $(cat \"$submission/cells.txt\"); do done_ $cells; done");
    assert_eq!(fake.run().unwrap(), finished());
    assert_eq!(fake.submissions()[0].jobs, [ids[..2].to_vec(), ids[2..].to_vec()]);
}

#[test]
fn job_with_progress_is_resubmitted_whole() {
    for (saved, again) in [(2, 1), (1, 2)] {
        let mut fake = Fake::new();
        (fake.options.cells_per_job, fake.plan) = (Some(2), of_one_kind());
        let ids = fake.ids();
        ids[2..].iter().for_each(|id| fake.finish(id));
        fake.hook(&format!(
            "[ $number -gt 1 ] || for id in {0} {1}; do
                 says 0 $id training ',\"episodes\":1,\"timesteps\":1,\"saved\":1'
                 says 0 $id training ',\"episodes\":2,\"timesteps\":2,\"saved\":{saved}'
             done
             echo \"$number|0|TIMEOUT|TimeLimit|n1|$name\" >queue
             [ $number -lt 2 ] || for cells in $(cat \"$submission/cells.txt\"); do done_ $cells; done",
            ids[0], ids[1]
        ));
        assert_eq!(fake.run().unwrap(), finished());
        let jobs: Vec<usize> = fake.submissions().iter().map(|submission| submission.jobs.len()).collect();
        assert_eq!(jobs, [1, again], "saved {saved}");
    }
}

#[test]
fn cell_without_progress_is_given_up() {
    let fake = Fake::new();
    let ids = fake.ids();
    fake.hook(&format!(
        "rm queue; echo 'no space left' >\"$submission/0.log\"; for cells in $(cat \"$submission/cells.txt\"); do
         [ \"$cells\" = {} ] || done_ $cells; done",
        ids[1]
    ));
    let error = fake.run().unwrap_err();
    let RunError::GaveUp { ids: given_up, .. } = &error else { panic!("{error}") };
    assert_eq!(*given_up, [ids[1].clone()]);
    let message = error.to_string();
    assert!(
        message.starts_with("1 cell without a result after 3 attempts")
            && message.contains("(gone) said `no space left`"),
        "{message}"
    );
    assert_eq!(fake.submissions().len(), 3);
    // A second run tries again.
    fake.hook(&format!("rm queue; done_ {}", ids[1]));
    assert_eq!(fake.run().unwrap(), finished());
    assert_eq!(fake.submissions().len(), 4);
}

#[test]
fn a_training_that_gets_further_each_time_is_not_given_up() {
    let fake = Fake::new();
    let ids = fake.ids();
    ids[1..].iter().for_each(|id| fake.finish(id));
    // The time limit ends the job five times, each time after a new checkpoint.
    fake.hook(&format!(
        "echo \"$number|0|TIMEOUT|TimeLimit|n1|$name\" >queue
         says 0 {0} training ',\"episodes\":1,\"timesteps\":1,\"saved\":'$number
         [ $number -lt 6 ] || done_ {0}",
        ids[0]
    ));
    assert_eq!(fake.run().unwrap(), finished());
    assert_eq!(fake.submissions().len(), 6);
}

#[test]
fn slurms_refusal_is_shown_and_leaves_nothing_behind() {
    let mut fake = Fake::new();
    fake.write("refusal", "sbatch: error: invalid partition specified: x");
    let message = fake.run().unwrap_err().to_string();
    assert_eq!(message, "sbatch refused: sbatch: error: invalid partition specified: x");
    assert!(fake.submissions().is_empty());

    // While other jobs are in the queue, a limit on their number may be the cause of a refusal.
    fs::remove_file(fake.bin().join("refusal")).unwrap();
    assert_eq!(fake.run_until("submitted 4 cells").unwrap(), stopped(&["1"]));
    fake.plan = Plan::parse("test", PLAN.replace("runs = 2", "runs = 3")).unwrap();
    fake.write("refusal", "sbatch: error: QOSMaxSubmitJobPerUserLimit");
    assert_eq!(fake.run_until("QOSMaxSubmitJobPerUserLimit; results are still read").unwrap(), stopped(&["1"]));
    let (stop, refusal) = (StopFlag::default(), fake.bin().join("refusal"));
    let raised = stop.clone();
    let end = fake.run_with(&stop, &mut |report| match report {
        ProgressEvent::Note(sentence) if sentence.contains("MaxSubmit") => fs::remove_file(&refusal).unwrap(),
        ProgressEvent::Note(sentence) if sentence.contains("submitted 2 cells") => raised.raise(2),
        _ => {}
    });
    assert_eq!(end.unwrap(), stopped(&["1", "2"]));
}

#[test]
fn a_silent_slurm_is_no_reason_to_submit_again() {
    let mut fake = Fake::new();
    assert_eq!(fake.run_until("submitted 4 cells").unwrap(), stopped(&["1"]));
    fake.command("squeue", "echo 'slurm_load_jobs error: Unable to contact slurm controller' >&2; exit 1");
    let message = fake.run().unwrap_err().to_string();
    assert_eq!(message, "squeue refused: slurm_load_jobs error: Unable to contact slurm controller");
    let silent = "exec sleep 60";
    fake.command("squeue", silent);
    fake.limit = Duration::from_secs(2); // enough for the fake commands to answer, even on a busy machine
    let message = fake.run().unwrap_err().to_string();
    assert!(message.contains("squeue did not answer within 2 s; is Slurm's controller up?"), "{message}");

    // If Slurm stops answering during the run, results are still found.
    fake.command("squeue", "cat queue");
    let end = fake.run_with(&StopFlag::default(), &mut |report| match report {
        ProgressEvent::Note(sentence) if sentence.contains("is in the queue") => fake.command("squeue", silent),
        ProgressEvent::Note(sentence) if sentence.contains("did not answer") => {
            fake.ids().iter().for_each(|id| fake.finish(id));
        }
        _ => {}
    });
    assert_eq!(end.unwrap(), finished());
    assert_eq!(fake.submissions().len(), 1);
}

#[test]
fn cancelled_job_is_resubmitted_by_the_next_call_only() {
    let fake = Fake::new();
    fake.hook("sed -i s/PENDING/CANCELLED/ queue");
    let message = fake.run().unwrap_err().to_string();
    assert_eq!(message, "Slurm job 1 was cancelled; the same command submits the unfinished cells again: 4 cells");
    assert_eq!(fake.submissions().len(), 1);
    fake.hook("for cells in $(cat \"$submission/cells.txt\"); do done_ $cells; done");
    assert_eq!(fake.run().unwrap(), finished());
    assert_eq!(fake.submissions().len(), 2);
}

#[test]
fn a_submission_without_a_stored_number_is_found_by_its_name() {
    let fake = Fake::new();
    let script = |_: &Path| Ok(String::new());
    let lost = submission::create(&fake.folder, &fake.plan, singles(&fake.ids()), &script).unwrap();
    let line = |index| format!("7|{index}|RUNNING|None|n1|{}\n", lost.names.name);
    fake.write("queue", &(0..4).map(line).collect::<String>());
    assert_eq!(fake.run_until("Slurm job 7 is in the queue").unwrap(), stopped(&["7"]));
    assert_eq!(fake.submissions()[0].names.job.as_deref(), Some("7"));
    // An array with the same name but another number is from a deleted folder, so it is ignored.
    fake.write("queue", &(0..4).map(line).collect::<String>().replace("7|", "8|"));
    assert_eq!(fake.run_until("submitted 4 cells").unwrap(), stopped(&["1"]));
}

#[test]
fn failed_cells_are_tried_again_on_request_only() {
    let mut fake = Fake::new();
    let ids = fake.ids();
    ids[1..].iter().for_each(|id| fake.finish(id));
    let failed = fake.folder.cell(&ids[0]);
    fs::create_dir_all(failed.training()).unwrap();
    let failure =
        FailureRecord { id: ids[0].clone(), reason: "NaN".into(), commit: "x".into(), requires_restart: true };
    failed.write_failure(&failure).unwrap();
    assert_eq!(fake.run().unwrap(), RunEnd::Finished { failed: vec![ids[0].clone()] });
    assert!(fake.submissions().is_empty());
    fake.retry_failed = true;
    fake.hook(&format!("done_ {}", ids[0]));
    assert_eq!(fake.run().unwrap(), finished());
    assert_eq!(fake.submissions()[0].jobs, singles(&ids[..1]));
    assert!(!failed.training().exists(), "from the beginning");
    assert!(!failed.path().join("failure.json").exists());
}

#[test]
fn failed_cell_is_retried_while_its_array_runs() {
    let mut fake = Fake::new();
    (fake.options.cells_per_job, fake.plan) = (Some(4), of_one_kind());
    let ids = fake.ids();
    assert_eq!(fake.run_until("submitted 4 cells as Slurm job 1: 1 job").unwrap(), stopped(&["1"]));
    let failure =
        FailureRecord { id: ids[0].clone(), reason: "NaN".into(), commit: "x".into(), requires_restart: true };
    fake.folder.cell(&ids[0]).write_failure(&failure).unwrap();
    fake.retry_failed = true;
    assert_eq!(fake.run_until("submitted 1 cell as Slurm job 2").unwrap(), stopped(&["1", "2"]));
    assert_eq!(fake.submissions()[1].jobs, singles(&ids[..1]));
    assert!(!fake.folder.cell(&ids[0]).is_settled(true));
}

#[test]
fn two_processes_do_not_submit_the_same_cells() {
    let fake = Fake::new();
    let directory = submission::directory(&fake.folder);
    fs::create_dir_all(&directory).unwrap();
    let lock = fs::File::create(directory.join("lock")).unwrap();
    lock.lock().unwrap();
    let stop = StopFlag::default();
    let raised = stop.clone();
    let mut looks = 0;
    let end = fake.run_with(&stop, &mut |_| {
        looks += 1;
        if looks == 10 {
            raised.raise(2);
        }
    });
    assert_eq!(end.unwrap(), stopped(&[]));
    assert!(fake.submissions().is_empty(), "the other process decides");
}

#[test]
fn a_machine_without_slurm_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let slurm = Slurm::in_directory(directory.path().into(), Duration::from_secs(1));
    let message = slurm.check(&StopFlag::default()).unwrap_err().to_string();
    assert!(message.contains("there is no `sbatch` here") && message.contains("install slurm-client"), "{message}");
    let fake = Fake::new();
    fake.slurm().check(&StopFlag::default()).unwrap();
    fake.command("scontrol", "echo 'MaxArraySize = 0'");
    assert!(fake.run().unwrap_err().to_string().contains("without job arrays"));
    fake.command("scontrol", "echo hello");
    assert!(fake.run().unwrap_err().to_string().contains("scontrol printed `hello`, expected a line MaxArraySize"));
}
