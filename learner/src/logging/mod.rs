//! Logs of a training: `monitor.csv`, `progress.csv` and TensorBoard events, all with stable-baselines3's names, so that
//! existing tools read them.

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
