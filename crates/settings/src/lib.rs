//! The settings of a training, and the parameter sets on which policies are trained and tested.
#![forbid(unsafe_code)]

pub mod sets;
mod settings;
mod value_error;

pub use settings::{
    A2cConfig, Architecture, Base, CollectionMode, Common, ConfigError, EpoptConfig, Method, Observe, PpoConfig,
    Preset, Ranking, Rl2Config, Schedule, SettingError, Settings, TrainConfig, Wrapper, spelled,
};
pub use value_error::{ValueError, require};
