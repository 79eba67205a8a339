//! A policy as portable arithmetic that gives the same bytes on every processor. It consists of the policy's shape and
//! weights ([`PolicySpec`], [`Weights`]), action sampling ([`Actor`]), inputs and normalisation ([`Inputs`],
//! [`Normalisers`]), playing in environments ([`Player`]), and learning of feed-forward policies ([`Objective`],
//! [`Differentiator`], [`Optimiser`]).
//!
//! The code is plain f32 loops and does not need libtorch. Programs that link libtorch can [register
//! it](register_recurrent) to compute the gradients of recurrent policies.
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
pub use player::{Player, PlayerRole, PlayerTrainingState, RolloutStep, SlotEnd, StepOutcome, TrialStreams};
pub use recurrent::{
    MakeRecurrent, RecurrentBatch, RecurrentDifferentiator, has_recurrent, recurrent_differentiator, register_recurrent,
};
pub use samples::{Samples, SequenceSamples};
pub use spec::{ActionKind, PolicySpec};
pub use weights::{NamedArray, Weights, check_arrays};
