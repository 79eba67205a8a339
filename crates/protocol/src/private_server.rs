//! A server that belongs to this program, on a private Unix socket.

use std::fs::{DirBuilder, Permissions};
use std::io::{BufRead, BufReader, ErrorKind};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

use tempfile::TempDir;

use crate::address::{Address, AddressError};
use crate::error::ClientError;
use crate::process_limit::spawn_failure;

const PROGRAM: &str = "perturb-server";
/// Variable with the path of the program.
const VARIABLE: &str = "PERTURB_SERVER";
/// Timeout of a start.
const START_TIMEOUT: Duration = Duration::from_secs(20);
/// Additional timeout of a start for each task folder, which the server first loads in a process of its own.
const TASK_TIMEOUT: Duration = Duration::from_secs(120);
/// Exit status of a server that refused its settings.
const REFUSED_STATUS: i32 = 2;
/// Time that a server has to end before it is killed.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(5);
/// Interval between two checks of a server that is starting or ending.
const STOP_POLL_INTERVAL: Duration = Duration::from_millis(50);
/// Time to wait for a server's last lines after its end.
const STDERR_TIMEOUT: Duration = Duration::from_secs(1);

/// Gets the lines that private servers write to standard error.
static STDERR_HANDLER: OnceLock<fn(String)> = OnceLock::new();

/// A `perturb-server` that lives no longer than this value, and no longer than this process: the server ends when its standard
/// input is closed, which happens even if this process is killed.
///
/// The server runs in its own process group, so that Ctrl-C reaches only this process, which can then finish its work.
#[derive(Debug)]
pub struct PrivateServer {
    program: PathBuf,
    process: Process,
    address: Address,
    workers: Option<usize>,
    /// Folders of tasks that it serves in addition to the built-in environments.
    tasks: Vec<PathBuf>,
    /// The directory of the socket, which only its owner may enter.
    directory: TempDir,
}

impl PrivateServer {
    /// Starts a server, `perturb-server --private`, with `workers` physics threads (`None`: one a core), and waits until it
    /// listens.
    ///
    /// # Errors
    /// [`ClientError::NoServerProgram`] if the program is missing, [`ClientError::Start`] if it ends or does not listen within
    /// 20 s.
    pub fn start(workers: Option<usize>) -> Result<Self, ClientError> {
        Self::start_unless(workers, &[], &|| None)
    }

    /// Starts a server like [`PrivateServer::start`] that also serves the tasks in the folders `tasks`, unless `stopped`
    /// gives the signal by which this process was asked to end.
    ///
    /// # Errors
    /// Those of [`PrivateServer::start`], with two more minutes for each folder; [`ClientError::Stopped`];
    /// [`ClientError::Tasks`] if the server refuses a folder, after it wrote the reason to standard error.
    pub fn start_unless(
        workers: Option<usize>,
        tasks: &[PathBuf],
        stopped: &dyn Fn() -> Option<i32>,
    ) -> Result<Self, ClientError> {
        let program = find_program()?;
        let system = |action| move |source| ClientError::System { action, source };
        let directory =
            tempfile::Builder::new().prefix("perturb-").permissions(Permissions::from_mode(0o700)).tempdir().map_err(
                system(
                    "create a private directory for the server's socket (set TMPDIR to a folder that can be written)",
                ),
            )?;
        let path = directory.path().join("server.sock");
        let address: Address =
            format!("unix:{}", path.display()).parse().map_err(|AddressError { reason, .. }| ClientError::Start {
                program: program.clone(),
                reason: format!(
                    "{reason} ({}); set TMPDIR to a folder with a shorter path, such as /tmp",
                    path.display()
                ),
            })?;

        let process = spawn(&program, &address, workers, tasks, stopped)?;
        Ok(Self { program, process, address, workers, tasks: tasks.to_vec(), directory })
    }

    /// Passes every line that servers started from now on write to standard error to `handler`. Without it they write to this
    /// process's standard error themselves, in between its own output. Lines after this process was killed are lost. Only the
    /// first call has an effect.
    pub fn set_stderr_handler(handler: fn(String)) {
        let _ = STDERR_HANDLER.set(handler);
    }

