//! Policies: what they are ([`PolicySpec`], [`Weights`]), how they learn ([`Policy`], on libtorch), and how they act
//! ([`Actor`], plain f32 loops).

mod act;
mod distribution;
mod ff;
mod initial;
mod normaliser;
mod tanh;

pub use act::{Actor, Acts};
pub use ff::{Evaluated, Policy};
pub use normaliser::{ObservationNormaliser, RewardNormaliser, RunningMoments};

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// The kind of actions that a policy takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionKind {
    /// One of `n` choices, 0 … n-1: a categorical distribution over `n` logits.
    Discrete {
        /// Number of choices.
        n: usize,
    },
    /// A vector of `size` numbers: a diagonal Gaussian whose log standard deviations do not depend on the state.
    Continuous {
        /// Length of the vector.
        size: usize,
    },
}

impl ActionKind {
    /// A: f32 numbers that hold one action, 1 for discrete actions.
    pub fn width(self) -> usize {
        match self {
            ActionKind::Discrete { .. } => 1,
            ActionKind::Continuous { size } => size,
        }
    }

    /// Outputs of the policy network: n logits, or A means.
    pub fn outputs(self) -> usize {
        match self {
            ActionKind::Discrete { n } => n,
            ActionKind::Continuous { size } => size,
        }
    }
}

/// The shape of a policy.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicySpec {
    /// O: numbers in an observation.
    pub observation_size: usize,
    /// The actions.
    pub action: ActionKind,
    /// Widths of the hidden layers, of the policy network and of the value network; the paper uses [64, 64].
    pub hidden: Vec<usize>,
}

impl PolicySpec {
    /// Refuses empty spaces and layers.
    pub fn validate(&self) -> Result<()> {
        let positive = |name, got: usize| {
            if got > 0 { Ok(()) } else { Err(Error::Setting { name, got: got.to_string(), expected: "at least 1" }) }
        };
        positive("observation_size", self.observation_size)?;
        positive("the number of action outputs", self.action.outputs())?;
        self.hidden.iter().try_for_each(|&width| positive("the width of a hidden layer", width))
    }

    /// Inputs and outputs of each layer of the policy network.
    pub(crate) fn policy_layers(&self) -> Vec<(usize, usize)> {
        self.layers(self.action.outputs())
    }

    /// Inputs and outputs of each layer of the value network.
    pub(crate) fn value_layers(&self) -> Vec<(usize, usize)> {
        self.layers(1)
    }

    fn layers(&self, outputs: usize) -> Vec<(usize, usize)> {
        let inputs = std::iter::once(self.observation_size).chain(self.hidden.iter().copied());
        let ends = self.hidden.iter().copied().chain(std::iter::once(outputs));
        inputs.zip(ends).collect()
    }

    /// Names and shapes of the weights, in order: "policy.0.weight" [out, in], "policy.0.bias" [out], …,
    /// "value.0.weight", …, and "log_std" [A] for continuous actions.
    pub fn layout(&self) -> Vec<(String, Vec<usize>)> {
        let mut layout = Vec::new();
        for (network, layers) in [("policy", self.policy_layers()), ("value", self.value_layers())] {
            for (i, (inputs, outputs)) in layers.into_iter().enumerate() {
                layout.push((format!("{network}.{i}.weight"), vec![outputs, inputs]));
                layout.push((format!("{network}.{i}.bias"), vec![outputs]));
            }
        }
        if let ActionKind::Continuous { size } = self.action {
            layout.push(("log_std".to_owned(), vec![size]));
        }
        layout
    }

    /// Whether `weights` have this specification's names and shapes, in order.
    pub fn check(&self, weights: &Weights) -> Result<()> {
        check_arrays(weights, &self.layout())
    }
}

/// An array with a name, in row-major order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NamedArray {
    /// Unique within its list.
    pub name: String,
    /// Length of each axis.
    pub shape: Vec<usize>,
    /// The elements, as many as the product of `shape`.
    pub data: Vec<f32>,
}

/// The weights of a policy, in the order of [`PolicySpec::layout`].
pub type Weights = Vec<NamedArray>;

/// Whether `arrays` have these names, shapes and lengths, in order.
pub(crate) fn check_arrays(arrays: &[NamedArray], layout: &[(String, Vec<usize>)]) -> Result<()> {
    let say = |name: &str, shape: &[usize], length: usize| format!("\"{name}\" {shape:?} of {length} elements");
    for position in 0..arrays.len().max(layout.len()) {
        let got = arrays.get(position).map(|array| say(&array.name, &array.shape, array.data.len()));
        let expected = layout.get(position).map(|(name, shape)| say(name, shape, shape.iter().product()));
        if got != expected {
            let got = got.unwrap_or_else(|| "missing".to_owned());
            let expected = expected.unwrap_or_else(|| "nothing".to_owned());
            return Err(Error::Arrays { position, got, expected });
        }
    }
    Ok(())
}
