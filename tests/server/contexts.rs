//! Contexts: each trial has the parameters of one row of a list.

use crate::common::server::{Actor, Server, Session, contexts, open, parameters, refusal};
use bytes::Bytes;
use insta::assert_snapshot;
use perturb::{
    env::{DrawPurpose, EnvironmentSpec, PhiloxStream, Version},
    proto::{self, AutoresetMode, EpisodeStart, Open, Release, Reset, Restore, SlotGroup},
    tasks,
};
use tonic::Code;

/// The values of length and mass in four contexts.
const ROWS: [[f64; 2]; 4] = [[0.3, 0.1], [0.3, 0.2], [0.6, 0.3], [0.7, 0.05]];
/// The number of standard deviations that a count may be from its mean.
const MAX_DEVIATIONS: f64 = 4.0;
/// The number of steps of a comparison. The pole falls several times.
const STEPS: u64 = 200;

/// Returns an `open` of pole-carts with these contexts.
fn with(contexts: proto::Contexts, envs: u32) -> Open {
    let autoreset_mode = AutoresetMode::SameStep.into();
    Open { autoreset_mode, contexts: Some(contexts), ..open("CartPole", envs, 4) }
}

fn rows() -> proto::Contexts {
    contexts(&["length", "mass"], ROWS.as_flattened())
}

fn requested(started: Vec<EpisodeStart>) -> Vec<Vec<f64>> {
    started.into_iter().map(|start| start.receipt.unwrap().requested).collect()
}

fn cart_pole() -> &'static EnvironmentSpec {
    tasks::catalogue().find("CartPole").unwrap()
}

#[tokio::test]
async fn trials_draw_each_context_equally_often() {
    const ENVS: u32 = 1000;
    let server = Server::start(&[]);
    let (_, opened) = Session::open(server.unix(), with(rows(), ENVS)).await;
    assert!(opened.supports_contexts);
    let drawn = requested(opened.started);
    let force = cart_pole().parameters[0].distribution(Version::R);
    for (index, drawn) in (0..).zip(&drawn) {
        let mut stream = PhiloxStream::new(4, index, DrawPurpose::Parameters, 0);
        let [length, mass] = ROWS[(4.0 * stream.unit()) as usize];
        assert_eq!(*drawn, [force.at(stream.unit()), length, mass], "environment {index}");
    }
    for row in ROWS {
        let count = drawn.iter().filter(|drawn| drawn[1..] == row).count() as f64;
        let (mean, deviation) = (f64::from(ENVS) / 4.0, (f64::from(ENVS) * 3.0 / 16.0).sqrt());
        assert!((count - mean).abs() < MAX_DEVIATIONS * deviation, "{count} trials of {row:?}");
    }
}

#[tokio::test]
async fn context_of_r_and_e_is_drawn_with_both() {
    let server = Server::start(&[]);
    let open = Open { version: Version::RE.to_proto().into(), ..with(rows(), 60) };
    let (_, opened) = Session::open(server.unix(), open).await;
    let mut seen = std::collections::HashSet::new();
    for (index, drawn) in (0..).zip(requested(opened.started)) {
        let mut stream = PhiloxStream::new(4, index, DrawPurpose::Parameters, 0);
        let chosen = (8.0 * stream.unit()) as usize;
        let part = [Version::R, Version::E][chosen % 2];
        let force = cart_pole().parameters[0].distribution(part).at(stream.unit());
        assert_eq!(drawn, [force, ROWS[chosen / 2][0], ROWS[chosen / 2][1]], "environment {index}");
        seen.insert(chosen);
    }
    assert_eq!(seen.len(), 8);
}

/// A session with some of the environments of a batch.
struct Part {
    session: Session,
    environment: proto::Environment,
    first: u64,
    n: usize,
}

impl Part {
    async fn open(server: &Server, open: Open) -> Self {
        let (first, n) = (open.first_environment_index.into(), open.batch_size as usize);
        let (session, opened) = Session::open(server.unix(), open).await;
        Self { session, environment: opened.environment.unwrap(), first, n }
    }

