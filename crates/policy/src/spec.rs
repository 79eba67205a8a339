//! The shape of a policy, and the names of its weights.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::weights::{Weights, check_arrays};

/// The kind of actions that a policy takes, and their probability distribution.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionKind {
    /// A choice from 0 … n-1, with a categorical distribution.
    Discrete {
        /// The number n of choices, which is also the number of logits.
        n: usize,
    },
    /// A vector of numbers, with a diagonal Gaussian distribution. Its log standard deviations do not depend on the
    /// state.
    Continuous {
        /// The length A of the vector.
        size: usize,
    },
}

impl ActionKind {
    /// Returns A, the number of f32 that represent one action; 1 for discrete actions.
    pub fn width(self) -> usize {
        match self {
            ActionKind::Discrete { .. } => 1,
            ActionKind::Continuous { size } => size,
        }
    }

    /// Returns the number of log standard deviations: A for continuous actions, 0 for discrete ones.
    pub fn log_stds(self) -> usize {
        match self {
            ActionKind::Discrete { .. } => 0,
            ActionKind::Continuous { size } => size,
        }
    }

    /// Returns the number of outputs of the policy network: n logits for discrete actions, A means for continuous ones.
    pub fn outputs(self) -> usize {
        match self {
            ActionKind::Discrete { n } => n,
            ActionKind::Continuous { size } => size,
        }
    }
}

/// The shape of a policy's networks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicySpec {
    /// O, the length of an input. An input is an observation, and with RL² also the previous step, see
    /// [`Inputs`](crate::Inputs).
    pub observation_size: usize,
    /// The kind of actions.
    pub action: ActionKind,
    /// Numbers of units in the hidden layers. A feed-forward policy has these layers in its policy network and again in
    /// its value network; Packer et al. (2018) use `[64, 64]`. A recurrent policy has them once, before its LSTM;
    /// Packer et al. use `[256, 256]`.
    pub hidden: Vec<usize>,
    /// H, the number of units in the LSTM of a recurrent policy; Packer et al. (2018) use 256. `None` for a
    /// feed-forward policy.
    #[serde(default)]
    pub lstm: Option<usize>,
}

impl PolicySpec {
    /// Returns the shape of the feed-forward policy of Packer et al. (2018), for inputs of `input_size` numbers.
    pub fn feed_forward(input_size: usize, action: ActionKind) -> Self {
        Self { observation_size: input_size, action, hidden: vec![64, 64], lstm: None }
    }

    /// Returns the shape of the recurrent policy of Packer et al. (2018), for inputs of `input_size` numbers.
    pub fn recurrent(input_size: usize, action: ActionKind) -> Self {
        Self { observation_size: input_size, action, hidden: vec![256, 256], lstm: Some(256) }
    }

    /// Checks that no size is 0.
    ///
    /// # Errors
    /// [`Error::Empty`] with the name of the first size that is 0.
    pub fn validate(&self) -> Result<()> {
        let positive = |name, got: usize| if got > 0 { Ok(()) } else { Err(Error::Empty { name }) };
        positive("observation_size", self.observation_size)?;
        positive("the number of action outputs", self.action.outputs())?;
        self.hidden.iter().try_for_each(|&width| positive("the width of a hidden layer", width))?;
        self.lstm.map_or(Ok(()), |width| positive("the width of the LSTM", width))
    }

    /// Returns S = 2H, the length of a recurrent policy's memory of one environment; 0 for a feed-forward policy. The
    /// memory consists of the LSTM's output h, followed by its cell state c. It is all 0 before the first step of an
    /// episode.
    pub fn memory_size(&self) -> usize {
        self.lstm.map_or(0, |width| 2 * width)
    }

    /// Returns the numbers of inputs and outputs of each hidden layer.
    pub fn hidden_layers(&self) -> Vec<(usize, usize)> {
        let inputs = std::iter::once(self.observation_size).chain(self.hidden.iter().copied());
        inputs.zip(self.hidden.iter().copied()).collect()
    }

    /// Returns the number of outputs of the last hidden layer, or O if there is none.
    pub fn hidden_size(&self) -> usize {
        self.hidden.last().copied().unwrap_or(self.observation_size)
    }

    /// Returns the names and shapes of all weights, in order.
    ///
    /// Feed-forward: "policy.0.weight" `[out, in]`, "policy.0.bias" `[out]`, …, "value.0.weight", ….
    ///
    /// Recurrent: "hidden.0.weight" `[out, in]`, "hidden.0.bias" `[out]`, …, "lstm.input.weight" `[4H, in]`,
    /// "lstm.recurrent.weight" `[4H, H]`, "lstm.bias" `[4H]`, "policy.weight" `[out, H]`, "policy.bias", "value.weight"
    /// `[1, H]`, "value.bias". The rows of the LSTM's arrays belong to its gates i, f, g and o, in this order.
    ///
    /// Both end with "log_std" `[A]` if actions are continuous.
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

    /// Returns P, the number of all weights.
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

    /// Checks that `weights` have the names and shapes of [`PolicySpec::layout`], in order.
    ///
    /// # Errors
    /// [`Error::Arrays`] at the first difference.
    pub fn check(&self, weights: &Weights) -> Result<()> {
        check_arrays(weights, &self.layout())
    }
}
