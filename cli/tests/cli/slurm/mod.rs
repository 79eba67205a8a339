//! A plan on a real Slurm cluster of two nodes, one of which fails. Needs Debian's packages slurmctld, slurmd,
//! slurm-client and munge, and the program `perturb-server`. `make slurm-test` installs and builds them.

mod cluster;

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};
use std::time::{Duration, Instant};

use perturb_experiment::{Cell, ExperimentFolder, Plan};
use perturb_learner::client::PrivateServer;
use tempfile::TempDir;

use self::cluster::Cluster;
use crate::common::{kill, perturb, stderr, wait_within};

/// Environment variable that decides about a missing Slurm. If it is set, the tests fail. If it is not set, they are
/// skipped.
const REQUIRED: &str = "PERTURB_SLURM_REQUIRED";
/// Environment variable with the path of an experiment file to use in place of [`PLAN`], e.g. experiments/quick.toml.
const PLAN_FILE: &str = "PERTURB_SLURM_PLAN";
/// Upper bound of every wait.
const LIMIT: Duration = Duration::from_secs(1800);

/// A plan with eight cells of a few seconds on a free core, and several checkpoints per second.
const PLAN: &str = "
environments = ['CartPole', 'MountainCar']
versions = ['D', 'E']
test_episodes = 30
settings = { episodes = 400, checkpoint_interval = 10 }

[[algorithm]]
name = 'a2c'
architectures = ['ff']

[[algorithm]]
name = 'ppo'
architectures = ['ff']
";

struct Experiment {
    directory: TempDir,
    file: PathBuf,
    plan: Plan,
}

impl Experiment {
    fn new() -> Self {
        let text = |path| fs::read_to_string(&path).unwrap_or_else(|error| panic!("{path:?}: {error}"));
        Self::with_plan(&std::env::var_os(PLAN_FILE).map_or_else(|| PLAN.to_owned(), text))
    }

    fn with_plan(text: &str) -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let file = directory.path().join("file.toml");
        fs::write(&file, text).expect("written");
        let plan = Plan::load(&file).unwrap_or_else(|error| panic!("{error}"));
        Self { directory, file, plan }
    }

    fn out(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    fn run(&self, name: &str, arguments: &[&str]) -> Command {
        let mut command = perturb(&["run"]);
        command.arg(&self.file).arg("--out").arg(self.out(name)).args(arguments);
        // With this filter the log says whether a training begins or resumes.
        command.env("RUST_LOG", "warn,perturb_learner::training=debug");
        command
    }

    fn on(&self, cluster: &Cluster, name: &str, arguments: &[&str]) -> Command {
        let mut command = self.run(name, &[&["--engine", "slurm"], arguments].concat());
        command.env("SLURM_CONF", cluster.configuration());
        command
    }

    fn cell(&self, name: &str, id: &str) -> PathBuf {
        ExperimentFolder::new(&self.out(name)).cell(id).path().to_owned()
    }

    fn result(&self, id: &str) -> PathBuf {
        self.cell("slurm", id).join("result.json")
    }

    /// Returns the bytes of all results.
    fn results(&self, name: &str) -> BTreeMap<&str, Vec<u8>> {
        let read = |id| fs::read(self.cell(name, id).join("result.json")).ok();
        self.plan.cells.iter().filter_map(|cell| Some((&*cell.id, read(&cell.id)?))).collect()
    }

    /// Returns the logs of the cells' processes. The log of a group is in the folder of its first cell.
    fn logs(&self, name: &str) -> String {
        let log = |cell: &Cell| fs::read_to_string(self.cell(name, &cell.id).join("log.txt")).unwrap_or_default();
        self.plan.cells.iter().map(log).collect()
    }

    /// Returns the number of log lines that contain `words` and a cell's id.
    fn said(&self, name: &str, id: &str, words: &str) -> usize {
        self.logs(name).lines().filter(|line| line.contains(words) && line.contains(&format!("/{id}/"))).count()
    }

    /// Returns the output and the files of `perturb report`.
    fn report(&self, name: &str) -> BTreeMap<String, Vec<u8>> {
        let page = self.out("page.html");
        let mut command = perturb(&["report"]);
        let output = command.arg(self.out(name)).arg("--html").arg(&page).output().expect("ended");
        assert!(output.status.success(), "{}", stderr(&output));
        let mut files =
            BTreeMap::from([("text".into(), output.stdout), ("page".into(), fs::read(page).expect("read"))]);
        for entry in fs::read_dir(self.out(name).join("report")).expect("a folder").flatten() {
            files.insert(entry.file_name().to_string_lossy().into_owned(), fs::read(entry.path()).expect("read"));
        }
        files
    }

    /// Returns the ids of the cells in each job of the run's only job array.
    fn jobs(&self, name: &str) -> Vec<Vec<String>> {
        let text = fs::read_to_string(self.out(name).join("slurm/1/cells.txt")).expect("a list");
        text.lines().map(|line| line.split(',').map(str::to_owned).collect()).collect()
    }
}

