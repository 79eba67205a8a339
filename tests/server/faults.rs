//! Bad input, bad clients and bad luck, each tried against a running server beside another session, which must not
//! notice: its bytes equal those of an undisturbed run.

use crate::common::server::{self, Actor, Server, Session, doubles, environment, open, parameters, until, within};
use bytes::Bytes;
use perturb::proto::{
    self, Environment, Open, Reset, Restore, SessionRequest, SessionResponse, Snapshot, Step, session_request::Request,
    session_response::Response,
};
use std::{
    io::{Read, Write},
    net::TcpStream,
    os::unix::net::UnixStream,
    process::{Child, Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;

const CLIENT: &str = "PERTURB_TEST_CLIENT_OF";

/// A session that steps all the time, beside whatever a test does.
struct Bystander {
    address: String,
    environment: Environment,
    steps: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
    task: JoinHandle<(Session, Vec<SessionResponse>)>,
}

impl Bystander {
    const N: u32 = 3;

    async fn start(address: &str) -> Self {
        let environment = environment(address, "Pendulum").await;
        let (mut session, _) = Session::open(address, open("Pendulum", Self::N, 99)).await;
        let (steps, stop) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let task = tokio::spawn({
            let (environment, steps, stop) = (environment.clone(), Arc::clone(&steps), Arc::clone(&stop));
            async move {
                let (actor, mut replies) = (Actor::new(&environment, Self::N as usize), Vec::new());
                while !stop.load(Ordering::Relaxed) {
                    let t = replies.len() as u64;
                    replies.extend(session.play(actor, t, t + 1).await);
                    steps.store(t + 1, Ordering::Relaxed);
                    tokio::time::sleep(Duration::from_micros(300)).await;
                }
                (session, replies)
            }
        });
        let bystander = Self { address: address.into(), environment, steps, stop, task };
        bystander.goes_on().await;
        bystander
    }

    /// Waits until it has taken more steps.
    async fn goes_on(&self) {
        let before = self.steps.load(Ordering::Relaxed);
        until("the other session goes on", async || {
            assert!(!self.task.is_finished(), "the other session failed");
            self.steps.load(Ordering::Relaxed) >= before + 20
        })
        .await;
    }

    /// Ends it and compares with an undisturbed run of as many steps.
    async fn ends_unharmed(self) {
        self.goes_on().await;
        self.stop.store(true, Ordering::Relaxed);
        let (session, replies) = within(self.task).await.unwrap();
        drop(session);
        let (mut reference, _) = Session::open(&self.address, open("Pendulum", Self::N, 99)).await;
        let actor = Actor::new(&self.environment, Self::N as usize);
        let reference = reference.play(actor, 0, replies.len() as u64).await;
        assert!(replies == reference, "the other session's bytes changed");
    }
}

/// A refusal: the request, its code, and what its message must say.
type Case = (Request, Code, &'static [&'static str]);

fn step(actions: impl Into<Bytes>) -> Request {
    Request::Step(Step { actions: actions.into() })
}

fn f32s(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}

fn i32s(numbers: &[i32]) -> Vec<u8> {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}

/// Tries each on an open session, and checks that its bytes stay those of a twin to which nothing was done.
async fn all_refused(address: &str, e: &Environment, n: u32, cases: Vec<Case>) {
    let (mut session, _) = Session::open(address, open(&e.name, n, 1)).await;
    let (mut twin, _) = Session::open(address, open(&e.name, n, 1)).await;
    let actor = Actor::new(e, n as usize);
    let mut t = 0;
    for case in cases {
        refused(&mut session, case.clone()).await;
        assert!(
            session.play(actor, t, t + 40).await == twin.play(actor, t, t + 40).await,
            "{case:?} changed something"
        );
        t += 40;
    }
    assert_eq!(session.snapshot(&[]).await, twin.snapshot(&[]).await);
}

async fn refused(session: &mut Session, (request, expected, words): Case) {
    let (code, message) = session.refused(request.clone()).await;
    assert_eq!(code, expected, "{request:?}: {message}");
    for word in words {
        assert!(message.contains(word), "{request:?}: {message:?} does not say {word:?}");
    }
}

#[tokio::test]
async fn wrong_requests_before_open_are_refused_and_open_still_works() {
    let server = Server::start(&["--max-envs", "1000"]);
    let bystander = Bystander::start(server.tcp()).await;
    let base = || open("CartPole", 4, 1);
    let bad = |change: fn(&mut Open)| {
        let mut open = base();
        change(&mut open);
        Request::Open(open)
    };
    let set = |name: &str, intervals: &[(f64, f64)]| {
        Request::Open(Open { parameters: parameters(&[(name, intervals)]), ..base() })
    };
    let (nan, inf) = (f64::NAN, f64::INFINITY);
    use Code::{FailedPrecondition, InvalidArgument, NotFound, ResourceExhausted};
    let cases: Vec<Case> = vec![
        (step(i32s(&[0; 4])), FailedPrecondition, &["step", "open first"]),
        (Request::Reset(Reset::default()), FailedPrecondition, &["reset", "open first"]),
        (Request::Snapshot(Snapshot::default()), FailedPrecondition, &["snapshot", "open first"]),
        (Request::Restore(Restore::default()), FailedPrecondition, &["restore", "open first"]),
        (bad(|o| o.environment = "cartpole".into()), NotFound, &["\"cartpole\"", "CartPole, MountainCar"]),
        (bad(|o| o.environment.clear()), NotFound, &["\"\"", "CartPole"]),
        (bad(|o| o.environment = "x\0\n".into()), NotFound, &["CartPole"]),
        (bad(|o| o.version = 0), InvalidArgument, &["open.version", "is 0", "VERSION_DEFAULT"]),
        (bad(|o| o.version = 4), InvalidArgument, &["open.version", "is 4", "VERSION_DEFAULT"]),
        (bad(|o| o.version = -1), InvalidArgument, &["open.version", "is -1"]),
        (bad(|o| o.autoreset_mode = 0), InvalidArgument, &["open.autoreset_mode", "is 0", "AUTORESET_MODE_NEXT_STEP"]),
        (bad(|o| o.autoreset_mode = 77), InvalidArgument, &["open.autoreset_mode", "is 77"]),
        (bad(|o| o.batch_size = 0), InvalidArgument, &["open.batch_size is 0", "at least 1"]),
        (bad(|o| o.batch_size = 1_000_000_000), ResourceExhausted, &["1000000000", "of this server's 1000"]),
        (bad(|o| o.batch_size = u32::MAX), ResourceExhausted, &["4294967295", "3 of this server's 1000 are in use"]),
        (bad(|o| o.batch_size = 998), ResourceExhausted, &["998", "open fewer"]),
        (bad(|o| o.first_environment_index = u32::MAX), InvalidArgument, &["first_environment_index", "4294967295"]),
        (bad(|o| o.first_environment_index = u32::MAX - 2), InvalidArgument, &["below 2^32"]),
        (set("Force", &[(1.0, 1.0)]), NotFound, &["\"Force\"", "force, length, mass"]),
        (set("", &[(1.0, 1.0)]), NotFound, &["force, length, mass"]),
        (set("force", &[]), InvalidArgument, &["\"force\"", "empty", "1 to 64 intervals"]),
        (set("force", &[(nan, 1.0)]), InvalidArgument, &["\"force\"", "NaN", "finite"]),
        (set("force", &[(1.0, inf)]), InvalidArgument, &["inf", "finite"]),
        (set("force", &[(-inf, inf)]), InvalidArgument, &["-inf", "finite"]),
        (set("force", &[(2.0, 1.0)]), InvalidArgument, &["[2, 1]", "low at most high"]),
        (set("force", &[(1.0, 3.0), (2.0, 4.0)]), InvalidArgument, &["[1, 3] ∪ [2, 4]", "do not overlap"]),
        (set("force", &[(3.0, 4.0), (1.0, 2.0)]), InvalidArgument, &["ascending"]),
        (set("force", &[(1.0, 2.0), (3.0, 3.0)]), InvalidArgument, &["positive length"]),
        (set("force", &[(1000.5, 1000.5)]), InvalidArgument, &["\"force\"", "1000.5 N", "[0, 1000]"]),
        (set("length", &[(-0.5, 0.5)]), InvalidArgument, &["\"length\"", "-0.5 m", "[0.001, 100]"]),
        (set("length", &[(0.0, 0.0)]), InvalidArgument, &["\"length\"", "0 m", "[0.001, 100]"]),
        (set("mass", &[(0.1, 0.2), (1e300, 1e308)]), InvalidArgument, &["\"mass\"", "kg"]),
    ];
    let mut session = Session::connect(server.unix()).await;
    for case in cases {
        refused(&mut session, case).await;
    }
    // Whatever was refused has left nothing behind: the rest of the room is there, to the last place.
    match session.ask(bad(|o| (o.batch_size, o.first_environment_index) = (997, u32::MAX - 996))).await {
        Response::Opened(opened) => {
            assert_eq!(opened.started[996].episode.as_ref().unwrap().environment_index, u32::MAX);
        }
        other => panic!("a right open was answered by {other:?}"),
    }
    refused(&mut session, (Request::Open(base()), FailedPrecondition, &["open already", "another session"])).await;
    drop(session);
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn wrong_actions_are_refused() {
    let server = Server::start(&[]);
    let bystander = Bystander::start(server.tcp()).await;
    use Code::InvalidArgument as Bad;
    let discrete: Vec<Case> = vec![
        (step(vec![]), Bad, &["step.actions is 0 bytes", "16 bytes: int32 [N]", "N = 4"]),
        (step(vec![0; 15]), Bad, &["15 bytes", "16 bytes"]),
        (step(vec![0; 17]), Bad, &["17 bytes", "16 bytes"]),
        (step(vec![0; 20]), Bad, &["20 bytes", "16 bytes"]),
        (step(vec![0; 1 << 20]), Bad, &["1048576 bytes", "16 bytes"]),
        (step(i32s(&[0, 1, 2, 0])), Bad, &["2 in slot 2", "0 … 1"]),
        (step(i32s(&[-1, 0, 0, 0])), Bad, &["-1 in slot 0", "0 … 1"]),
        (step(i32s(&[0, 0, 0, i32::MIN])), Bad, &["-2147483648 in slot 3"]),
        (step(f32s(&[1.0; 4])), Bad, &["1065353216 in slot 0"]),
    ];
    all_refused(server.tcp(), &environment(server.tcp(), "CartPole").await, 4, discrete).await;
    let continuous: Vec<Case> = vec![
        (step(f32s(&[0.0])), Bad, &["4 bytes", "8 bytes: float32 [N, A]", "A = 1"]),
        (step(doubles(&[0.0, 0.0])), Bad, &["16 bytes", "8 bytes"]),
        (step(f32s(&[0.0, f32::NAN])), Bad, &["NaN in slot 1, entry 0", "finite"]),
        (step(f32s(&[f32::INFINITY, 0.0])), Bad, &["inf in slot 0", "finite"]),
        (step(f32s(&[0.0, f32::NEG_INFINITY])), Bad, &["-inf in slot 1", "finite"]),
    ];
    all_refused(server.unix(), &environment(server.tcp(), "Pendulum").await, 2, continuous).await;
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn wrong_resets_snapshots_and_restores_are_refused() {
    let server = Server::start(&[]);
    let bystander = Bystander::start(server.tcp()).await;
    let (mut cart, _) = Session::open(server.tcp(), open("CartPole", 3, 1)).await;
    let (mut pendulum, _) = Session::open(server.tcp(), open("Pendulum", 3, 1)).await;
    let (good, foreign) = (cart.snapshot(&[]).await, pendulum.snapshot(&[]).await);
    let random: Vec<Bytes> = (0..3).map(|i| (0..200).map(|j| server::mixed(200 * i + j) as u8).collect()).collect();
    let reset = |change: fn(&mut Reset)| {
        let mut reset = Reset::default();
        change(&mut reset);
        Request::Reset(reset)
    };
    let set = |intervals: &[(f64, f64)]| {
        Request::Reset(Reset { parameters: parameters(&[("mass", intervals)]), ..Reset::default() })
    };
    let restore = |mask: &'static [u8], snapshots: Vec<Bytes>| {
        Request::Restore(Restore { mask: Bytes::from_static(mask), snapshots })
    };
    use Code::InvalidArgument as Bad;
    let cases: Vec<Case> = vec![
        (reset(|r| r.mask = vec![1].into()), Bad, &["reset.mask is 1 bytes", "each of the 3 environments"]),
        (reset(|r| r.mask = vec![1; 4].into()), Bad, &["reset.mask is 4 bytes"]),
        (reset(|r| r.mask = vec![1, 0, 255].into()), Bad, &["255 in slot 2", "0 or 1"]),
        (reset(|r| r.seeds = vec![1, 2]), Bad, &["2 seeds", "3 selected"]),
        (reset(|r| (r.mask, r.seeds) = (vec![0, 0, 1].into(), vec![1, 2, 3])), Bad, &["3 seeds", "1 selected"]),
        (reset(|r| (r.mask, r.seeds) = (vec![0; 3].into(), vec![1])), Bad, &["1 seeds", "0 selected"]),
        (reset(|r| r.states = doubles(&[0.0; 4])), Bad, &["32 bytes", "96 bytes: float64 [M, S]", "M = 3, S = 4"]),
        (reset(|r| r.states = vec![0; 95].into()), Bad, &["95 bytes", "96 bytes"]),
        (reset(|r| (r.seeds, r.states) = (vec![1; 3], doubles(&[f64::NAN; 12]))), Bad, &["NaN", "cart_position"]),
        (reset(|r| r.states = doubles(&[&[0.0; 11][..], &[f64::INFINITY]].concat())), Bad, &["inf", "row 2"]),
        (reset(|r| r.states = doubles(&[2.5; 12])), Bad, &["2.5 m for cart_position", "[-2.4, 2.4]"]),
        (reset(|r| r.parameters = parameters(&[("gravity", &[(1.0, 1.0)])])), Code::NotFound, &["gravity", "mass"]),
        (set(&[]), Bad, &["empty"]),
        (set(&[(f64::NAN, f64::NAN)]), Bad, &["NaN", "finite"]),
        (set(&[(2.0, 1.0)]), Bad, &["low at most high"]),
        (set(&[(1.0, 2.0), (1.5, 3.0)]), Bad, &["do not overlap"]),
        (set(&[(0.0, 1.0)]), Bad, &["\"mass\"", "0 kg", "[0.0001, 1000]"]),
        (Request::Snapshot(Snapshot { mask: vec![1, 1].into() }), Bad, &["snapshot.mask is 2 bytes"]),
        (Request::Snapshot(Snapshot { mask: vec![9, 1, 1].into() }), Bad, &["9 in slot 0"]),
        (restore(&[], vec![]), Bad, &["0 snapshots", "3 selected"]),
        (restore(&[0, 1, 0], good.clone()), Bad, &["3 snapshots", "1 selected"]),
        (restore(&[1], good.clone()), Bad, &["restore.mask"]),
        (restore(&[], vec![Bytes::new(); 3]), Bad, &["snapshot cannot be restored", "0 bytes are not a snapshot"]),
        (restore(&[], random), Bad, &["snapshot cannot be restored"]),
        (restore(&[], vec![Bytes::from(vec![0xFF; 100_000]); 3]), Bad, &["snapshot cannot be restored"]),
        (restore(&[], foreign), Bad, &["Pendulum", "CartPole"]),
        (restore(&[], vec![good[0].clone(), good[1].clone(), good[2].slice(..30)]), Bad, &["not a snapshot"]),
        (restore(&[], vec![good[0].slice(1..), good[1].clone(), good[2].clone()]), Bad, &["snapshot cannot"]),
    ];
    all_refused(server.tcp(), &environment(server.tcp(), "CartPole").await, 3, cases).await;
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn a_snapshot_with_any_byte_changed_is_refused_or_harmless() {
    let server = Server::start(&["--workers", "1"]);
    for e in &server::catalogue(server.tcp()).await {
        let actor = Actor::new(e, 1);
        let (mut session, _) = Session::open(server.tcp(), Open { receipts: false, ..open(&e.name, 1, 1) }).await;
        session.play(actor, 0, 3).await;
        let good = session.snapshot(&[]).await.remove(0);
        for i in 0..good.len() {
            for byte in [0, 1, 0x7F, 0x80, 0xFF, good[i] ^ 1, good[i] ^ 0x40] {
                let mut bad = good.to_vec();
                bad[i] = byte;
                let request = Request::Restore(Restore { mask: Bytes::new(), snapshots: vec![bad.into()] });
                match session.ask(request).await {
                    Response::Error(error) => assert_eq!(error.code, Code::InvalidArgument as i32, "{error:?}"),
                    Response::Restore(_) => {
                        // What it was restored to can be run, reset and saved.
                        session.play(actor, 0, 5).await;
                        session.reset(Reset::default()).await;
                        let saved = session.snapshot(&[]).await;
                        session.restore(&[], saved).await;
                    }
                    other => panic!("restore was answered by {other:?}"),
                }
            }
        }
        session.restore(&[], vec![good.clone()]).await;
        assert_eq!(session.snapshot(&[]).await, [good]);
    }
    assert!(!server.log().contains("panicked"), "{}", server.log());
}

/// A request that this protocol does not know.
#[derive(Clone, PartialEq, prost::Message)]
struct Unknown {
    #[prost(uint64, tag = "99")]
    something: u64,
}

/// A request whose `open` is a number.
#[derive(Clone, PartialEq, prost::Message)]
struct Malformed {
    #[prost(uint64, tag = "1")]
    open: u64,
}

async fn raw<T: prost::Message + Default + 'static>(
    address: &str,
    path: &'static str,
    message: T,
) -> Result<Option<SessionResponse>, tonic::Status> {
    let mut grpc = tonic::client::Grpc::new(server::channel(address).await);
    within(grpc.ready()).await.unwrap();
    let (sender, receiver) = tokio::sync::mpsc::channel(1);
    sender.send(message).await.unwrap();
    let codec = tonic_prost::ProstCodec::<T, SessionResponse>::default();
    let request = tonic::Request::new(ReceiverStream::new(receiver));
    let mut responses = within(grpc.streaming(request, path.parse().unwrap(), codec)).await?.into_inner();
    within(responses.message()).await
}

#[tokio::test]
async fn an_empty_or_unknown_request_is_refused_and_a_malformed_one_ends_its_session_only() {
    const PATH: &str = "/perturb.v1.Perturb/Session";
    let server = Server::start(&[]);
    let bystander = Bystander::start(server.tcp()).await;
    match raw(server.tcp(), PATH, SessionRequest::default()).await.unwrap().unwrap().response.unwrap() {
        Response::Error(error) => {
            assert_eq!(error.code, Code::InvalidArgument as i32);
            assert!(error.message.contains("request is empty"), "{error:?}");
        }
        other => panic!("{other:?}"),
    }
    match raw(server.tcp(), PATH, Unknown { something: 5 }).await.unwrap().unwrap().response.unwrap() {
        Response::Error(error) => assert_eq!(error.code, Code::InvalidArgument as i32, "{error:?}"),
        other => panic!("{other:?}"),
    }
    let status = raw(server.tcp(), PATH, Malformed { open: 1 }).await.unwrap_err();
    assert_eq!(status.code(), Code::Internal, "{status:?}");
    let status = raw(server.tcp(), "/perturb.v1.Perturb/Nothing", SessionRequest::default()).await.unwrap_err();
    assert_eq!(status.code(), Code::Unimplemented, "{status:?}");
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn an_oversized_message_ends_its_session_and_frees_its_environments() {
    let server = Server::start(&["--max-message-bytes", "4096", "--max-envs", "10"]);
    let bystander = Bystander::start(server.tcp()).await;
    for size in [4_097, 100_000, 20_000_000] {
        let mut session = Session::connect(server.tcp()).await;
        until("seven environments are free", async || {
            matches!(session.ask(Request::Open(open("CartPole", 7, 1))).await, Response::Opened(_))
        })
        .await;
        let (code, message) = session.refused(step(vec![0; 4_000])).await;
        assert_eq!(code, Code::InvalidArgument, "a message below the limit is read: {message}");
        session.send(step(vec![0; size])).await;
        let status = session.end().await;
        assert_eq!(status.code(), Code::OutOfRange, "{status:?}");
        assert!(status.message().contains("4096"), "the limit is told: {status:?}");
    }
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn garbage_bytes_on_the_port_harm_nobody() {
    const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
    let server = Server::start(&["--workers", "1"]);
    let (tcp, unix) = (Bystander::start(server.tcp()).await, Bystander::start(server.unix()).await);
    let noise: Vec<u8> = (0..100_000).map(|i| server::mixed(i) as u8).collect();
    let settings = [0, 0, 0, 4, 0, 0, 0, 0, 0];
    let pieces: Vec<Vec<u8>> = vec![
        noise.clone(),
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n".to_vec(),
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".to_vec(), // a TLS handshake
        b"\n".to_vec(),
        Vec::new(),
        PREFACE[..11].to_vec(),
        [PREFACE, &noise].concat(),
        [PREFACE, &settings, &noise].concat(),
        [PREFACE, &[0xFF; 9]].concat(),
        [PREFACE, &settings, &[0, 0, 5, 1, 4, 0, 0, 0, 1], b"\xFF\xFF\xFF\xFF\xFF"].concat(), // headers that are none
    ];
    let mut open_connections: Vec<Box<dyn Read>> = Vec::new();
    for piece in &pieces {
        let mut connections: Vec<Box<dyn ReadWrite>> = vec![
            Box::new(TcpStream::connect(server.port()).unwrap()),
            Box::new(UnixStream::connect(server.socket()).unwrap()),
        ];
        for connection in &mut connections {
            // The server may hang up before it has read everything.
            let _ = connection.write_all(piece);
            let _ = connection.flush();
        }
        // Some hang up, some stay.
        drop(connections.swap_remove(0));
        open_connections.push(Box::new(connections.remove(0)));
        tcp.goes_on().await;
    }
    unix.ends_unharmed().await;
    tcp.ends_unharmed().await;
    drop(open_connections);
}

trait ReadWrite: Read + Write {}
impl<T: Read + Write> ReadWrite for T {}

/// Not a test of its own: the client that other tests start as a process, to kill it.
#[test]
#[ignore = "a process for other tests"]
fn client_that_steps_for_ever() {
    let Ok(address) = std::env::var(CLIENT) else { return };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let environment = environment(&address, "Acrobot").await;
        let mut session = Session::connect(&address).await;
        until("there is room", async || {
            matches!(session.ask(Request::Open(open("Acrobot", 2_000, 1))).await, Response::Opened(_))
        })
        .await;
        let actor = Actor::new(&environment, 2_000);
        session.play(actor, 0, 1).await;
        println!("\nstepping");
        session.play(actor, 1, u64::MAX).await;
    });
}

/// That client as a process, which is killed when this is dropped.
struct ClientProcess(Child);

impl ClientProcess {
    /// Starts it and waits until it steps.
    async fn start(address: &str) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args(["--ignored", "--exact", "--nocapture", "faults::client_that_steps_for_ever"])
            .env(CLIENT, address);
        let mut client = Self(command.stdout(Stdio::piped()).spawn().unwrap());
        let lines = server::lines(client.0.stdout.take().unwrap());
        until("the client steps", async || lines.try_iter().any(|line| line == "stepping")).await;
        // Read on: a closed pipe would end it.
        std::thread::spawn(move || lines.iter().count());
        client
    }
}

impl Drop for ClientProcess {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits until so many environments can be opened at once.
async fn room_for(address: &str, n: u32) {
    until("the environments are free again", async || {
        let mut session = Session::connect(address).await;
        match session.ask(Request::Open(open("Acrobot", n, 1))).await {
            Response::Opened(_) => true,
            Response::Error(error) if error.code == Code::ResourceExhausted as i32 => false,
            other => panic!("{other:?}"),
        }
    })
    .await;
}

#[tokio::test]
async fn a_client_killed_in_mid_step_frees_its_environments() {
    let server = Server::start(&["--max-envs", "2003"]);
    let bystander = Bystander::start(server.tcp()).await;
    for address in [server.tcp(), server.unix()] {
        let client = ClientProcess::start(address).await;
        let (code, message) = Session::connect(address).await.refused(Request::Open(open("Acrobot", 1, 1))).await;
        assert_eq!(code, Code::ResourceExhausted, "{message}");
        drop(client);
        room_for(address, 2_000).await;
    }
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn a_client_that_hangs_is_found_out_by_keepalive() {
    let server = Server::start(&["--max-envs", "2003", "--keepalive-seconds", "1"]);
    let bystander = Bystander::start(server.tcp()).await;
    let client = ClientProcess::start(server.tcp()).await;
    server::signal(client.0.id(), "STOP");
    room_for(server.unix(), 2_000).await;
    drop(client);
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn two_hundred_sessions_opened_and_dropped_leave_nothing_behind() {
    const EACH: u32 = 5;
    let server = Server::start(&["--max-envs", "1003", "--max-sessions", "250"]);
    let bystander = Bystander::start(server.tcp()).await;
    // All at a time, over one connection and over many, dropped in mid-step.
    let mut client = server::client(server.unix()).await;
    for own_connection in [false, true] {
        let mut sessions = Vec::new();
        for seed in 0..200 {
            let mut session = match own_connection {
                true => Session::connect(server.tcp()).await,
                false => Session::start(&mut client).await.unwrap(),
            };
            // At first the session that looked for room may still hold it.
            until("there is room", async || {
                matches!(session.ask(Request::Open(open("CartPole", EACH, seed))).await, Response::Opened(_))
            })
            .await;
            session.send(step(i32s(&[0; EACH as usize]))).await;
            sessions.push(session);
        }
        let mut one_more = Session::connect(server.tcp()).await;
        assert_eq!(one_more.refused(Request::Open(open("CartPole", 1, 1))).await.0, Code::ResourceExhausted);
        drop((sessions, one_more));
        room_for(server.tcp(), 200 * EACH).await;
    }
    // One after the other, dropped without waiting for any reply.
    for seed in 0..200 {
        let session = Session::connect(server.tcp()).await;
        session.send(Request::Open(open("CartPole", 1000, seed))).await;
    }
    room_for(server.tcp(), 200 * EACH).await;
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn sessions_beyond_the_limit_are_refused_until_one_ends() {
    let server = Server::start(&["--max-sessions", "3"]);
    let bystander = Bystander::start(server.tcp()).await;
    let (first, _second) = (Session::connect(server.tcp()).await, Session::connect(server.unix()).await);
    let mut client = server::client(server.tcp()).await;
    let status = Session::start(&mut client).await.err().expect("a fourth session is refused");
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    assert!(status.message().contains("all of this server's 3 sessions"), "{status:?}");
    drop(first);
    until("there is room for a session", async || Session::start(&mut client).await.is_ok()).await;
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn a_client_that_never_reads_costs_bounded_memory_and_its_replies_are_not_lost() {
    const N: usize = 2_000;
    let server = Server::start(&["--workers", "1"]);
    let bystander = Bystander::start(server.tcp()).await;
    let (mut session, opened) = Session::open(server.tcp(), open("CartPole", N as u32, 1)).await;
    let environment = opened.environment.unwrap();
    let before = server.memory();
    let (sent, stop) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
    let sender = session.sender();
    let sending = tokio::spawn({
        let (sent, stop, environment) = (Arc::clone(&sent), Arc::clone(&stop), environment.clone());
        async move {
            // Up to 800 MB of requests, and 5 GB of replies.
            for t in 0..100_000 {
                let request = Some(step(Actor::new(&environment, N).actions(t)));
                if stop.load(Ordering::Relaxed) || sender.send(SessionRequest { request }).await.is_err() {
                    return;
                }
                sent.store(t + 1, Ordering::Relaxed);
            }
        }
    });
    let mut last = u64::MAX;
    until("the server takes no more", async || {
        tokio::time::sleep(Duration::from_millis(500)).await;
        let stalled = sent.load(Ordering::Relaxed) == last;
        last = sent.load(Ordering::Relaxed);
        stalled
    })
    .await;
    assert!(!sending.is_finished(), "the server took {last} requests without a reader of its replies");
    let grown = server.memory().saturating_sub(before);
    assert!(grown < 64 << 20, "the server grew by {grown} bytes");
    bystander.goes_on().await;
    // It reads at last: every reply is there, in order.
    stop.store(true, Ordering::Relaxed);
    session.close();
    let mut replies = Vec::new();
    while let Some(reply) = session.receive().await.unwrap() {
        replies.push(reply);
    }
    within(sending).await.unwrap();
    assert!(replies.len() as u64 >= last, "{} replies to {last} requests", replies.len());
    let (mut reference, _) = Session::open(server.tcp(), open("CartPole", N as u32, 1)).await;
    assert!(reference.play(Actor::new(&environment, N), 0, replies.len() as u64).await == replies);
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn an_idle_session_is_ended_and_a_busy_one_is_not() {
    let server = Server::start(&["--idle-seconds", "1", "--max-envs", "103"]);
    let bystander = Bystander::start(server.tcp()).await;
    let (mut idle, _) = Session::open(server.tcp(), open("CartPole", 100, 1)).await;
    let mut never_opened = Session::connect(server.unix()).await;
    for session in [&mut idle, &mut never_opened] {
        let status = session.end().await;
        assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
        assert!(status.message().contains("idle for 1 s"), "{status:?}");
    }
    room_for(server.tcp(), 100).await;
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn a_step_after_the_end_is_refused_when_autoreset_is_disabled() {
    let server = Server::start(&[]);
    let bystander = Bystander::start(server.tcp()).await;
    let disabled = Open { autoreset_mode: proto::AutoresetMode::Disabled.into(), ..open("CartPole", 20, 1) };
    let (mut session, _) = Session::open(server.tcp(), disabled).await;
    let mut ended = 0;
    while ended == 0 {
        ended = session.step(i32s(&[1; 20]).into()).await.ended.len();
    }
    let snapshots = session.snapshot(&[]).await;
    for _ in 0..3 {
        let case: Case = (step(i32s(&[1; 20])), Code::FailedPrecondition, &["have ended", "disabled", "reset"]);
        refused(&mut session, case).await;
    }
    assert_eq!(session.snapshot(&[]).await, snapshots, "nothing changed");
    bystander.ends_unharmed().await;
}
