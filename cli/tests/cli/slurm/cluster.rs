//! A Slurm cluster of two nodes on one machine, for a test. Its daemons run in the foreground as the current user, with
//! all files in a temporary directory, and end with the test.

use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use crate::common::wait_within;
use tempfile::TempDir;

const PROGRAMS: [&str; 6] = ["munged", "slurmctld", "slurmd", "sbatch", "squeue", "sinfo"];
/// Maximum time for the daemons to connect to each other.
const START_LIMIT: Duration = Duration::from_secs(60);

pub struct Cluster {
    directory: TempDir,
    /// Processes: munged, slurmctld, then a slurmd for each node.
    daemons: Vec<Child>,
}

/// Returns the path of a program in PATH, or in /usr/sbin, Debian's folder for daemons.
fn find(program: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let directories = std::env::split_paths(&path).chain(["/usr/sbin".into()]);
    directories.map(|directory| directory.join(program)).find(|path| path.is_file())
}

/// Returns a free port.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr()).expect("a port").port()
}

impl Cluster {
    /// Returns the name of a missing program; `None` if all are installed.
    pub fn missing() -> Option<String> {
        let missing: Vec<&str> = PROGRAMS.into_iter().filter(|program| find(program).is_none()).collect();
        (!missing.is_empty()).then(|| format!("{} not installed", missing.join(", ")))
    }

    /// Starts nodes n1 and n2, each with one core.
    pub fn start() -> Self {
        let directory = tempfile::Builder::new().prefix("perturb-slurm-").tempdir().expect("a directory");
        let mut cluster = Self { directory, daemons: Vec::new() };
        let path = cluster.directory.path().to_owned();
        for name in ["state", "spool"] {
            fs::create_dir(path.join(name)).expect("a directory");
        }
        fs::write(cluster.configuration(), configuration(&path)).expect("written");
        let key: Vec<u8> = (0..=255).cycle().take(1024).collect(); // it guards nothing
        fs::write(path.join("key"), key).expect("written");
        use std::os::unix::fs::PermissionsExt;
        fs::set_permissions(path.join("key"), fs::Permissions::from_mode(0o600)).expect("permissions");

        let file = |name: &str| path.join(name).display().to_string();
        let munged = ["--socket", "--key-file", "--pid-file", "--seed-file", "--log-file"]
            .map(|option| format!("{option}={}", file(&format!("munge{}", &option[1..]))))
            .map(|argument| argument.replace("munge-key-file", "key"));
        // Without --force, munged refuses folders that other users can write, such as temporary directories.
        cluster.daemon("munged", &[&["--foreground".to_owned(), "--force".to_owned()], &munged[..]].concat());
        let socket = path.join("munge-socket");
        wait_within(START_LIMIT, "munged", || socket.exists());
        cluster.daemon("slurmctld", &["-D".to_owned()]);
        for node in ["n1", "n2"] {
            cluster.daemon("slurmd", &["-D".to_owned(), "-N".to_owned(), node.to_owned()]);
        }
        let idle = || {
            let output = cluster.command("sinfo").args(["--noheader", "--Node", "--format=%T"]).output();
            output.is_ok_and(|output| output.stdout == b"idle\nidle\n")
        };
        wait_within(START_LIMIT, "two idle nodes", idle);
        cluster
    }

    /// Returns a command that runs one of Slurm's programs in this cluster.
    pub fn command(&self, program: &str) -> Command {
        let mut command = Command::new(find(program).unwrap_or_else(|| program.into()));
        command.env("SLURM_CONF", self.configuration()).stdin(Stdio::null());
        command
    }

    pub fn configuration(&self) -> PathBuf {
        self.directory.path().join("slurm.conf")
    }

    /// Returns the indices, within their job array, of the jobs that run on a node.
    pub fn running_on(&self, node: &str) -> Vec<usize> {
        let mut command = self.command("squeue");
        let output: Output =
            command.args(["--noheader", "--array", "--states=R", "--format=%K %N"]).output().expect("squeue");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        text.lines()
            .filter_map(|line| line.split_once(' '))
            .filter(|(_, name)| *name == node)
            .filter_map(|(index, _)| index.parse().ok())
            .collect()
    }

