//! Start and end of the server: configuration, addresses, health, reflection, signals, draining.

use crate::common::server::{self, Actor, Server, Session, client, command, environment, open, until, within};
use insta::assert_snapshot;
use perturb::proto::{Release, session_response::Response};
use rstest::rstest;
use std::{
    io::Write,
    net::{TcpListener, TcpStream},
    os::unix::{
        ffi::OsStrExt,
        net::{UnixListener, UnixStream},
        process::ExitStatusExt,
    },
    path::Path,
    process::{Output, Stdio},
    time::{Duration, Instant},
};
use tonic::{Code, Status};
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};

const SERVICE: &str = "perturb.v1.Perturb";

async fn health(address: &str, service: &str) -> Result<ServingStatus, Status> {
    let mut client = HealthClient::new(server::channel(address).await);
    let reply = within(client.check(HealthCheckRequest { service: service.into() })).await?;
    Ok(reply.into_inner().status())
}

/// Runs a server that must end by itself.
pub fn finished(command: &mut std::process::Command) -> Output {
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let start = Instant::now();
    while child.try_wait().unwrap().is_none() {
        if start.elapsed() > Duration::from_secs(30) {
            child.kill().unwrap();
            panic!("{command:?} was not refused: {:?}", child.wait_with_output());
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    child.wait_with_output().unwrap()
}

/// Runs a server that must refuse its settings. Returns its message.
fn refused(mut command: std::process::Command) -> String {
    let Output { status, stdout, stderr } = finished(&mut command);
    let stderr = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(2), "{command:?}: {stderr}");
    assert_eq!(String::from_utf8_lossy(&stdout), "", "{command:?} listened before it refused");
    assert!(!stderr.contains("panicked"), "{stderr}");
    stderr
}

fn file(directory: &Path, text: &str) -> std::path::PathBuf {
    let path = directory.join("server.toml");
    std::fs::write(&path, text).unwrap();
    path
}

/// Returns the maximum number of environments of a session.
async fn max_envs(server: &Server) -> u32 {
    let mut client = server::client(server.tcp()).await;
    let reply = within(client.list_environments(perturb::proto::ListEnvironmentsRequest {})).await.unwrap();
    reply.into_inner().max_batch_size
}

#[rstest]
#[tokio::test]
async fn signal_lets_running_sessions_go_on_and_refuses_new_ones(
    #[values("TERM", "INT", "USR1", "USR2", "XCPU")] signal: &str,
) {
    let mut server = Server::start(&["--grace-seconds", "100000"]);
    let e = environment(server.tcp(), "CartPole").await;
    let actor = Actor::new(&e, 4);
    let (mut session, _) = Session::open(server.tcp(), open("CartPole", 4, 1)).await;
    let (mut twin, _) = Session::open(server.tcp(), open("CartPole", 4, 1)).await;
    let mut not_opened = Session::connect(server.tcp()).await;
    let reference = twin.play(actor, 0, 400).await;
    drop(twin);
    let mut replies = session.play(actor, 0, 200).await;
    let mut client = server::client(server.tcp()).await;
    assert_eq!(health(server.tcp(), SERVICE).await.unwrap(), ServingStatus::Serving);
    assert_eq!(health(server.tcp(), "").await.unwrap(), ServingStatus::Serving);

    server.signal(signal);
    until("health tells of the end", async || {
        health(server.tcp(), SERVICE).await.unwrap() == ServingStatus::NotServing
    })
    .await;
    assert_eq!(health(server.unix(), "").await.unwrap(), ServingStatus::NotServing, "the whole server drains");
    let status = Session::start(&mut client).await.err().expect("a new session is refused");
    assert_eq!(status.code(), Code::Unavailable, "{status:?}");
    assert!(status.message().contains("shutting down"), "{status:?}");
    let status = Session::start(&mut server::client(server.unix()).await).await.err().expect("is refused");
    assert_eq!(status.code(), Code::Unavailable, "also on a new connection: {status:?}");
    not_opened.send(open("CartPole", 1, 1)).await;
    let status = not_opened.end().await;
    assert_eq!(status.code(), Code::Unavailable, "nothing is opened any more: {status:?}");

    if !["TERM", "INT"].contains(&signal) {
        server.signal(signal); // the kernel and batch systems repeat warnings
    }
    replies.extend(session.play(actor, 200, 400).await);
    assert!(replies == reference, "the running session goes on as if nothing had happened");
    assert!(server.child.try_wait().unwrap().is_none(), "the server waits for its session");
    session.close();
    assert_eq!(session.receive().await.unwrap(), None);
    assert_eq!(server.ended().await.code(), Some(0));
    assert!(!server.socket().exists(), "the socket's file is gone");
}

#[tokio::test]
async fn grace_period_ends_sessions_with_unavailable() {
    let mut server = Server::start(&["--grace-seconds", "1"]);
    let (mut silent, _) = Session::open(server.tcp(), open("CartPole", 4, 1)).await;
    // This session always has requests in flight.
    let (mut busy, opened) = Session::open(server.unix(), open("Acrobot", 200, 1)).await;
    let sender = busy.sender();
    busy.close();
    let sending = tokio::spawn(async move {
        let environment = opened.environment.unwrap();
        for t in 0.. {
            let actions = Actor::new(&environment, 200).actions(t % 100);
            let request = Some(server::step(actions));
            if sender.send(perturb::proto::SessionRequest { request }).await.is_err() {
                return;
            }
        }
    });
    for _ in 0..50 {
        busy.receive().await.unwrap().unwrap();
    }
    server.signal("TERM");
    let (silent, busy) = tokio::join!(silent.end(), busy.end());
    for status in [silent, busy] {
        assert_eq!(status.code(), Code::Unavailable, "{status:?}");
        assert!(status.message().contains("this server is shutting down"), "{status:?}");
    }
    assert_eq!(server.ended().await.code(), Some(0));
    sending.abort();
}

#[tokio::test]
async fn server_without_sessions_ends_at_once() {
    // Connections without sessions do not delay the end.
    let mut server = Server::start(&["--grace-seconds", "100000"]);
    let _idle = server::client(server.tcp()).await;
    let mut half = TcpStream::connect(server.port()).unwrap();
    half.write_all(b"PRI * HTTP/2.0\r\n").unwrap();
    server.signal("TERM");
    assert_eq!(server.ended().await.code(), Some(0));
}

#[tokio::test]
async fn the_program_tells_whether_a_server_takes_sessions() {
    let ask = |address: &str| {
        let mut command = command();
        let Output { status, stderr, .. } = finished(command.args(["--health", "--listen", address]));
        (status.code(), String::from_utf8(stderr).unwrap())
    };
    let mut server = Server::start(&["--grace-seconds", "100000"]);
    let (tcp, unix) = (format!("tcp://{}", server.port()), server.unix().to_owned());
    for address in [&tcp, &unix] {
        assert_eq!(ask(address), (Some(0), String::new()), "{address}");
    }
    let (session, _) = Session::open(server.tcp(), open("CartPole", 4, 1)).await;
    server.signal("TERM");
    until("the server drains", async || health(server.tcp(), SERVICE).await.unwrap() == ServingStatus::NotServing)
        .await;
    let (code, words) = ask(&tcp);
    assert!(code == Some(1) && words.contains("it is shutting down"), "{code:?}: {words}");
    drop(session);
    server.ended().await;
    for address in [&tcp, &unix] {
        let (code, words) = ask(address);
        assert!(code == Some(1) && words.contains("the health check of the server at"), "{code:?}: {words}");
    }
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let (code, words) = ask(&format!("tcp://{}", silent.local_addr().unwrap()));
    assert!(code == Some(1) && words.contains("it took more than 3 s"), "{code:?}: {words}");
}

#[tokio::test]
async fn sigterm_right_after_the_address_is_printed_is_an_orderly_end() {
    for _ in 0..10 {
        let mut server = Server::start(&[]);
        server.signal("TERM");
        let status = server.ended().await;
        assert_eq!((status.code(), status.signal()), (Some(0), None));
    }
}

#[tokio::test]
async fn a_second_signal_ends_the_server_at_once() {
    let mut server = Server::start(&["--grace-seconds", "100000"]);
    let (_session, _) = Session::open(server.tcp(), open("CartPole", 4, 1)).await;
    server.signal("TERM");
    until("the server drains", async || health(server.tcp(), SERVICE).await.unwrap() == ServingStatus::NotServing)
        .await;
    server.signal("INT");
    assert_eq!(server.ended().await.code(), Some(1));
}

#[tokio::test]
async fn exit_with_stdin_ends_the_server_with_its_input() {
    let mut server = Server::start(&["--exit-with-stdin"]);
    server.stdin.as_mut().unwrap().write_all(b"words mean nothing\n").unwrap();
    assert_eq!(health(server.tcp(), SERVICE).await.unwrap(), ServingStatus::Serving);
    server.stdin = None;
    assert_eq!(server.ended().await.code(), Some(0));

    let mut server = Server::start(&[]);
    server.stdin = None;
    for _ in 0..20 {
        assert_eq!(health(server.tcp(), SERVICE).await.unwrap(), ServingStatus::Serving, "without the flag it stays");
    }
    assert!(server.child.try_wait().unwrap().is_none());
}

#[tokio::test]
async fn private_server_ends_with_its_input_and_heeds_only_flags() {
    let directory = tempfile::tempdir().unwrap();
    let mut others = command();
    others
        .args(["--private", "--max-sessions", "1", "--listen", "tcp://127.0.0.1:0"])
        .env("PERTURB_SERVER_MAX_ENVS", "7");
    others.env("PERTURB_SERVER_CONFIG", file(directory.path(), "workers = 0"));
    let mut server = Server::spawn(others, directory, 1);
    assert_eq!(max_envs(&server).await, 1 << 24);
    let (_session, _) = Session::open(server.tcp(), open("CartPole", 20_000, 1)).await;
    let second = Session::start(&mut server::client(server.tcp()).await).await.err().expect("flags beat --private");
    assert_eq!(second.code(), Code::ResourceExhausted, "{second:?}");
    for signal in ["USR1", "USR2", "XCPU", "HUP"] {
        server.signal(signal);
        assert_eq!(health(server.tcp(), SERVICE).await.unwrap(), ServingStatus::Serving, "after {signal}");
    }
    let closed = Instant::now();
    server.stdin = None;
    assert_eq!(server.ended().await.code(), Some(0));
    assert!(closed.elapsed() < Duration::from_secs(10), "a second's grace, although a session runs");
}

/// A batch system warns by a signal of its own choice before it sends SIGTERM.
#[tokio::test]
async fn sigterm_after_a_warning_keeps_the_grace_period() {
    let mut server = Server::start(&["--grace-seconds", "60"]);
    let (mut session, _) = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    server.signal("USR1");
    server.signal("TERM");
    tokio::time::sleep(Duration::from_millis(300)).await;
    session.ask(perturb::proto::Reset::default()).await;
    server.signal("TERM");
    assert_eq!(server.ended().await.code(), Some(1), "a second SIGTERM ends it at once");
}

#[tokio::test]
async fn the_catalogue_is_printed_as_a_server_would_tell_it() {
    let printed = command().arg("--catalogue").output().unwrap();
    assert!(printed.status.success(), "{printed:?}");
    let server = Server::start(&[]);
    let mut client = server::client(server.tcp()).await;
    let told = within(client.list_environments(perturb::proto::ListEnvironmentsRequest {})).await.unwrap();
    let told = format!("{:#}\n", perturb_protocol::catalogue::to_json(told.get_ref()));
    assert!(String::from_utf8(printed.stdout).unwrap() == told);
}

#[test]
fn shells_and_man_know_every_flag() {
    let printed = |arguments: &[&str]| {
        let Output { status, stdout, .. } = command().args(arguments).output().unwrap();
        assert!(status.success());
        String::from_utf8(stdout).unwrap()
    };
    for shell in ["bash", "zsh", "fish"] {
        let script = printed(&["--completions", shell]);
        assert!(["max-envs", "keepalive-seconds", "catalogue"].iter().all(|flag| script.contains(flag)), "{script}");
    }
    let page = printed(&["--man"]);
    assert!(page.starts_with(".ie") && page.contains("\\-\\-max\\-envs"), "{page}");
    assert_eq!(command().args(["--man", "--catalogue"]).output().unwrap().status.code(), Some(2));
}

#[tokio::test]
async fn a_stale_socket_is_replaced_a_live_one_and_a_file_are_not() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("perturb.sock");
    let address = format!("unix:{}", socket.display());
    let listen = || {
        let mut command = command();
        command.args(["--listen", &address]);
        command
    };
    drop(UnixListener::bind(&socket).unwrap());
    assert!(socket.exists(), "a dead server's socket");
    let server = Server::spawn(listen(), tempfile::tempdir().unwrap(), 1);
    assert_eq!(server.addresses, std::slice::from_ref(&address));

    let second = finished(&mut listen());
    assert_eq!(second.status.code(), Some(2));
    let message = String::from_utf8(second.stderr).unwrap();
    assert!(
        message.contains("cannot listen at") && message.contains("another program already listens there"),
        "{message}"
    );
    assert_eq!(health(&address, SERVICE).await.unwrap(), ServingStatus::Serving, "the first is still there");
    drop(server); // kills it, so that the socket's file stays
    assert!(UnixStream::connect(&socket).is_err() && socket.exists());
    let server = Server::spawn(listen(), tempfile::tempdir().unwrap(), 1);
    assert_eq!(health(&address, SERVICE).await.unwrap(), ServingStatus::Serving);
    drop(server);

    std::fs::remove_file(&socket).unwrap();
    std::fs::write(&socket, "precious").unwrap();
    assert_eq!(finished(&mut listen()).status.code(), Some(2));
    assert_eq!(std::fs::read_to_string(&socket).unwrap(), "precious");
}

