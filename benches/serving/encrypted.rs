//! The cost of encryption: the steps of a batch over TCP with TLS, compared with TCP without TLS.

use super::{
    Failure, ROUNDS,
    client::{Client, ServerProcess},
    median,
};
use perturb_faults::certificates::{Authority, CertificateFiles};
use perturb_protocol::{Address, Connection, Timeouts, credentials::Credentials};
use std::path::Path;

/// Measures CartPole with `batch` environments.
pub(crate) async fn measure(batch: usize) -> Result<(), Failure> {
    /// The number of steps in a round. Rounds with and without TLS alternate.
    const TRIPS: usize = 400;
    let directory = tempfile::tempdir()?;
    let CertificateFiles { cert, key } = certificates(directory.path());
    let (plain, encrypted) =
        (ServerProcess::tcp(1, &[])?, ServerProcess::tcp(1, &[("--tls-cert", &cert), ("--tls-key", &key)])?);
    let mut plain_client =
        Client::on(&connect(&plain.address, Credentials::default()).await?, "CartPole", batch).await?;
    let credentials = Credentials::pinned(&cert)?;
    let mut encrypted_client = Client::on(&connect(&encrypted.address, credentials).await?, "CartPole", batch).await?;
    let mut plain_times = Vec::new();
    let mut ratios = Vec::new();
    for _ in 0..ROUNDS {
        let plain = plain_client.run(TRIPS).await?;
        let encrypted = encrypted_client.run(TRIPS).await?;
        plain_times.push(plain / TRIPS as f64 * 1e6);
        ratios.push(encrypted / plain);
    }
    let plain = median(&mut plain_times);
    let ratio = median(&mut ratios);
    println!("tls/CartPole/{batch:<9} {plain:>12.1} us a step by TCP, with TLS {ratio:.2} of that");
    Ok(())
}

/// Creates a certificate for a server on this machine.
pub(crate) fn certificates(directory: &Path) -> CertificateFiles {
    Authority::new("bench").issue(directory, "server", &["127.0.0.1"], 2200)
}

pub(crate) async fn connect(address: &str, credentials: Credentials) -> Result<Connection, Failure> {
    let address: Address = address.parse()?;
    Ok(Connection::open_as(&address, Timeouts::default(), credentials).await?)
}
