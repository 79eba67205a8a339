//! Leases over a line that is cut and held at random, in simulated time, by seeds: `PERTURB_SEED` gives the first,
//! `PERTURB_SIMULATIONS` how many; a failure prints its seed.

use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::rc::Rc;
use std::time::Duration;

use perturb_faults::Dice;
use perturb_faults::dice::SEED;
use perturb_protocol::{ClientError, Stream, proto};
use perturb_simulation::{KEEPALIVE, LEASE, Ledger, SERVER, connect, serve};
use turmoil::{Builder, Sim};

const CLIENT: &str = "client";
/// Steps of a session.
const STEPS: u64 = 200;
/// Requests that wait for their replies, at most.
const AHEAD: u64 = 5;
/// How long one is busy between two steps, at most; ms.
const BUSY: u64 = 100;
/// How long the line is good or bad at a time, at most; ms.
const SPELL: u64 = 8_000;
/// Simulations of each test unless a variable says how many.
const SIMULATIONS: u64 = 50;

/// What a client saw: when, in the simulation's time, and the numbers of each reply.
type Seen = Rc<RefCell<Vec<(Duration, [u64; 2])>>>;

fn number(name: &str, usual: u64) -> u64 {
    std::env::var(name).map_or(usual, |text| text.parse().expect("a number"))
}

/// For each seed.
fn simulations(simulate: impl Fn(u64)) {
    let first = number(SEED, 1);
    for seed in first..first + number("PERTURB_SIMULATIONS", SIMULATIONS) {
        if let Err(failure) = catch_unwind(AssertUnwindSafe(|| simulate(seed))) {
            eprintln!("{SEED}={seed} SIMULATIONS=1 make simulation-test simulates this again");
            resume_unwind(failure);
        }
    }
}

fn simulation(seed: u64, ledger: &Ledger) -> Sim<'static> {
    let mut builder = Builder::new();
    builder.rng_seed(seed).simulation_duration(Duration::from_secs(7200)).min_message_latency(Duration::from_millis(1));
    builder.max_message_latency(Duration::from_millis(50));
    let mut simulation = builder.build();
    let ledger = ledger.clone();
    simulation.host(SERVER, move || serve(ledger.clone()));
    simulation
}

async fn open() -> Result<Stream, ClientError> {
    let open = proto::Open { lease: AHEAD as u32, ..Default::default() };
    Ok(Stream::open(&connect().await?, open).await?.0)
}

async fn ask(session: &mut Stream, number: u64) -> Result<(), ClientError> {
    session.send(proto::Step { actions: number.to_le_bytes().to_vec().into() }).await
}

async fn take(session: &mut Stream) -> Result<[u64; 2], ClientError> {
    let stepped = session.receive::<proto::Step>().await?;
    let (numbers, _) = stepped.observations.as_chunks::<8>();
    Ok([0, 1].map(|i| u64::from_le_bytes(numbers[i])))
}

/// Takes all steps, some requests ahead, at its leisure.
async fn play(seed: u64, seen: Seen) -> turmoil::Result {
    let mut dice = Dice::of(seed);
    let (mut session, mut asked) = (open().await?, 0);
    for received in 0..STEPS {
        let ahead = 1 + dice.below(AHEAD);
        while asked < STEPS.min(received + ahead) {
            ask(&mut session, asked).await?;
            asked += 1;
        }
        let reply = take(&mut session).await?;
        seen.borrow_mut().push((turmoil::elapsed(), reply));
        tokio::time::sleep(Duration::from_millis(dice.below(BUSY))).await;
    }
    session.close().await;
    Ok(())
}

/// Runs the simulation to its end on a line that is good and bad by turns; then it is good. Whether it was so for long
/// enough before that what its client said last was heard: a cut that nobody has noticed yet swallows it.
fn disturb(simulation: &mut Sim<'_>, seed: u64) -> bool {
    let (mut dice, mut change, mut is_good) = (Dice::of(!seed), Duration::from_secs(1), true);
    let mut good_since = Duration::ZERO;
    loop {
        if simulation.elapsed() >= change {
            simulation.release(CLIENT, SERVER);
            simulation.repair(CLIENT, SERVER);
            is_good = !is_good;
            good_since = simulation.elapsed();
            match dice.below(4) {
                _ if is_good => {}
                0 => simulation.hold(CLIENT, SERVER),
                1 => simulation.partition_oneway(CLIENT, SERVER),
                2 => simulation.partition_oneway(SERVER, CLIENT),
                _ => simulation.partition(CLIENT, SERVER),
            }
            change += Duration::from_millis(1 + dice.below(SPELL));
        }
        if simulation.step().expect("no client fails") {
            simulation.release(CLIENT, SERVER);
            simulation.repair(CLIENT, SERVER);
            return is_good && simulation.elapsed() - good_since > 3 * KEEPALIVE;
        }
    }
}