#[tokio::test]
async fn a_successors_socket_stays_when_an_old_server_ends() {
    let directory = tempfile::tempdir().unwrap();
    let address = format!("unix:{}", directory.path().join("perturb.sock").display());
    let listen = || {
        let mut command = command();
        command.args(["--listen", &address]);
        Server::spawn(command, tempfile::tempdir().unwrap(), 1)
    };
    let mut old = listen();
    std::fs::remove_file(old.socket()).unwrap();
    let new = listen();
    old.signal("TERM");
    old.ended().await;
    assert_eq!(health(new.unix(), SERVICE).await.unwrap(), ServingStatus::Serving);
}

#[tokio::test]
async fn socket_of_a_stuck_server_is_in_use() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("perturb.sock");
    let _deaf = UnixListener::bind(&socket).unwrap();
    let mut waiting = Vec::new();
    while let Ok(connection) = tokio::net::UnixStream::connect(&socket).await {
        waiting.push(connection);
    }
    let address = format!("unix:{}", socket.display());
    let message = refused({
        let mut command = command();
        command.args(["--listen", &address]);
        command
    });
    assert!(message.contains("another program already listens there"), "{message}");
}

#[tokio::test]
async fn the_transport_comes_before_physics() {
    let server = Server::start(&["--workers", "2"]);
    let niceness = |task: &Path| {
        let stat = std::fs::read_to_string(task.join("stat")).unwrap();
        // Takes the text after the program's name in parentheses. The wanted field follows the state and fifteen
        // numbers.
        let rest = stat.rsplit_once(") ").unwrap().1.to_owned();
        rest.split(' ').nth(16).unwrap().parse::<i32>().unwrap()
    };
    let tasks = Path::new("/proc").join(server.child.id().to_string()).join("task");
    let mut found = Vec::new();
    until("the workers have started", async || {
        found = std::fs::read_dir(&tasks).unwrap().map(|task| task.unwrap().path()).collect::<Vec<_>>();
        let physics = |task: &&std::path::PathBuf| {
            std::fs::read_to_string(task.join("comm")).is_ok_and(|name| name.starts_with("physics"))
        };
        let transport = niceness(&tasks.join(server.child.id().to_string()));
        found.iter().filter(physics).filter(|task| niceness(task) > transport).count() == 2
    })
    .await;
}

