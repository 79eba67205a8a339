//! A server that a client program starts for itself, on a private Unix socket.

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
/// Environment variable with the path of the server's program.
const VARIABLE: &str = "PERTURB_SERVER";
/// Maximal time from the start of a server until it listens.
const START_TIMEOUT: Duration = Duration::from_secs(20);
/// Additional time to start for each task folder, because the server first loads each folder in a separate process.
const TASK_TIMEOUT: Duration = Duration::from_secs(120);
/// Exit status by which `perturb-server` reports that it refused its command line or a task folder.
const REFUSED_STATUS: i32 = 2;
/// Time to wait for a server to end by itself before it is killed.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(5);
/// Interval between two checks whether this process was asked to stop, while it waits for a server to start. Also the
/// time for which a failed server may finish exiting.
const STOP_POLL_INTERVAL: Duration = Duration::from_millis(50);
/// Maximal time to wait for the rest of a server's standard error after the server has ended.
const STDERR_TIMEOUT: Duration = Duration::from_secs(1);

/// Receives the lines that private servers write to standard error; set by [`PrivateServer::set_stderr_handler`].
static STDERR_HANDLER: OnceLock<fn(String)> = OnceLock::new();

/// A `perturb-server` that this process starts for itself. It ends when this value is dropped, or when this process
/// ends in any way, even if this process is killed: the server ends when its standard input is closed.
///
/// The server runs in its own process group. So Ctrl-C reaches only this process, which can finish its work with the
/// server.
#[derive(Debug)]
pub struct PrivateServer {
    program: PathBuf,
    process: Process,
    address: Address,
    workers: Option<usize>,
    /// Task folders that the server serves in addition to the built-in environments.
    tasks: Vec<PathBuf>,
    /// The directory of the socket, accessible only to the current user.
    directory: TempDir,
}

impl PrivateServer {
    /// Starts `perturb-server --private` and waits until it listens. `workers` is the number of physics threads, `None`
    /// one for each core.
    ///
    /// # Errors
    /// [`ClientError::NoServerProgram`] if the program is not found, [`ClientError::Start`] if it cannot be started,
    /// ends, or does not listen within 20 s, [`ClientError::System`] if the directory of the socket cannot be created.
    pub fn start(workers: Option<usize>) -> Result<Self, ClientError> {
        Self::start_unless(workers, &[], &|| None)
    }

    /// Starts a server as [`PrivateServer::start`] does, which also serves the task folders `tasks`. While it waits, it
    /// calls `stopped` every 50 ms. The wait ends if `stopped` returns the number of a signal that asked this process
    /// to end.
    ///
    /// # Errors
    /// The errors of [`PrivateServer::start`]; for each folder, the server has two more minutes to start.
    /// [`ClientError::Stopped`] if `stopped` returned a signal. [`ClientError::Tasks`] if the server refused a folder;
    /// the server writes the reason to standard error.
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
        let refused = |reason: &str, other: &str| {
            let reason = format!("{reason} ({}); set TMPDIR to a folder with {other}, such as /tmp", path.display());
            ClientError::Start { program: program.clone(), reason }
        };
        let text = path.to_str().ok_or_else(|| refused("the path of the socket is not UTF-8", "another path"))?;
        let address: Address =
            format!("unix:{text}").parse().map_err(|AddressError { reason, .. }| refused(&reason, "a shorter path"))?;

