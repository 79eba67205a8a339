//! Checks the contents of requests, and converts between messages of the protocol and the types of [`crate::env`] and
//! the pool.

use super::Error;
use crate::{
    env::{
        self, Achievement, ActionSpec, Catalogue, ChannelSpec, Distribution, EnvironmentSpec, EpisodeId,
        EpisodeReceipt, EpisodeSettings, FinishedEpisode, Interval, ParameterSpec, StartedEpisode, SuccessComparison,
        SuccessRuleSpec, Version, disturbance, resolve, shorten,
    },
    pool::{Autoreset, Batch, BatchSettings, ResetEntry, SlotGroupSettings, StepResult},
    proto,
    render::Size,
};
use bytes::Bytes;
use perturb_protocol::limits::{DEFAULT_PICTURE_PIXELS, MAX_DRAWN_CONTEXTS, PICTURE_PIXELS};
use std::{
    collections::{HashMap, HashSet},
    sync::Arc,
};

/// Checks an `open` request, and converts it to the settings of its batch. `max_envs` is the server's maximum number of
/// environments. It also limits the number of groups.
pub fn open(catalogue: &Catalogue, max_envs: usize, request: proto::Open) -> Result<BatchSettings, Error> {
    let spec = with_parameters(catalogue.find(&request.environment)?, &request)?;
    let autoreset = match request.autoreset_mode() {
        proto::AutoresetMode::NextStep => Autoreset::NextStep,
        proto::AutoresetMode::SameStep => Autoreset::SameStep,
        proto::AutoresetMode::Disabled => Autoreset::Disabled,
        proto::AutoresetMode::Unspecified => {
            let expected = "AUTORESET_MODE_NEXT_STEP (1), _SAME_STEP (2) or _DISABLED (3)";
            return Err(Error::value("open.autoreset_mode", request.autoreset_mode, expected));
        }
    };
    let proto::Open { receipts, receipt_arrays, reward_terms, observe_parameters, .. } = request;
    let groups = if request.groups.is_empty() {
        vec![group(spec, "open", "open.batch_size", single(request))?]
    } else {
        check_no_single(&request)?;
        // Each group has at least one environment, so there cannot be more groups than environments. This is checked
        // before the groups are converted.
        if request.groups.len() > max_envs {
            let got = format!("{} groups", request.groups.len());
            return Err(Error::value(
                "open.groups",
                got,
                format!("at most {max_envs}, the number of environments of this server"),
            ));
        }
        let numbered = request.groups.into_iter().enumerate();
        let named = |i, slots| group(spec, &format!("open.groups[{i}]"), &format!("open.groups[{i}].size"), slots);
        numbered.map(|(i, slots)| named(i, slots)).collect::<Result<_, _>>()?
    };
    Ok(BatchSettings { spec, groups, autoreset, receipts, receipt_arrays, reward_terms, observe_parameters })
}