#[test]
fn a_port_in_use_is_an_error_that_names_it() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tcp://{}", taken.local_addr().unwrap());
    let output = finished(command().args(["--listen", &address]));
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2));
    let named = message.contains(&taken.local_addr().unwrap().to_string());
    assert!(named && message.contains("another program already listens there"), "{message}");
}

#[test]
fn a_bad_flag_is_refused_before_any_port_is_bound() {
    let wrong: &[&[&str]] = &[
        &["--workers", "0"],
        &["--workers", "1025"],
        &["--transport-threads", "0"],
        &["--transport-threads", "129"],
        &["--workers", "-1"],
        &["--workers", "two"],
        &["--max-envs", "0"],
        &["--max-envs", "16777217"],
        &["--max-sessions", "0"],
        &["--max-message-bytes", "1023"],
        &["--keepalive-seconds", "0"],
        &["--handshake-seconds", "0"],
        &["--stall-seconds", "86401"],
        &["--max-memory", "1000"],
        &["--keepalive-seconds", "18446744073709551615"],
        &["--grace-seconds", "-1"],
        &["--log", "perturb=loud"],
        &["--listen", "127.0.0.1"],
        &["--listen", "http://127.0.0.1:0"],
        &["--listen", "unix:"],
        &["--colour", "red"],
        &["--config", "/nowhere/server.toml"],
    ];
    let said = wrong.iter().map(|flags| {
        let mut command = command();
        command.args(["--listen", "tcp://127.0.0.1:0"]).args(*flags);
        format!("{}\n{}\n", flags.join(" "), refused(command))
    });
    assert_snapshot!(said.collect::<String>());
}

