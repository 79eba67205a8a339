//! A line that takes its time: a proxy that holds every byte back for a while, both ways.

use std::io::{Read, Result, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use perturb_learner::client::Address;

/// Listens on a port of this machine until the process ends.
pub struct Proxy {
    port: u16,
}

impl Proxy {
    /// Before the server at the Unix socket `address`, with so much delay each way.
    pub fn start(address: &Address, delay: Duration) -> Result<Self> {
        let path = PathBuf::from(address.to_string().trim_start_matches("unix:"));
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let port = listener.local_addr()?.port();
        thread::spawn(move || {
            for client in listener.incoming().flatten() {
                if let Ok(server) = UnixStream::connect(&path) {
                    let _ = connect(client, server, delay); // the connection is closed then
                }
            }
        });
        Ok(Self { port })
    }

    /// Where it listens.
    pub fn address(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }
}

fn connect(client: TcpStream, server: UnixStream, delay: Duration) -> Result<()> {
    client.set_nodelay(true)?;
    let (client_end, server_end) = (client.try_clone()?, server.try_clone()?);
    pass(client.try_clone()?, server.try_clone()?, delay, move || drop(server_end.shutdown(Shutdown::Write)));
    pass(server, client, delay, move || drop(client_end.shutdown(Shutdown::Write)));
    Ok(())
}

/// Passes on what comes, in order, each piece so long after it came.
fn pass(
    mut from: impl Read + Send + 'static,
    mut to: impl Write + Send + 'static,
    delay: Duration,
    end: impl FnOnce() + Send + 'static,
) {
    let (sender, receiver) = mpsc::channel::<(Instant, Vec<u8>)>();
    thread::spawn(move || {
        let mut piece = vec![0; 1 << 16];
        while let Ok(count @ 1..) = from.read(&mut piece) {
            if sender.send((Instant::now() + delay, piece[..count].to_vec())).is_err() {
                break;
            }
        }
    });
    thread::spawn(move || {
        for (due, piece) in receiver {
            thread::sleep(due.saturating_duration_since(Instant::now()));
            if to.write_all(&piece).is_err() {
                break;
            }
        }
        end();
    });
}