    /// Ends the server, if it still runs, and starts it again at the same address.
    ///
    /// # Errors
    /// Those of [`PrivateServer::start_unless`].
    pub fn restart(&mut self, stopped: &dyn Fn() -> Option<i32>) -> Result<(), ClientError> {
        self.process.kill(); // a server that still runs does not answer
        let again = |source| ClientError::System { action: "create the server's private directory again", source };
        own_directory(self.directory.path()).map_err(again)?;
        self.process = spawn(&find_program()?, &self.address, self.workers, &self.tasks, stopped)?;
        Ok(())
    }

    /// The address at which the server listens.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// The error of a server that listens but does not take sessions, for `reason`.
    pub fn unusable(&mut self, reason: &str) -> ClientError {
        thread::sleep(STOP_POLL_INTERVAL); // a server that ends closes its connections a moment earlier
        let ended = self.exit_status().map(|status| format!("it ended with {status}"));
        let reason = ended.unwrap_or_else(|| format!("it listens, but does not take sessions: {reason}"));
        ClientError::Start { program: self.program.clone(), reason }
    }

    /// The process id.
    pub fn process_id(&self) -> u32 {
        self.process.child.id()
    }

    /// Ends the server at once, for instance because it does not answer.
    pub fn kill(&mut self) {
        self.process.kill();
    }

    /// The exit status; `None` while the server runs.
    pub fn exit_status(&mut self) -> Option<ExitStatus> {
        self.process.child.try_wait().ok().flatten()
    }
}

impl Drop for PrivateServer {
    fn drop(&mut self) {
        self.process.end();
    }
}

#[derive(Debug)]
struct Process {
    child: Child,
    /// Disconnects after all lines of standard error were handled; `None` without a handler.
    stderr_done: Option<Receiver<()>>,
}

impl Process {
    /// Closes the process's standard input, and waits until it has ended.
    fn end(&mut self) {
        drop(self.child.stdin.take());
        let deadline = Instant::now() + SHUTDOWN_TIMEOUT;
        while Instant::now() < deadline && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(Duration::from_millis(5));
        }
        self.kill();
    }

    /// The exit status as a number; `None` while the process runs, or after a signal.
    fn exit_code(&mut self) -> Option<i32> {
        self.child.try_wait().ok().flatten().and_then(|status| status.code())
    }

    fn kill(&mut self) {
        // An error means that it has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
        // A process that inherited the standard error may live on, so the wait is limited.
        self.stderr_done.take().map(|done| done.recv_timeout(STDERR_TIMEOUT));
    }
}

/// Creates the directory again, which a server deletes at its regular end. An existing one must belong to this user alone.
fn own_directory(path: &Path) -> std::io::Result<()> {
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            let there = path.symlink_metadata()?;
            let own = Path::new("/proc/self").metadata()?.uid();
            let is_own = there.is_dir() && there.uid() == own && there.mode().trailing_zeros() >= 6;
            if is_own { Ok(()) } else { Err(ErrorKind::PermissionDenied.into()) }
        }
        made => made,
    }
}

/// Starts `program`, and waits until it listens, unless `stopped` gives a signal.
fn spawn(
    program: &Path,
    address: &Address,
    workers: Option<usize>,
    tasks: &[PathBuf],
    stopped: &dyn Fn() -> Option<i32>,
) -> Result<Process, ClientError> {
    let mut command = Command::new(program);
    command.arg("--listen").arg(address.to_string()).args(["--private", "--log", "warn"]);
    if let Some(workers) = workers {
        command.args(["--workers", &workers.to_string()]);
    }
    for task in tasks {
        command.arg("--task").arg(task);
    }
    let fail = |reason| ClientError::Start { program: program.to_owned(), reason };
    let mut child = command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(if STDERR_HANDLER.get().is_some() { Stdio::piped() } else { Stdio::inherit() })
        .process_group(0)
        .spawn()
        .map_err(|error| fail(spawn_failure(&error)))?;
    let (sender, stderr_done) = channel();
    let stderr = STDERR_HANDLER.get().zip(child.stderr.take());
    let forwarded = stderr.map(|(handler, stderr)| {
        thread::Builder::new().name("stderr".into()).spawn(move || forward_stderr(stderr, handler, &sender))
    });
    let stderr_done = forwarded.is_some().then_some(stderr_done);
    let timeout = START_TIMEOUT + TASK_TIMEOUT * u32::try_from(tasks.len()).unwrap_or(u32::MAX);
    let output = child.stdout.take();
    let mut process = Process { child, stderr_done };
    let begun = forwarded.transpose().and_then(|_| output.map(read_lines).transpose());
    let ready = match begun {
        Ok(lines) => wait_until_ready(&mut process.child, lines, timeout, stopped),
        Err(error) => {
            Err(NotReady::Reason(format!("a thread for its output cannot be started: {}", spawn_failure(&error))))
        }
    };
    match ready {
        Ok(()) => Ok(process),
        Err(not_ready) => {
            let is_refusal = process.exit_code() == Some(REFUSED_STATUS) && !tasks.is_empty();
            process.kill();
            Err(match not_ready {
                NotReady::Stopped(signal) => {
                    ClientError::Stopped { signal, action: "starting a private server".into() }
                }
                NotReady::Reason(_) if is_refusal => ClientError::Tasks { tasks: tasks.to_vec() },
                NotReady::Reason(reason) => fail(reason),
            })
        }
    }
}