/// Returns the description of the environment that an `open` requests. If the `open` names a disturbance, all
/// disturbances are added to the environment's parameters.
fn with_parameters(spec: &'static EnvironmentSpec, open: &proto::Open) -> Result<&'static EnvironmentSpec, Error> {
    let groups = open.groups.iter().map(|group| (&group.parameters, &group.contexts));
    let all = groups.chain([(&open.parameters, &open.contexts)]);
    let names = all.flat_map(|(parameters, contexts)| {
        parameters.keys().chain(contexts.iter().flat_map(|contexts| &contexts.names)).map(String::as_str)
    });
    let mut names: Vec<&str> = names.collect();
    // The names are sorted, so that the same request always gets the same error.
    names.sort_unstable();
    Ok(disturbance::with_parameters(spec, names)?)
}

/// Converts an `open` without groups to a single group.
fn single(request: proto::Open) -> proto::SlotGroup {
    proto::SlotGroup {
        size: request.batch_size,
        version: request.version,
        parameters: request.parameters,
        seed: request.seed,
        first_environment_index: request.first_environment_index,
        episodes_per_trial: request.episodes_per_trial,
        contexts: request.contexts,
    }
}

/// Checks that an `open` with groups does not also use the fields that groups replace.
fn check_no_single(request: &proto::Open) -> Result<(), Error> {
    let given = [
        ("open.version", request.version != 0),
        ("open.parameters", !request.parameters.is_empty()),
        ("open.batch_size", request.batch_size != 0),
        ("open.seed", request.seed != 0),
        ("open.first_environment_index", request.first_environment_index != 0),
        ("open.episodes_per_trial", request.episodes_per_trial != 0),
        ("open.contexts", request.contexts.is_some()),
    ];
    match given.into_iter().find(|(_, given)| *given) {
        Some((field, _)) => Err(Error::value(field, "given in addition to open.groups", "it only inside each group")),
        None => Ok(()),
    }
}

/// Checks and converts a group. `path` is the group's field path in errors, `size_field` the path of its size.
fn group(
    spec: &'static EnvironmentSpec,
    path: &str,
    size_field: &str,
    group: proto::SlotGroup,
) -> Result<SlotGroupSettings, Error> {
    let version = Version::from_proto(group.version()).ok_or_else(|| {
        let expected = "VERSION_DEFAULT (1), VERSION_RANDOM (2), VERSION_EXTREME (3) or VERSION_RANDOM_OR_EXTREME (4)";
        Error::value(format!("{path}.version"), group.version, expected)
    })?;
    if group.size == 0 {
        return Err(Error::value(size_field.to_owned(), 0, "at least 1"));
    }
    let first = group.first_environment_index;
    if first.checked_add(group.size - 1).is_none() {
        let (field, got) =
            (format!("{path}.first_environment_index"), format!("{first} for a batch of {}", group.size));
        return Err(Error::value(field, got, "the last environment's index below 2^32"));
    }
    let mut distributions = spec.distributions(version);
    if let Some(contexts) = &group.contexts {
        distributions = with_contexts(spec, &format!("{path}.contexts"), &distributions, contexts, &group.parameters)?;
    }
    override_parameters(spec, &mut distributions, &group.parameters)?;
    let episodes = EpisodeSettings {
        seed: group.seed,
        environment_index: first,
        distributions: distributions.into(),
        episodes_per_trial: group.episodes_per_trial.max(1),
    };
    Ok(SlotGroupSettings { size: group.size as usize, episodes })
}

/// Checks contexts, and returns their distributions. `base` has the distributions of the version, and `parameters` those
/// that the group names besides its contexts. `path` is the field path of the contexts in errors.
fn with_contexts<'a>(
    spec: &'static EnvironmentSpec,
    path: &str,
    base: &[Distribution],
    proto::Contexts { names, values }: &'a proto::Contexts,
    parameters: &HashMap<String, proto::Distribution>,
) -> Result<Vec<Distribution>, Error> {
    let mut known = HashSet::new();
    if let Some(twice) = names.iter().find(|name| !known.insert(*name) || parameters.contains_key(*name)) {
        let expected = "each parameter once, either in contexts or in parameters";
        return Err(Error::value(format!("{path}.names"), format!("{:?} twice", shorten(twice)), expected));
    }
    let rows = values.chunks(names.len().max(1));
    if names.is_empty() || !(1..=MAX_DRAWN_CONTEXTS).contains(&rows.len()) || !values.len().is_multiple_of(names.len())
    {
        let got = format!("{} numbers for {} names", values.len(), names.len());
        let expected = format!("a value of each parameter in 1 … {MAX_DRAWN_CONTEXTS} contexts");
        return Err(Error::value(format!("{path}.values"), got, expected));
    }
    let mut distributions = Vec::new();
    for row in rows {
        let fixed = |(name, &value): (&'a String, &f64)| {
            let distribution = Distribution::union(&[Interval::new(value, value)]);
            Ok((name.as_str(), distribution.map_err(env::Error::in_distribution(name))?))
        };
        let mut of_row = base.to_vec();
        resolve(spec, &mut of_row, names.iter().zip(row).map(fixed).collect::<Result<Vec<_>, env::Error>>()?)?;
        distributions.append(&mut of_row);
    }
    Ok(distributions)
}

/// Replaces the distributions in `base` of all parameters that `parameters` names.
fn override_parameters(
    spec: &'static EnvironmentSpec,
    base: &mut [Distribution],
    parameters: &HashMap<String, proto::Distribution>,
) -> Result<(), Error> {
    // The parameters are sorted by name, so that the same request always gets the same error.
    let mut parameters: Vec<_> = parameters.iter().collect();
    parameters.sort_by_key(|(name, _)| *name);
    let mut overrides = Vec::with_capacity(parameters.len());
    for (name, distribution) in parameters {
        overrides
            .push((name.as_str(), Distribution::try_from(distribution).map_err(env::Error::in_distribution(name))?));
    }
    Ok(resolve(spec, base, overrides)?)
}