        let process = spawn(&program, &address, workers, tasks, stopped)?;
        Ok(Self { program, process, address, workers, tasks: tasks.to_vec(), directory })
    }

    /// Sets a function that receives each line that private servers write to standard error. It applies to servers that
    /// are started later. Without a handler, servers write directly to this process's standard error, mixed with the
    /// process's own lines. Only the first call has an effect.
    pub fn set_stderr_handler(handler: fn(String)) {
        let _ = STDERR_HANDLER.set(handler);
    }

    /// Kills the server, if it still runs, and starts it again at the same address.
    ///
    /// # Errors
    /// The errors of [`PrivateServer::start_unless`].
    pub fn restart(&mut self, stopped: &dyn Fn() -> Option<i32>) -> Result<(), ClientError> {
        self.process.kill(); // the caller restarts a server that runs only if it does not answer
        let again = |source| ClientError::System { action: "create the server's private directory again", source };
        own_directory(self.directory.path()).map_err(again)?;
        self.process = spawn(&find_program()?, &self.address, self.workers, &self.tasks, stopped)?;
        Ok(())
    }

    /// The address at which the server listens.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// Creates the error for a server that listens but does not accept sessions, with the `reason`. If the server has
    /// ended, the error has its exit status instead.
    pub fn unusable(&mut self, reason: &str) -> ClientError {
        thread::sleep(STOP_POLL_INTERVAL); // a server closes its connections just before it ends
        let ended = self.exit_status().map(|status| format!("it ended with {status}"));
        let reason = ended.unwrap_or_else(|| format!("it listens, but does not take sessions: {reason}"));
        ClientError::Start { program: self.program.clone(), reason }
    }

    /// The process id of the server.
    pub fn process_id(&self) -> u32 {
        self.process.child.id()
    }

    /// Kills the server, for instance because it does not answer. [`PrivateServer::restart`] starts it again.
    pub fn kill(&mut self) {
        self.process.kill();
    }

    /// The exit status of the server; `None` while it runs.
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
    /// A channel that disconnects after the handler received the last line of standard error. `None` without a handler.
    stderr_done: Option<Receiver<()>>,
}

impl Process {
    /// Ends the process by closing its standard input. Kills it if it still runs 5 s later.
    fn end(&mut self) {
        drop(self.child.stdin.take());
        let deadline = Instant::now() + SHUTDOWN_TIMEOUT;
        while Instant::now() < deadline && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(Duration::from_millis(5));
        }
        self.kill();
    }

    /// The exit code; `None` while the process runs, or if a signal ended it.
    fn exit_code(&mut self) -> Option<i32> {
        self.child.try_wait().ok().flatten().and_then(|status| status.code())
    }

    fn kill(&mut self) {
        // An error means that the process has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
        // The time to wait is limited, because a child process of the server may still hold the server's standard error
        // open.
        self.stderr_done.take().map(|done| done.recv_timeout(STDERR_TIMEOUT));
    }
}

/// Creates the directory of the socket again, because a server deletes it at its regular end. If it exists, it must
/// belong to the current user and be accessible only to that user; otherwise this is an error.
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

/// Starts the server's program, and waits until it listens or `stopped` returns a signal.
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
    // Passes the server's standard error to the handler, if there is one. Its standard output is read below, since it
    // reports when the server listens.
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
            // The server reports a refused task folder by its exit status.
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

/// The reason why a server did not become ready.
enum NotReady {
    Reason(String),
    /// The signal with this number asked this process to end.
    Stopped(i32),
}

/// Passes each line of `stderr` to `handler` until the end. Reading it all keeps the server from blocking on a full
/// pipe. Dropping `_done` at the end tells the receiver that all lines were handled.
fn forward_stderr(stderr: ChildStderr, handler: &fn(String), _done: &Sender<()>) {
    for line in BufReader::new(stderr).split(b'\n').map_while(Result::ok) {
        handler(String::from_utf8_lossy(&line).into_owned());
    }
}

/// Waits until the server prints that it listens, ends, or exceeds `timeout`, or until `stopped` returns a signal.
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

/// Starts a thread that reads all lines of a server's standard output. Reading it all keeps the server from blocking on
/// a full pipe.
fn read_lines(output: ChildStdout) -> std::io::Result<Receiver<String>> {
    let (sender, receiver) = channel();
    let read = move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            let _ = sender.send(line); // fails once the server is ready, because the receiver is gone
        }
    };
    thread::Builder::new().name("stdout".into()).spawn(read)?;
    Ok(receiver)
}

/// Finds the server's program: the path in `$PERTURB_SERVER`, if it is set. Otherwise, searches the directory of the
/// running program, the parent of that directory (tests run in `target/release/deps`), and the PATH.
fn find_program() -> Result<PathBuf, ClientError> {
    if let Some(path) = std::env::var_os(VARIABLE) {
        let path = PathBuf::from(path);
        let tried = format!("{VARIABLE} names {}, which is not a file", path.display());
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