fn end(child: Child) -> Output {
    child.wait_with_output().expect("ended")
}

/// Returns the inode and the modification time of a file, which differ if the file is written again.
fn identity(path: &Path) -> Option<(u64, i64, i64)> {
    fs::metadata(path).ok().map(|data| (data.ino(), data.mtime(), data.mtime_nsec()))
}

/// Prints a message of the test in a way that cargo does not hide, in contrast to `println!`.
fn say(sentence: &str) {
    let _ = writeln!(std::io::stderr(), "{sentence}");
}

/// Tells whether Slurm is missing. Panics if it is missing although [`REQUIRED`] is set.
fn is_missing() -> bool {
    let Some(missing) = Cluster::missing() else { return false };
    assert!(std::env::var_os(REQUIRED).is_none(), "{missing}, but {REQUIRED} is set: use `make slurm-test`");
    say(&format!("the test with a real Slurm is skipped: {missing}; `make slurm-test` installs it"));
    true
}

#[test]
fn a_plan_survives_the_loss_of_a_node() {
    if is_missing() {
        return;
    }
    let experiment = Experiment::new();
    let start = Instant::now();
    let whole = end(experiment.run("whole", &["--jobs", "2"]).spawn().expect("started"));
    assert!(whole.status.success(), "{}", stderr(&whole));
    let local_seconds = start.elapsed().as_secs();
    let mut cluster = Cluster::start();
    refusals(&experiment, &cluster);

    let start = Instant::now();
    let mut run = interrupted_and_begun_again(&experiment, &cluster);
    let victim = in_mid_training_on_n1(&experiment, &cluster, &mut run);
    cluster.kill_node(1);
    let killed_after = start.elapsed().as_secs();
    let results = || experiment.results("slurm").into_keys();
    let done: Vec<_> = results().map(|id| (id, identity(&experiment.result(id)))).collect();
    assert!(!done.iter().any(|(id, _)| *id == victim), "{victim} was done before the node died");

    let output = end(run);
    let said = stderr(&output);
    assert!(output.status.success(), "{said}\n{}", cluster.logs());
    assert!(said.contains("is in the queue, with ") && said.contains(" cells are done"), "{said}");
    let seconds = start.elapsed().as_secs();
    same_results_and_report(&experiment);
    let moved = job_that_moved(&experiment);
    assert!(experiment.jobs("slurm")[moved].contains(&victim));
    nothing_was_done_twice(&experiment, &victim, &experiment.jobs("slurm")[moved], done);
    say(&format!(
        "{} cells in {} jobs: {seconds} s on two nodes, n1 killed after {killed_after} s, job {moved} went to n2, \
         where {victim} went on from its checkpoint; {local_seconds} s locally, and the report is the same",
        experiment.plan.cells.len(),
        experiment.jobs("slurm").len(),
    ));
    shared_server(&experiment, &cluster);
}

