//! Recorded test episodes: the requested parameters of each, the applied parameters, and the outcome.
//!
//! One Parquet file holds the tests of one policy. Every figure of a result follows from it, at any threshold of success,
//! and each episode can be played again from its address: seed, environment index and episode index.

mod checksum;
mod columns;
mod parquet;
mod replay;

pub use parquet::{FILE, RecordsError};

use perturb_protocol::{EndedEpisode, proto};
use perturb_settings::sets::TestSet;
use perturb_settings::{ValueError, require};
use serde::{Deserialize, Serialize};

use crate::axis::Axis;
use crate::results::TestResult;
use crate::statistics::{mean, wilson};
use crate::success::{Criterion, Rule};

/// Requested and applied values may differ by this share of the requested one: physics rounds what it derives.
pub const ROUNDING: f64 = 1e-9;

/// The recorded tests of a policy.
#[derive(Clone, Debug, PartialEq)]
pub struct Records {
    /// Metadata of all episodes.
    pub about: RecordsMetadata,
    /// The episodes, in the order of the tests. Those of a test are in the order of their environment and episode indices.
    pub episodes: Vec<EpisodeRecord>,
}

/// Metadata of a policy's recorded episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordsMetadata {
    /// The environment's name.
    pub environment: String,
    /// The environment's revision.
    pub revision: u32,
    /// The environment's parameters, in the order of the requested values.
    pub parameters: Vec<RecordedParameter>,
    /// The names of the quantities that were read back, in the order of the applied values.
    pub applied: Vec<String>,
    /// The id of the policy's checkpoint.
    pub policy: String,
    /// Episodes in a trial. Only the last one is recorded. 1 without trials.
    pub episodes_per_trial: u32,
    /// The success criterion; `None` if the server judged without naming one.
    pub success: Option<Criterion>,
    /// The criterion of the paper's text; `None` in records of older programs, which knew no other criterion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text_success: Option<Criterion>,
    /// The criterion of the paper's published code; `None` if the server did not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub code_success: Option<Criterion>,
    /// The quantity of [`EpisodeRecord::also_achieved`], if the two rules compare different quantities.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub also: Option<String>,
    /// The tests, in order.
    pub tests: Vec<RecordedTest>,
}

/// A parameter of recorded episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordedParameter {
    /// The parameter's name.
    pub name: String,
    /// The unit; "1" if dimensionless.
    pub unit: String,
    /// The quantity that reads it back; empty if its server did not say.
    pub applied: String,
}

/// A test.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordedTest {
    /// The test set.
    pub set: TestSet,
    /// The seed of the environments and of the actions.
    pub seed: u64,
    /// The axes x and y of a heatmap's test. `None` in other tests and in records of older programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axes: Option<[Axis; 2]>,
}

/// The end of an episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// The task ended it.
    Terminated,
    /// The step limit ended it.
    Truncated,
    /// The physics came to numbers that are not finite.
    Diverged,
}

/// An episode of a test.
#[derive(Clone, Debug, PartialEq)]
pub struct EpisodeRecord {
    /// The name of the set that it was a test on.
    pub set: String,
    /// The seed of the environments. With the two indices that follow it is the episode's address.
    pub seed: u64,
    /// The environment's index among those that were tested together, from 0.
    pub environment_index: u32,
    /// Counts the environment's episodes from 0.
    pub episode_index: u64,
    /// The parameters that were drawn or given, in the order of [`RecordsMetadata::parameters`].
    pub requested: Vec<f64>,
    /// Applied parameters, in the order of [`RecordsMetadata::applied`].
    pub applied: Vec<f64>,
    /// SHA-256 of the model; empty without one.
    pub model_hash: String,
    /// The undiscounted sum of its rewards.
    pub episode_return: f64,
    /// The number of steps.
    pub length: u32,
    /// Whether it was a success.
    pub success: bool,
    /// The way in which the episode ended.
    pub ending: Ending,
    /// The value of the criterion's quantity; `None` if it was not reached.
    pub achieved: Option<f64>,
    /// The value of [`RecordsMetadata::also`]; `None` if it was not reached or there is no such quantity.
    pub also_achieved: Option<f64>,
}

/// Check that requested and applied parameters agree.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterCheck {
    /// Episodes in which all parameters were compared.
    pub episodes: u64,
    /// The largest difference; `None` if nothing was compared.
    pub largest: Option<Difference>,
}

/// A parameter that was asked for, and what the physics had instead.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Difference {
    /// The parameter's name in the catalogue.
    pub parameter: String,
    /// The requested value.
    pub requested: f64,
    /// The applied value.
    pub applied: f64,
    /// The difference divided by the requested value; the difference itself if the requested value is 0.
    pub relative: f64,
}

