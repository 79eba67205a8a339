//! A line that breaks: a proxy in front of a server, whose connections are cut or fall silent.

use std::{
    io::{Read, Write},
    net::{Shutdown, TcpListener, TcpStream},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread,
};

/// Listens on a port of this machine until the process ends.
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

/// Both ends of one, and whether its bytes are held back.
#[derive(Clone)]
struct Connection {
    ends: [Arc<TcpStream>; 2],
    is_silent: Arc<AtomicBool>,
    /// So many more bytes go through, both ways together.
    left: Arc<AtomicUsize>,
}

impl Proxy {
    /// In front of the server at `address`, host and port. Connection number n, counted from 0, is cut when `most(n)`
    /// bytes went through.
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

    /// Where it listens, host and port.
    pub fn address(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }

    /// Cuts all connections.
    pub fn cut(&self) {
        self.state.connections.lock().unwrap().drain(..).for_each(|connection| connection.cut());
    }

    /// Lets nothing more through on the connections that there are, and closes none: a cable that was pulled.
    pub fn silence(&self) {
        let connections = self.state.connections.lock().unwrap();
        connections.iter().for_each(|connection| connection.is_silent.store(true, Ordering::Relaxed));
    }

    /// How many connections were cut because of their bytes.
    pub fn cuts(&self) -> usize {
        self.state.cut.load(Ordering::Relaxed)
    }
}

impl Connection {
    fn cut(&self) {
        self.ends.iter().for_each(|end| _ = end.shutdown(Shutdown::Both)); // it may be already
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
