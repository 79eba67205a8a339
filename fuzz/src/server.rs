//! Fuzz targets for the server, which runs in this process and listens on a Unix socket.
//!
//! After each input, another client, the bystander, runs fixed sessions of both robots and a classic task. It must
//! always get the same bytes.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Duration;

use bytes::Bytes;
use perturb::config::{Config, ListenAddress};
use perturb::proto::session_request::Request;
use perturb::proto::{AutoresetMode, Open, Restore, SessionRequest, Step, Version};
use perturb::server::{self, net::listener::Listener, security::Security};
use perturb::tasks;
use prost::Message;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::UnixStream;
use tokio::runtime::{Builder, Runtime};

/// Maximum time until the server replies. It is long, because the machine may be busy and a sanitizer makes the server
/// slow.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(60);
/// Time without output after which a client is taken to have sent everything.
const CLIENT_SILENCE: Duration = Duration::from_millis(300);
/// The path of the gRPC method that opens sessions.
const SESSION: &str = "/perturb.v1.Perturb/Session";
/// The path of dm_env_rpc's gRPC method.
const PROCESS: &str = "/dm_env_rpc.v1.Environment/Process";
/// The gRPC status code of internal errors.
const INTERNAL: &str = "13";

/// Calls the session method with `data` as the body, which should consist of framed requests.
pub fn requests(data: &[u8]) {
    attack(|socket| exchange(socket, SESSION, data.to_vec()));
}

/// Restores a snapshot and steps the restored environment. The input is a byte that selects an environment, and a
/// snapshot without its checksum. This function adds the checksum.
pub fn snapshots(data: &[u8]) {
    let Some((&choice, snapshot)) = data.split_first() else { return };
    let environments = tasks::catalogue();
    let specs: Vec<_> = environments.specs().collect();
    let environment = specs[usize::from(choice) % specs.len()].name;
    let sealed = [snapshot, &crc32c::crc32c(snapshot).to_le_bytes()].concat();
    let restore = Restore { mask: Bytes::new(), snapshots: vec![sealed.into()] };
    let body = [open(environment, 1), framed(Request::Restore(restore)), steps(environment, 1, 3)].concat();
    attack(|socket| exchange(socket, SESSION, body));
}

/// Calls dm_env_rpc's method with `data` as the body.
pub fn worlds(data: &[u8]) {
    attack(|socket| exchange(socket, PROCESS, data.to_vec()));
}

/// Opens a connection and sends the bytes `data`, without the framing of HTTP/2 or gRPC.
pub fn connections(data: &[u8]) {
    attack(async |socket| {
        let mut connection = UnixStream::connect(socket).await.expect("the server listens");
        // The server may close the connection at any time.
        let _ = connection.write_all(data).await;
        let _ = connection.shutdown().await;
        let mut answer = Vec::new();
        let _ = connection.read_to_end(&mut answer).await;
        answer
    });
}

/// Encodes a request as a gRPC message, with its header.
pub(crate) fn framed(request: Request) -> Vec<u8> {
    frame(&SessionRequest { request: Some(request) }.encode_to_vec())
}

/// Adds the gRPC header to a message: a flag and the length.
pub(crate) fn frame(message: &[u8]) -> Vec<u8> {
    let length = u32::try_from(message.len()).expect("a short message");
    [&[0][..], &length.to_be_bytes(), message].concat()
}

/// Returns the framed request that opens a session of `n` environments.
pub(crate) fn open(environment: &str, n: u32) -> Vec<u8> {
    framed(Request::Open(Open {
        environment: environment.into(),
        version: Version::Random.into(),
        batch_size: n,
        seed: 7,
        autoreset_mode: AutoresetMode::SameStep.into(),
        ..Open::default()
    }))
}

/// Returns `count` framed requests, each of which steps a session of `n` environments.
pub(crate) fn steps(environment: &str, n: usize, count: usize) -> Vec<u8> {
    let width = match environment {
        "Hopper" => 3,
        "HalfCheetah" => 6,
        _ => 1,
    };
    framed(Request::Step(Step { actions: vec![0; 4 * width * n].into() })).repeat(count)
}

/// Runs an attack on the server. Checks that the bystander, another client, gets the same replies as before any attack.
fn attack<F: AsyncFnOnce(&'static Path) -> Vec<u8>>(attack: F) {
    thread_local! {
        static CLIENT: Runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
    }
    let socket = socket();
    CLIENT.with(|client| {
        client.block_on(async {
            tokio::time::timeout(ANSWER_TIMEOUT, attack(socket)).await.expect("an answer, or the connection's end");
            let seen = tokio::time::timeout(ANSWER_TIMEOUT, bystander(socket)).await.expect("an answer to a bystander");
            assert!(seen == *expected(), "a bystander got other bytes");
        });
    });
}

