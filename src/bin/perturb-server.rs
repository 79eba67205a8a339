//! The program `perturb-server`.
#![forbid(unsafe_code)]

use clap::{CommandFactory, Parser};
#[cfg(feature = "mujoco")]
use perturb::tasks::folder::{self, LoadError};
use perturb::{
    config::{Arguments, Config, ListenAddress},
    env::Catalogue,
    server::{
        self,
        auth::{file_watcher::Reloader, new_token},
        net::{listener::Listener, probe::probe},
        security::Security,
    },
    tasks,
};
use rustix::process::{Resource, Rlimit, Signal, getrlimit, setrlimit};
use std::{
    error::Error,
    io::{self, Read, Write},
    process::ExitCode,
};
use tokio::{
    signal::unix::{SignalKind, signal},
    sync::oneshot,
};
#[cfg(not(feature = "otel"))]
use tracing_subscriber::{layer::SubscriberExt, util::SubscriberInitExt};

/// The text of the file that defines the protocol.
const CONTRACT: &str = include_str!("../../proto/perturb/v1/perturb.proto");

fn main() -> ExitCode {
    let _ = perturb_system::ignore_sigxfsz(); // if this fails, a file-size limit can end the program
    let arguments = Arguments::parse();
    if let Some(page) = requested_text(&arguments) {
        // An error is ignored, because the reader may close the pipe early.
        let _ = io::stdout().write_all(&page);
        return ExitCode::SUCCESS;
    }
    if let Some(name) = &arguments.new_token {
        return match new_token(name) {
            Ok((token, entry)) => {
                eprint!("{entry}");
                println!("{token}");
                ExitCode::SUCCESS
            }
            Err(error) => {
                print_error(format_args!("--new-token {name:?}: {error}"));
                ExitCode::from(2)
            }
        };
    }
    #[cfg(feature = "mujoco")]
    if let Some(folder) = &arguments.check_task {
        return check_task(folder, arguments.measure_task);
    }
    let config = match Config::load(&arguments) {
        Ok(config) => config,
        Err(error) => {
            print_error(error);
            return ExitCode::from(2);
        }
    };
    #[cfg(not(feature = "otel"))]
    {
        let lines = tracing_subscriber::fmt::layer()
            .with_writer(io::stderr)
            .with_ansi(io::IsTerminal::is_terminal(&io::stderr()))
            .log_internal_errors(false); // they are printed by `eprintln!`, which panics if standard error is closed
        tracing_subscriber::registry().with(lines).with(config.filter()).init();
    }
    #[cfg(feature = "otel")]
    let _traces = match perturb::traces::init(config.filter()) {
        Ok(traces) => traces,
        Err(error) => {
            print_error(format_args!("traces cannot be sent: {error}; correct the variables OTEL_…"));
            return ExitCode::from(2);
        }
    };
    let done = if arguments.health {
        health(&config)
    } else if arguments.check {
        check(&config)
    } else if arguments.catalogue {
        environments(&config, false).and_then(|environments| print_catalogue(&environments, &config))
    } else {
        let done = environments(&config, false).and_then(|environments| run(&config, &environments));
        if arguments.private && !matches!(done, Err(Failure::Setting(_))) {
            remove_folders(&config);
        }
        done
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure::Setting(error)) => {
            print_error(error);
            ExitCode::from(2)
        }
        Err(Failure::Other(error)) => {
            print_error(error);
            ExitCode::FAILURE
        }
    }
}

/// Prints an error on standard error, and ignores failures to print it.
fn print_error(words: impl std::fmt::Display) {
    let _ = writeln!(io::stderr(), "perturb-server: {words}");
}

/// Returns the text that the command line requests instead of a server, if any: shell completions, the protocol, the
/// schema of tasks, or the manual page.
fn requested_text(arguments: &Arguments) -> Option<Vec<u8>> {
    let (mut command, mut page) = (Arguments::command(), Vec::new());
    if let Some(shell) = arguments.completions {
        clap_complete::generate(shell, &mut command, "perturb-server", &mut page);
    } else if arguments.proto {
        page = CONTRACT.into();
    } else if arguments.task_schema {
        page = task_schema();
    } else if arguments.man {
        clap_mangen::Man::new(command).render(&mut page).expect("memory takes it");
    } else {
        return None;
    }
    Some(page)
}

/// Why the program fails, which determines its exit status.
enum Failure {
    /// A setting cannot be used: an address is not available, or a file or folder is invalid.
    Setting(Box<dyn Error>),
    Other(Box<dyn Error>),
}

impl Failure {
    fn setting(error: impl Into<Box<dyn Error>>) -> Self {
        Self::Setting(error.into())
    }
}

impl<E: Into<Box<dyn Error>>> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Other(error.into())
    }
}

/// Removes the empty folders that contained a private server's sockets, because the program that made the folders may
/// have been killed before it could remove them. Folders with files are kept.
fn remove_folders(config: &Config) {
    for address in &config.listen {
        if let ListenAddress::Unix(path) = address {
            let _ = path.parent().map(std::fs::remove_dir);
        }
    }
}

