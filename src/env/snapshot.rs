//! Snapshots: the complete state of an environment as bytes, which can be restored in any session, process or server.

use super::{
    Distribution, Draw, EnvironmentSpec, EpisodeSettings, Episodes, Error, Interval, check_bounds, check_distribution,
    environment::{MAX_DISTRIBUTIONS_BYTES, distributions_bytes},
    episode::{EpisodeProgress, boxes},
    shorten,
};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The version of the snapshot format. Every change of [`Saved`], or of the bytes that follow, raises the version.
const FORMAT: u32 = 3;
/// The last format without a checksum. Later formats end with a checksum: the little-endian CRC-32C of all preceding
/// bytes.
const UNSEALED: u32 = 2;
/// The first format, which has only [`Saved`]. Later formats append [`EpisodeProgress::held_longest`].
const FIRST: u32 = 1;

/// Maximal size of a snapshot, in bytes. The largest possible snapshot consists of:
///
/// - the distributions: 216 KiB, see [`MAX_DISTRIBUTIONS_BYTES`];
/// - a state, and an observation of 4096 entries: some 50 KiB;
/// - delayed actions and observations: 80 KiB.
pub const MAX_SNAPSHOT_BYTES: usize = 384 << 10;

/// An upper bound of how much a snapshot grows, in bytes, when its counters and the number of its distributions grow.
/// Large numbers have longer encodings than small ones.
const MAX_COUNTERS_GROWTH_BYTES: usize = 64;

/// Maximal episode number in a snapshot. With this limit, the numbers of later episodes do not overflow a u64.
const MAX_EPISODE: u64 = 1 << 63;

/// The content of a snapshot: everything that determines the future of an environment, except the actions. Random
/// streams have no state of their own, because they follow from the seed, the environment's index and the counters.
#[derive(Serialize, Deserialize)]
struct Saved {
    format: u32,
    environment: String,
    revision: u32,
    model_hash: String,
    seed: u64,
    environment_index: u32,
    episodes_per_trial: u32,
    /// For each distribution in [`EpisodeSettings::distributions`], the ends (low, high) of its intervals.
    distributions: Vec<Vec<(f64, f64)>>,
    values: Vec<f64>,
    progress: EpisodeProgress,
    state: Vec<f64>,
}

impl Episodes {
    /// Returns a snapshot of the environment: its physics, parameters, counters and settings, including the seed.
    pub fn snapshot(&self) -> Vec<u8> {
        let spec = self.spec();
        let mut state = Vec::new();
        self.environment.save(&mut state);
        let pairs = |d: &Distribution| d.intervals().iter().map(|i| (i.low, i.high)).collect();
        let saved = Saved {
            format: FORMAT,
            environment: spec.name.into(),
            revision: spec.revision,
            model_hash: self.environment.model_hash().into(),
            seed: self.settings.seed,
            environment_index: self.settings.environment_index,
            episodes_per_trial: self.settings.episodes_per_trial,
            distributions: self.settings.distributions.iter().map(pairs).collect(),
            values: self.values.clone(),
            progress: self.progress,
            state,
        };
        let mut snapshot = postcard::to_stdvec(&(saved, self.progress.held_longest))
            .expect("plain numbers and strings always encode into a growing buffer");
        snapshot.extend(crc32c::crc32c(&snapshot).to_le_bytes());
        snapshot
    }

    /// Returns an upper bound of the size of later snapshots of this environment, without their distributions, in
    /// bytes.
    pub(crate) fn max_snapshot_bytes(&self) -> usize {
        let growth = size_of::<f64>() * self.environment.max_saved_growth() + MAX_COUNTERS_GROWTH_BYTES;
        self.snapshot().len() - distributions_bytes(&*self.settings.distributions) + growth
    }

