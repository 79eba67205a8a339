//! Draws pictures of environments.
//!
//! A server has one thread that draws all pictures. So the threads for physics and connections never draw or wait for
//! OpenGL. A session sends a [`Scene`] to the thread and receives pixels.
//!
//! - `turns` is the fair queue of the pictures to draw.
//! - `canvas` draws shapes in a plane.
//! - `model` draws MuJoCo models, with colours, floor, light and sky.

mod canvas;
mod fair_queue;
#[cfg(feature = "mujoco")]
mod model;

use crate::{meters::Histogram, priority::lower, scene::Scene};
use bytes::Bytes;
use fair_queue::FairQueue;
use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Mutex, PoisonError},
    thread::{self, JoinHandle},
    time::Duration,
};
use tokio::{sync::oneshot, time::Instant};

/// Scheduling priority (niceness) of the drawing thread and of the graphics driver's threads. The threads for physics
/// have a higher priority.
const NICENESS: i32 = 5;
/// Maximal time that a server waits at shutdown for the picture being drawn.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// The size of a picture in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// The width, within [`PICTURE_PIXELS`](perturb_protocol::limits::PICTURE_PIXELS).
    pub width: u16,
    /// The height, within [`PICTURE_PIXELS`](perturb_protocol::limits::PICTURE_PIXELS).
    pub height: u16,
}

/// The reason why a picture cannot be drawn.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The server's machine lacks a library or device that is needed to draw this environment.
    #[error("this server cannot draw {environment}: {reason}")]
    Missing {
        /// The environment's name.
        environment: &'static str,
        /// The missing part, and how to install it.
        reason: String,
    },
    /// The drawing failed.
    #[error("{environment} could not be drawn: {reason}")]
    Failed {
        /// The environment's name.
        environment: &'static str,
        /// The reason.
        reason: String,
    },
    /// The operating system refuses to start the drawing thread.
    #[error("no thread could be started to draw with ({reason}); try again when the machine is less busy")]
    NoThread {
        /// The system's error.
        reason: String,
    },
    /// The drawing thread panicked, because of a bug of the server.
    #[error("drawing failed because of a bug of the server; report it with the server's log")]
    Defect,
}

/// Draws pictures on a separate thread, which starts with the first picture. Dropping the renderer ends the thread
/// after the current picture, and waits for it at most one second.
#[derive(Default)]
pub struct Renderer {
    thread: Mutex<Option<DrawingThread>>,
    times: Arc<Histogram>,
}

/// The drawing thread and its queue.
struct DrawingThread {
    jobs: Arc<FairQueue<PictureJob>>,
    handle: JoinHandle<()>,
}

struct PictureJob {
    scene: Scene,
    size: Size,
    reply: oneshot::Sender<Result<Vec<u8>, Error>>,
}

impl Renderer {
    /// Creates a renderer. Its thread starts with the first picture.
    pub fn new() -> Self {
        Self::default()
    }

    /// Returns the histogram of the time that each picture took to draw.
    pub fn times(&self) -> Arc<Histogram> {
        Arc::clone(&self.times)
    }

    /// Draws a picture. Returns its pixels, `[height, width, 3]`: red, green and blue, top row first. Pictures are
    /// drawn one at a time; small pictures may overtake large pictures in the queue. The same scene and size give the
    /// same bytes.
    ///
    /// # Errors
    /// [`Error`] if the picture cannot be drawn.
    pub async fn draw(&self, scene: Scene, size: Size) -> Result<Bytes, Error> {
        let (reply, picture) = oneshot::channel();
        let pixels = u64::from(size.width) * u64::from(size.height);
        self.jobs()?.push(pixels, PictureJob { scene, size, reply }, |job| !job.reply.is_closed());
        // No reply means a bug: the thread replies to every picture, and ends only when the renderer is dropped.
        picture.await.map_err(|_| Error::Defect)?.map(Bytes::from)
    }

    fn jobs(&self) -> Result<Arc<FairQueue<PictureJob>>, Error> {
        let mut running = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(thread) = &*running {
            return Ok(Arc::clone(&thread.jobs));
        }
        let jobs = Arc::new(FairQueue::new());
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
            // Waits for the thread, because the graphics driver should not draw while the process ends. The wait is
            // limited, because a driver may hang.
            for _ in 0..SHUTDOWN_TIMEOUT.as_millis() {
                if handle.is_finished() {
                    break;
                }
                thread::sleep(Duration::from_millis(1));
            }
        }
    }
}

/// The drawing thread: draws the pictures in the queue until it is closed.
fn work(jobs: &FairQueue<PictureJob>, times: &Histogram) {
    lower(NICENESS);
    let mut cache = Cache::default();
    while let Some(PictureJob { scene, size, reply }) = jobs.pop() {
        if reply.is_closed() {
            continue; // the session no longer waits
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
            cache = Cache::default(); // the failure may have left the cached models in any state
        }
        let _ = reply.send(drawn); // fails if the session no longer waits
    }
}

/// The models that the drawing thread has compiled, reused for later pictures.
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