/// Why a server is not ready.
enum NotReady {
    Reason(String),
    /// This process was asked to end, by the signal of this number.
    Stopped(i32),
}

/// Passes the lines of `stderr` to `handler` until the end, so that the server never waits for a reader. The end is signalled by
/// the drop of the sender.
fn forward_stderr(stderr: ChildStderr, handler: &fn(String), _done: &Sender<()>) {
    for line in BufReader::new(stderr).split(b'\n').map_while(Result::ok) {
        handler(String::from_utf8_lossy(&line).into_owned());
    }
}

/// Waits until `child` prints that it listens.
fn wait_until_ready(
    child: &mut Child,
    lines: Option<Receiver<String>>,
    timeout: Duration,
    stopped: &dyn Fn() -> Option<i32>,
) -> Result<(), NotReady> {
    let lines = lines.ok_or_else(|| NotReady::Reason("its output cannot be read".into()))?;
    let deadline = Instant::now() + timeout;
    loop {
        match lines.recv_timeout(STOP_POLL_INTERVAL) {
            Ok(line) if line.starts_with("listening on ") => return Ok(()),
            Ok(_) => {}
            Err(RecvTimeoutError::Timeout) => {
                if let Some(signal) = stopped() {
                    return Err(NotReady::Stopped(signal));
                }
                if Instant::now() >= deadline {
                    return Err(NotReady::Reason(format!("it did not listen within {} s", timeout.as_secs())));
                }
            }
            Err(RecvTimeoutError::Disconnected) => {
                let status = child.wait().map_or_else(|error| error.to_string(), |status| status.to_string());
                return Err(NotReady::Reason(format!("it ended with {status} before it listened")));
            }
        }
    }
}

/// Reads the lines of the output until its end, so that the server never waits for a reader.
fn read_lines(output: ChildStdout) -> std::io::Result<Receiver<String>> {
    let (sender, receiver) = channel();
    let read = move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            let _ = sender.send(line); // nobody listens once the server is ready
        }
    };
    thread::Builder::new().name("stdout".into()).spawn(read)?;
    Ok(receiver)
}

/// Finds the server's program: `$PERTURB_SERVER`, else beside the running program, else in its parent directory (tests run in
/// `target/release/deps`), else on the PATH.
fn find_program() -> Result<PathBuf, ClientError> {
    if let Some(path) = std::env::var_os(VARIABLE) {
        let path = PathBuf::from(path);
        let tried = format!("{VARIABLE} names {}, which is no file", path.display());
        return if path.is_file() { Ok(path) } else { Err(ClientError::NoServerProgram { tried }) };
    }
    let executable = std::env::current_exe().ok();
    let directories = executable.iter().flat_map(|path| path.ancestors().skip(1).take(2));
    let mut candidates: Vec<PathBuf> = directories.map(|directory| directory.join(PROGRAM)).collect();
    let tried: Vec<String> = candidates.iter().map(|path| path.display().to_string()).collect();
    if let Some(path) = std::env::var_os("PATH") {
        candidates.extend(std::env::split_paths(&path).map(|directory| directory.join(PROGRAM)));
    }
    candidates.into_iter().find(|path| path.is_file()).ok_or_else(|| ClientError::NoServerProgram {
        tried: format!("neither {} nor anywhere on the PATH", tried.join(" nor ")),
    })
}
