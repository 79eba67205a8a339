//! A server of a program's own, on a private Unix socket.

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

use crate::address::Address;
use crate::error::ClientError;

const PROGRAM: &str = "perturb-server";
/// Overrides where the program is looked for.
const VARIABLE: &str = "PERTURB_SERVER";
/// How long a start may take.
const START_LIMIT: Duration = Duration::from_secs(20);
/// How long a server may take to end before it is killed.
const END_LIMIT: Duration = Duration::from_secs(5);
/// How long its last words are waited for.
const HEARING_LIMIT: Duration = Duration::from_secs(1);

/// Is told the lines that private servers write to standard error.
static HEARD: OnceLock<fn(String)> = OnceLock::new();

/// A `perturb-server` that lives no longer than this value, and no longer than this process: it holds the other end of
/// the server's standard input, whose closing ends the server even if this process is killed.
///
/// It runs in a process group of its own, so that Ctrl-C reaches this process alone, which can then finish what it does.
#[derive(Debug)]
pub struct PrivateServer {
    process: Process,
    address: Address,
    workers: Option<usize>,
    /// Holds the socket; only its owner may enter.
    directory: TempDir,
}

impl PrivateServer {
    /// Starts a server, `perturb-server --private`, with so many physics threads (`None`: one a core), and waits until it
    /// listens.
    ///
    /// # Errors
    /// [`ClientError::NoServerProgram`] if there is none, [`ClientError::Start`] if it ends or does not listen within 20 s.
    pub fn start(workers: Option<usize>) -> Result<Self, ClientError> {
        let program = find_program()?;
        let system = |action| move |source| ClientError::System { action, source };
        let directory = tempfile::Builder::new()
            .prefix("perturb-")
            .permissions(Permissions::from_mode(0o700))
            .tempdir()
            .map_err(system("create a private directory for the server's socket"))?;
        let path = directory.path().join("server.sock");
        let address: Address = format!("unix:{}", path.display())
            .parse()
            .map_err(|error| ClientError::Start { program: program.clone(), reason: format!("{error}; set TMPDIR") })?;

        let process = spawn(&program, &address, workers)?;
        Ok(Self { process, address, workers, directory })
    }

    /// Has `hear` told what all servers that this process starts from now on have to say, line by line; without it they
    /// write to this process's standard error themselves, through whatever is shown there. What they say after this process
    /// was killed is lost. The first call counts.
    pub fn have_heard(hear: fn(String)) {
        let _ = HEARD.set(hear);
    }

    /// Ends it, if it still runs, and starts it again at the same address.
    ///
    /// # Errors
    /// Those of [`PrivateServer::start`].
    pub fn restart(&mut self) -> Result<(), ClientError> {
        self.process.end();
        let again = |source| ClientError::System { action: "create the server's private directory again", source };
        own_directory(self.directory.path()).map_err(again)?;
        self.process = spawn(&find_program()?, &self.address, self.workers)?;
        Ok(())
    }

    /// Where it listens.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// The operating system's number of the process.
    pub fn process_id(&self) -> u32 {
        self.process.child.id()
    }

    /// How it ended; `None` while it runs.
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
    /// Hangs up once all is told that it said; nothing if nobody hears.
    hearing: Option<Receiver<()>>,
}

impl Process {
    /// Closes its standard input, and waits until it has ended.
    fn end(&mut self) {
        drop(self.child.stdin.take());
        let deadline = Instant::now() + END_LIMIT;
        while Instant::now() < deadline && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(Duration::from_millis(5));
        }
        self.kill();
    }

    fn kill(&mut self) {
        // An error means that it has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
        // Whoever inherited its standard error may live on.
        self.hearing.take().map(|hearing| hearing.recv_timeout(HEARING_LIMIT));
    }
}

/// Makes the directory again, which a server that ended in order has deleted. One that is there must be this user's alone.
fn own_directory(path: &Path) -> std::io::Result<()> {
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            let (there, own) = (path.symlink_metadata()?, Path::new("/proc/self").metadata()?.uid());
            let is_own = there.is_dir() && there.uid() == own && there.mode().trailing_zeros() >= 6;
            if is_own { Ok(()) } else { Err(ErrorKind::PermissionDenied.into()) }
        }
        made => made,
    }
}

/// Starts `program`, and waits until it listens.
fn spawn(program: &Path, address: &Address, workers: Option<usize>) -> Result<Process, ClientError> {
    let mut command = Command::new(program);
    command.arg("--listen").arg(address.to_string()).args(["--private", "--log", "warn"]);
    if let Some(workers) = workers {
        command.args(["--workers", &workers.to_string()]);
    }
    let fail = |reason| ClientError::Start { program: program.to_owned(), reason };
    let mut child = command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(if HEARD.get().is_some() { Stdio::piped() } else { Stdio::inherit() })
        .process_group(0)
        .spawn()
        .map_err(|error| fail(error.to_string()))?;
    let hearing = HEARD.get().zip(child.stderr.take()).map(|(hear, words)| {
        let (told, hearing) = channel();
        thread::spawn(move || pass_on(words, hear, &told));
        hearing
    });
    let ready = wait_until_ready(&mut child);
    let mut process = Process { child, hearing };
    match ready {
        Ok(()) => Ok(process),
        Err(reason) => {
            process.kill();
            Err(fail(reason))
        }
    }
}

/// Tells `hear` the lines of `words` to their end, so that the server never waits for a reader.
fn pass_on(words: ChildStderr, hear: &fn(String), _told: &Sender<()>) {
    for line in BufReader::new(words).split(b'\n').map_while(Result::ok) {
        hear(String::from_utf8_lossy(&line).into_owned());
    }
}

/// Waits until `child` says that it listens.
fn wait_until_ready(child: &mut Child) -> Result<(), String> {
    let lines = child.stdout.take().map(read_lines).ok_or("its output cannot be read")?;
    let deadline = Instant::now() + START_LIMIT;
    loop {
        match lines.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            Ok(line) if line.starts_with("listening on ") => return Ok(()),
            Ok(_) => {}
            Err(RecvTimeoutError::Timeout) => {
                return Err(format!("it did not listen within {} s", START_LIMIT.as_secs()));
            }
            Err(RecvTimeoutError::Disconnected) => {
                let status = child.wait().map_or_else(|error| error.to_string(), |status| status.to_string());
                return Err(format!("it ended with {status} before it listened"));
            }
        }
    }
}

/// The output's lines, read to its end, so that the server never waits for a reader.
fn read_lines(output: ChildStdout) -> Receiver<String> {
    let (sender, receiver) = channel();
    thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            let _ = sender.send(line); // nobody listens once the server is ready
        }
    });
    receiver
}

/// `$PERTURB_SERVER`, else beside the running program, else in its parent directory (tests run in
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