    /// Simulates a power loss: ends slurmd and all its processes at once.
    pub fn kill_node(&mut self, number: usize) {
        let slurmd = &mut self.daemons[1 + number];
        slurmd.kill().expect("killed");
        slurmd.wait().expect("ended");
        let name = format!("SLURMD_NODENAME=n{number}");
        let tasks: Vec<u32> = self.processes().into_iter().filter(|&id| environment(id).contains(&name)).collect();
        assert!(!tasks.is_empty(), "node {number} ran no job");
        for &id in &tasks {
            let parent = parent(id);
            if fs::read_to_string(format!("/proc/{parent}/comm")).is_ok_and(|name| name.starts_with("slurmstepd")) {
                kill(parent);
            }
        }
        tasks.into_iter().for_each(kill);
    }

    fn daemon(&mut self, program: &str, arguments: &[String]) {
        // setpriv makes the kernel end the daemons if the test is killed.
        let mut command = self.command("setpriv");
        command.args(["--pdeathsig", "KILL"]).arg(find(program).expect("installed")).args(arguments);
        let log =
            |ending| fs::File::create(self.directory.path().join(format!("{program}-{}.{ending}", self.daemons.len())));
        command.stdout(log("out").expect("a file")).stderr(log("err").expect("a file"));
        self.daemons.push(command.spawn().expect("setpriv"));
    }

    /// Returns all processes of this cluster, including jobs.
    fn processes(&self) -> Vec<u32> {
        let ours = format!("SLURM_CONF={}", self.configuration().display());
        let entries = fs::read_dir("/proc").expect("/proc").flatten();
        let ids = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
        ids.filter(|&id| id != std::process::id() && environment(id).contains(&ours)).collect()
    }

    /// Returns the daemons' logs, for a failed test.
    pub fn logs(&self) -> String {
        let names = ["slurmctld.log", "slurmd-n1.log", "slurmd-n2.log"];
        let tail = |name: &str| {
            let text = fs::read_to_string(self.directory.path().join(name)).unwrap_or_default();
            let lines: Vec<&str> = text.lines().collect();
            format!("{name}:\n{}\n", lines[lines.len().saturating_sub(30)..].join("\n"))
        };
        names.map(tail).concat()
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("{}", self.logs());
        }
        // The nodes end first, so that no job is started again.
        for daemon in self.daemons.iter_mut().rev() {
            let _ = daemon.kill();
            let _ = daemon.wait();
        }
        for _ in 0..100 {
            let left = self.processes();
            if left.is_empty() {
                return;
            }
            left.into_iter().for_each(kill);
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// Returns the environment variables of a process.
fn environment(id: u32) -> Vec<String> {
    let bytes = fs::read(format!("/proc/{id}/environ")).unwrap_or_default();
    bytes.split(|&byte| byte == 0).map(|variable| String::from_utf8_lossy(variable).into_owned()).collect()
}

fn parent(id: u32) -> u32 {
    let stat = fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
    let after_name = stat.rsplit(") ").next().unwrap_or_default();
    after_name.split(' ').nth(1).and_then(|id| id.parse().ok()).unwrap_or_default()
}

fn kill(id: u32) {
    let _ = Command::new("kill").args(["-KILL", &id.to_string()]).stderr(Stdio::null()).status();
}

/// A minimal configuration, with which Slurm quickly notices a lost node and moves its jobs to another one.
fn configuration(path: &Path) -> String {
    let output = |program: &str, argument: &str| {
        let output = Command::new(program).arg(argument).output().expect(program);
        String::from_utf8_lossy(&output.stdout).trim().to_owned()
    };
    let host = output("uname", "-n");
    let user = output("id", "-un");
    let directory = path.display();
    let [control, n1, n2] = [free_port(), free_port(), free_port()];
    format!(
        "ClusterName=perturb
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={control}
AuthType=auth/munge
CryptoType=crypto/munge
AuthInfo=socket={directory}/munge-socket,cred_expire=5
SlurmUser={user}
SlurmdUser={user}
StateSaveLocation={directory}/state
SlurmdSpoolDir={directory}/spool/%n
SlurmctldPidFile={directory}/slurmctld.pid
SlurmdPidFile={directory}/slurmd-%n.pid
SlurmctldLogFile={directory}/slurmctld.log
SlurmdLogFile={directory}/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=2,batch_sched_delay=1
SlurmdParameters=config_overrides
SlurmdTimeout=20
KillWait=5
ReturnToService=2
MailProg=/bin/true
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={n1} CPUs=1
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={n2} CPUs=1
PartitionName=main Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
"
    )
}
