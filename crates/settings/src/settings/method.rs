//! A method: an algorithm with its architecture.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Observe, Preset, Settings};

/// A method, which is a row of the tables of Packer et al. (2018): an algorithm with its architecture and, for RL²,
/// the number of episodes in a trial.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Method {
    /// The name of the algorithm, e.g. "ppo".
    pub algorithm: String,
    /// The architecture: "ff" (feed-forward) or "rc" (recurrent).
    pub architecture: String,
    /// The number of episodes in a trial; `None` if the algorithm has no trials.
    pub episodes_per_trial: Option<u32>,
    /// The preset, which chooses the default settings.
    #[serde(default, skip_serializing_if = "Preset::is_default")]
    pub preset: Preset,
    /// The quantities that the policies observe.
    #[serde(default, skip_serializing_if = "Observe::is_default")]
    pub observe: Observe,
    /// Whether the method is an external agent, which was not trained by an experiment. Then `algorithm` is the agent's
    /// name, and the other fields have no information.
    #[serde(alias = "elsewhere", default, skip_serializing_if = "std::ops::Not::not")]
    pub external: bool,
}

impl Method {
    /// Returns whether the method learns, unlike the random policy and the heuristic policies.
    pub fn learns(&self) -> bool {
        let known = Settings::all().into_iter().find(|settings| settings.name() == self.algorithm);
        self.external || known.is_none_or(|settings| settings.learns())
    }

    /// Returns whether the method only serves as a reference: it learns nothing, or its policies observe parameters
    /// that the policies of other methods have to infer.
    pub fn is_reference(&self) -> bool {
        !self.learns() || self.observe.sees_parameters()
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.learns() {
            write!(f, "{} policy (reference)", self.algorithm)?;
        } else if self.external {
            f.write_str(&self.algorithm)?;
        } else {
            write!(f, "{} {}", self.algorithm, self.architecture)?;
        }
        self.episodes_per_trial.map_or(Ok(()), |episodes| write!(f, " N={episodes}"))?;
        let preset = (!self.preset.is_default()).then(|| self.preset.to_string());
        let sees = self.observe.note().map(str::to_owned);
        let elsewhere = self.external.then(|| "trained elsewhere".to_owned());
        let notes = preset.into_iter().chain(elsewhere).chain(sees).collect::<Vec<_>>().join(", ");
        if notes.is_empty() { Ok(()) } else { write!(f, " ({notes})") }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_says_in_what_a_method_differs_from_others() {
        let rl2 = Method {
            algorithm: "rl2-ppo".into(),
            architecture: "rc".into(),
            episodes_per_trial: Some(2),
            preset: Preset::Perturb,
            observe: Observe::State,
            external: false,
        };
        assert_eq!(rl2.to_string(), "rl2-ppo rc N=2");
        let seeing = |preset| Method { preset, observe: Observe::Parameters, ..rl2.clone() }.to_string();
        assert_eq!(seeing(Preset::Perturb), "rl2-ppo rc N=2 (sees parameters)");
        assert_eq!(seeing(Preset::Paper), "rl2-ppo rc N=2 (paper, sees parameters)");
        assert_eq!(Method { preset: Preset::Paper, ..rl2 }.to_string(), "rl2-ppo rc N=2 (paper)");
    }
}
