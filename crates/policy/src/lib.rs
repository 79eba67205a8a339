//! A policy as portable arithmetic, the same bytes on every processor: what it is ([`PolicySpec`], [`Weights`]), how it acts
//! ([`Actor`]), what stands between an environment and it ([`Inputs`], [`Normalisers`]), how it plays ([`Player`]), and how
//! a feed-forward one learns ([`Objective`], [`Differentiator`], [`Descent`]). Plain f32 loops, without libtorch, which
//! [differentiates recurrent ones](register_recurrent) where it is.
#![forbid(unsafe_code)]
#![deny(clippy::disallowed_methods)]

mod act;
mod act_ff;
mod act_rc;
mod backend;
mod collect_until;
mod differentiator;
mod error;
mod gradient;
mod initial;
mod inputs;
mod kernel;
mod losses;
pub mod math;
mod normaliser;
mod normalisers;
mod objective;
mod optimiser;
mod perceptron;
mod player;
mod product;
pub mod random;
mod recurrent;
mod sample;
mod samples;
mod spec;
mod weights;

pub use act::{Actor, Acts, Streams};
pub use backend::gradient_backend;
pub use collect_until::{CollectUntil, EpisodeQuotas, Remaining};
pub use differentiator::Differentiator;
pub use error::{Error, Result, check_length};
pub use gradient::{ActingOutputs, Batch, GradientBackend};
pub use initial::initial_weights;
pub use inputs::Inputs;
pub use losses::Losses;
pub use normaliser::{ObservationNormaliser, RewardNormaliser, RunningMoments};
pub use normalisers::{Normalisers, Statistics};
pub use objective::{Acting, Objective, Surrogate};
pub use optimiser::{Adam, Descent, Optimiser, RmsProp};
pub use player::{Ended, Outcome, Player, PlayerState, Role, RolloutStep, TrialStreams};
pub use recurrent::{
    MakeRecurrent, RecurrentBatch, RecurrentDifferentiator, has_recurrent, recurrent_differentiator, register_recurrent,
};
pub use samples::{Samples, SequenceSamples};
pub use spec::{ActionKind, PolicySpec};
pub use weights::{NamedArray, Weights, check_arrays};
