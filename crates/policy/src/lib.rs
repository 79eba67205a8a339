//! A policy as portable arithmetic, with the same bytes on every processor: its shape and weights ([`PolicySpec`],
//! [`Weights`]), acting ([`Actor`]), inputs and normalisation ([`Inputs`], [`Normalisers`]), playing ([`Player`]), and the
//! learning of feed-forward policies ([`Objective`], [`Differentiator`], [`Optimiser`]). Plain f32 loops, without libtorch.
//! libtorch [differentiates recurrent policies](register_recurrent) in programs that have it.
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

pub use act::{Actor, ActorOutput, Streams};
pub use backend::gradient_backend;
pub use collect_until::{CollectUntil, EpisodeQuotas, RemainingRollout};
pub use differentiator::Differentiator;
pub use error::{Error, Result, check_length};
pub use gradient::{ActingOutputs, GradientBackend, GradientBatch};
pub use initial::initial_weights;
pub use inputs::Inputs;
pub use losses::Losses;
pub use normaliser::{ObservationNormaliser, RewardNormaliser, RunningMoments};
pub use normalisers::{Normalisers, Statistics};
pub use objective::{Acting, Objective, Surrogate};
pub use optimiser::{Adam, Optimiser, RmsProp, UpdateRule};
pub use player::{Player, PlayerState, Role, RolloutStep, SlotEnd, StepOutcome, TrialStreams};
pub use recurrent::{
    MakeRecurrent, RecurrentBatch, RecurrentDifferentiator, has_recurrent, recurrent_differentiator, register_recurrent,
};
pub use samples::{Samples, SequenceSamples};
pub use spec::{ActionKind, PolicySpec};
pub use weights::{NamedArray, Weights, check_arrays};