/// Loads the environments to serve: the built-in environments and the environments of the configured folders. Each
/// folder is first loaded in a separate process. If `measured`, the reports contain the speed of the folders'
/// environments.
#[cfg(feature = "mujoco")]
fn environments(config: &Config, measured: bool) -> Result<Environments, Failure> {
    let mut environments = Environments { catalogue: tasks::catalogue(), folders: Vec::new(), reports: Vec::new() };
    let program = std::env::current_exe()?;
    for path in &config.tasks {
        environments.reports.push(folder::child::check(&program, path, measured).map_err(Failure::setting)?);
        let loaded = folder::load(path).map_err(|error| Failure::setting(LoadError::new(path, error)))?;
        let added = environments.catalogue.with(loaded.spec());
        environments.catalogue = added.map_err(|error| Failure::setting(LoadError::new(path, error)))?;
        for parameter in loaded.parameters_without_effect().map_err(|error| LoadError::new(path, error))? {
            tracing::warn!(task = loaded.spec().name, parameter, "no effect of this parameter was seen; see --check");
        }
        environments.folders.push(loaded);
    }
    Ok(environments)
}

#[cfg(not(feature = "mujoco"))]
fn environments(config: &Config, _measured: bool) -> Result<Environments, Failure> {
    if config.tasks.is_empty() {
        return Ok(Environments { catalogue: tasks::catalogue() });
    }
    Err(Failure::setting("--task: this server was built without MuJoCo; build it with the feature `mujoco`"))
}

/// The environments to serve.
struct Environments {
    catalogue: Catalogue,
    #[cfg(feature = "mujoco")]
    folders: Vec<folder::TaskFolder>,
    /// The descriptions of the folders' environments, for `--check`.
    #[cfg(feature = "mujoco")]
    reports: Vec<String>,
}

/// Logs a warning when the files of a folder change, once for each folder. The server continues to use the files as
/// they were when it loaded them.
#[cfg(feature = "mujoco")]
async fn watch_folders(mut folders: Vec<folder::TaskFolder>) {
    const FILES_CHECK_INTERVAL: std::time::Duration = std::time::Duration::from_secs(5);
    while !folders.is_empty() {
        tokio::time::sleep(FILES_CHECK_INTERVAL).await;
        folders.retain(|folder| {
            let is_unchanged = folder.is_unchanged();
            if !is_unchanged {
                tracing::warn!(
                    task = folder.spec().name,
                    "the files of this task changed; the server serves what it loaded, restart it to serve the new files"
                );
            }
            is_unchanged
        });
    }
}

/// Loads the configured folders, each in a process of its own, and prints their descriptions.
#[cfg(feature = "mujoco")]
fn check(config: &Config) -> Result<(), Failure> {
    if config.tasks.is_empty() {
        return Err(Failure::setting("--check needs a folder; give --task FOLDER"));
    }
    let reports = environments(config, true)?.reports;
    Ok(io::stdout().write_all(reports.concat().as_bytes())?)
}

#[cfg(not(feature = "mujoco"))]
fn check(config: &Config) -> Result<(), Failure> {
    environments(config, true).map(|_| ())
}

/// Loads a folder within limits of memory and CPU time, and prints its description. Another `perturb-server` process
/// started this process for that purpose.
#[cfg(feature = "mujoco")]
fn check_task(path: &std::path::Path, measured: bool) -> ExitCode {
    let report = folder::child::limit_this_process()
        .map_err(|error| format!("the process cannot be limited: {error}"))
        .and_then(|()| folder::report(path, measured).map_err(|error| error.problem().to_owned()));
    match report {
        Ok(report) => match io::stdout().write_all(report.as_bytes()) {
            Ok(()) => ExitCode::SUCCESS,
            Err(_) => ExitCode::FAILURE,
        },
        Err(problem) => {
            let _ = writeln!(io::stderr(), "{}{problem}", folder::child::COMPLAINT);
            ExitCode::from(2)
        }
    }
}

fn task_schema() -> Vec<u8> {
    #[cfg(feature = "mujoco")]
    return folder::SCHEMA.into();
    #[cfg(not(feature = "mujoco"))]
    Vec::new()
}

fn run(config: &Config, environments: &Environments) -> Result<(), Failure> {
    raise_descriptors();
    // The runtime of the first transport thread. Each transport thread has a runtime of its own, because passing a
    // request between threads doubles latency.
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let security = Security::load(config, &environments.catalogue).map_err(Failure::setting)?;
    let result = runtime.block_on(async {
        // Signal handlers are set before the addresses are printed, because the reader of the addresses may send a
        // signal at once.
        let shutdown = shutdown(config.exit_with_stdin)?;
        tokio::spawn(reload_on_hangup(signal(SignalKind::hangup())?, security.reloader()));
        let mut listeners = Vec::new();
        let metrics = match &config.metrics {
            Some(address) => {
                let bound = Listener::bind_as(address, "--metrics", config.socket_mode).await;
                Some(bound.map_err(Failure::setting)?)
            }
            None => None,
        };
        for address in &config.listen {
            let listener = Listener::bind(address, config.socket_mode).await.map_err(Failure::setting)?;
            // An error is ignored, because the program that started the server may have closed the pipe.
            let _ = writeln!(io::stdout(), "listening on {}", client_address(&listener.address()?, config));
            listeners.push(listener);
        }
        if let Some(listener) = &metrics {
            let _ = writeln!(io::stdout(), "metrics at {}{}", listener.address()?, server::metrics::endpoint::PATH);
        }
        if let Some(target) = grpc_target(&listeners) {
            let _ = writeln!(io::stdout(), "gRPC target {target}");
        }
        #[cfg(feature = "mujoco")]
        tokio::spawn(watch_folders(environments.folders.clone()));
        server::run(listeners, metrics, config, &security, environments.catalogue.clone(), shutdown).await?;
        Ok(())
    });
    // The program does not wait for connections that are still open.
    runtime.shutdown_background();
    result
}