#[test]
fn a_bad_file_is_refused_before_any_port_is_bound() {
    let directory = tempfile::tempdir().unwrap();
    let wrong = [
        "max_env = 3",
        "workers = 0",
        "workers = \"many\"",
        "workers = -3",
        "listen = [\"127.0.0.1\"]",
        "listen = []",
        "workers = ",
        "[server]\nworkers = 1",
    ];
    let said = wrong.map(|text| {
        let mut command = command();
        // The server runs in the folder of the file, because messages name the file relative to it.
        command.arg("--config").arg(file(directory.path(), text)).current_dir(directory.path());
        format!("{text}\n{}\n", refused(command))
    });
    assert_snapshot!(said.concat());
}

#[test]
fn a_bad_variable_is_refused_before_any_port_is_bound() {
    let wrong = [
        ("PERTURB_SERVER_MAX_ENV", "3"),
        ("PERTURB_SERVER_WORKERS", "0"),
        ("PERTURB_SERVER_WORKERS", "many"),
        ("PERTURB_SERVER_LISTEN", "tcp://127.0.0.1:0,somewhere"),
        ("PERTURB_SERVER_CONFIG", "/nowhere/server.toml"),
    ];
    let said = wrong.map(|(name, value)| {
        let mut command = command();
        command.env(name, value);
        format!("{name}={value}\n{}\n", refused(command))
    });
    assert_snapshot!(said.concat());
}