/// Returns the path of the server's socket. The first call starts the server.
fn socket() -> &'static Path {
    static SOCKET: OnceLock<PathBuf> = OnceLock::new();
    SOCKET.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a folder").keep();
        let path = folder.join("server.sock");
        let address = ListenAddress::Unix(path.clone());
        let config =
            Config { listen: vec![address.clone()], workers: 1, max_envs: 256, max_sessions: 64, ..Config::default() };
        let (listening, listens) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
            runtime.block_on(async {
                let listener = Listener::bind(&address, config.socket_mode).await.expect("an address");
                listening.send(()).expect("somebody waits");
                let guards = Security::default();
                let forever = std::future::pending();
                let served = server::run(vec![listener], None, &config, &guards, tasks::catalogue(), forever).await;
                panic!("the server ended: {served:?}");
            });
        });
        listens.recv().expect("a server");
        path
    })
}

/// Returns the bytes that the bystander (another client) got before any attack.
fn expected() -> &'static Vec<u8> {
    static EXPECTED: OnceLock<Vec<u8>> = OnceLock::new();
    EXPECTED.get_or_init(|| {
        let asked = std::thread::spawn(|| {
            let runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
            runtime.block_on(bystander(socket()))
        });
        asked.join().expect("an answer")
    })
}

async fn bystander(socket: &Path) -> Vec<u8> {
    let mut seen = Vec::new();
    for environment in ["Hopper", "HalfCheetah", "Pendulum"] {
        let body = [open(environment, 2), steps(environment, 2, 2)].concat();
        seen.extend(exchange(socket, SESSION, body).await);
    }
    seen
}

/// Calls the session method with this body of framed requests, and returns the messages of the replies.
pub(crate) fn replies_to(body: Vec<u8>) -> Vec<Vec<u8>> {
    let runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
    let bytes = runtime.block_on(exchange(socket(), SESSION, body));
    let mut rest = &bytes[..];
    let mut replies = Vec::new();
    while let Some((header, behind)) = rest.split_first_chunk::<5>() {
        let length = u32::from_be_bytes([header[1], header[2], header[3], header[4]]) as usize;
        let (reply, behind) = behind.split_at(length);
        replies.push(reply.to_vec());
        rest = behind;
    }
    replies
}

/// Returns all bytes that a client sends on a connection for a session with this body, before it receives anything.
pub(crate) fn client_bytes(body: &[u8]) -> Vec<u8> {
    let runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
    runtime.block_on(async {
        let (ours, mut theirs) = tokio::io::duplex(1 << 16);
        let body = body.to_vec();
        tokio::spawn(async move { call(ours, SESSION, body).await });
        let mut sent = vec![0; 1 << 16];
        let mut length = 0;
        // If the client sends nothing for this time, it has sent everything.
        while let Ok(Ok(more)) = tokio::time::timeout(CLIENT_SILENCE, theirs.read(&mut sent[length..])).await {
            length += more;
        }
        sent.truncate(length);
        sent
    })
}

/// Connects to the server and calls the method `path` with this body. Returns the bytes of the replies.
async fn exchange(socket: &Path, path: &str, body: Vec<u8>) -> Vec<u8> {
    let connection = loop {
        match UnixStream::connect(socket).await {
            Ok(connection) => break connection,
            Err(error) if error.kind() == ErrorKind::WouldBlock => tokio::task::yield_now().await,
            Err(error) => panic!("the server does not listen: {error}"),
        }
    };
    call(connection, path, body).await
}

async fn call<T: AsyncRead + AsyncWrite + Unpin + Send + 'static>(connection: T, path: &str, body: Vec<u8>) -> Vec<u8> {
    let (client, connection) = h2::client::handshake(connection).await.expect("HTTP/2");
    let connection = tokio::spawn(connection);
    let mut client = client.ready().await.expect("a connection");
    let request = http::Request::post(format!("http://perturb{path}"))
        .header("content-type", "application/grpc")
        .header("te", "trailers");
    let (response, mut upwards) = client.send_request(request.body(()).expect("a request"), false).expect("a stream");
    let mut replies = Vec::new();
    // The server may end the call before it has received the whole body.
    let _ = upwards.send_data(body.into(), true);
    if let Ok(response) = response.await {
        let mut downwards = response.into_body();
        while let Some(Ok(data)) = downwards.data().await {
            let _ = downwards.flow_control().release_capacity(data.len());
            replies.extend_from_slice(&data);
        }
        if let Ok(Some(trailers)) = downwards.trailers().await {
            let trailer = |name| trailers.get(name).map(|value| String::from_utf8_lossy(value.as_bytes()).into_owned());
            let message = trailer("grpc-message").unwrap_or_default();
            assert!(trailer("grpc-status").as_deref() != Some(INTERNAL) || !message.contains("defect"), "{message}");
        }
    }
    drop(client);
    connection.abort();
    replies
}