impl RecordsMetadata {
    /// Returns the metadata of a policy in `environment`, without tests so far.
    pub fn new(environment: &proto::Environment, policy: String, episodes_per_trial: u32) -> Self {
        let parameter = |parameter: &proto::Parameter| RecordedParameter {
            name: parameter.name.clone(),
            unit: parameter.unit.clone(),
            applied: parameter.applied.clone(),
        };
        let (text, code) = (Criterion::from_environment(environment), Criterion::from_environment_code(environment));
        let quantities = text.as_ref().zip(code.as_ref()).map(|(text, code)| (&text.quantity, &code.quantity));
        let also = quantities.filter(|(text, code)| text != code).map(|(_, code)| code.clone());
        Self {
            environment: environment.name.clone(),
            revision: environment.revision,
            parameters: environment.parameters.iter().map(parameter).collect(),
            applied: environment.applied.iter().map(|quantity| quantity.name.clone()).collect(),
            policy,
            episodes_per_trial,
            success: text.clone(),
            text_success: code.as_ref().and(text),
            code_success: code,
            also,
            tests: Vec::new(),
        }
    }

    /// The criterion by `rule`.
    ///
    /// # Errors
    /// [`ValueError`] for a rule by which these episodes cannot be judged.
    pub fn criterion(&self, rule: &Rule) -> Result<Criterion, ValueError> {
        rule.criterion(self.text_success.as_ref().or(self.success.as_ref()), self.code_success.as_ref())
    }

    /// Makes `rule` the success criterion of episodes that are recorded from now on.
    ///
    /// # Errors
    /// Those of [`RecordsMetadata::criterion`].
    pub fn judge_by(&mut self, rule: &Rule) -> Result<(), ValueError> {
        let criterion = self.criterion(rule)?;
        if self.also.as_ref() == Some(&criterion.quantity) {
            self.also = self.success.take().map(|before| before.quantity);
        }
        self.success = Some(criterion);
        Ok(())
    }

    /// Returns the values of the criterion's quantity and of the environment's other quantity, if it has two.
    fn achieved(&self, end: &EndedEpisode) -> (Option<f64>, Option<f64>) {
        let text = (end.achieved, self.also.is_some().then_some(end.code_achieved).flatten());
        if self.is_judged_by_code() { (text.1, text.0) } else { text }
    }

    /// Whether [`EpisodeRecord::achieved`] is the quantity of the code's rule, which differs from that of the text's rule.
    pub fn is_judged_by_code(&self) -> bool {
        let quantity = |criterion: &Option<Criterion>| criterion.as_ref().map(|it| it.quantity.clone());
        self.also.is_some() && quantity(&self.success) == quantity(&self.code_success)
    }
}

impl EpisodeRecord {
    /// Returns the record of an episode on `set`, whose environments have `seed`.
    pub fn new(about: &RecordsMetadata, set: &str, seed: u64, end: EndedEpisode) -> Self {
        let (achieved, also_achieved) = about.achieved(&end);
        Self {
            set: set.to_owned(),
            seed,
            environment_index: end.environment_index,
            episode_index: end.episode_index,
            ending: match (end.diverged, end.terminated) {
                (true, _) => Ending::Diverged,
                (false, true) => Ending::Terminated,
                (false, false) => Ending::Truncated,
            },
            requested: end.receipt.requested,
            applied: end.receipt.applied,
            model_hash: end.receipt.model_hash,
            episode_return: end.episode_return,
            length: end.length,
            success: about.success.as_ref().map_or(end.success, |criterion| criterion.holds(achieved)),
            achieved,
            also_achieved,
        }
    }
}

impl Records {
    /// Records of a policy without tests so far.
    pub fn new(about: RecordsMetadata) -> Self {
        Self { about, episodes: Vec::new() }
    }

    /// Adds a test.
    pub fn add(&mut self, test: RecordedTest, episodes: Vec<EpisodeRecord>) {
        self.about.tests.push(test);
        self.episodes.extend(episodes);
    }

    /// Adds other tests of the same policy.
    pub fn append(&mut self, other: Self) {
        self.about.tests.extend(other.about.tests);
        self.episodes.extend(other.episodes);
    }

    /// The episodes of the test on the set called `name`.
    pub fn episodes_on<'a>(&'a self, name: &'a str) -> impl Iterator<Item = &'a EpisodeRecord> + Clone {
        self.episodes.iter().filter(move |episode| episode.set == name)
    }

    /// The figures of the test on the set called `name`. With `criterion`, which must compare a recorded quantity,
    /// successes are judged anew.
    pub fn result(&self, name: &str, criterion: Option<&Criterion>) -> TestResult {
        let success =
            |episode: &EpisodeRecord| criterion.map_or(episode.success, |c| c.holds(self.achieved(episode, c)));
        let episodes: Vec<&EpisodeRecord> = self.episodes_on(name).collect();
        let n = episodes.len() as u64;
        let successes = episodes.iter().filter(|episode| success(episode)).count() as u64;
        let (low, high) = wilson(successes, n);
        TestResult {
            episodes: n,
            success_percent: 100.0 * successes as f64 / n as f64,
            success_percent_95: [100.0 * low, 100.0 * high],
            mean_return: mean(episodes.iter().map(|episode| episode.episode_return)),
            mean_length: mean(episodes.iter().map(|episode| f64::from(episode.length))),
        }
    }