/// What a client saw over a bad line, and how often it took its session up.
fn disturbed(seed: u64) -> (Vec<(Duration, [u64; 2])>, u64) {
    let (ledger, seen) = (Ledger::default(), Seen::default());
    let mut simulation = simulation(seed, &ledger);
    simulation.client(CLIENT, play(seed, Rc::clone(&seen)));
    let is_heard = disturb(&mut simulation, seed);
    assert_eq!(ledger.done(), (0..STEPS).collect::<Vec<_>>(), "each step is done once, in its order");
    let numbers: Vec<_> = seen.borrow().iter().map(|(_, numbers)| *numbers).collect();
    assert_eq!(numbers, (0..STEPS).map(|step| [step, step + 1]).collect::<Vec<_>>(), "and each reply comes once");
    // Its client has closed it, and no lease is waited for where that was heard.
    let patience = Duration::from_secs(5) + if is_heard { Duration::ZERO } else { LEASE };
    let end = simulation.elapsed() + patience;
    while simulation.elapsed() < end {
        simulation.step().expect("the server goes on");
    }
    assert!(ledger.is_idle(), "nothing is left of it");
    (seen.take(), ledger.resumed())
}

#[test]
fn over_a_line_that_is_cut_and_held_each_step_is_done_once_and_each_reply_comes_once() {
    let resumed = RefCell::new(0);
    simulations(|seed| *resumed.borrow_mut() += disturbed(seed).1);
    println!("sessions were taken up {} times", resumed.borrow());
    assert!(*resumed.borrow() > 0, "no line was bad enough");
}

#[test]
fn a_seed_gives_the_same_again_to_the_millisecond() {
    let seed = number(SEED, 1);
    assert_eq!(disturbed(seed), disturbed(seed));
    assert_ne!(disturbed(seed), disturbed(seed + 1));
}

/// A client that steps once and again after `away`, on a line that is cut in between.
fn cut_off(seed: u64, away: Duration) -> (Result<[u64; 2], ClientError>, Ledger) {
    let (ledger, outcome) = (Ledger::default(), Rc::new(RefCell::new(None)));
    let mut simulation = simulation(seed, &ledger);
    let told = Rc::clone(&outcome);
    simulation.client(CLIENT, async move {
        let mut session = open().await?;
        ask(&mut session, 0).await?;
        take(&mut session).await?;
        turmoil::partition(CLIENT, SERVER);
        tokio::time::sleep(away).await;
        turmoil::repair(CLIENT, SERVER);
        ask(&mut session, 1).await?;
        *told.borrow_mut() = Some(take(&mut session).await);
        Ok(())
    });
    simulation.run().expect("the client ends");
    // The server notices that the client is gone, and holds a session as long as it said.
    let end = simulation.elapsed() + 2 * LEASE;
    while !ledger.is_idle() && simulation.elapsed() < end {
        simulation.step().expect("the server goes on");
    }
    (outcome.take().expect("the client was answered"), ledger)
}

/// Of two steps the client took one, then it asked for its session, which nobody knew any more.
#[track_caller]
fn assert_gone(reply: &Result<[u64; 2], ClientError>, ledger: &Ledger) {
    assert!(matches!(reply, Err(ClientError::Lost { request: "a step", .. })), "{reply:?}");
    assert_eq!((ledger.done(), ledger.unknown()), (vec![0], 1));
}

#[test]
fn a_session_is_taken_up_as_long_as_its_lease_holds_and_is_gone_after_that() {
    simulations(|seed| {
        // The server notices a cut after two seconds at most.
        let (reply, ledger) = cut_off(seed, LEASE - Duration::from_secs(5));
        assert_eq!((reply.expect("it goes on"), ledger.done()), ([1, 2], vec![0, 1]));
        assert!(ledger.is_idle(), "its session is over");
        let (reply, ledger) = cut_off(seed, LEASE + Duration::from_secs(10));
        assert_gone(&reply, &ledger);
        assert!(ledger.is_idle(), "nothing is left of it");
    });
}

#[test]
fn a_client_whose_server_has_begun_anew_is_told_and_nothing_is_stepped() {
    simulations(|seed| {
        let (ledger, outcome) = (Ledger::default(), Rc::new(RefCell::new(None)));
        let mut simulation = simulation(seed, &ledger);
        let told = Rc::clone(&outcome);
        simulation.client(CLIENT, async move {
            let mut session = open().await?;
            ask(&mut session, 0).await?;
            take(&mut session).await?;
            tokio::time::sleep(Duration::from_secs(10)).await;
            ask(&mut session, 1).await?;
            *told.borrow_mut() = Some(take(&mut session).await);
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