    /// Restores a snapshot. For the same actions, the environment then gives the same bytes as it gave after the
    /// snapshot was taken.
    ///
    /// # Errors
    /// [`Error::Snapshot`] if the snapshot is damaged, or is of another environment, revision or model. After an error,
    /// the environment is unchanged.
    pub fn restore(&mut self, snapshot: &[u8]) -> Result<(), Error> {
        let (saved, distributions) = self.check(snapshot)?;
        let (before, address) = (self.physics_state(), self.draw());
        let Saved { seed, environment_index, progress, .. } = saved;
        self.environment.set_parameters(&saved.values);
        self.environment
            .set_address(Draw { seed, environment_index, episode_index: progress.episode }, progress.length);
        if let Err(error) = self.environment.load(&saved.state) {
            self.environment.set_parameters(&self.values);
            self.environment.set_address(address, self.progress.length);
            self.environment.load(&before)?;
            return Err(error);
        }
        self.values = saved.values;
        self.update_observed_parameters();
        self.progress = saved.progress;
        self.settings = EpisodeSettings {
            seed: saved.seed,
            environment_index: saved.environment_index,
            // Environments of one session mostly share their distributions, also if their snapshots are restored.
            distributions: if *self.settings.distributions == *distributions {
                Arc::clone(&self.settings.distributions)
            } else {
                distributions.into()
            },
            episodes_per_trial: saved.episodes_per_trial,
        };
        Ok(())
    }

    /// Returns the state of the physics, as [`Environment::save`](super::Environment::save) appends it.
    pub fn physics_state(&self) -> Vec<f64> {
        let mut state = Vec::new();
        self.environment.save(&mut state);
        state
    }

    /// Decodes a snapshot and checks everything except the state of the physics.
    fn check(&self, snapshot: &[u8]) -> Result<(Saved, Vec<Distribution>), Error> {
        let (saved, distributions) = Saved::read(self.spec(), snapshot)?;
        if saved.model_hash != self.environment.model_hash() {
            return Err(Error::Snapshot { reason: "it was taken with another model".into() });
        }
        let found = boxes(distributions.len(), saved.values.len()).unwrap_or_default();
        if found > self.max_boxes {
            let reason = format!(
                "its parameters are drawn from a list of {found}, this session accepts at most {}; open the session with \
                 the same contexts",
                self.max_boxes
            );
            return Err(Error::Snapshot { reason });
        }
        Ok((saved, distributions))
    }
}

/// The seed, parameter distributions and current parameters of the environment in a snapshot. The server's ledger uses
/// them to record the regions of the parameter space from which the environment draws.
#[derive(Debug, Clone, PartialEq)]
pub struct SavedDraw {
    /// The seed, environment index and episode index of the environment's current episode.
    pub draw: Draw,
    /// The distributions of the environment's parameters, as in [`EpisodeSettings::distributions`].
    pub distributions: Vec<Distribution>,
    /// The parameters of the current trial, in the order of [`EnvironmentSpec::parameters`]. A client may have forged
    /// them.
    pub values: Vec<f64>,
}

/// Reads the seed, distributions and parameters in a snapshot without restoring it.
///
/// # Errors
/// [`Error::Snapshot`] if the snapshot is damaged, or is not of the environment `spec`.
pub fn saved_draw(spec: &'static EnvironmentSpec, snapshot: &[u8]) -> Result<SavedDraw, Error> {
    let (Saved { seed, environment_index, values, progress, .. }, distributions) = Saved::read(spec, snapshot)?;
    let draw = Draw { seed, environment_index, episode_index: progress.episode };
    Ok(SavedDraw { draw, distributions, values })
}

