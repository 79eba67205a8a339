//! Plays the scenarios of the C++ and Go clients in `examples/clients` with the Rust client. `client ADDRESS SCENARIO
//! FILE` writes every reply to a file, as a `SessionResponse` message. The C++ and Go clients must write the same
//! bytes.

use std::error::Error;
use std::{env, fs};

use perturb_protocol::proto::{self, AutoresetMode, Version};
use perturb_protocol::{ClientError, Connection, Stream, TypedRequest};
use prost::Message;
use tonic::Code;

/// The field number of `error` in `SessionResponse`.
const ERROR: u32 = 15;

/// A session and its encoded replies so far.
struct Session {
    stream: Stream,
    replies: Vec<u8>,
}

impl Session {
    async fn open(connection: &Connection, open: proto::Open) -> Result<(Self, proto::Opened), ClientError> {
        let (stream, opened) = Stream::open(connection, open).await?;
        let mut session = Self { stream, replies: Vec::new() };
        session.record(1, &opened);
        Ok((session, opened))
    }

    /// Sends a request and returns its reply. `number` is the request's field number in `SessionRequest`. The reply has
    /// the same field number in `SessionResponse`.
    async fn ask<A>(&mut self, number: u32, request: A) -> Result<A::Reply, ClientError>
    where
        A: TypedRequest,
        A::Reply: Message,
    {
        let reply = self.stream.ask(request).await;
        match &reply {
            Ok(reply) => self.record(number, reply),
            Err(ClientError::Refused { code, message, .. }) => {
                self.record(ERROR, &proto::Error { code: *code as i32, message: message.clone() });
            }
            Err(_) => {}
        }
        reply
    }

    /// Stores a reply, encoded as the field of `SessionResponse` with this number.
    fn record(&mut self, number: u32, reply: &impl Message) {
        prost::encoding::message::encode(number, reply, &mut self.replies);
    }

    async fn step(&mut self, actions: Vec<u8>) -> Result<proto::Stepped, ClientError> {
        self.ask(2, proto::Step { actions: actions.into() }).await
    }

    async fn play(&mut self, mut act: proto::Act) -> Result<(), ClientError> {
        while !self.ask(8, act).await?.finished {
            act = proto::Act::default(); // requests the rest of the task
        }
        Ok(())
    }
}

fn open(environment: &str, version: Version, batch_size: u32, seed: u64) -> proto::Open {
    proto::Open {
        environment: environment.into(),
        version: version.into(),
        batch_size,
        seed,
        autoreset_mode: AutoresetMode::SameStep.into(),
        ..proto::Open::default()
    }
}

fn floats(array: &[u8]) -> Vec<f32> {
    array.as_chunks::<4>().0.iter().map(|number| f32::from_le_bytes(*number)).collect()
}

/// Returns actions that push each cart under its falling pole. `observations` is float32 [N, 4]: position, velocity,
/// angle, angular velocity.
fn balance(observations: &[u8]) -> Vec<u8> {
    floats(observations)
        .as_chunks::<4>()
        .0
        .iter()
        .flat_map(|row| i32::from(row[2] + row[3] > 0.0).to_le_bytes())
        .collect()
}

/// Returns actions that turn Hopper's three joints towards position 0. `observations` is float32 [N, 15]; the positions
/// of the joints are the entries 8, 10 and 12.
fn straighten(observations: &[u8]) -> Vec<u8> {
    let rows = floats(observations);
    let joints = rows.as_chunks::<15>().0.iter().flat_map(|row| [row[8], row[10], row[12]]);
    joints.flat_map(|position| (-0.5 * position).to_le_bytes()).collect()
}

async fn cart_pole(connection: &Connection) -> Result<Session, Box<dyn Error>> {
    let request = proto::Open { receipts: true, ..open("CartPole", Version::Extreme, 256, 1) };
    let (mut session, opened) = Session::open(connection, request).await?;
    let seeds = vec![1; 256];
    let mut observations = session.ask(3, proto::Reset { seeds, ..proto::Reset::default() }).await?.observations;
    if observations != opened.observations {
        return Err("a reset with the seed of open gave other observations".into());
    }
    for _ in 0..1000 {
        observations = session.step(balance(&observations)).await?.observations;
    }
    Ok(session)
}

async fn hopper(connection: &Connection) -> Result<Session, Box<dyn Error>> {
    let request = open("Hopper", Version::Random, 16, 2);
    let autoreset_mode = AutoresetMode::NextStep.into();
    let request = proto::Open { autoreset_mode, reward_terms: true, ..request };
    let (mut session, opened) = Session::open(connection, request).await?;
    let mut observations = opened.observations;
    for _ in 0..300 {
        observations = session.step(straighten(&observations)).await?.observations;
    }
    Ok(session)
}

async fn snapshots(connection: &Connection) -> Result<Session, Box<dyn Error>> {
    let (mut session, _) = Session::open(connection, open("CartPole", Version::Random, 8, 3)).await?;
    let actions: Vec<u8> = [0_i32, 1, 0, 1, 0, 1, 0, 1].into_iter().flat_map(i32::to_le_bytes).collect();
    for _ in 0..20 {
        session.step(actions.clone()).await?;
    }
    let saved = session.ask(4, proto::Snapshot::default()).await?.snapshots;
    let mut played = [Vec::new(), Vec::new()];
    for observations in &mut played {
        for _ in 0..50 {
            observations.extend_from_slice(&session.step(actions.clone()).await?.observations);
        }
        session.ask(5, proto::Restore { snapshots: saved.clone(), ..proto::Restore::default() }).await?;
    }
    if played[0] != played[1] {
        return Err("the restored environments gave other observations".into());
    }
    match session.step(b"?".to_vec()).await {
        Err(ClientError::Refused { code: Code::InvalidArgument, .. }) => {}
        other => return Err(format!("not refused: {other:?}").into()),
    }
    session.step(actions).await?;
    Ok(session)
}

async fn act(connection: &Connection) -> Result<Session, Box<dyn Error>> {
    let (mut session, _) = Session::open(connection, open("CartPole", Version::Random, 8, 4)).await?;
    let weights = (0..2 * (80 + 272) + (2 + 1) * 17).map(|i| (i * 37 % 17 - 8) as f32 / 16.0);
    let weights: Vec<u8> = weights.flat_map(f32::to_le_bytes).collect();
    let stream = proto::RandomStream { key: vec![0; 32].into(), ..proto::RandomStream::default() };
    let role = Some(proto::policy::Role::Training(stream));
    let policy = Some(proto::Policy { hidden: vec![16, 16], role, ..proto::Policy::default() });
    let task = Some(proto::act::Task::Steps(500));
    session.play(proto::Act { policy, weights: weights.into(), task, ..proto::Act::default() }).await?;
    let task = Some(proto::act::Task::Episodes(20));
    session.play(proto::Act { task, only_ended: true, ..proto::Act::default() }).await?;
    session.ask(9, proto::SavePlayer {}).await?;
    Ok(session)
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<_> = env::args().skip(1).collect();
    let [address, scenario, file] = arguments.as_slice() else {
        return Err("usage: client ADDRESS cart_pole|hopper|snapshots|act FILE".into());
    };
    let connection = Connection::open(&address.parse()?).await?;
    let session = match scenario.as_str() {
        "cart_pole" => cart_pole(&connection).await?,
        "hopper" => hopper(&connection).await?,
        "snapshots" => snapshots(&connection).await?,
        "act" => act(&connection).await?,
        _ => return Err(format!("there is no scenario {scenario}").into()),
    };
    fs::write(file, &session.replies)?;
    session.stream.close().await;
    Ok(())
}