#[rstest]
#[case::none([None, None, None], 16_384)]
#[case::file([Some("11"), None, None], 11)]
#[case::file_and_variable([Some("11"), Some("22"), None], 22)]
#[case::file_and_flag([Some("11"), None, Some("33")], 33)]
#[case::all([Some("11"), Some("22"), Some("33")], 33)]
#[tokio::test]
async fn a_flag_beats_a_variable_and_a_variable_beats_the_file(
    #[case] given: [Option<&str>; 3],
    #[case] expected: u32,
) {
    let [in_file, variable, flag] = given;
    let directory = tempfile::tempdir().unwrap();
    let mut command = command();
    // The address may also come from the file or from a variable.
    if let Some(n) = in_file {
        let text = format!("max_envs = {n}\nlisten = [\"tcp://127.0.0.1:0\", \"tcp://[::1]:0\"]\n");
        command.env("PERTURB_SERVER_CONFIG", file(directory.path(), &text));
    } else {
        command.env("PERTURB_SERVER_LISTEN", "tcp://127.0.0.1:0,127.0.0.1:0");
    }
    if let Some(n) = variable {
        command.env("PERTURB_SERVER_MAX_ENVS", n);
    }
    if let Some(n) = flag {
        command.args(["--max-envs", n]);
    }
    assert_eq!(max_envs(&Server::spawn(command, directory, 2)).await, expected);
}

