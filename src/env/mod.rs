//! Environments: the trait that each environment implements, its description, and the episodes that it runs.

mod catalogue;
pub mod disturbance;
mod environment;
mod episode;
mod error;
mod normal;
mod parameter;
mod seeding;
mod seen;
mod snapshot;
mod spaces;
mod success;

pub use catalogue::Catalogue;
pub use environment::{
    Environment, EnvironmentSpec, MakeEnvironment, PushSpec, Transition, check_bounds, check_distribution, resolve,
};
pub use episode::{EpisodeEnd, EpisodeId, EpisodeStart, Episodes, Outcome, Receipt, Settings};
pub use error::Error;
pub(crate) use error::shorten;
pub use parameter::Parameter;
pub use perturb_protocol::{Distribution, DistributionError, Interval, Version};
pub use seeding::{Draw, Purpose, Stream};
pub(crate) use snapshot::{MAX_SNAPSHOT_BYTES, distributions_bytes};
pub use snapshot::{SavedDraw, saved_draw};
pub use spaces::{Action, ActionSpace, Channel, Quantity, RewardTerm};
pub use success::{Achievement, Comparison, Success};
