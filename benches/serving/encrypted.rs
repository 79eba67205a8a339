//! What encryption costs: a batch's steps over TCP, with TLS beside without.

use super::{
    Failure, ROUNDS,
    client::{Client, Process},
    median,
};
use perturb_faults::certificates::{Authority, Pair};
use perturb_protocol::{Address, Connection, Patience, credentials::Credentials};

/// CartPole in batches of so many.
pub(crate) async fn stepped(batch: usize) -> Result<(), Failure> {
    const TRIPS: usize = 400;
    let directory = tempfile::tempdir()?;
    let Pair { cert, key } = Authority::new("bench").issue(directory.path(), "server", &["127.0.0.1"], 2200);
    let (plain, encrypted) = (Process::tcp(&[])?, Process::tcp(&[("--tls-cert", &cert), ("--tls-key", &key)])?);
    let mut bare = Client::on(&connected(&plain.address, Credentials::default()).await?, "CartPole", batch).await?;
    let credentials = Credentials::knowing(&cert)?;
    let mut hidden = Client::on(&connected(&encrypted.address, credentials).await?, "CartPole", batch).await?;
    let (mut plains, mut ratios) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let (plain, encrypted) = (bare.run(TRIPS).await?, hidden.run(TRIPS).await?);
        plains.push(plain / TRIPS as f64 * 1e6);
        ratios.push(encrypted / plain);
    }
    let (plain, ratio) = (median(&mut plains), median(&mut ratios));
    println!("tls/CartPole/{batch:<9} {plain:>12.1} us a step by TCP, with TLS {ratio:.2} of that");
    Ok(())
}

async fn connected(address: &str, credentials: Credentials) -> Result<Connection, Failure> {
    let address: Address = address.parse()?;
    Ok(Connection::open_as(&address, Patience::default(), credentials).await?)
}