#[tokio::test]
async fn variables_of_other_programs_are_none_of_its_business() {
    let mut command = command();
    command.env("SOMETHING", std::ffi::OsStr::from_bytes(b"\xFF\xFE")).args(["--listen", "tcp://127.0.0.1:0"]);
    let server = Server::spawn(command, tempfile::tempdir().unwrap(), 1);
    assert_eq!(health(server.tcp(), SERVICE).await.unwrap(), ServingStatus::Serving);
}

#[tokio::test]
async fn health_knows_the_service_and_no_other() {
    let server = Server::start(&[]);
    for address in [server.tcp(), server.unix()] {
        assert_eq!(health(address, SERVICE).await.unwrap(), ServingStatus::Serving);
        assert_eq!(health(address, "").await.unwrap(), ServingStatus::Serving);
        assert_eq!(health(address, "perturb.v1.Other").await.unwrap_err().code(), Code::NotFound);
    }
}

/// Requests the services, and the file of one symbol, from a version of the reflection service.
macro_rules! reflect {
    ($version:ident, $address:expr) => {{
        use tonic_reflection::pb::$version::{
            ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
            server_reflection_request::MessageRequest, server_reflection_response::MessageResponse,
        };
        let mut client = ServerReflectionClient::new(server::channel($address).await);
        let ask = |request| ServerReflectionRequest { message_request: Some(request), ..Default::default() };
        let requests = [
            ask(MessageRequest::ListServices(String::new())),
            ask(MessageRequest::FileContainingSymbol(format!("{SERVICE}.Session"))),
            ask(MessageRequest::FileContainingSymbol("perturb.v1.Interval".into())),
        ];
        let mut replies =
            within(client.server_reflection_info(tokio_stream::iter(requests))).await.unwrap().into_inner();
        let mut next = async || within(replies.message()).await.unwrap().unwrap().message_response.unwrap();
        let names: Vec<String> = match next().await {
            MessageResponse::ListServicesResponse(list) => list.service.into_iter().map(|s| s.name).collect(),
            other => panic!("{other:?}"),
        };
        for name in [SERVICE, "dm_env_rpc.v1.Environment", "grpc.health.v1.Health"] {
            assert!(names.iter().any(|listed| listed == name), "{name} is not in {names:?}");
        }
        for _ in 0..2 {
            match next().await {
                MessageResponse::FileDescriptorResponse(file) => {
                    let file = String::from_utf8_lossy(&file.file_descriptor_proto[0]).into_owned();
                    assert!(file.contains("perturb/v1/perturb.proto") && file.contains("AutoresetMode"));
                }
                other => panic!("{other:?}"),
            }
        }
    }};
}

#[tokio::test]
async fn reflection_lists_and_describes_the_service_in_v1_and_v1alpha() {
    let server = Server::start(&[]);
    reflect!(v1, server.tcp());
    reflect!(v1alpha, server.unix());
}