/// Checks the actions of a step: little-endian i32 `[N]` or f32 `[N, A]`, where N is the batch size `size`. Choices
/// must be in range, and numbers must be finite.
pub fn actions(spec: &EnvironmentSpec, size: usize, actions: &Bytes) -> Result<(), Error> {
    const FIELD: &str = "step.actions";
    let (element, width) = match spec.action {
        ActionSpec::Discrete(_) => ("int32 [N]", 1),
        ActionSpec::Continuous(channels) => ("float32 [N, A]", channels.len()),
    };
    if actions.len() != 4 * width * size {
        let expected = format!("{} bytes: {element} with N = {size}, A = {width}", 4 * width * size);
        return Err(Error::value(FIELD, format!("{} bytes", actions.len()), expected));
    }
    let words = actions.as_chunks::<4>().0;
    match spec.action {
        ActionSpec::Discrete(names) => {
            let legal = |word: &[u8; 4]| (0..names.len() as i32).contains(&i32::from_le_bytes(*word));
            if let Some(slot) = words.iter().position(|word| !legal(word)) {
                let got = format!("{} in slot {slot}", i32::from_le_bytes(words[slot]));
                return Err(Error::value(FIELD, got, format!("a choice in 0 … {}", names.len() - 1)));
            }
        }
        ActionSpec::Continuous(_) => {
            if let Some(i) = words.iter().position(|word| !f32::from_le_bytes(*word).is_finite()) {
                let got = format!("{} in slot {}, entry {}", f32::from_le_bytes(words[i]), i / width, i % width);
                return Err(Error::value(FIELD, got, "finite numbers"));
            }
        }
    }
    Ok(())
}

/// Returns the slots that a mask selects. An empty mask selects all `size` slots. `field` is the mask's name in errors.
pub fn mask(field: &'static str, size: usize, mask: &[u8]) -> Result<Vec<usize>, Error> {
    if mask.is_empty() {
        return Ok((0..size).collect());
    }
    if mask.len() != size {
        let expected = format!("one byte for each of the {size} environments, or none for all");
        return Err(Error::value(field, format!("{} bytes", mask.len()), expected));
    }
    if let Some(slot) = mask.iter().position(|&byte| byte > 1) {
        return Err(Error::value(field, format!("{} in slot {slot}", mask[slot]), "0 or 1"));
    }
    Ok((0..size).filter(|&slot| mask[slot] == 1).collect())
}

/// Checks a `reset` request, and converts it to one entry for each selected slot.
pub fn reset(batch: &Batch, request: proto::Reset) -> Result<Vec<ResetEntry>, Error> {
    let spec = batch.settings().spec;
    let mut names: Vec<&str> = request.parameters.keys().map(String::as_str).collect();
    names.sort_unstable();
    disturbance::check_open(spec, names)?;
    let slots = mask("reset.mask", batch.size(), &request.mask)?;
    if !request.seeds.is_empty() && request.seeds.len() != slots.len() {
        let expected = format!("one for each of the {} selected environments, or none", slots.len());
        return Err(Error::value("reset.seeds", format!("{} seeds", request.seeds.len()), expected));
    }
    let mut states = states(spec, &request.states, slots.len())?.into_iter();
    // Successive environments mostly have the same distributions, so the result of the last override is reused.
    let mut edited: [Arc<[Distribution]>; 2] = [Arc::new([]), Arc::new([])];
    let mut entries = Vec::with_capacity(slots.len());
    for (i, slot) in slots.into_iter().enumerate() {
        let mut distributions = None;
        if !request.parameters.is_empty() {
            let old = batch.distributions(slot);
            if !Arc::ptr_eq(&old, &edited[0]) && old != edited[0] {
                let mut new = old.to_vec();
                override_parameters(spec, &mut new, &request.parameters)?;
                edited = [old, new.into()];
            }
            distributions = Some(Arc::clone(&edited[1]));
        }
        entries.push(ResetEntry { slot, seed: request.seeds.get(i).copied(), distributions, state: states.next() });
    }
    Ok(entries)
}

