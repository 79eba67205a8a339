//! Invalid requests.

use super::Bystander;
use crate::common::server::{
    self, Actor, Server, Session, doubles, environment, open, parameters, refusal, step, until, within,
};
use bytes::Bytes;
use insta::assert_snapshot;
use perturb::proto::{
    self, Environment, Open, Reset, Restore, SessionRequest, SessionResponse, Snapshot, session_request::Request,
    session_response::Response,
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;

fn f32s(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}

fn i32s(numbers: &[i32]) -> Vec<u8> {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}

/// Sends requests that must be refused. Returns a line with the refusal of each.
async fn refusals(session: &mut Session, requests: impl IntoIterator<Item = Request>) -> String {
    let mut lines = String::new();
    for request in requests {
        lines += &refusal(session.refused(request).await);
    }
    lines
}

/// Sends requests that must be refused in an open session. Asserts that the session's later bytes equal the bytes of an
/// undisturbed session. Returns a line with the refusal of each request.
async fn harmless_refusals(address: &str, e: &Environment, n: u32, requests: Vec<Request>) -> String {
    let (mut session, _) = Session::open(address, open(&e.name, n, 1)).await;
    let (mut twin, _) = Session::open(address, open(&e.name, n, 1)).await;
    let actor = Actor::new(e, n as usize);
    let mut lines = String::new();
    for (i, request) in requests.into_iter().enumerate() {
        lines += &refusals(&mut session, [request.clone()]).await;
        let (from, to) = (40 * i as u64, 40 * (i as u64 + 1));
        assert!(
            session.play(actor, from, to).await == twin.play(actor, from, to).await,
            "{request:?} changed something"
        );
    }
    assert_eq!(session.snapshot(&[]).await, twin.snapshot(&[]).await);
    lines
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
    let wrong = vec![
        step(i32s(&[0; 4])),
        Request::Reset(Reset::default()),
        Request::Snapshot(Snapshot::default()),
        Request::Restore(Restore::default()),
        bad(|o| o.environment = "cartpol".into()),
        bad(|o| o.environment.clear()),
        bad(|o| o.environment = "x\0\n".into()),
        bad(|o| o.version = 0),
        bad(|o| o.version = 5),
        bad(|o| o.version = -1),
        bad(|o| o.autoreset_mode = 0),
        bad(|o| o.autoreset_mode = 77),
        bad(|o| o.batch_size = 0),
        bad(|o| o.batch_size = 1_000_000_000),
        bad(|o| o.batch_size = u32::MAX),
        bad(|o| o.batch_size = 998),
        bad(|o| o.first_environment_index = u32::MAX),
        bad(|o| o.first_environment_index = u32::MAX - 2),
        set("Force", &[(1.0, 1.0)]),
        set("", &[(1.0, 1.0)]),
        set("force", &[]),
        set("force", &[(nan, 1.0)]),
        set("force", &[(1.0, inf)]),
        set("force", &[(-inf, inf)]),
        set("force", &[(2.0, 1.0)]),
        set("force", &[(1.0, 3.0), (2.0, 4.0)]),
        set("force", &[(3.0, 4.0), (1.0, 2.0)]),
        set("force", &[(1.0, 2.0), (3.0, 3.0)]),
        set("force", &[(1000.5, 1000.5)]),
        set("length", &[(-0.5, 0.5)]),
        set("length", &[(0.0, 0.0)]),
        set("mass", &[(0.1, 0.2), (1e300, 1e308)]),
    ];
    let mut session = Session::connect(server.unix()).await;
    assert_snapshot!(refusals(&mut session, wrong).await);
    // Refused requests occupy nothing: all remaining environments can be opened.
    let opened = session.ask(Open { batch_size: 997, first_environment_index: u32::MAX - 996, ..base() }).await;
    assert_eq!(opened.started[996].episode.as_ref().unwrap().environment_index, u32::MAX);
    assert_snapshot!(refusals(&mut session, [Request::Open(base())]).await, @"FailedPrecondition: open came on a session that is open already; use reset, or start another session");
    drop(session);
    bystander.ends_unharmed().await;
}

#[tokio::test]
async fn wrong_actions_are_refused() {
    let server = Server::start(&[]);
    let bystander = Bystander::start(server.tcp()).await;
    let discrete = vec![
        step(vec![]),
        step(vec![0; 15]),
        step(vec![0; 17]),
        step(vec![0; 20]),
        step(vec![0; 1 << 20]),
        step(i32s(&[0, 1, 2, 0])),
        step(i32s(&[-1, 0, 0, 0])),
        step(i32s(&[0, 0, 0, i32::MIN])),
        step(f32s(&[1.0; 4])),
    ];
    let cart_pole = environment(server.tcp(), "CartPole").await;
    assert_snapshot!(harmless_refusals(server.tcp(), &cart_pole, 4, discrete).await, @r"
    InvalidArgument: step.actions is 0 bytes; expected 16 bytes: int32 [N] with N = 4, A = 1
    InvalidArgument: step.actions is 15 bytes; expected 16 bytes: int32 [N] with N = 4, A = 1
    InvalidArgument: step.actions is 17 bytes; expected 16 bytes: int32 [N] with N = 4, A = 1
    InvalidArgument: step.actions is 20 bytes; expected 16 bytes: int32 [N] with N = 4, A = 1
    InvalidArgument: step.actions is 1048576 bytes; expected 16 bytes: int32 [N] with N = 4, A = 1
    InvalidArgument: step.actions is 2 in slot 2; expected a choice in 0 … 1
    InvalidArgument: step.actions is -1 in slot 0; expected a choice in 0 … 1
    InvalidArgument: step.actions is -2147483648 in slot 3; expected a choice in 0 … 1
    InvalidArgument: step.actions is 1065353216 in slot 0; expected a choice in 0 … 1
    ");
    let continuous = vec![
        step(f32s(&[0.0])),
        step(doubles(&[0.0, 0.0])),
        step(f32s(&[0.0, f32::NAN])),
        step(f32s(&[f32::INFINITY, 0.0])),
        step(f32s(&[0.0, f32::NEG_INFINITY])),
    ];
    let pendulum = environment(server.tcp(), "Pendulum").await;
    assert_snapshot!(harmless_refusals(server.unix(), &pendulum, 2, continuous).await, @r"
    InvalidArgument: step.actions is 4 bytes; expected 8 bytes: float32 [N, A] with N = 2, A = 1
    InvalidArgument: step.actions is 16 bytes; expected 8 bytes: float32 [N, A] with N = 2, A = 1
    InvalidArgument: step.actions is NaN in slot 1, entry 0; expected finite numbers
    InvalidArgument: step.actions is inf in slot 0, entry 0; expected finite numbers
    InvalidArgument: step.actions is -inf in slot 1, entry 0; expected finite numbers
    ");
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
    let wrong = vec![
        reset(|r| r.mask = vec![1].into()),
        reset(|r| r.mask = vec![1; 4].into()),
        reset(|r| r.mask = vec![1, 0, 255].into()),
        reset(|r| r.seeds = vec![1, 2]),
        reset(|r| (r.mask, r.seeds) = (vec![0, 0, 1].into(), vec![1, 2, 3])),
        reset(|r| (r.mask, r.seeds) = (vec![0; 3].into(), vec![1])),
        reset(|r| r.states = doubles(&[0.0; 4])),
        reset(|r| r.states = vec![0; 95].into()),
        reset(|r| (r.seeds, r.states) = (vec![1; 3], doubles(&[f64::NAN; 12]))),
        reset(|r| r.states = doubles(&[&[0.0; 11][..], &[f64::INFINITY]].concat())),
        reset(|r| r.states = doubles(&[2.5; 12])),
        reset(|r| r.parameters = parameters(&[("gravity", &[(1.0, 1.0)])])),
        set(&[]),
        set(&[(f64::NAN, f64::NAN)]),
        set(&[(2.0, 1.0)]),
        set(&[(1.0, 2.0), (1.5, 3.0)]),
        set(&[(0.0, 1.0)]),
        Request::Snapshot(Snapshot { mask: vec![1, 1].into() }),
        Request::Snapshot(Snapshot { mask: vec![9, 1, 1].into() }),
        restore(&[], vec![]),
        restore(&[0, 1, 0], good.clone()),
        restore(&[1], good.clone()),
        restore(&[], vec![Bytes::new(); 3]),
        restore(&[], random),
        restore(&[], vec![Bytes::from(vec![0xFF; 100_000]); 3]),
        restore(&[], foreign),
        restore(&[], vec![good[0].clone(), good[1].clone(), good[2].slice(..30)]),
        restore(&[], vec![good[0].slice(1..), good[1].clone(), good[2].clone()]),
    ];
    let cart_pole = environment(server.tcp(), "CartPole").await;
    assert_snapshot!(harmless_refusals(server.tcp(), &cart_pole, 3, wrong).await);
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
                match session.answer(request).await {
                    Response::Error(error) => assert_eq!(error.code, Code::InvalidArgument as i32, "{error:?}"),
                    Response::Restore(_) => {
                        // The restored environment can be stepped, reset and saved.
                        session.play(actor, 0, 5).await;
                        session.ask(Reset::default()).await;
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

/// A request of a kind that this protocol does not have.
#[derive(Clone, PartialEq, prost::Message)]
struct Unknown {
    #[prost(uint64, tag = "99")]
    something: u64,
}

/// A malformed request, whose `open` is a number.
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
async fn unknown_request_is_refused_and_malformed_ends_its_session() {
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
async fn oversized_message_ends_its_session() {
    let server = Server::start(&["--max-message-bytes", "4096", "--max-envs", "10"]);
    let bystander = Bystander::start(server.tcp()).await;
    for size in [4_097, 100_000, 20_000_000] {
        let mut session = Session::connect(server.tcp()).await;
        until("seven environments are free", async || {
            matches!(session.answer(open("CartPole", 7, 1)).await, Response::Opened(_))
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
    assert_snapshot!(refusals(&mut session, vec![step(i32s(&[1; 20])); 2]).await, @r"
    FailedPrecondition: the episodes of slots 7, 15, 19 have ended and autoreset is disabled; reset these slots before the next step
    FailedPrecondition: the episodes of slots 7, 15, 19 have ended and autoreset is disabled; reset these slots before the next step
    ");
    assert_eq!(session.snapshot(&[]).await, snapshots, "nothing changed");
    bystander.ends_unharmed().await;
}
