//! The logs of a training: `monitor.csv`, `progress.csv` and TensorBoard events. Formats and names are those of
//! stable-baselines3, so that existing tools can read them.

mod clock;
mod disk;
mod logs;
mod monitor;
mod progress;
mod tensorboard;

pub use clock::Clock;
pub use logs::{LogError, LogLengths, Logs};
pub use monitor::Monitor;
pub use progress::{EpisodeFigures, Progress, ProgressLog, TimeShares};
pub use tensorboard::EventWriter;
