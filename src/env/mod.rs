//! Environments: the trait that each environment implements, its description, and the episodes that it runs.

mod catalogue;
pub mod disturbance;
mod environment;
mod episode;
mod error;
mod normal;
mod observed_parameters;
mod parameter;
mod seeding;
mod snapshot;
mod spaces;
mod success;

pub use catalogue::Catalogue;
pub(crate) use environment::distributions_bytes;
pub use environment::{
    Environment, EnvironmentSpec, MakeEnvironment, PushSpec, Transition, check_bounds, check_distribution, resolve,
};
pub use episode::{EpisodeId, EpisodeReceipt, EpisodeSettings, Episodes, FinishedEpisode, Outcome, StartedEpisode};
pub use error::Error;
pub(crate) use error::shorten;
pub use parameter::ParameterSpec;
pub use perturb_protocol::{Distribution, DistributionError, Interval, Version};
pub use seeding::{Draw, DrawPurpose, PhiloxStream};
pub(crate) use snapshot::MAX_SNAPSHOT_BYTES;
pub use snapshot::{SavedDraw, saved_draw};
pub use spaces::{Action, ActionSpec, ChannelSpec, QuantitySpec, RewardTermSpec};
pub use success::{Achievement, SuccessComparison, SuccessRuleSpec};