    /// Takes steps, and returns each environment's observations and requested parameters at each step.
    async fn play(&mut self, from: u64, to: u64) -> Vec<Vec<(Vec<u8>, Vec<f64>)>> {
        let actor = Actor { environment: &self.environment, first: self.first, n: self.n };
        let mut steps = Vec::new();
        for t in from..to {
            let stepped = self.session.step(actor.actions(t)).await;
            let mut rows: Vec<_> = stepped.observations.chunks(16).map(|row| (row.to_vec(), Vec::new())).collect();
            for start in stepped.started {
                rows[start.slot as usize].1 = start.receipt.unwrap().requested;
            }
            steps.push(rows);
        }
        steps
    }
}

#[tokio::test]
async fn contexts_do_not_depend_on_the_cut_of_a_batch() {
    let server = Server::start(&["--workers", "3"]);
    let mut whole = Part::open(&server, with(rows(), 5)).await.play(0, STEPS).await;
    let parts = [(0, 2), (2, 3)].map(|(first, size)| Open { first_environment_index: first, ..with(rows(), size) });
    let drawn = whole.iter().flatten().filter(|row| !row.1.is_empty()).count();
    assert!(drawn > 20, "{drawn} trials");
    for open in parts.into_iter().rev() {
        let keep = open.first_environment_index as usize;
        let own = Part::open(&server, open).await.play(0, STEPS).await;
        let expected: Vec<_> = whole.iter_mut().map(|rows| rows.split_off(keep)).collect();
        assert!(own == expected, "environments from {keep} on");
    }
}

#[tokio::test]
async fn group_with_contexts_is_a_session_of_its_own() {
    let server = Server::start(&[]);
    let group = |contexts| SlotGroup { size: 2, version: 2, seed: 4, contexts, ..SlotGroup::default() };
    let groups = vec![group(None), group(Some(rows()))];
    let autoreset_mode = AutoresetMode::SameStep.into();
    let together = Open { groups, autoreset_mode, environment: "CartPole".into(), receipts: true, ..Open::default() };
    let (_, opened) = Session::open(server.unix(), together).await;
    let (_, alone) = Session::open(server.unix(), with(rows(), 2)).await;
    assert_eq!(requested(opened.started)[2..], requested(alone.started));
}

#[tokio::test]
async fn contexts_are_restored_into_sessions_with_as_many() {
    let server = Server::start(&[]);
    let mut whole = Part::open(&server, with(rows(), 3)).await;
    whole.play(0, STEPS).await;
    let snapshots = whole.session.snapshot(&[]).await;
    let expected = whole.play(STEPS, 2 * STEPS).await;
    let others = contexts(&["length"], &[0.4, 0.5, 0.6, 0.7]);
    let mut other = Part::open(&server, Open { seed: 9, ..with(others, 3) }).await;
    other.session.restore(&[], snapshots.clone()).await;
    assert!(other.play(STEPS, 2 * STEPS).await == expected);
    // The lists of forged snapshots would take memory that a session without contexts did not reserve.
    let mut without = Part::open(&server, Open { contexts: None, ..with(rows(), 3) }).await;
    let (_, refused) = without.session.refused(Restore { mask: Bytes::new(), snapshots: snapshots.clone() }).await;
    assert!(refused.contains("a list of 4, this session accepts at most 2"), "{refused}");
    // The first session restores them, too, and frees an environment.
    whole.session.restore(&[], snapshots).await;
    whole.session.ask(Release { mask: vec![1, 0, 0].into() }).await;
    (whole.first, whole.n) = (1, 2);
    let kept: Vec<_> = expected.iter().map(|rows| rows[1..].to_vec()).collect();
    assert!(whole.play(STEPS, 2 * STEPS).await == kept);
}

#[tokio::test]
async fn single_context_is_a_fixed_value() {
    let server = Server::start(&[]);
    let one = with(contexts(&["length"], &[0.7]), 3);
    let fixed = Open { contexts: None, parameters: parameters(&[("length", &[(0.7, 0.7)])]), ..one.clone() };
    let [mut one, mut fixed] = [Part::open(&server, one).await, Part::open(&server, fixed).await];
    assert!(one.play(0, STEPS).await == fixed.play(0, STEPS).await);
    assert_eq!(one.session.snapshot(&[]).await, fixed.session.snapshot(&[]).await);
}