/// Interrupts a run with Ctrl-C and starts it again. The jobs continue to run, and the second command watches them.
fn interrupted_and_begun_again(experiment: &Experiment, cluster: &Cluster) -> Child {
    let arguments = ["--cells-per-job", "2", "--time", "2:00:00"];
    let first = experiment.on(cluster, "slurm", &arguments).spawn().expect("started");
    wait_within(LIMIT, "jobs on both nodes", || ["n1", "n2"].iter().all(|node| !cluster.running_on(node).is_empty()));
    kill("-INT", first.id());
    let first = end(first);
    assert_eq!(first.status.code(), Some(130), "{}", stderr(&first));
    assert!(stderr(&first).contains("to cancel it: scancel "), "{}", stderr(&first));
    experiment.on(cluster, "slurm", &arguments).spawn().expect("started")
}

/// Waits until the training of a cell runs on node n1, and returns the cell's id. The training is in the first half of
/// its episodes, so it will not end before the node is killed.
fn in_mid_training_on_n1(experiment: &Experiment, cluster: &Cluster, run: &mut Child) -> String {
    let jobs = experiment.jobs("slurm");
    let in_work = |id: &String| {
        let cell = experiment.cell("slurm", id);
        let budget = experiment.plan.find(id).map_or(0, |cell| cell.config.common.episodes as usize);
        let log = fs::read_to_string(cell.join("training/monitor.csv"));
        let trained = log.map_or(0, |text| text.lines().count());
        (3..budget / 2).contains(&trained) && cell.join("training/checkpoint/checkpoint.json").exists()
    };
    let mut victim = None;
    wait_within(LIMIT, "a training on n1", || {
        let cells = cluster.running_on("n1").into_iter().flat_map(|job| jobs[job].clone());
        victim = cells.into_iter().find(in_work);
        let ended = run.try_wait().expect("its status");
        assert!(
            victim.is_some() || ended.is_none(),
            "no training on n1 was seen in its first half before all had ended"
        );
        victim.is_some()
    });
    victim.expect("a cell")
}

/// Checks that the results and the report equal those of a local run, byte for byte.
fn same_results_and_report(experiment: &Experiment) {
    assert_eq!(experiment.results("whole").len(), experiment.plan.cells.len());
    assert!(experiment.results("slurm") == experiment.results("whole"), "results differ");
    let whole = experiment.report("whole");
    let slurm = experiment.report("slurm");
    assert!(whole.keys().eq(slurm.keys()));
    for (name, content) in &whole {
        assert!(*content == slurm[name], "{name} differs");
    }
}

/// Returns the index of the job that Slurm moved to the other node. Checks that no job was submitted twice.
fn job_that_moved(experiment: &Experiment) -> usize {
    assert!(!experiment.out("slurm/slurm/2").exists());
    let moved: Vec<usize> = (0..experiment.jobs("slurm").len())
        .filter(|job| {
            let log = fs::read_to_string(experiment.out(&format!("slurm/slurm/1/{job}.log"))).expect("a log");
            log.contains("on n1, restarted 0 times") && log.contains("on n2, restarted 1 times")
        })
        .collect();
    assert_eq!(moved.len(), 1);
    moved[0]
}

/// The id of a cell, with the inode and the modification time of its result if there is one.
type DoneCell<'a> = (&'a str, Option<(u64, i64, i64)>);

