//! Tests leases over a connection that is randomly cut or delayed, in simulated time.
//!
//! The environment variable `PERTURB_SEED` sets the first seed, and `PERTURB_SIMULATIONS` sets the number of seeds. A
//! failed test prints the seed of the failure.

use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::rc::Rc;
use std::time::Duration;

use perturb_faults::SeededRng;
use perturb_faults::rng::SEED_VARIABLE;
use perturb_protocol::{ClientError, Stream, proto};
use perturb_simulation::{KEEPALIVE, LEASE, SERVER, StepLog, connect, serve};
use turmoil::{Builder, Sim};

const CLIENT: &str = "client";
/// Number of steps of a session.
const STEPS: u64 = 200;
/// Maximal number of requests without a reply.
const MAX_IN_FLIGHT: u64 = 5;
/// Maximal pause between two steps, in ms.
const MAX_PAUSE_MS: u64 = 100;
/// Maximal time between two changes of the network, in ms.
const MAX_CHANGE_INTERVAL_MS: u64 = 8_000;
/// Default number of simulations of each test.
const SIMULATIONS: u64 = 50;

/// The replies that a client received, each with the simulated time of its arrival and the two numbers in it.
type Replies = Rc<RefCell<Vec<(Duration, [u64; 2])>>>;

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

/// Calls `simulate` with each seed. If it panics, prints the seed.
fn simulations(simulate: impl Fn(u64)) {
    let first = number(SEED_VARIABLE, 1);
    for seed in first..first + number("PERTURB_SIMULATIONS", SIMULATIONS) {
        if let Err(failure) = catch_unwind(AssertUnwindSafe(|| simulate(seed))) {
            eprintln!("{SEED_VARIABLE}={seed} SIMULATIONS=1 make simulation-test simulates this again");
            resume_unwind(failure);
        }
    }
}

fn simulation(seed: u64, ledger: &StepLog) -> Sim<'static> {
    let mut builder = Builder::new();
    builder.rng_seed(seed).simulation_duration(Duration::from_secs(7200)).min_message_latency(Duration::from_millis(1));
    builder.max_message_latency(Duration::from_millis(50));
    let mut simulation = builder.build();
    let ledger = ledger.clone();
    simulation.host(SERVER, move || serve(ledger.clone()));
    simulation
}

async fn open() -> Result<Stream, ClientError> {
    let open = proto::Open { lease: MAX_IN_FLIGHT as u32, ..Default::default() };
    Ok(Stream::open(&connect().await?, open).await?.0)
}

async fn send_step(session: &mut Stream, number: u64) -> Result<(), ClientError> {
    session.send(proto::Step { actions: number.to_le_bytes().to_vec().into() }).await
}

async fn receive_step(session: &mut Stream) -> Result<[u64; 2], ClientError> {
    let stepped = session.receive::<proto::Step>().await?;
    let (numbers, _) = stepped.observations.as_chunks::<8>();
    Ok([0, 1].map(|i| u64::from_le_bytes(numbers[i])))
}

/// Simulates a client that takes all steps, with several requests in flight and random pauses.
async fn play(seed: u64, replies: Replies) -> turmoil::Result {
    let mut rng = SeededRng::from_seed(seed);
    let mut session = open().await?;
    let mut sent = 0;
    for received in 0..STEPS {
        let in_flight = 1 + rng.below(MAX_IN_FLIGHT);
        while sent < STEPS.min(received + in_flight) {
            send_step(&mut session, sent).await?;
            sent += 1;
        }
        let reply = receive_step(&mut session).await?;
        replies.borrow_mut().push((turmoil::elapsed(), reply));
        tokio::time::sleep(Duration::from_millis(rng.below(MAX_PAUSE_MS))).await;
    }
    session.close().await;
    Ok(())
}

/// Runs the simulation until the client ends, and interrupts the network at random. Returns whether the client's last
/// message certainly arrived. The message may be lost if the network was interrupted shortly before and neither side
/// noticed.
fn disturb(simulation: &mut Sim<'_>, seed: u64) -> bool {
    let mut rng = SeededRng::from_seed(!seed);
    let mut change = Duration::from_secs(1);
    let mut is_good = true;
    let mut good_since = Duration::ZERO;
    loop {
        if simulation.elapsed() >= change {
            simulation.release(CLIENT, SERVER);
            simulation.repair(CLIENT, SERVER);
            is_good = !is_good;
            good_since = simulation.elapsed();
            match rng.below(4) {
                _ if is_good => {}
                0 => simulation.hold(CLIENT, SERVER),
                1 => simulation.partition_oneway(CLIENT, SERVER),
                2 => simulation.partition_oneway(SERVER, CLIENT),
                _ => simulation.partition(CLIENT, SERVER),
            }
            change += Duration::from_millis(1 + rng.below(MAX_CHANGE_INTERVAL_MS));
        }
        if simulation.step().expect("no client fails") {
            simulation.release(CLIENT, SERVER);
            simulation.repair(CLIENT, SERVER);
            return is_good && simulation.elapsed() - good_since > 3 * KEEPALIVE;
        }
    }
}