fn states(spec: &EnvironmentSpec, bytes: &Bytes, selected: usize) -> Result<Vec<Vec<f64>>, Error> {
    const FIELD: &str = "reset.states";
    if bytes.is_empty() {
        return Ok(Vec::new());
    }
    let n = spec.state.len();
    if bytes.len() != 8 * n * selected {
        let expected = format!("{} bytes: float64 [M, S] with M = {selected}, S = {n}", 8 * n * selected);
        return Err(Error::value(FIELD, format!("{} bytes", bytes.len()), expected));
    }
    let numbers: Vec<f64> = bytes.as_chunks::<8>().0.iter().map(|word| f64::from_le_bytes(*word)).collect();
    for (i, &x) in numbers.iter().enumerate() {
        let ChannelSpec { name, unit, low, high, .. } = spec.state[i % n];
        if !x.is_finite() || x < low || x > high {
            let got = format!("{x} {unit} for {name} in row {}", i / n);
            return Err(Error::value(FIELD, got, format!("a finite number within [{low}, {high}]")));
        }
    }
    Ok(numbers.chunks_exact(n).map(<[f64]>::to_vec).collect())
}

/// Checks a `release` request to a batch of `size` environments. Returns the slots to free: some, but not all.
pub fn release(size: usize, request: &proto::Release) -> Result<Vec<usize>, Error> {
    const FIELD: &str = "release.mask";
    let slots = mask(FIELD, size, &request.mask)?;
    let expected = "at least one environment to free and one to keep; end the stream to free all";
    match slots.len() {
        0 => Err(Error::value(FIELD, "without a selected environment", expected)),
        all if all == size => Err(Error::value(FIELD, format!("all of the {size} environments"), expected)),
        _ => Ok(slots),
    }
}

/// Checks a `restore` request to a batch of `size` environments. Returns each selected slot with its snapshot.
pub fn restore(size: usize, request: proto::Restore) -> Result<Vec<(usize, Bytes)>, Error> {
    let slots = mask("restore.mask", size, &request.mask)?;
    if request.snapshots.len() != slots.len() {
        let got = format!("{} snapshots", request.snapshots.len());
        let expected = format!("one for each of the {} selected environments", slots.len());
        return Err(Error::value("restore.snapshots", got, expected));
    }
    Ok(slots.into_iter().zip(request.snapshots).collect())
}

/// Checks a `render` request to a batch of `n` environments. Returns the slot to draw and the size of the picture.
pub fn render(n: usize, request: proto::Render) -> Result<(usize, Size), Error> {
    let slot = request.slot as usize;
    if slot >= n {
        return Err(Error::value("render.slot", request.slot, format!("a slot of the batch, 0 … {}", n - 1)));
    }
    let pixels = |field, value| match u16::try_from(value) {
        Ok(0) => Ok(DEFAULT_PICTURE_PIXELS),
        Ok(pixels) if PICTURE_PIXELS.contains(&pixels) => Ok(pixels),
        _ => {
            let (min, max) = (PICTURE_PIXELS.start(), PICTURE_PIXELS.end());
            let expected = format!("{min} … {max} pixels, or 0 for {DEFAULT_PICTURE_PIXELS}");
            Err(Error::value(field, value, expected))
        }
    };
    let (width, height) = (pixels("render.width", request.width)?, pixels("render.height", request.height)?);
    Ok((slot, Size { width, height }))
}

/// Makes an environment's entry in the catalogue.
pub fn environment(spec: &'static EnvironmentSpec, model_hash: &str) -> proto::Environment {
    let quantity = |q: &env::QuantitySpec| proto::Quantity { name: q.name.into(), unit: q.unit.into() };
    let term = |t: &env::RewardTermSpec| proto::RewardTerm { name: t.name.into(), description: t.description.into() };
    proto::Environment {
        name: spec.name.into(),
        revision: spec.revision,
        description: spec.description.into(),
        parameters: spec.parameters.iter().map(parameter).collect(),
        disturbances: disturbance::disturbances(spec).iter().map(parameter).collect(),
        observation: channels(spec.observation),
        action: Some(action_space(spec.action)),
        state: channels(spec.state),
        reward_terms: spec.reward_terms.iter().map(term).collect(),
        applied: spec.applied.iter().map(quantity).collect(),
        step_limit: spec.step_limit,
        control_timestep: spec.control_timestep,
        success: Some(success(&spec.success, spec.step_limit)),
        code_success: Some(success(spec.code_success.as_ref().unwrap_or(&spec.success), spec.step_limit)),
        model_hash: model_hash.into(),
        heatmap_axes: spec.heatmap_axes.iter().flatten().map(|name| (*name).into()).collect(),
        parameter_observations: spec.parameters.iter().map(parameter_observation).collect(),
    }
}

