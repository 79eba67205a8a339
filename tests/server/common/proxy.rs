//! A proxy in front of a server, which can cut connections or hold back their bytes.

use std::{
    io::{Read, Write},
    net::{Shutdown, TcpListener, TcpStream},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread,
};

/// The proxy. It listens until the process ends.
pub struct Proxy {
    port: u16,
    state: Arc<State>,
}

#[derive(Default)]
struct State {
    connections: Mutex<Vec<Connection>>,
    begun: AtomicUsize,
    cut: AtomicUsize,
}

/// A connection through the proxy: its two sockets, and whether its bytes are held back.
#[derive(Clone)]
struct Connection {
    ends: [Arc<TcpStream>; 2],
    is_silent: Arc<AtomicBool>,
    /// The number of bytes, in both directions together, after which the connection is cut.
    left: Arc<AtomicUsize>,
}

impl Proxy {
    /// Starts a proxy in front of the server at `address`, "host:port". Connection number n, from 0, is cut after
    /// `most(n)` bytes.
    pub fn start(address: &str, most: impl Fn(usize) -> usize + Send + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let (port, state) = (listener.local_addr().unwrap().port(), Arc::<State>::default());
        let (address, own) = (address.to_owned(), Arc::clone(&state));
        thread::spawn(move || {
            for client in listener.incoming().flatten() {
                let left = most(own.begun.fetch_add(1, Ordering::Relaxed));
                let Ok(server) = TcpStream::connect(&address) else { continue };
                let ends = [client, server].map(|end| {
                    end.set_nodelay(true).unwrap();
                    Arc::new(end)
                });
                let (is_silent, left) = (Arc::default(), Arc::new(AtomicUsize::new(left)));
                let connection = Connection { ends, is_silent, left };
                own.connections.lock().unwrap().push(connection.clone());
                for way in 0..2 {
                    let (connection, state) = (connection.clone(), Arc::clone(&own));
                    thread::spawn(move || connection.pass(way, &state));
                }
            }
        });
        Self { port, state }
    }

    /// The address of the proxy, "host:port".
    pub fn address(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }

    /// Closes all connections.
    pub fn cut(&self) {
        self.state.connections.lock().unwrap().drain(..).for_each(|connection| connection.cut());
    }

    /// Holds back all bytes of the existing connections without closing them, like an unplugged cable.
    pub fn silence(&self) {
        let connections = self.state.connections.lock().unwrap();
        connections.iter().for_each(|connection| connection.is_silent.store(true, Ordering::Relaxed));
    }

    /// The number of connections that were cut because of their number of bytes.
    pub fn cuts(&self) -> usize {
        self.state.cut.load(Ordering::Relaxed)
    }
}

impl Connection {
    fn cut(&self) {
        self.ends.iter().for_each(|end| _ = end.shutdown(Shutdown::Both)); // fails if it is already closed
    }

    fn pass(&self, way: usize, state: &State) {
        let [mut from, mut to] = [way, 1 - way].map(|end| &*self.ends[end]);
        let mut piece = vec![0; 1 << 16];
        while let Ok(count @ 1..) = from.read(&mut piece) {
            if self.is_silent.load(Ordering::Relaxed) {
                continue;
            }
            let take = |left: usize| Some(left.saturating_sub(count));
            let left = self.left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take).unwrap();
            if to.write_all(&piece[..count.min(left)]).is_err() {
                break;
            }
            if count > left {
                state.cut.fetch_add(usize::from(left > 0), Ordering::Relaxed);
                break;
            }
        }
        self.cut();
    }
}
