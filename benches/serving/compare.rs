//! Compares this server with another executable of it, for example one of the previous commit: `cargo bench --bench
//! serving -- compare PROGRAM`. Both programs serve the same steps in alternating short rounds, so that other load
//! affects both. The output has medians over pairs of rounds. The observations from both programs must be equal.

use crate::{
    Failure,
    client::{Client, ServerProcess},
    median,
};
use bytes::Bytes;
use std::{path::Path, time::Instant};

/// Number of pairs of servers for each measurement. Even two equal servers differ in speed, depending on the cores on
/// which the operating system runs their threads. Therefore both servers are restarted for each pair, and the order in
/// which they start alternates.
const PAIRS: usize = 6;
/// Number of rounds with each pair of servers.
const ROUNDS: usize = 7;
/// Environment steps in a round, and the number of workers, for CartPole. There are more steps than for Hopper, because
/// a step of CartPole takes less than a microsecond.
const CART_POLE: (usize, usize) = (1 << 18, 1);
const HOPPER: (usize, usize) = (1 << 13, 2);
/// Number of round trips in a round with one environment.
const TRIPS: usize = 2000;

/// Two sessions with the same environments, one on this server and one on the other executable.
struct Pair {
    clients: [Client; 2],
    _servers: [ServerProcess; 2],
}

impl Pair {
    async fn open(other: &Path, name: &str, batch: usize, workers: usize, number: usize) -> Result<Self, Failure> {
        let start =
            |own| if own { ServerProcess::server(workers) } else { ServerProcess::program(other, workers, &[]) };
        let own_first = number.is_multiple_of(2);
        let first = start(own_first)?;
        let first_client = Client::open(&first.socket, name, batch).await?;
        let second = start(!own_first)?;
        let second_client = Client::open(&second.socket, name, batch).await?;
        let clients = if own_first { [first_client, second_client] } else { [second_client, first_client] };
        Ok(Self { clients, _servers: [first, second] })
    }
}

/// Measures both programs, and prints the ratios of their speeds.
pub(crate) async fn compared(other: &Path) -> Result<(), Failure> {
    round_trip(other).await?;
    for (name, batch, (steps, workers)) in
        [("CartPole", 256, CART_POLE), ("Hopper", 64, HOPPER), ("Hopper", 256, HOPPER), ("Hopper", 1024, HOPPER)]
    {
        for in_flight in [1, 2] {
            let mut ratios = Vec::with_capacity(PAIRS * ROUNDS);
            for number in 0..PAIRS {
                let mut pair = Pair::open(other, name, batch, workers, number).await?;
                for round in 0..ROUNDS {
                    let mut rounds = [const { (0.0, Bytes::new()) }; 2];
                    let actions: Vec<Bytes> = (0..steps / batch).map(|_| pair.clients[0].actions()).collect();
                    for turn in 0..2 {
                        let which = (round + turn) % 2; // alternates the order, because the first one is slower
                        let start = Instant::now();
                        let last = pair.clients[which].play(&actions, in_flight).await?;
                        rounds[which] = (start.elapsed().as_secs_f64(), last);
                    }
                    let [(own, saw), (others, also)] = rounds;
                    assert_eq!(saw, also, "the servers differ");
                    ratios.push(others / own);
                }
            }
            let id = format!("compare/{name}/{batch}/{in_flight}");
            println!("{id:<24} {:>8.3} of the other program's steps a second", median(&mut ratios));
        }
    }
    Ok(())
}

/// Compares the round-trip times of one environment.
async fn round_trip(other: &Path) -> Result<(), Failure> {
    let mut p50s = [const { Vec::new() }; 2];
    for number in 0..PAIRS {
        let mut pair = Pair::open(other, "CartPole", 1, 1, number).await?;
        for round in 0..ROUNDS {
            for turn in 0..2 {
                let which = (round + turn) % 2;
                let mut micros = Vec::with_capacity(TRIPS);
                for _ in 0..TRIPS {
                    micros.push(pair.clients[which].run(1).await? * 1e6);
                }
                p50s[which].push(median(&mut micros));
            }
        }
    }
    let mut more: Vec<f64> = p50s[0].iter().zip(&p50s[1]).map(|(own, other)| own - other).collect();
    let [own, others] = p50s.each_mut().map(|p50s| median(p50s));
    let more = median(&mut more);
    println!("compare/CartPole/1       {own:>8.2} us p50, the other program {others:.2} us, pairwise {more:+.2} us");
    Ok(())
}