#[tokio::test]
async fn many_sessions_share_a_connection() {
    let server = Server::start(&[]);
    let mut client = server::client(server.unix()).await;
    let mut sessions = Vec::new();
    for seed in 0..500 {
        let mut session = Session::start(&mut client).await.unwrap();
        session.ask(open("MountainCar", 1, seed)).await;
        sessions.push(session);
    }
}

#[tokio::test]
async fn requests_are_counted_by_kind_and_told_at_the_end() {
    let mut server = Server::start(&["--log", "perturb=debug"]);
    let (mut session, opened) = Session::open(server.tcp(), open("CartPole", 2, 1)).await;
    let environment = opened.environment.unwrap();
    session.play(Actor::new(&environment, 2), 0, 3).await;
    session.refused(server::step(&b"x"[..])).await;
    drop(session);
    server.signal("TERM");
    server.ended().await;
    let log = server.log();
    assert!(log.contains("open 1 (0 refused), step 4 (1 refused), reset 0 (0 refused)"), "{log}");
    assert!(log.contains("create_world 0 (0 refused)"), "{log}");
    assert!(
        log.contains(
            r#"request{kind="step"}: perturb::server::session::instrumented: refused refusal="step.actions is 1 bytes"#
        ),
        "{log}"
    );
}

#[rstest]
#[case::small(64)]
#[case::large(200)]
#[tokio::test]
async fn a_session_that_ended_in_order_has_freed_its_places(#[case] envs: u32) {
    const OPENS: u64 = 1_000;
    // A single session fills the server, so each `open` needs all environments of the previous session.
    let server = Server::start(&["--max-envs", &envs.to_string(), "--max-sessions", "1"]);
    let mut connection = client(server.tcp()).await;
    for seed in 0..OPENS {
        let mut session = Session::start(&mut connection).await.expect("a place for a session is free");
        let opened = session.answer(open("CartPole", envs, seed)).await;
        assert!(matches!(opened, Response::Opened(_)), "open {seed}: {opened:?}");
        session.close();
        assert_eq!(session.end().await.code(), Code::Ok);
    }
}

#[tokio::test]
async fn released_environments_have_freed_their_places() {
    let server = Server::start(&["--max-envs", "200"]);
    let (mut first, _) = Session::open(server.tcp(), open("CartPole", 200, 1)).await;
    let mask: Vec<u8> = (0..200).map(|slot| u8::from(slot >= 100)).collect();
    first.ask(Release { mask: mask.into() }).await;
    let mut connection = client(server.tcp()).await;
    for seed in 0..100 {
        let mut other = Session::start(&mut connection).await.unwrap();
        let opened = other.answer(open("CartPole", 100, seed)).await;
        assert!(matches!(opened, Response::Opened(_)), "open {seed}: {opened:?}");
        other.close();
        assert_eq!(other.end().await.code(), Code::Ok);
    }
}

#[test]
fn the_contract_is_printed_as_it_is() {
    let printed = command().arg("--proto").output().unwrap().stdout;
    let own = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/proto/perturb/v1/perturb.proto")).unwrap();
    assert!(printed == own);
}

#[test]
fn variables_of_kubernetes_do_not_keep_a_server_from_starting() {
    let directory = tempfile::tempdir().unwrap();
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0"]);
    command.env("PERTURB_SERVER_PORT", "tcp://10.96.3.7:7447").env("PERTURB_SERVER_SERVICE_HOST", "10.96.3.7");
    command.env("PERTURB_SERVER_PORT_7447_TCP_ADDR", "10.96.3.7");
    Server::spawn(command, directory, 1);
}

#[test]
fn printed_address_of_a_socket_is_absolute() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().canonicalize().unwrap();
    let mut command = command();
    command.current_dir(&path).args(["--listen", "unix:my.sock"]);
    let server = Server::spawn(command, directory, 1);
    assert_eq!(server.addresses[0], format!("unix:{}", path.join("my.sock").display()));
}
