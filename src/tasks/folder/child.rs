//! Loads a folder in a separate process before the server itself loads the folder. The reason is that MuJoCo 2.2.2
//! aborts the process on some models and never finishes the compilation of others.

use super::error::{LoadError, escaped};
use perturb_protocol::spawn_failure;
use rustix::process::{Resource, Rlimit, setrlimit};
use std::{
    io::{self, Read},
    os::unix::process::ExitStatusExt,
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    thread,
    time::Duration,
};
use tokio::time::Instant;

/// Maximal memory of the process that loads a folder, in bytes.
const MAX_MEMORY_BYTES: u64 = 2 << 30;
/// Maximal CPU time of the process that loads a folder, in s.
const MAX_CPU_SECONDS: u64 = 60;
/// Maximal wall-clock time of the process that loads a folder, in s. After it the process is killed.
const MAX_WALL_SECONDS: u64 = 120;
/// Interval between two checks whether the process has ended.
const POLL_INTERVAL: Duration = Duration::from_millis(2);
/// Maximal number of bytes that are stored of the process's standard output, and of its standard error. The rest is
/// dropped.
const MAX_OUTPUT_BYTES: u64 = 1 << 20;

/// Limits the memory and CPU time of this process, and disables core files. Call it in a process that will load an
/// untested folder.
///
/// # Errors
/// [`io::Error`] if the operating system refuses.
pub fn limit_this_process() -> io::Result<()> {
    let limit =
        |resource, soft: u64, hard: u64| setrlimit(resource, Rlimit { current: Some(soft), maximum: Some(hard) });
    limit(Resource::As, MAX_MEMORY_BYTES, MAX_MEMORY_BYTES)?;
    // At the soft limit the process gets SIGXCPU, at the hard limit SIGKILL, which may also have other causes.
    limit(Resource::Cpu, MAX_CPU_SECONDS, MAX_CPU_SECONDS + 1)?;
    // Without this limit, a crash of the process could leave a core file of two gigabytes.
    limit(Resource::Core, 0, 0)?;
    Ok(())
}

/// Loads a folder in a separate process, and returns the report that `--check` prints. `program` is the path of
/// `perturb-server`. If `measured`, the report includes the speed of the environment.
///
/// # Errors
/// [`LoadError`] with the error that the process printed. If the process printed no error, [`LoadError`] says in which
/// way the process ended.
pub fn check(program: &Path, folder: &Path, measured: bool) -> Result<String, LoadError> {
    let refuse = |problem: String| LoadError::new(folder, problem);
    let mut child = Command::new(program)
        .arg("--check-task")
        .arg(folder)
        .args(measured.then_some("--measure-task"))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|error| {
            refuse(format!("it could not be loaded in a process of its own: {}", spawn_failure(&error)))
        })?;
    let [output, complaint] = match (collect(child.stdout.take()), collect(child.stderr.take())) {
        (Ok(output), Ok(complaint)) => [output, complaint],
        (Err(error), _) | (_, Err(error)) => {
            let _ = child.kill(); // fails only if the process has ended
            let _ = child.wait();
            return Err(refuse(format!("no thread could read the output of its process: {}", spawn_failure(&error))));
        }
    };
    let status = wait(&mut child).map_err(|error| refuse(format!("its process could not be waited for: {error}")))?;
    let words = |reader: thread::JoinHandle<String>| reader.join().unwrap_or_default();
    let (output, complaint) = (words(output), words(complaint));
    match status {
        Some(status) if status.success() => Ok(output),
        Some(status) => Err(match complaint.lines().find_map(|line| line.strip_prefix(COMPLAINT)) {
            Some(problem) => refuse(problem.to_owned()),
            None => refuse(how_it_ended(status, complaint.lines().next())),
        }),
        None => Err(refuse(format!(
            "it was not loaded within {MAX_WALL_SECONDS} s; use a smaller model, or one with fewer elements of a composite"
        ))),
    }
}

/// The start of the line on standard error by which the process reports the error of a folder.
pub const COMPLAINT: &str = "perturb-server: refused: ";

fn how_it_ended(status: ExitStatus, last_words: Option<&str>) -> String {
    const ABORTED: i32 = 6;
    const KILLED: i32 = 9;
    const CPU_TIME: i32 = 24;
    let memory = MAX_MEMORY_BYTES >> 30;
    match status.signal() {
        Some(CPU_TIME) => {
            format!("MuJoCo needed more than {MAX_CPU_SECONDS} s to compile the model; use a smaller one")
        }
        Some(KILLED) => format!(
            "MuJoCo needed more than {MAX_CPU_SECONDS} s to compile the model, or the system killed the process for \
             lack of memory; use a smaller model"
        ),
        Some(ABORTED) => format!(
            "MuJoCo 2.2.2 aborted while it compiled the model, for instance because it needs more than {memory} GiB; look at \
             the numbers in <size>, and at the sizes of composites and height fields"
        ),
        Some(signal) => {
            format!("MuJoCo 2.2.2 crashed by signal {signal} while it compiled the model; change the model")
        }
        None => match last_words {
            Some(words) => format!("MuJoCo 2.2.2 ended the process while it compiled the model: {}", escaped(words)),
            None => format!("its process ended with {status} and did not say why"),
        },
    }
}

/// Waits for the end of a process. If the process has not ended after [`MAX_WALL_SECONDS`], kills it and returns
/// `None`.
fn wait(child: &mut Child) -> io::Result<Option<ExitStatus>> {
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(MAX_WALL_SECONDS) {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        thread::sleep(POLL_INTERVAL);
    }
    child.kill()?;
    child.wait()?;
    Ok(None)
}

/// Starts a thread that reads an output of a process to its end. The thread returns the first [`MAX_OUTPUT_BYTES`]
/// bytes as text.
fn collect(stream: Option<impl Read + Send + 'static>) -> io::Result<thread::JoinHandle<String>> {
    let read = move || {
        let mut kept = Vec::new();
        if let Some(mut stream) = stream {
            let _ = (&mut stream).take(MAX_OUTPUT_BYTES).read_to_end(&mut kept);
            let _ = io::copy(&mut stream, &mut io::sink()); // so that a full pipe does not block the process
        }
        String::from_utf8_lossy(&kept).into_owned()
    };
    thread::Builder::new().spawn(read)
}
