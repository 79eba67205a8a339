//! Pictures of environments.
//!
//! One thread for a server draws them all, so that neither the physics' workers nor the transport's thread ever draws
//! or waits for OpenGL: a session hands over a [`Scene`] and gets pixels back.
//!
//! - `turns` puts those that wait in order.
//! - `canvas` draws shapes in a plane: paths in metres, anti-aliased, by a library in Rust.
//! - `model` draws MuJoCo's models, each on one of its own with colours, floor, light and sky.

mod canvas;
#[cfg(feature = "mujoco")]
mod model;
mod turns;

use crate::{meters::Histogram, priority::lower, scene::Scene};
use bytes::Bytes;
use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Mutex, PoisonError},
    thread::{self, JoinHandle},
    time::Duration,
};
use tokio::{sync::oneshot, time::Instant};
use turns::Turns;

/// The thread's niceness. Its driver's threads inherit it: physics comes first.
const NICENESS: i32 = 5;
/// How long the end of a server waits for the picture under way.
const FAREWELL: Duration = Duration::from_secs(1);

/// A picture's size in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// From left to right, within [`PICTURE_PIXELS`](perturb_protocol::limits::PICTURE_PIXELS).
    pub width: u16,
    /// From top to bottom, within [`PICTURE_PIXELS`](perturb_protocol::limits::PICTURE_PIXELS).
    pub height: u16,
}

/// Why there is no picture.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The machine lacks something to draw this environment with.
    #[error("this server cannot draw {environment}: {reason}")]
    Missing {
        /// The environment.
        environment: &'static str,
        /// What is missing, and how to get it.
        reason: String,
    },
    /// The drawing failed.
    #[error("{environment} could not be drawn: {reason}")]
    Failed {
        /// The environment.
        environment: &'static str,
        /// Why.
        reason: String,
    },
    /// The operating system gives no thread to draw with.
    #[error("no thread could be started to draw with ({reason}); try again when the machine is less busy")]
    NoThread {
        /// What it says.
        reason: String,
    },
    /// The drawing thread panicked: a defect of the server.
    #[error("the drawing failed from a defect of the server; report what its log says")]
    Defect,
}

/// Draws pictures on a thread of its own, which starts with the first. Dropping it ends the thread after the picture
/// under way, for which it waits a second at most.
#[derive(Default)]
pub struct Renderer {
    thread: Mutex<Option<DrawingThread>>,
    times: Arc<Histogram>,
}

/// The thread, and what waits for it.
struct DrawingThread {
    jobs: Arc<Turns<Job>>,
    handle: JoinHandle<()>,
}

struct Job {
    scene: Scene,
    size: Size,
    reply: oneshot::Sender<Result<Vec<u8>, Error>>,
}

impl Renderer {
    /// A renderer whose thread has not started.
    pub fn new() -> Self {
        Self::default()
    }

    /// How long each picture was drawn.
    pub fn times(&self) -> Arc<Histogram> {
        Arc::clone(&self.times)
    }

    /// A picture, `[height, width, 3]`: red, green, blue, the uppermost row first. Pictures are drawn one after the
    /// other, in an order that lets nobody wait for more pixels than are fair. The same scene and size give the same bytes.
    ///
    /// # Errors
    /// [`Error`].
    pub async fn draw(&self, scene: Scene, size: Size) -> Result<Bytes, Error> {
        let (reply, picture) = oneshot::channel();
        let pixels = u64::from(size.width) * u64::from(size.height);
        self.jobs()?.push(pixels, Job { scene, size, reply }, |job| !job.reply.is_closed());
        // The thread ends only when this is dropped.
        picture.await.map_err(|_| Error::Defect)?.map(Bytes::from)
    }

    fn jobs(&self) -> Result<Arc<Turns<Job>>, Error> {
        let mut running = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(thread) = &*running {
            return Ok(Arc::clone(&thread.jobs));
        }
        let jobs = Arc::new(Turns::new());
        let (own, times) = (Arc::clone(&jobs), self.times());
        let handle = thread::Builder::new()
            .name("render".into())
            .spawn(move || work(&own, &times))
            .map_err(|error| Error::NoThread { reason: error.to_string() })?;
        *running = Some(DrawingThread { jobs: Arc::clone(&jobs), handle });
        Ok(jobs)
    }
}

impl Drop for Renderer {
    fn drop(&mut self) {
        let running = self.thread.get_mut().unwrap_or_else(PoisonError::into_inner);
        if let Some(DrawingThread { jobs, handle }) = running.take() {
            jobs.close();
            // A driver should not be drawing while the process ends; one that hangs must not keep it from ending.
            for _ in 0..FAREWELL.as_millis() {
                if handle.is_finished() {
                    break;
                }
                thread::sleep(Duration::from_millis(1));
            }
        }
    }
}

/// The thread: draws what is asked for until nobody can ask any more.
fn work(jobs: &Turns<Job>, times: &Histogram) {
    lower(NICENESS);
    let mut cache = Cache::default();
    while let Some(Job { scene, size, reply }) = jobs.pop() {
        if reply.is_closed() {
            continue; // its session is gone
        }
        let start = Instant::now();
        let drawn = catch_unwind(AssertUnwindSafe(|| cache.draw(&scene, size))).unwrap_or_else(|_| {
            tracing::error!(?scene, "a drawing panicked");
            Err(Error::Defect)
        });
        if drawn.is_ok() {
            times.observe(start.elapsed());
        }
        if matches!(drawn, Err(Error::Failed { .. } | Error::Defect)) {
            cache = Cache::default(); // what a failed drawing leaves behind is not to be trusted
        }
        let _ = reply.send(drawn); // the session may be gone by now
    }
}

/// What the thread keeps from one picture to the next.
#[derive(Default)]
struct Cache {
    #[cfg(feature = "mujoco")]
    models: model::Models,
}

impl Cache {
    fn draw(&mut self, scene: &Scene, size: Size) -> Result<Vec<u8>, Error> {
        match scene {
            Scene::Drawing(drawing) => Ok(canvas::draw(drawing, size)),
            #[cfg(feature = "mujoco")]
            Scene::Model(model) => self.models.draw(model, size),
        }
    }
}
