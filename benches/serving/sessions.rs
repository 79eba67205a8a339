//! Many concurrent sessions, each on its own connection and with one request at a time, over TCP with and without TLS.
//! Run `cargo bench --bench serving -- sessions`, or give a part of an id such as `sessions/CartPole/plain`. The
//! clients run on the same machine, on as many threads as it has cores, and take more CPU time than the server's
//! transport threads.

use super::{
    Failure,
    client::{Client, ServerProcess},
    encrypted::{certificates, connect},
};
use futures_util::future::try_join_all;
use perturb::tasks;
use perturb_faults::certificates::CertificateFiles;
use perturb_protocol::credentials::Credentials;
use std::{
    fs,
    path::Path,
    sync::Barrier,
    thread,
    time::{Duration, Instant},
};

/// The number of environments in a session.
const BATCH: usize = 16;
const SESSIONS: [usize; 5] = [1, 4, 16, 64, 256];
const TRANSPORT_THREADS: [usize; 3] = [1, 2, 4];
/// The time at the start of a run during which requests are not measured.
const WARM_UP: Duration = Duration::from_millis(500);
/// The time after [`WARM_UP`] during which requests are measured.
const MEASURED: Duration = Duration::from_secs(2);

/// Measures each combination of settings for whose id `wanted` returns true.
pub(crate) fn measure(wanted: impl Fn(&str) -> bool) -> Result<(), Failure> {
    let directory = tempfile::tempdir()?;
    let files = certificates(directory.path());
    for name in ["CartPole", "Hopper"].into_iter().filter(|name| tasks::catalogue().find(name).is_ok()) {
        for tls in [None, Some(&files)] {
            for threads in TRANSPORT_THREADS {
                for sessions in SESSIONS {
                    let transport = if tls.is_some() { "tls" } else { "plain" };
                    let id = format!("sessions/{name}/{transport}/{threads}/{sessions}");
                    if wanted(&id) {
                        let line = served(name, tls, threads, sessions)?;
                        println!("{id:<32} {line}");
                    }
                }
            }
        }
    }
    Ok(())
}

/// Measures `sessions` concurrent sessions, with a server that has `threads` transport threads. Returns a line of
/// output.
fn served(name: &str, tls: Option<&CertificateFiles>, threads: usize, sessions: usize) -> Result<String, Failure> {
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let threads = threads.to_string();
    let mut flags = vec![("--transport-threads", Path::new(&threads))];
    let certificate = tls.map(|files| files.cert.as_path());
    if let Some(CertificateFiles { cert, key }) = tls {
        flags.extend([("--tls-cert", cert.as_path()), ("--tls-key", key.as_path())]);
    }
    let server = ServerProcess::tcp(cores, &flags)?;
    let drivers = sessions.min(cores);
    let begin = Barrier::new(drivers + 1);
    let (mut micros, cpu) = thread::scope(|scope| {
        let share = |driver| sessions / drivers + usize::from(driver < sessions % drivers);
        let drive = |driver| {
            let (address, begin) = (server.address.as_str(), &begin);
            scope.spawn(move || drive(address, certificate, name, share(driver), begin).map_err(|e| e.to_string()))
        };
        let running: Vec<_> = (0..drivers).map(drive).collect();
        begin.wait();
        thread::sleep(WARM_UP);
        let before = transport_seconds(&server)?;
        thread::sleep(MEASURED);
        let cpu = transport_seconds(&server)? - before;
        let mut micros = Vec::new();
        for driver in running {
            micros.extend(driver.join().map_err(|_| "a client panicked")??);
        }
        Ok::<_, Failure>((micros, cpu))
    })?;
    micros.sort_by(f64::total_cmp);
    let quantile = |q: f64| micros[(q * (micros.len() - 1) as f64) as usize];
    let rate = micros.len() as f64 / MEASURED.as_secs_f64();
    let each = cpu / micros.len() as f64 * 1e6;
    let (p50, p99) = (quantile(0.5), quantile(0.99));
    Ok(format!(
        "{rate:>8.0} requests/s, {each:>6.1} us of transport threads each, {p50:>8.1} us p50, {p99:>8.1} us p99"
    ))
}

/// Opens sessions and steps all of them concurrently. Returns the durations of the measured requests, in µs.
fn drive(
    address: &str,
    certificate: Option<&Path>,
    name: &str,
    sessions: usize,
    begin: &Barrier,
) -> Result<Vec<f64>, Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let opened = try_join_all((0..sessions).map(|_| async {
            let credentials = certificate.map_or_else(|| Ok(Credentials::default()), Credentials::pinned)?;
            let connection = connect(address, credentials).await?;
            Ok::<_, Failure>((Client::on(&connection, name, BATCH).await?, connection))
        }));
        let opened = opened.await;
        begin.wait(); // even after an error, because other threads wait here
        let mut clients = opened?;
        let from = Instant::now() + WARM_UP;
        let times = try_join_all(clients.iter_mut().map(|(client, _)| async move {
            let mut times = Vec::new();
            while from.elapsed() < MEASURED {
                let seconds = client.run(1).await?;
                if Instant::now() > from {
                    times.push(seconds * 1e6);
                }
            }
            Ok::<_, Failure>(times)
        }));
        Ok(times.await?.concat())
    })
}

/// Returns the CPU time of a server's transport threads, in seconds. These are its first thread and all threads whose
/// name begins with `transport-`.
fn transport_seconds(server: &ServerProcess) -> Result<f64, Failure> {
    let mut nanos = 0;
    for task in fs::read_dir(server.proc().join("task"))? {
        let task = task?;
        let is_first = server.proc().file_name() == Some(&task.file_name());
        if is_first || fs::read_to_string(task.path().join("comm"))?.starts_with("transport-") {
            let times = fs::read_to_string(task.path().join("schedstat"))?;
            nanos += times.split_whitespace().next().ok_or("no processor time")?.parse::<u64>()?;
        }
    }
    Ok(nanos as f64 / 1e9)
}
