//! Checks the settings in requests, and converts them to the types of [`env`] and the pool. The bounds of parameters
//! are checked by [`resolve`].

use super::{Error, tensors};
use crate::{
    env::{self, Catalogue, Distribution, EnvironmentSpec, Version, disturbance, resolve, shorten},
    pool::{Autoreset, BatchSettings, SlotGroupSettings},
    proto::dm_env_rpc::v1::Tensor,
};
use std::collections::BTreeMap;

const ENV_ID: &str = "env_id";
const VERSION: &str = "version";
const SEED: &str = "seed";
const ENVIRONMENT_INDEX: &str = "environment_index";
const EPISODES_PER_TRIAL: &str = "episodes_per_trial";
const WORLD_NAME: &str = "world_name";
const SHARED: &str = "shared";

/// The maximum length of a world's name that a client chooses, bytes.
const MAX_NAME_BYTES: usize = 64;

type WorldSettings = BTreeMap<String, Tensor>;

/// The requested name of a world, and whether other streams may reset and destroy the world.
pub(super) struct Ownership {
    /// The requested name; `None` for a random name.
    pub(super) name: Option<String>,
    /// Whether every stream with the same token may reset and destroy the world.
    pub(super) shared: bool,
}

/// Changes that a reset or a write to a property makes. The changes take effect when the next episode begins.
#[derive(Default)]
pub(super) struct WorldChange {
    /// The new version. The version sets the distributions of all parameters; `parameters` then overrides some of these
    /// distributions.
    pub(super) version: Option<Version>,
    /// The new seed. It restarts the counts of episodes and trials at 0.
    pub(super) seed: Option<u64>,
    /// New distributions of parameters, by name.
    pub(super) parameters: Vec<(&'static str, Distribution)>,
}

/// Checks the settings of `create_world`. Returns the settings of the world's batch, the version, and the world's name
/// and ownership.
///
/// # Errors
/// If a setting is missing, unknown, of a wrong type, or out of range.
pub(super) fn create(
    catalogue: &Catalogue,
    settings: &WorldSettings,
) -> Result<(BatchSettings, Version, Ownership), Error> {
    let id = settings.get(ENV_ID).ok_or_else(|| {
        let expected = format!("a STRING scalar, one of {}", catalogue.names().collect::<Vec<_>>().join(", "));
        Error::value(field(ENV_ID), "missing", expected)
    })?;
    let spec = catalogue.find(tensors::text(&field(ENV_ID), id)?)?;
    let own = [ENV_ID, VERSION, SEED, ENVIRONMENT_INDEX, EPISODES_PER_TRIAL, WORLD_NAME, SHARED];
    let is_disturbance = |name: &&String| disturbance::disturbances(spec).iter().any(|known| known.name == **name);
    let named = settings.keys().filter(is_disturbance).map(String::as_str);
    let spec = disturbance::with_parameters(spec, named)?;
    check_names(spec, "create_world", &own, settings)?;
    let integer = |name, default, low, high| match settings.get(name) {
        Some(tensor) => tensors::integer(&field(name), tensor, low, high),
        None => Ok(default),
    };
    let small =
        |name, default, low| integer(name, default, low, u32::MAX.into()).map(|n| u32::try_from(n).unwrap_or(u32::MAX));
    let version = version(settings)?.unwrap_or(Version::D);
    let mut distributions = spec.distributions(version);
    resolve(spec, &mut distributions, parameters(spec, settings)?)?;
    let episodes = env::EpisodeSettings {
        seed: integer(SEED, 0, 0, u64::MAX)?,
        environment_index: small(ENVIRONMENT_INDEX, 0, 0)?,
        distributions: distributions.into(),
        episodes_per_trial: small(EPISODES_PER_TRIAL, 1, 1)?,
    };
    // The runner itself resets the environment at the agent's first step after the end of an episode.
    let autoreset = Autoreset::Disabled;
    let batch = BatchSettings {
        spec,
        groups: vec![SlotGroupSettings { size: 1, episodes }],
        autoreset,
        receipts: true,
        receipt_arrays: false,
        reward_terms: false,
        observe_parameters: false,
    };
    Ok((batch, version, ownership(settings)?))
}

fn ownership(settings: &WorldSettings) -> Result<Ownership, Error> {
    let name = settings.get(WORLD_NAME).map(|tensor| tensors::text(&field(WORLD_NAME), tensor)).transpose()?;
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    if let Some(name) =
        name.filter(|name| name.is_empty() || name.len() > MAX_NAME_BYTES || !name.bytes().all(is_plain))
    {
        let expected = format!("1 to {MAX_NAME_BYTES} letters, digits, -, _ or .");
        return Err(Error::value(field(WORLD_NAME), format!("{:?}", shorten(name)), expected));
    }
    let shared = settings.get(SHARED).map(|tensor| tensors::boolean(&field(SHARED), tensor)).transpose()?;
    Ok(Ownership { name: name.map(String::from), shared: shared.unwrap_or(false) })
}

/// Checks the settings of `reset` or `reset_world`.
///
/// # Errors
/// If a setting is unknown, of a wrong type, or invalid, e.g. a negative seed or a parameter that is not finite. Also
/// if a setting is a disturbance, but the world was created without disturbances.
/// [`World::change`](super::world::World::change) checks the bounds of parameters later.
pub(super) fn change(
    spec: &'static EnvironmentSpec,
    request: &'static str,
    settings: &WorldSettings,
) -> Result<WorldChange, Error> {
    let disturbances = disturbance::disturbances(spec).iter().map(|disturbance| disturbance.name);
    disturbance::check_open(spec, disturbances.filter(|name| settings.contains_key(*name)))?;
    check_names(spec, request, &[VERSION, SEED], settings)?;
    Ok(WorldChange {
        version: version(settings)?,
        seed: settings.get(SEED).map(|tensor| tensors::integer(&field(SEED), tensor, 0, u64::MAX)).transpose()?,
        parameters: parameters(spec, settings)?,
    })
}

/// Checks that a request has no settings.
///
/// # Errors
/// If there is a setting.
pub(super) fn check_none(request: &'static str, settings: &WorldSettings) -> Result<(), Error> {
    match settings.keys().next() {
        Some(name) => Err(unknown(name, format!("{request} takes no settings; give them to create_world or reset"))),
        None => Ok(()),
    }
}

/// Parses the letter of a version.
///
/// # Errors
/// If `letter` is not D, R or E.
pub(super) fn parse_version(field: String, letter: &str) -> Result<Version, Error> {
    let found = letter.parse().ok().filter(|version| Version::ALL.contains(version));
    found.ok_or_else(|| Error::value(field, format!("{:?}", shorten(letter)), "\"D\", \"R\" or \"E\""))
}

fn version(settings: &WorldSettings) -> Result<Option<Version>, Error> {
    let read = |tensor| parse_version(field(VERSION), tensors::text(&field(VERSION), tensor)?);
    settings.get(VERSION).map(read).transpose()
}

/// Returns the environment's parameters that have a value in `settings`: the name of each, and a distribution that is
/// fixed at the value.
fn parameters(spec: &EnvironmentSpec, settings: &WorldSettings) -> Result<Vec<(&'static str, Distribution)>, Error> {
    let given = spec.parameters.iter().filter_map(|p| Some((p.name, settings.get(p.name)?)));
    given.map(|(name, tensor)| Ok((name, Distribution::fixed(tensors::number(&field(name), tensor)?)))).collect()
}

fn check_names(
    spec: &'static EnvironmentSpec,
    request: &'static str,
    own: &[&str],
    settings: &WorldSettings,
) -> Result<(), Error> {
    let is_known = |name: &&String| own.contains(&name.as_str()) || spec.parameters.iter().any(|p| p.name == *name);
    match settings.keys().find(|name| !is_known(name)) {
        Some(name) => {
            let parameters: Vec<_> = spec.parameters.iter().map(|p| p.name).collect();
            let known = format!("{request} takes {} and {}'s {}", own.join(", "), spec.name, parameters.join(", "));
            Err(unknown(name, known))
        }
        None => Ok(()),
    }
}

fn field(name: &str) -> String {
    format!("setting {name:?}")
}

fn unknown(name: &str, known: String) -> Error {
    Error::Unknown { what: "setting", name: format!("{:?}", shorten(name)), known }
}