    /// Judges the episodes by `rule` instead of the recorded rule.
    ///
    /// # Errors
    /// Those of [`RecordsMetadata::criterion`].
    pub fn judged_by(mut self, rule: &Rule) -> Result<Self, ValueError> {
        let criterion = self.about.criterion(rule)?;
        let swaps = self.about.also.as_ref() == Some(&criterion.quantity);
        for episode in &mut self.episodes {
            if swaps {
                std::mem::swap(&mut episode.achieved, &mut episode.also_achieved);
            }
            episode.success = criterion.holds(episode.achieved);
        }
        self.about.judge_by(rule)?;
        Ok(self)
    }

    /// Judges the episodes by a criterion whose quantity was not recorded. `values` `[episodes]` holds the quantity, NaN
    /// where it was not reached, and replaces the recorded ones.
    ///
    /// # Errors
    /// [`ValueError`] for another number of values than of episodes.
    pub fn judged_by_values(mut self, criterion: Criterion, values: &[f64]) -> Result<Self, ValueError> {
        let expected = format!("{}, one for each episode", self.episodes.len());
        require(
            values.len() == self.episodes.len(),
            "the number of values of the rule of success",
            values.len(),
            expected,
        )?;
        for (episode, &value) in self.episodes.iter_mut().zip(values) {
            episode.achieved = Some(value).filter(|value| !value.is_nan());
            episode.also_achieved = None;
            episode.success = criterion.holds(episode.achieved);
        }
        let about = &mut self.about;
        (about.success, about.text_success, about.code_success, about.also) = (Some(criterion), None, None, None);
        Ok(self)
    }

    /// Returns the value of the quantity that `criterion` compares.
    pub fn achieved(&self, episode: &EpisodeRecord, criterion: &Criterion) -> Option<f64> {
        if self.about.also.as_ref() == Some(&criterion.quantity) { episode.also_achieved } else { episode.achieved }
    }

    /// Compares the requested with the applied parameters of every episode.
    pub fn agreement(&self) -> ParameterCheck {
        let comparison = ParameterComparison::with(&self.about);
        let of = |episode: &EpisodeRecord| comparison.largest(&episode.requested, &episode.applied);
        let largest = self.episodes.iter().filter_map(of).max_by(|a, b| a.relative.total_cmp(&b.relative));
        let episodes = if comparison.is_complete() { self.episodes.len() as u64 } else { 0 };
        ParameterCheck { episodes, largest }
    }
}

/// Compares requested with applied parameters.
#[derive(Clone, Debug)]
pub struct ParameterComparison {
    /// The parameters' names, and where the quantity that reads each back is among the applied values; `None` if the
    /// server does not say.
    parameters: Vec<(String, Option<usize>)>,
}

impl ParameterComparison {
    fn with(about: &RecordsMetadata) -> Self {
        let place = |parameter: &RecordedParameter| about.applied.iter().position(|name| *name == parameter.applied);
        let parameters = about.parameters.iter().map(|parameter| (parameter.name.clone(), place(parameter)));
        Self { parameters: parameters.collect() }
    }

    /// A comparison for the receipts of `environment`.
    pub fn new(environment: &proto::Environment) -> Self {
        Self::with(&RecordsMetadata::new(environment, String::new(), 1))
    }

    /// The largest difference in a receipt, if it is more than rounding.
    pub fn difference_beyond_rounding(&self, requested: &[f64], applied: &[f64]) -> Option<Difference> {
        self.largest(requested, applied).filter(Difference::exceeds_tolerance)
    }

    /// Whether every parameter is read back.
    fn is_complete(&self) -> bool {
        self.parameters.iter().all(|(_, place)| place.is_some())
    }

    /// The largest difference in a receipt; `None` if nothing is read back. A value that is missing differs.
    fn largest(&self, requested: &[f64], applied: &[f64]) -> Option<Difference> {
        let value = |values: &[f64], place: usize| values.get(place).copied().unwrap_or(f64::NAN);
        let compared = self.parameters.iter().enumerate().filter_map(|(index, (name, place))| {
            let (requested, applied) = (value(requested, index), value(applied, (*place)?));
            Some((name, requested, applied, relative(requested, applied)))
        });
        let largest = compared.max_by(|a, b| a.3.total_cmp(&b.3));
        largest.map(|(name, requested, applied, relative)| Difference {
            parameter: name.clone(),
            requested,
            applied,
            relative,
        })
    }
}

/// The difference divided by the requested value; the difference itself if the requested value is 0.
fn relative(requested: f64, applied: f64) -> f64 {
    let difference = (applied - requested).abs();
    // Positive, so that NaN counts as the largest of all.
    let relative = if requested == 0.0 { difference } else { difference / requested.abs() };
    if relative.is_nan() { f64::NAN } else { relative }
}

impl Difference {
    /// Whether the difference is more than rounding. NaN counts as more.
    pub fn exceeds_tolerance(&self) -> bool {
        self.relative.is_nan() || self.relative > ROUNDING
    }
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { parameter, requested, applied, .. } = self;
        write!(f, "the parameter {parameter} was requested as {requested}, but the physics ran with {applied}")
    }
}

#[cfg(test)]
mod tests;