/// Checks that finished cells were kept, and that the interrupted training resumed from its checkpoint.
fn nothing_was_done_twice(experiment: &Experiment, victim: &str, moved: &[String], done: Vec<DoneCell<'_>>) {
    for (id, before) in done {
        assert_eq!(identity(&experiment.result(id)), before, "{id} was written again");
    }
    let told = |job| fs::read_to_string(experiment.out(&format!("slurm/slurm/1/{job}.jsonl"))).expect("lines");
    let told: String = (0..experiment.jobs("slurm").len()).map(told).collect();
    for cell in &experiment.plan.cells {
        let said = |words: &str| experiment.said("slurm", &cell.id, words);
        // The warning about a missing checkpoint also contains the folder's name, and does not count.
        let begun = said("training begins directory=");
        let gone_on = said("training goes on directory=");
        if cell.id == victim {
            assert_eq!((begun, gone_on), (1, 1), "{}", cell.id);
        } else {
            // Other trainings of the moved job may begin or resume a second time.
            let most = 1 + usize::from(moved.contains(&cell.id));
            let logs = experiment.logs("slurm");
            assert!(
                (1..=most).contains(&(begun + gone_on)),
                "{}: {begun} + {gone_on}, not 1 to {most}\n{logs}",
                cell.id
            );
        }
        let done = format!(r#"{{"cell":"{}","event":"done"}}"#, cell.id);
        assert_eq!(told.lines().filter(|line| **line == done).count(), 1, "{}", cell.id);
    }
}

/// Checks that an error message of Slurm and the refusal of a wrong option are printed, and that no files are left.
fn refusals(experiment: &Experiment, cluster: &Cluster) {
    for (option, value, words) in
        [("--partition", "nowhere", "invalid partition"), ("--array-limit", "0", "expected a whole number, at least 1")]
    {
        let arguments = ["--cells-per-job", "2", option, value];
        let output = end(experiment.on(cluster, "refused", &arguments).spawn().expect("started"));
        assert!(!output.status.success());
        assert!(stderr(&output).contains(words), "{}", stderr(&output));
    }
    assert!(!experiment.out("refused/slurm/1").exists());
}

#[test]
fn jobs_serve_the_task_folders_of_a_plan() {
    if is_missing() {
        return;
    }
    let cluster = Cluster::start();
    let tasks = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/tasks");
    let experiment = Experiment::with_plan(&format!(
        "tasks = ['{0}/reaching_arm', '{0}/quadruped']\nenvironments = ['ReachingArm', 'Quadruped']\nversions = ['R']
        test_episodes = 10\nsettings = {{ episodes = 20, num_envs = 4 }}
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']",
        tasks.display()
    ));
    let whole = end(experiment.run("whole", &[]).spawn().expect("started"));
    assert!(whole.status.success(), "{}", stderr(&whole));
    let output = end(experiment.on(&cluster, "slurm", &["--cells-per-job", "1"]).spawn().expect("started"));
    assert!(output.status.success(), "{}\n{}", stderr(&output), cluster.logs());
    assert_eq!(experiment.results("slurm").len(), 2);
    assert!(experiment.results("slurm") == experiment.results("whole"), "results differ");
    say("a plan over two tasks from folders has the same results on Slurm");
}

/// Checks a run whose job runs on the remaining node and uses the server given by --server. Without --cells-per-job,
/// the run estimates the number of cells in a job.
fn shared_server(experiment: &Experiment, cluster: &Cluster) {
    let server = PrivateServer::start(None).unwrap_or_else(|error| panic!("{error}"));
    let id = &experiment.plan.cells[0].id;
    // The first cell remains to be run, because the others get results here.
    for cell in &experiment.plan.cells[1..] {
        let from = experiment.cell("slurm", &cell.id);
        let to = experiment.cell("shared", &cell.id);
        fs::create_dir_all(&to).expect("a folder");
        fs::copy(from.join("result.json"), to.join("result.json")).expect("copied");
    }
    let mut command = experiment.on(cluster, "shared", &["--server", &server.address().to_string()]);
    // With this variable, a job that starts a private server would fail.
    let output = end(command.env("SBATCH_EXPORT", "ALL,PERTURB_SERVER=/nowhere").spawn().expect("started"));
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(experiment.jobs("shared"), [vec![id.clone()]]);
    assert!(experiment.results("shared") == experiment.results("whole"), "results differ");
}
