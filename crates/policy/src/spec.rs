//! The shape of a policy, and the names of its weights.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::weights::{Weights, check_arrays};

/// The kind of actions that a policy takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionKind {
    /// A choice, 0 … n-1: a categorical distribution over `n` logits.
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

    /// Number of log standard deviations: A, or 0 for discrete actions.
    pub fn log_stds(self) -> usize {
        match self {
            ActionKind::Discrete { .. } => 0,
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
    /// O, the length of an input: an observation, with RL² also the previous step, see [`Inputs`](crate::Inputs).
    pub observation_size: usize,
    /// The actions.
    pub action: ActionKind,
    /// Widths of the hidden layers. Feed-forward: of the policy network and of the value network; the paper uses `[64, 64]`.
    /// Recurrent: of the one network below the LSTM; the paper uses `[256, 256]`.
    pub hidden: Vec<usize>,
    /// H: width of the LSTM of a recurrent policy, for which the paper uses 256; None for a feed-forward one.
    #[serde(default)]
    pub lstm: Option<usize>,
}

impl PolicySpec {
    /// The paper's feed-forward policy for inputs of `input_size` numbers.
    pub fn feed_forward(input_size: usize, action: ActionKind) -> Self {
        Self { observation_size: input_size, action, hidden: vec![64, 64], lstm: None }
    }

    /// The paper's recurrent policy for inputs of `input_size` numbers.
    pub fn recurrent(input_size: usize, action: ActionKind) -> Self {
        Self { observation_size: input_size, action, hidden: vec![256, 256], lstm: Some(256) }
    }

    /// Refuses empty spaces and layers.
    pub fn validate(&self) -> Result<()> {
        let positive = |name, got: usize| if got > 0 { Ok(()) } else { Err(Error::Empty { name }) };
        positive("observation_size", self.observation_size)?;
        positive("the number of action outputs", self.action.outputs())?;
        self.hidden.iter().try_for_each(|&width| positive("the width of a hidden layer", width))?;
        self.lstm.map_or(Ok(()), |width| positive("the width of the LSTM", width))
    }

    /// S = 2H, the length of a recurrent policy's memory of an environment: the LSTM's output h, then its cell state c. 0 for a
    /// feed-forward policy. The memory before the first step of an episode is all 0.
    pub fn memory_size(&self) -> usize {
        self.lstm.map_or(0, |width| 2 * width)
    }

    /// Inputs and outputs of each hidden layer.
    pub fn hidden_layers(&self) -> Vec<(usize, usize)> {
        let inputs = std::iter::once(self.observation_size).chain(self.hidden.iter().copied());
        inputs.zip(self.hidden.iter().copied()).collect()
    }

    /// Numbers that leave the last hidden layer.
    pub fn hidden_size(&self) -> usize {
        self.hidden.last().copied().unwrap_or(self.observation_size)
    }

    /// Names and shapes of the weights, in order.
    ///
    /// Feed-forward: "policy.0.weight" [out, in], "policy.0.bias" `[out]`, …, "value.0.weight", …. Recurrent:
    /// "hidden.0.weight" [out, in], "hidden.0.bias" `[out]`, …, "lstm.input.weight" [4H, in], "lstm.recurrent.weight"
    /// `[4H, H]`, "lstm.bias" `[4H]`, "policy.weight" [out, H], "policy.bias", "value.weight" `[1, H]`, "value.bias"; the rows
    /// of the LSTM are those of its gates i, f, g, o. Both: "log_std" `[A]` for continuous actions.
    pub fn layout(&self) -> Vec<(String, Vec<usize>)> {
        let mut layout = Vec::new();
        let linear = |name: &str, inputs: usize, outputs: usize| {
            [(format!("{name}.weight"), vec![outputs, inputs]), (format!("{name}.bias"), vec![outputs])]
        };
        let heads = [("policy", self.action.outputs()), ("value", 1)];
        if let Some(width) = self.lstm {
            for (i, (inputs, outputs)) in self.hidden_layers().into_iter().enumerate() {
                layout.extend(linear(&format!("hidden.{i}"), inputs, outputs));
            }
            layout.push(("lstm.input.weight".to_owned(), vec![4 * width, self.hidden_size()]));
            layout.push(("lstm.recurrent.weight".to_owned(), vec![4 * width, width]));
            layout.push(("lstm.bias".to_owned(), vec![4 * width]));
            for (name, outputs) in heads {
                layout.extend(linear(name, width, outputs));
            }
        } else {
            for (name, outputs) in heads {
                let layers = self.hidden_layers().into_iter().chain([(self.hidden_size(), outputs)]);
                for (i, (inputs, outputs)) in layers.enumerate() {
                    layout.extend(linear(&format!("{name}.{i}"), inputs, outputs));
                }
            }
        }
        if let ActionKind::Continuous { size } = self.action {
            layout.push(("log_std".to_owned(), vec![size]));
        }
        layout
    }

    /// P: the number of weights.
    pub fn n_weights(&self) -> usize {
        let linear = |(inputs, outputs): (usize, usize)| outputs * (inputs + 1);
        let hidden: usize = self.hidden_layers().into_iter().map(linear).sum();
        let heads = |inputs| linear((inputs, self.action.outputs())) + linear((inputs, 1));
        self.action.log_stds()
            + match self.lstm {
                None => 2 * hidden + heads(self.hidden_size()),
                Some(width) => hidden + 4 * width * (self.hidden_size() + width + 1) + heads(width),
            }
    }

    /// Whether `weights` have this specification's names and shapes, in order.
    pub fn check(&self, weights: &Weights) -> Result<()> {
        check_arrays(weights, &self.layout())
    }
}
