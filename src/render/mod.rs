//! Pictures of environments.
//!
//! One thread of a server draws all pictures, so that neither the physics' workers nor the transport thread ever draws
//! or waits for OpenGL. A session hands over a [`Scene`] and gets pixels back.
//!
//! - `turns` is the queue of pictures that wait.
//! - `canvas` draws shapes in a plane: paths in metres, anti-aliased, by a library in Rust.
//! - `model` draws MuJoCo's models, with colours, floor, light and sky.

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

/// Niceness of the drawing thread, which the driver's threads inherit. Physics has priority.
const NICENESS: i32 = 5;
/// Time that the end of a server waits for the picture that is being drawn.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// A picture's size in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// The width, within [`PICTURE_PIXELS`](perturb_protocol::limits::PICTURE_PIXELS).
    pub width: u16,
    /// The height, within [`PICTURE_PIXELS`](perturb_protocol::limits::PICTURE_PIXELS).
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
        /// The missing part, and how to install it.
        reason: String,
    },
    /// The drawing failed.
    #[error("{environment} could not be drawn: {reason}")]
    Failed {
        /// The environment.
        environment: &'static str,
        /// The reason.
        reason: String,
    },
    /// The operating system gives no thread to draw with.
    #[error("no thread could be started to draw with ({reason}); try again when the machine is less busy")]
    NoThread {
        /// The system's error.
        reason: String,
    },
    /// The drawing thread panicked: a defect of the server.
    #[error("drawing failed because of a bug of the server; report it with the server's log")]
    Defect,
}

/// Draws pictures on a thread of its own, which starts with the first picture. Dropping it ends the thread after the
/// picture that is being drawn, and waits a second for that at most.
#[derive(Default)]
pub struct Renderer {
    thread: Mutex<Option<DrawingThread>>,
    times: Arc<Histogram>,
}

/// The drawing thread and its queue.
struct DrawingThread {
    jobs: Arc<Turns<PictureJob>>,
    handle: JoinHandle<()>,
}

struct PictureJob {
    scene: Scene,
    size: Size,
    reply: oneshot::Sender<Result<Vec<u8>, Error>>,
}

impl Renderer {
    /// Makes a renderer without a thread yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Returns the histogram of the time that drawing a picture took.
    pub fn times(&self) -> Arc<Histogram> {
        Arc::clone(&self.times)
    }

    /// Draws a picture, `[height, width, 3]`: red, green, blue, the uppermost row first. Pictures are drawn one at a
    /// time, in the fair order of `Turns`. The same scene and size give the same bytes.
    ///
    /// # Errors
    /// [`Error`].
    pub async fn draw(&self, scene: Scene, size: Size) -> Result<Bytes, Error> {
        let (reply, picture) = oneshot::channel();
        let pixels = u64::from(size.width) * u64::from(size.height);
        self.jobs()?.push(pixels, PictureJob { scene, size, reply }, |job| !job.reply.is_closed());
        // The thread ends only when the renderer is dropped.
        picture.await.map_err(|_| Error::Defect)?.map(Bytes::from)
    }

    fn jobs(&self) -> Result<Arc<Turns<PictureJob>>, Error> {
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
            // A driver should not be drawing while the process ends, but one that hangs must not block the end.
            for _ in 0..SHUTDOWN_TIMEOUT.as_millis() {
                if handle.is_finished() {
                    break;
                }
                thread::sleep(Duration::from_millis(1));
            }
        }
    }
}

/// Runs on the drawing thread until the queue is closed.
fn work(jobs: &Turns<PictureJob>, times: &Histogram) {
    lower(NICENESS);
    let mut cache = Cache::default();
    while let Some(PictureJob { scene, size, reply }) = jobs.pop() {
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
            cache = Cache::default(); // a failed drawing may have left it in any state
        }
        let _ = reply.send(drawn); // the session may be gone by now
    }
}

/// The drawing thread's models, which are compiled once.
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