fn success(rule: &SuccessRuleSpec, step_limit: u32) -> proto::Success {
    let SuccessRuleSpec { description, achievement, comparison, threshold } = *rule;
    let env::QuantitySpec { name, unit } = rule.quantity();
    let comparison = match comparison {
        SuccessComparison::AtLeast => proto::Comparison::AtLeast,
        SuccessComparison::AtMost => proto::Comparison::AtMost,
    };
    proto::Success {
        description: description.into(),
        steps: if let Achievement::Own(_) = achievement { step_limit } else { threshold as u32 },
        quantity: name.into(),
        unit: unit.into(),
        comparison: comparison.into(),
        threshold,
    }
}

fn channels(channels: &[ChannelSpec]) -> Vec<proto::Channel> {
    let channel =
        |c: &ChannelSpec| proto::Channel { name: c.name.into(), unit: c.unit.into(), low: c.low, high: c.high };
    channels.iter().map(channel).collect()
}

fn parameter(p: &ParameterSpec) -> proto::Parameter {
    proto::Parameter {
        name: p.name.into(),
        unit: p.unit.into(),
        description: p.description.into(),
        default_value: p.default,
        low: p.bounds.low,
        high: p.bounds.high,
        random: Some((&p.distribution(Version::R)).into()),
        extreme: Some((&p.distribution(Version::E)).into()),
        applied: p.applied.into(),
        integer: p.is_integer,
    }
}

fn parameter_observation(p: &ParameterSpec) -> proto::ParameterObservation {
    let whole = p.whole();
    let bound = |value| f64::from(p.observed(value));
    proto::ParameterObservation {
        entry: Some(proto::Channel {
            name: format!("parameter_{}", p.name),
            unit: "1".into(),
            low: bound(p.bounds.low),
            high: bound(p.bounds.high),
        }),
        at_minus_one: whole.low,
        at_plus_one: whole.high,
    }
}

fn action_space(space: ActionSpec) -> proto::ActionSpace {
    use proto::action_space::Kind;
    let kind = match space {
        ActionSpec::Discrete(names) => {
            Kind::Discrete(proto::Discrete { names: names.iter().map(|name| (*name).into()).collect() })
        }
        ActionSpec::Continuous(list) => Kind::Continuous(proto::Continuous { channels: channels(list) }),
    };
    proto::ActionSpace { kind: Some(kind) }
}

/// Converts the result of a step to its response.
pub fn stepped(stepped: StepResult) -> proto::Stepped {
    proto::Stepped {
        observations: stepped.observations,
        rewards: stepped.rewards,
        terminated: stepped.terminated,
        truncated: stepped.truncated,
        final_observations: stepped.final_observations,
        ended: stepped.ended.into_iter().map(ended).collect(),
        started: started(stepped.started),
        reward_terms: stepped.reward_terms,
        receipt_episodes: stepped.receipt_episodes,
        receipt_values: stepped.receipt_values,
    }
}

/// Converts the starts of episodes, each with its slot.
pub fn started(episodes: Vec<(u32, StartedEpisode)>) -> Vec<proto::EpisodeStart> {
    let start = |(slot, start): (u32, StartedEpisode)| proto::EpisodeStart {
        slot,
        episode: Some(episode(start.id)),
        receipt: start.receipt.map(receipt),
    };
    episodes.into_iter().map(start).collect()
}

pub(super) fn ended((slot, end): (u32, FinishedEpisode)) -> proto::EpisodeEnd {
    proto::EpisodeEnd {
        slot,
        episode: Some(episode(end.id)),
        r#return: end.total_reward,
        length: end.length,
        success: end.success,
        diverged: end.diverged,
        receipt: end.receipt.map(receipt),
        achieved: end.achieved,
        code_achieved: end.code_achieved,
    }
}

fn episode(id: EpisodeId) -> proto::Episode {
    let EpisodeId { environment_index, trial_index, episode_index, episode_in_trial } = id;
    proto::Episode { environment_index, trial_index, episode_index, episode_in_trial }
}

fn receipt(receipt: EpisodeReceipt) -> proto::Receipt {
    let EpisodeReceipt { requested, applied, model_hash } = receipt;
    proto::Receipt { requested, applied, model_hash }
}