impl Saved {
    /// Decodes a snapshot. Checks everything except the model's hash and the state of the physics.
    fn read(spec: &'static EnvironmentSpec, snapshot: &[u8]) -> Result<(Self, Vec<Distribution>), Error> {
        let refuse = |reason: String| Err(Error::Snapshot { reason });
        let unreadable = || refuse(format!("its {} bytes are not a snapshot", snapshot.len()));
        // The limit also bounds the memory for decoding: a list entry that is encoded in one byte takes more than
        // twenty bytes in memory.
        if snapshot.len() > MAX_SNAPSHOT_BYTES {
            return unreadable();
        }
        let Ok((mut saved, rest)) = postcard::take_from_bytes::<Saved>(snapshot) else { return unreadable() };
        let rest = match (saved.format, rest.split_last_chunk()) {
            (FIRST | UNSEALED, _) => rest,
            (FORMAT, Some((rest, sum)))
                if crc32c::crc32c(&snapshot[..snapshot.len() - sum.len()]).to_le_bytes() == *sum =>
            {
                rest
            }
            (FORMAT, _) => return refuse("its checksum does not match: it was damaged after it was taken".into()),
            (format, _) => return refuse(format!("its format is {format}, but this server reads 1 to {FORMAT}")),
        };
        saved.progress.held_longest = match (saved.format, rest) {
            // The first format has only the current number of consecutive steps at the goal, so an earlier maximum is
            // unknown.
            (FIRST, []) => saved.progress.held_for,
            (FIRST, _) => return unreadable(),
            (_, rest) => match postcard::take_from_bytes(rest) {
                Ok((held_longest, [])) => held_longest,
                _ => return unreadable(),
            },
        };
        if (saved.environment.as_str(), saved.revision) != (spec.name, spec.revision) {
            let Saved { environment, revision, .. } = saved;
            let environment = shorten(&environment).escape_debug().to_string();
            return refuse(format!(
                "it is of {environment}-v{revision}, but this session is of {}-v{}",
                spec.name, spec.revision
            ));
        }
        let n = spec.parameters.len();
        if boxes(saved.distributions.len(), n).is_none() || saved.values.len() != n {
            return refuse(format!("it does not have the {n} parameters of {}", spec.name));
        }
        let distributions = Self::distributions(spec, &saved)?;
        let bytes = distributions_bytes(&distributions);
        if bytes > MAX_DISTRIBUTIONS_BYTES {
            return refuse(format!(
                "its distributions have {bytes} bytes, but at most {MAX_DISTRIBUTIONS_BYTES} are possible"
            ));
        }
        let EpisodeProgress { trial, episode, episode_in_trial, length, total_reward, ended, .. } = saved.progress;
        let EpisodeProgress { reached_at, held_for, held_longest, .. } = saved.progress;
        if episode_in_trial >= saved.episodes_per_trial
            || trial > episode
            || episode > MAX_EPISODE
            || reached_at.max(held_longest) > length
            || held_for > held_longest
            || !total_reward.is_finite()
        {
            return refuse("its counters contradict each other".into());
        }
        if length > spec.step_limit || (length == spec.step_limit && !ended) {
            return refuse(format!("its episode is {length} steps long, the limit is {}", spec.step_limit));
        }
        Ok((saved, distributions))
    }

    fn distributions(spec: &'static EnvironmentSpec, saved: &Saved) -> Result<Vec<Distribution>, Error> {
        let bad = |error: Error| Error::Snapshot { reason: error.to_string() };
        let refuse_value = |name, value| {
            Err(Error::Snapshot { reason: format!("its parameter {name:?} is {value}, which is not a whole number") })
        };
        let parameters = spec.parameters.iter().zip(&saved.values).cycle();
        let each = parameters.zip(&saved.distributions);
        each.map(|((parameter, &value), pairs)| {
            let intervals: Vec<Interval> = pairs.iter().map(|&(low, high)| Interval { low, high }).collect();
            let distribution =
                Distribution::union(&intervals).map_err(Error::in_distribution(parameter.name)).map_err(bad)?;
            check_distribution(spec, parameter, &distribution).map_err(bad)?;
            check_bounds(spec, parameter, (value, value)).map_err(bad)?;
            if parameter.is_integer && value.fract() != 0.0 {
                return refuse_value(parameter.name, value);
            }
            Ok(distribution)
        })
        .collect()
    }
}