/// Simulates a client over an interrupted network. Returns its replies, and how often it resumed its session.
fn disturbed(seed: u64) -> (Vec<(Duration, [u64; 2])>, u64) {
    let ledger = StepLog::default();
    let replies = Replies::default();
    let mut simulation = simulation(seed, &ledger);
    simulation.client(CLIENT, play(seed, Rc::clone(&replies)));
    let is_heard = disturb(&mut simulation, seed);
    assert_eq!(ledger.done(), (0..STEPS).collect::<Vec<_>>(), "each step is done once, in its order");
    let numbers: Vec<_> = replies.borrow().iter().map(|(_, numbers)| *numbers).collect();
    assert_eq!(numbers, (0..STEPS).map(|step| [step, step + 1]).collect::<Vec<_>>(), "and each reply comes once");
    // The client has closed the session. If its last message was lost, the server ends the session when the lease ends.
    let timeout = Duration::from_secs(5) + if is_heard { Duration::ZERO } else { LEASE };
    let end = simulation.elapsed() + timeout;
    while simulation.elapsed() < end {
        simulation.step().expect("the server goes on");
    }
    assert!(ledger.is_idle(), "nothing is left of it");
    (replies.take(), ledger.resumed())
}

#[test]
fn interruptions_lose_and_repeat_no_step() {
    let resumed = RefCell::new(0);
    simulations(|seed| *resumed.borrow_mut() += disturbed(seed).1);
    println!("sessions were resumed {} times", resumed.borrow());
    assert!(*resumed.borrow() > 0, "no session was interrupted");
}

#[test]
fn equal_seeds_give_equal_times() {
    let seed = number(SEED_VARIABLE, 1);
    assert_eq!(disturbed(seed), disturbed(seed));
    assert_ne!(disturbed(seed), disturbed(seed + 1));
}

/// Simulates a client that steps once, and again after `gap`. The network is cut in between. Returns the second reply.
fn cut_off(seed: u64, gap: Duration) -> (Result<[u64; 2], ClientError>, StepLog) {
    let ledger = StepLog::default();
    let outcome = Rc::new(RefCell::new(None));
    let mut simulation = simulation(seed, &ledger);
    let result = Rc::clone(&outcome);
    simulation.client(CLIENT, async move {
        let mut session = open().await?;
        send_step(&mut session, 0).await?;
        receive_step(&mut session).await?;
        turmoil::partition(CLIENT, SERVER);
        tokio::time::sleep(gap).await;
        turmoil::repair(CLIENT, SERVER);
        send_step(&mut session, 1).await?;
        *result.borrow_mut() = Some(receive_step(&mut session).await);
        Ok(())
    });
    simulation.run().expect("the client ends");
    // The server notices the end of the client, and keeps its session until the lease ends.
    let end = simulation.elapsed() + 2 * LEASE;
    while !ledger.is_idle() && simulation.elapsed() < end {
        simulation.step().expect("the server goes on");
    }
    (outcome.take().expect("the client was answered"), ledger)
}

/// Checks that the server took only the client's first step, and no longer had the session when the client tried to
/// resume it.
#[track_caller]
fn assert_gone(reply: &Result<[u64; 2], ClientError>, ledger: &StepLog) {
    assert!(matches!(reply, Err(ClientError::Lost { request: "a step", .. })), "{reply:?}");
    assert_eq!((ledger.done(), ledger.unknown()), (vec![0], 1));
}

#[test]
fn a_session_resumes_until_its_lease_ends() {
    simulations(|seed| {
        // The lease begins when the server notices the cut, at most two seconds after it. Both margins are longer.
        let (reply, ledger) = cut_off(seed, LEASE - Duration::from_secs(5));
        assert_eq!((reply.expect("it goes on"), ledger.done()), ([1, 2], vec![0, 1]));
        assert!(ledger.is_idle(), "its session is over");
        let (reply, ledger) = cut_off(seed, LEASE + Duration::from_secs(10));
        assert_gone(&reply, &ledger);
        assert!(ledger.is_idle(), "nothing is left of it");
    });
}

#[test]
fn a_restarted_server_refuses_to_resume() {
    simulations(|seed| {
        let ledger = StepLog::default();
        let outcome = Rc::new(RefCell::new(None));
        let mut simulation = simulation(seed, &ledger);
        let result = Rc::clone(&outcome);
        simulation.client(CLIENT, async move {
            let mut session = open().await?;
            send_step(&mut session, 0).await?;
            receive_step(&mut session).await?;
            tokio::time::sleep(Duration::from_secs(10)).await;
            send_step(&mut session, 1).await?;
            *result.borrow_mut() = Some(receive_step(&mut session).await);
            Ok(())
        });
        while simulation.elapsed() < Duration::from_secs(5) {
            simulation.step().expect("no client fails");
        }
        simulation.bounce(SERVER);
        simulation.run().expect("the client ends");
        assert_gone(&outcome.take().expect("the client was answered"), &ledger);
    });
}