#[tokio::test]
async fn reset_replaces_a_distribution_in_every_context() {
    let server = Server::start(&[]);
    let (mut session, opened) = Session::open(server.unix(), with(rows(), 100)).await;
    let masses = |drawn: Vec<Vec<f64>>| drawn.into_iter().map(|values| values[2]).collect::<Vec<_>>();
    let before = masses(requested(opened.started));
    let parameters = parameters(&[("length", &[(0.9, 0.9)])]);
    let started = session.ask(Reset { parameters, seeds: vec![4; 100], ..Reset::default() }).await.started;
    let after = requested(started);
    assert!(after.iter().all(|values| values[1] == 0.9));
    assert_eq!(masses(after), before, "the mass is still of a context");
}

#[tokio::test]
async fn disturbance_may_be_in_a_context() {
    let server = Server::start(&[]);
    let delays = contexts(&["action_delay", "length"], &[0.0, 0.5, 3.0, 0.6]);
    let (_, opened) = Session::open(server.unix(), with(delays, 20)).await;
    let named =
        |name: &str| opened.environment.as_ref().unwrap().parameters.iter().position(|p| p.name == name).unwrap();
    let (delay, length) = (named("action_delay"), named("length"));
    let drawn = requested(opened.started);
    assert!(drawn.iter().all(|values| [(0.0, 0.5), (3.0, 0.6)].contains(&(values[delay], values[length]))));
}

#[tokio::test]
async fn environments_of_a_session_share_their_contexts() {
    const ENVS: u32 = 4000;
    let server = Server::start(&[]);
    let (mut session, _) = Session::open(server.unix(), Open { contexts: None, ..with(rows(), ENVS) }).await;
    session.close();
    session.end().await;
    let before = server.memory();
    let lengths: Vec<f64> = (0..1024).map(|row| 0.3 + f64::from(row) / 4096.0).collect();
    let (_session, _) = Session::open(server.unix(), with(contexts(&["length"], &lengths), ENVS)).await;
    let grown = server.memory().saturating_sub(before);
    assert!(grown < 100 << 20, "{grown} bytes for {ENVS} environments");
}

#[tokio::test]
async fn each_environment_reserves_memory_for_its_own_list() {
    let server = Server::start(&["--max-memory", "9000000"]);
    let open = |envs| with(contexts(&["length"], &[0.5; 1000]), envs);
    let (_session, _) = Session::open(server.unix(), open(10)).await;
    // Resets of single environments could give each of them a list of some 200 kB.
    let mut other = Session::connect(server.unix()).await;
    assert_eq!(other.refused(open(100)).await.0, Code::ResourceExhausted);
}

#[tokio::test]
async fn wrong_contexts_are_refused() {
    let server = Server::start(&[]);
    let mut session = Session::connect(server.unix()).await;
    let mut lines = String::new();
    for contexts in [
        contexts(&["colour"], &[1.0]),
        contexts(&["length"], &[0.5, 90.0, 200.0]),
        contexts(&["length"], &[0.5, f64::NAN]),
        contexts(&["length"], &[f64::INFINITY]),
        contexts(&["length", "length"], &[0.5, 0.6]),
        contexts(&["mass"], &[0.5]),
        contexts(&[], &[0.5]),
        contexts(&["length"], &[]),
        contexts(&["length", "force"], &[0.5, 7.0, 0.6]),
        contexts(&["length"], &[0.5; 1025]),
        contexts(&["action_delay"], &[0.5]),
        contexts(&["action_delay"], &[0.0; 1024]),
        contexts(&["length"; 1025], &[0.5]),
    ] {
        let parameters = parameters(&[("mass", &[(0.1, 0.2)])]);
        lines += &refusal(session.refused(Open { parameters, ..with(contexts, 2) }).await);
    }
    assert_snapshot!(lines);
    session.ask(with(rows(), 2)).await;
}