/// Returns an address in the syntax that clients use.
fn client_address(address: &ListenAddress, config: &Config) -> String {
    match address {
        ListenAddress::Tcp(tcp) if config.tls_cert.is_some() => format!("https://{tcp}"),
        // The path is made absolute, because a client may have another working directory.
        ListenAddress::Unix(path) => {
            ListenAddress::Unix(std::path::absolute(path).unwrap_or_else(|_| path.clone())).to_string()
        }
        other => other.to_string(),
    }
}

/// Returns the first TCP address in the syntax of gRPC's own tools and libraries, which do not accept `http://`. The
/// syntax for Unix sockets is the same everywhere.
fn grpc_target(listeners: &[Listener]) -> Option<String> {
    listeners.iter().find_map(|listener| match listener.address() {
        Ok(ListenAddress::Tcp(tcp)) => Some(tcp.to_string()),
        _ => None,
    })
}

/// Reloads the token and TLS files at each SIGHUP. SIGHUP does not end the server.
async fn reload_on_hangup(mut hangups: tokio::signal::unix::Signal, reloader: Reloader) {
    while hangups.recv().await.is_some() {
        if !reloader.reload() {
            tracing::info!("received SIGHUP, but the server has no token or TLS files to reload");
        }
    }
}

/// Raises the limit of file descriptors to the hard limit, because each connection needs a descriptor.
fn raise_descriptors() {
    let limit = getrlimit(Resource::Nofile);
    if let Err(error) = setrlimit(Resource::Nofile, Rlimit { current: limit.maximum, ..limit }) {
        tracing::debug!(%error, "cannot raise the limit of file descriptors");
    }
}

/// Prints the catalogue that a server would serve.
fn print_catalogue(environments: &Environments, config: &Config) -> Result<(), Failure> {
    let listing = server::listing(&environments.catalogue, config)?;
    writeln!(io::stdout(), "{:#}", perturb_protocol::catalogue::to_json(&listing))?;
    Ok(())
}

/// Checks the health of the running server that has the same configuration.
fn health(config: &Config) -> Result<(), Failure> {
    let listen = config.listen.first().ok_or("no address is given")?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    Ok(runtime.block_on(probe(listen, config.tls_cert.as_deref()))?)
}

/// Returns a future that resolves at SIGTERM or SIGINT, or, if `exit_with_stdin`, when standard input closes. At the
/// next SIGTERM or SIGINT after that, the program exits immediately.
///
/// Batch systems and the kernel warn of a limit by SIGUSR1, SIGUSR2 or SIGXCPU. The first warning also resolves the
/// future. The server then exits immediately only at the second SIGTERM or SIGINT after the warning. If
/// `exit_with_stdin`, warnings are ignored: the program that started the server may get the same warning, and still
/// needs the server while it saves its own work.
fn shutdown(exit_with_stdin: bool) -> io::Result<impl Future<Output = ()>> {
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    let (mut user_1, mut user_2) = (signal(SignalKind::user_defined1())?, signal(SignalKind::user_defined2())?);
    let mut processor_time = signal(SignalKind::from_raw(Signal::XCPU.as_raw()))?;
    let (closed, stdin) = oneshot::channel::<()>();
    if exit_with_stdin {
        std::thread::Builder::new()
            .name("stdin".into())
            .spawn(move || {
                // The content of the input is ignored. The end of the input, or an error, starts the shutdown.
                let _ = io::copy(&mut io::stdin().lock().by_ref(), &mut io::sink());
                drop(closed);
            })
            .map_err(|error| perturb_system::explain_no_thread(&error))?;
    } else {
        std::mem::forget(closed);
    }
    Ok(async move {
        let is_warning = tokio::select! {
            _ = terminate.recv() => false,
            _ = interrupt.recv() => false,
            _ = user_1.recv(), if !exit_with_stdin => true,
            _ = user_2.recv(), if !exit_with_stdin => true,
            _ = processor_time.recv(), if !exit_with_stdin => true,
            _ = stdin => false,
        };
        tokio::spawn(async move {
            // A batch system sends SIGTERM after its warning. This first SIGTERM must not exit at once, so that
            // sessions keep their grace period.
            for _ in 0..=usize::from(is_warning) {
                tokio::select! {
                    _ = terminate.recv() => {}
                    _ = interrupt.recv() => {}
                }
            }
            std::process::exit(1);
        });
    })
}
