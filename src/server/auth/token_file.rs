//! Parses and checks the token file.

use super::role::{DrawSet, TokenRole};
use crate::env::{Catalogue, Distribution, Version, disturbance, resolve};
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write,
    sync::Arc,
};
use toml::Spanned;

/// The minimum length of a token. A shorter token could be guessed.
const MIN_TOKEN_CHARS: usize = 16;
/// A description of the file's format for error messages.
const EXPECTED_ENTRY: &str = "[[token]] with name = \"…\", sha256 = \"64 hexadecimal digits\" or token = \"…\", \
                     and optionally max_sessions = N, max_envs = N, max_steps_per_second = N, max_bytes = N \
                     and role = \"…\"; [[role]] with name, draws = [\"D\", \"R\", …] and \
                     never = […]; [[set]] with name, environment, version and parameters";

/// Why a token file is invalid. The message never contains any part of a token.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {what}; expected {EXPECTED_ENTRY}")]
pub struct TokenFileError {
    pub(super) line: usize,
    what: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TokenFile {
    #[serde(default)]
    token: Vec<Spanned<TokenEntry>>,
    #[serde(default)]
    role: Vec<Spanned<RoleEntry>>,
    #[serde(default)]
    set: Vec<Spanned<SetEntry>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TokenEntry {
    pub(super) name: String,
    sha256: Option<String>,
    token: Option<String>,
    pub(super) max_sessions: Option<usize>,
    pub(super) max_envs: Option<usize>,
    pub(super) max_steps_per_second: Option<u32>,
    pub(super) max_bytes: Option<usize>,
    role: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RoleEntry {
    name: String,
    draws: Option<Vec<String>>,
    #[serde(default)]
    never: Vec<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SetEntry {
    name: String,
    environment: String,
    #[serde(default)]
    version: Option<String>,
    parameters: BTreeMap<String, Distribution>,
}

/// A checked entry of the token file.
pub(super) struct ParsedToken {
    /// The SHA-256 digest of the token.
    pub(super) digest: [u8; 32],
    pub(super) entry: TokenEntry,
    pub(super) role: Option<Arc<TokenRole>>,
}

/// Parses and checks a token file. The file's parameter sets may refer to the environments of `catalogue`.
pub(super) fn parse(catalogue: &Catalogue, text: &str) -> Result<Vec<ParsedToken>, TokenFileError> {
    let line = |byte: usize| 1 + text.bytes().take(byte).filter(|byte| *byte == b'\n').count();
    let TokenFile { token: entries, role: roles, set: sets } = toml::from_str(text).map_err(|error| {
        // The parser's message may quote a token. Messages about keys quote none, so only these messages are passed on.
        let words = error.message();
        let about_keys = ["unknown field", "missing field", "duplicate key"].iter().any(|kind| words.starts_with(kind));
        let what = if about_keys {
            words.lines().next().unwrap_or_default()
        } else {
            "this is not valid TOML, or a value is invalid"
        };
        TokenFileError { line: line(error.span().map_or(0, |span| span.start)), what: what.into() }
    })?;
    // Parameter sets, which roles refer to.
    let mut known_sets: BTreeMap<String, DrawSet> =
        Version::KNOWN.iter().map(|version| (version.to_string(), DrawSet::Version(*version))).collect();
    for set in sets {
        let line = line(set.span().start);
        let set = set.into_inner();
        let name = set.name.clone();
        let own = own_set(catalogue, set).map_err(|what| TokenFileError { line, what })?;
        if known_sets.insert(name.clone(), own).is_some() {
            return Err(TokenFileError {
                line,
                what: format!(
                    "there are two sets called {name:?}; the names of versions (D, R, E, R+E) are also names of sets"
                ),
            });
        }
    }
    // Roles, which tokens refer to.
    let mut known_roles: BTreeMap<String, Arc<TokenRole>> = BTreeMap::new();
    for role in roles {
        let line = line(role.span().start);
        let RoleEntry { name, draws, never } = role.into_inner();
        let find = |names: Vec<String>| names.iter().map(|name| look_up("set", name, &known_sets)).collect();
        let sets: Result<(Option<Vec<DrawSet>>, Vec<DrawSet>), String> =
            draws.map(find).transpose().and_then(|draws| Ok((draws, find(never)?)));
        let (draws, never) = sets.map_err(|what| TokenFileError { line, what })?;
        if draws.is_none() && !never.is_empty() {
            // With `never` alone, a session could draw from just outside the forbidden set, so `never` would forbid
            // almost nothing.
            return Err(TokenFileError {
                line,
                what: format!(
                    "the role {name:?} has the key never but not the key draws; add draws, the sets that it may draw \
                     from"
                ),
            });
        }
        if known_roles.insert(name.clone(), Arc::new(TokenRole { name: name.clone(), draws, never })).is_some() {
            return Err(TokenFileError { line, what: format!("there are two roles called {name:?}") });
        }
    }
    // Tokens.
    let (mut names, mut digests) = (BTreeSet::new(), BTreeSet::new());
    let mut listed = Vec::with_capacity(entries.len());
    for entry in entries {
        let line = line(entry.span().start);
        let entry = entry.into_inner();
        let digest = digest(&entry).map_err(|what| TokenFileError { line, what })?;
        if !names.insert(entry.name.clone()) {
            return Err(TokenFileError { line, what: format!("there are two tokens called {:?}", entry.name) });
        }
        if !digests.insert(digest) {
            return Err(TokenFileError {
                line,
                what: format!("the token of {:?} is also the token of another entry", entry.name),
            });
        }
        let role = entry.role.as_ref().map(|role| look_up("role", role, &known_roles)).transpose();
        let role = role.map_err(|what| TokenFileError { line, what })?;
        listed.push(ParsedToken { digest, entry, role });
    }
    Ok(listed)
}

/// Looks up the role or set with this name.
fn look_up<T: Clone>(what: &str, name: &str, known: &BTreeMap<String, T>) -> Result<T, String> {
    let names = || known.keys().map(|name| format!("{name:?}")).collect::<Vec<_>>().join(", ");
    known.get(name).cloned().ok_or_else(|| format!("there is no {what} {name:?}; there are {}", names()))
}

/// Checks a parameter set of the file and computes its region.
fn own_set(catalogue: &Catalogue, set: SetEntry) -> Result<DrawSet, String> {
    let SetEntry { name, environment, version, parameters } = set;
    let spec = catalogue.find(&environment).map_err(|error| error.to_string())?;
    let version = version.map_or(Ok(Version::D), |version| version.parse()).map_err(|error| error.to_string())?;
    let names = parameters.keys().map(String::as_str);
    let spec = disturbance::with_parameters(spec, names).map_err(|error| error.to_string())?;
    let mut distributions = spec.distributions(version);
    let own = parameters.iter().map(|(name, values)| (name.as_str(), values.clone()));
    resolve(spec, &mut distributions, own).map_err(|error| error.to_string())?;
    Ok(DrawSet::Own { name, environment: spec.name, region: spec.region(&distributions) })
}

/// Checks an entry and returns the digest of its token, or what is wrong with the entry.
fn digest(entry: &TokenEntry) -> Result<[u8; 32], String> {
    let name = &entry.name;
    if name.is_empty() || name.chars().any(char::is_control) {
        return Err(format!("the name {name:?} is empty or has control characters"));
    }
    for (key, limit) in [
        ("max_sessions", entry.max_sessions),
        ("max_envs", entry.max_envs),
        ("max_steps_per_second", entry.max_steps_per_second.map(|rate| rate as usize)),
        ("max_bytes", entry.max_bytes),
    ] {
        if limit == Some(0) {
            return Err(format!("{key} of {name:?} is 0, at least 1 is expected; leave the token out to revoke it"));
        }
    }
    match (&entry.sha256, &entry.token) {
        (Some(hex), None) => {
            let mut digest = [0; 32];
            let is_hex = hex.len() == 64 && hex.bytes().all(|digit| digit.is_ascii_hexdigit());
            if !is_hex {
                return Err(format!("sha256 of {name:?} is not 64 hexadecimal digits"));
            }
            for (byte, place) in digest.iter_mut().zip((0..64).step_by(2)) {
                *byte = u8::from_str_radix(&hex[place..place + 2], 16).unwrap_or_default();
            }
            Ok(digest)
        }
        (None, Some(token)) if token.len() < MIN_TOKEN_CHARS => {
            Err(format!("the token of {name:?} has fewer than {MIN_TOKEN_CHARS} characters"))
        }
        (None, Some(token)) if !token.bytes().all(|byte| byte.is_ascii_graphic()) => {
            Err(format!("the token of {name:?} has characters other than visible ASCII"))
        }
        (None, Some(token)) => Ok(Sha256::digest(token).into()),
        (Some(_), Some(_)) => Err(format!("{name:?} has both sha256 and token; one of them is expected")),
        (None, None) => Err(format!("{name:?} has neither sha256 nor token")),
    }
}

/// Makes a new token of 256 random bits. Returns the token, and an entry for the token file with the token's digest.
///
/// # Errors
/// If `name` is not a valid name, or the operating system has no random bits.
pub fn new_token(name: &str) -> std::io::Result<(String, String)> {
    let mut bits = [0; 32];
    std::io::Read::read_exact(&mut std::fs::File::open("/dev/urandom")?, &mut bits)?;
    let token = hex(&bits);
    let name = toml::Value::String(name.into());
    let entry = format!("[[token]]\nname = {name}\nsha256 = \"{:x}\"\n", Sha256::digest(&token));
    parse(&Catalogue::default(), &entry).map_err(std::io::Error::other)?;
    Ok((token, entry))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}
