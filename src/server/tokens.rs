//! Who may call: tokens, of which a file has names, digests and quotas, and the gate that asks for them.

use super::{
    peers::{Connection, Peer},
    refusals::Refusals,
    status::Refusal,
};
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::{
    collections::BTreeSet,
    convert::Infallible,
    fmt::Write,
    future::{Future, ready},
    pin::Pin,
    sync::{
        Arc, PoisonError, RwLock,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    task::{Context, Poll},
};
use subtle::ConstantTimeEq;
use tokio::sync::Notify;
use toml::Spanned;
use tonic::{
    Status,
    body::Body,
    codegen::{Service, http},
    server::NamedService,
};

/// Fewer characters could be guessed.
const SHORTEST: usize = 16;
/// What an entry may have.
const ENTRY: &str = "[[token]] with name = \"…\", sha256 = \"64 hexadecimal digits\" or token = \"…\", and if need be \
                     max_sessions = N and max_envs = N";

/// Why a file of tokens is refused. Nothing of a token is in it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {what}; expected {ENTRY}")]
pub struct Wrong {
    line: usize,
    what: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Listed {
    #[serde(default)]
    token: Vec<Spanned<Entry>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    sha256: Option<String>,
    token: Option<String>,
    max_sessions: Option<usize>,
    max_envs: Option<usize>,
}

/// So many of something, of which a token may have no more than a limit.
#[derive(Default)]
struct Quota {
    taken: AtomicUsize,
    limit: AtomicUsize,
}

impl Quota {
    fn bound(&self, limit: Option<usize>) {
        self.limit.store(limit.unwrap_or(usize::MAX), Ordering::Relaxed);
    }

    /// Takes so many, or says how many there may be.
    fn take(&self, wanted: usize) -> Result<(), usize> {
        let limit = self.limit.load(Ordering::Relaxed);
        let grown = |taken: usize| taken.checked_add(wanted).filter(|sum| *sum <= limit);
        self.taken.fetch_update(Ordering::Relaxed, Ordering::Relaxed, grown).map(|_| ()).map_err(|_| limit)
    }

    fn give_back(&self, count: usize) {
        self.taken.fetch_sub(count, Ordering::Relaxed);
    }
}

/// What a client shows, and what whoever shows it may have.
pub struct Token {
    name: String,
    /// SHA-256 of the token.
    digest: [u8; 32],
    revoked: AtomicBool,
    /// Wakes who waits for that.
    told: Notify,
    sessions: Arc<Quota>,
    envs: Arc<Quota>,
    spent: Arc<Spent>,
}

/// What was done with a token so far.
#[derive(Default)]
pub struct Spent {
    /// Steps of an environment.
    pub steps: AtomicU64,
    /// Requests and calls that were refused.
    pub refusals: AtomicU64,
}

/// What a token has, and what was done with it.
pub struct Used {
    /// What it is called.
    pub name: String,
    /// Sessions now.
    pub sessions: usize,
    /// Environments now.
    pub envs: usize,
    /// Steps of an environment so far.
    pub steps: u64,
    /// What was refused so far.
    pub refusals: u64,
}

/// The token of a call.
pub type Bearer = Arc<Token>;

impl Token {
    /// What it is called.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// What was done with it.
    pub fn spent(&self) -> &Spent {
        &self.spent
    }

    fn used(&self) -> Used {
        Used {
            name: self.name.clone(),
            sessions: self.sessions.taken.load(Ordering::Relaxed),
            envs: self.envs.taken.load(Ordering::Relaxed),
            steps: self.spent.steps.load(Ordering::Relaxed),
            refusals: self.spent.refusals.load(Ordering::Relaxed),
        }
    }

    /// Whether it is in the file no more.
    fn is_revoked(&self) -> bool {
        self.revoked.load(Ordering::Acquire)
    }

    /// Waits until it is in the file no more, and gives the refusal of what comes then.
    pub async fn revoked(&self) -> Refusal {
        loop {
            let told = self.told.notified();
            if self.is_revoked() {
                return Refusal::RevokedToken { name: self.name.clone() };
            }
            told.await;
        }
    }

    fn revoke(&self) {
        self.revoked.store(true, Ordering::Release);
        self.told.notify_waiters();
    }

    /// A session of it.
    ///
    /// # Errors
    /// [`Refusal::TooManyOfAToken`].
    pub fn session(self: &Arc<Self>) -> Result<Held, Refusal> {
        self.take(1, |token| &token.sessions, "sessions")
    }

    /// So many environments of it.
    ///
    /// # Errors
    /// [`Refusal::TooManyOfAToken`].
    pub fn envs(self: &Arc<Self>, count: usize) -> Result<Held, Refusal> {
        self.take(count, |token| &token.envs, "environments")
    }

    fn take(self: &Arc<Self>, count: usize, of: fn(&Self) -> &Quota, what: &'static str) -> Result<Held, Refusal> {
        let refuse = |limit| Refusal::TooManyOfAToken { name: self.name.clone(), wanted: count, limit, what };
        of(self).take(count).map_err(refuse)?;
        Ok(Held { token: Arc::clone(self), count, of })
    }
}

/// A part of a quota, until it is dropped.
pub struct Held {
    token: Bearer,
    count: usize,
    of: fn(&Token) -> &Quota,
}

impl Held {
    /// Gives some of it back.
    pub fn give_back(&mut self, count: usize) {
        let count = count.min(self.count);
        self.count -= count;
        (self.of)(&self.token).give_back(count);
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.give_back(self.count);
    }
}

/// The tokens that are good now.
#[derive(Clone, Default)]
pub struct Tokens(Arc<RwLock<Vec<Bearer>>>);

impl Tokens {
    /// Those of a file's text.
    ///
    /// # Errors
    /// [`Wrong`].
    pub fn new(text: &str) -> Result<Self, Wrong> {
        let tokens = Self::default();
        tokens.renew(text)?;
        Ok(tokens)
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.0.read().unwrap_or_else(PoisonError::into_inner).len()
    }

    /// What each has and has done.
    pub fn used(&self) -> Vec<Used> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).iter().map(|token| token.used()).collect()
    }

    /// Takes the file's new text: tokens that stay keep what they have, others are revoked.
    ///
    /// # Errors
    /// [`Wrong`]; then all stays as it is.
    pub fn renew(&self, text: &str) -> Result<(), Wrong> {
        let listed = listed(text)?;
        let mut tokens = self.0.write().unwrap_or_else(PoisonError::into_inner);
        let mut renewed = Vec::with_capacity(listed.len());
        for (digest, Entry { name, max_sessions, max_envs, .. }) in listed {
            // Another token of the same name has what was taken with the one before, too.
            let before = tokens.iter().find(|token| token.name == name);
            let (sessions, envs, spent) = before.map_or_else(Default::default, |token| {
                (Arc::clone(&token.sessions), Arc::clone(&token.envs), Arc::clone(&token.spent))
            });
            sessions.bound(max_sessions);
            envs.bound(max_envs);
            renewed.push(match before.filter(|token| token.digest == digest) {
                Some(token) => Arc::clone(token),
                None => Arc::new(Token {
                    name,
                    digest,
                    revoked: AtomicBool::new(false),
                    told: Notify::new(),
                    sessions,
                    envs,
                    spent,
                }),
            });
        }
        let gone = |token: &&Bearer| !renewed.iter().any(|kept| Arc::ptr_eq(kept, token));
        tokens.iter().filter(gone).for_each(|token| token.revoke());
        *tokens = renewed;
        Ok(())
    }

    /// The token that a call shows. All are compared, each in constant time.
    fn find(&self, shown: &[u8]) -> Option<Bearer> {
        let digest: [u8; 32] = Sha256::digest(shown).into();
        let tokens = self.0.read().unwrap_or_else(PoisonError::into_inner);
        let fits = |token: &Bearer| bool::from(token.digest.ct_eq(&digest));
        tokens.iter().fold(None, |found, token| if fits(token) { Some(token) } else { found }).cloned()
    }

    /// Whose call it is; none for one by a Unix socket, which needs no token.
    ///
    /// # Errors
    /// [`Refusal::NoToken`] or [`Refusal::WrongToken`].
    fn admit(&self, request: &http::Request<Body>) -> Result<Option<Bearer>, Refusal> {
        let peer = request.extensions().get::<Connection>().map(|connection| connection.peer);
        if matches!(peer, Some(Peer::User(_))) {
            return Ok(None);
        }
        let header = request.headers().get(http::header::AUTHORIZATION).ok_or(Refusal::NoToken)?.as_bytes();
        let (scheme, token) = header.split_at_checked("Bearer ".len()).ok_or(Refusal::NoToken)?;
        if !scheme.eq_ignore_ascii_case(b"Bearer ") {
            return Err(Refusal::NoToken);
        }
        let bearer = self.find(token).ok_or(Refusal::WrongToken)?;
        tracing::debug!(token = bearer.name(), path = request.uri().path(), ?peer, "a call");
        Ok(Some(bearer))
    }
}

/// The entries of a file, with their digests.
fn listed(text: &str) -> Result<Vec<([u8; 32], Entry)>, Wrong> {
    let line = |byte: usize| 1 + text.bytes().take(byte).filter(|byte| *byte == b'\n').count();
    let Listed { token: entries } = toml::from_str(text).map_err(|error| {
        // A parser's words may quote a token, but for those that are about keys.
        let words = error.message();
        let about_keys = ["unknown field", "missing field", "duplicate key"].iter().any(|kind| words.starts_with(kind));
        let what = if about_keys { words.lines().next().unwrap_or_default() } else { "this cannot be read" };
        Wrong { line: line(error.span().map_or(0, |span| span.start)), what: what.into() }
    })?;
    let (mut names, mut digests) = (BTreeSet::new(), BTreeSet::new());
    let mut listed = Vec::with_capacity(entries.len());
    for entry in entries {
        let line = line(entry.span().start);
        let entry = entry.into_inner();
        let digest = digest(&entry).map_err(|what| Wrong { line, what })?;
        if !names.insert(entry.name.clone()) {
            return Err(Wrong { line, what: format!("there are two tokens called {:?}", entry.name) });
        }
        if !digests.insert(digest) {
            return Err(Wrong { line, what: format!("the token of {:?} is another one's, too", entry.name) });
        }
        listed.push((digest, entry));
    }
    Ok(listed)
}

/// The digest of an entry's token, or what is wrong with the entry.
fn digest(entry: &Entry) -> Result<[u8; 32], String> {
    let name = &entry.name;
    if name.is_empty() || name.chars().any(char::is_control) {
        return Err(format!("{name:?} is no name"));
    }
    for (key, limit) in [("max_sessions", entry.max_sessions), ("max_envs", entry.max_envs)] {
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
        (None, Some(token)) if token.len() < SHORTEST => {
            Err(format!("the token of {name:?} has fewer than {SHORTEST} characters"))
        }
        (None, Some(token)) if !token.bytes().all(|byte| byte.is_ascii_graphic()) => {
            Err(format!("the token of {name:?} has characters that are no visible ones of ASCII"))
        }
        (None, Some(token)) => Ok(Sha256::digest(token).into()),
        (Some(_), Some(_)) => Err(format!("{name:?} has both sha256 and token; one of them is expected")),
        (None, None) => Err(format!("{name:?} has neither sha256 nor token")),
    }
}

/// A new token of 256 random bits, and its entry in the file of tokens.
///
/// # Errors
/// If the name cannot be one, or the system has no random bits.
pub fn new_token(name: &str) -> std::io::Result<(String, String)> {
    let mut bits = [0; 32];
    std::io::Read::read_exact(&mut std::fs::File::open("/dev/urandom")?, &mut bits)?;
    let token = hex(&bits);
    let name = toml::Value::String(name.into());
    let entry = format!("[[token]]\nname = {name}\nsha256 = \"{}\"\n", hex(&Sha256::digest(&token)));
    listed(&entry).map_err(std::io::Error::other)?;
    Ok((token, entry))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // A string takes it.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// A service that answers whoever shows a token, if there are any to be shown.
#[derive(Clone)]
pub struct Gated<S> {
    service: S,
    tokens: Option<Tokens>,
    refusals: Refusals,
}

impl<S> Gated<S> {
    /// Asks for one of these, or for none, and counts whom it refuses.
    pub fn new(service: S, tokens: Option<Tokens>, refusals: Refusals) -> Self {
        Self { service, tokens, refusals }
    }
}

impl<S: NamedService> NamedService for Gated<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<http::Request<Body>> for Gated<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>, Error = Infallible>,
    S::Future: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, Infallible>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.service.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<Body>) -> Self::Future {
        match self.tokens.as_ref().map(|tokens| tokens.admit(&request)).transpose() {
            Ok(bearer) => {
                if let Some(bearer) = bearer.flatten() {
                    request.extensions_mut().insert(bearer);
                }
                Box::pin(self.service.call(request))
            }
            Err(refusal) => {
                let peer = request.extensions().get::<Connection>().map(|connection| connection.peer);
                tracing::debug!(?peer, path = request.uri().path(), %refusal, "refused a call");
                self.refusals.count(&refusal, None);
                Box::pin(ready(Ok(Status::from(refusal).into_http())))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    const SECRET: &str = "correct-horse-battery";

    fn file(token: &str, more: &str) -> String {
        format!("[[token]]\nname = \"ann\"\ntoken = \"{token}\"\n{more}")
    }

    #[test]
    fn a_token_is_found_by_itself_or_by_its_digest() {
        let (token, entry) = new_token("bob \"the\" builder").unwrap();
        let tokens = Tokens::new(&(entry + &file(SECRET, ""))).unwrap();
        let name = |shown: &str| tokens.find(shown.as_bytes()).map(|token| token.name().to_owned());
        assert_eq!(name(SECRET).as_deref(), Some("ann"));
        assert_eq!(name(&token).as_deref(), Some("bob \"the\" builder"));
        assert_eq!(name(&SECRET[1..]), None);
        assert_eq!(name(""), None);
        assert_eq!(tokens.count(), 2);
    }

    #[rstest]
    #[case::not_toml("[[token]]\nname =", 2, "cannot be read")]
    #[case::unknown_key("# a\n[[token]]\nname = \"ann\"\ntokn = \"x\"", 4, "unknown field `tokn`")]
    #[case::no_name("[[token]]\ntoken = \"correct-horse-battery\"", 1, "missing field `name`")]
    #[case::neither("\n\n[[token]]\nname = \"ann\"", 3, "neither")]
    #[case::both(&file(SECRET, "sha256 = \"00\""), 1, "both")]
    #[case::no_digest("[[token]]\nname = \"ann\"\nsha256 = \"correct-horse-battery\"", 1, "64 hexadecimal")]
    #[case::short(&file("correct-horse", ""), 1, "fewer than 16")]
    #[case::spaces(&file("correct horse battery", ""), 1, "visible")]
    #[case::no_number(&file(SECRET, "max_envs = \"correct-horse-battery\""), 4, "cannot be read")]
    #[case::nothing(&file(SECRET, "max_envs = 0"), 1, "leave the token out")]
    #[case::twice(&(file(SECRET, "") + &file("another-horse-battery", "")), 4, "two tokens called \"ann\"")]
    #[case::shared(&(file(SECRET, "") + &file(SECRET, "").replace("ann", "bob")), 4, "another one's")]
    fn a_wrong_file_is_refused_with_its_line_and_no_token(#[case] text: &str, #[case] line: usize, #[case] part: &str) {
        let wrong = Tokens::new(text).err().unwrap();
        assert_eq!(wrong.line, line, "{wrong}");
        let words = wrong.to_string();
        assert!(words.contains(part) && words.contains("expected [[token]]"), "{words}");
        assert!(!words.contains("correct"), "it tells the token: {words}");
    }

    #[test]
    fn a_new_file_revokes_and_a_broken_one_changes_nothing() {
        let tokens = Tokens::new(&file(SECRET, "max_envs = 8\nmax_sessions = 1")).unwrap();
        let ann = tokens.find(SECRET.as_bytes()).unwrap();
        let mut held = ann.envs(6).unwrap();
        assert!(ann.envs(3).is_err());
        held.give_back(1);
        assert!(ann.envs(3).is_ok());
        assert!(tokens.renew("[[token]]").is_err());
        assert!(tokens.find(SECRET.as_bytes()).is_some() && !ann.is_revoked());
        tokens.renew(&file(SECRET, "max_envs = 10")).unwrap();
        assert!(!ann.is_revoked() && ann.envs(6).is_err() && ann.envs(5).is_ok(), "what it has is remembered");
        let first = ann.session().unwrap();
        assert!(ann.session().is_ok(), "that quota is gone");
        let renewed = file("another-horse-battery", "max_envs = 10");
        tokens.renew(&renewed).unwrap();
        let new = tokens.find(b"another-horse-battery").unwrap();
        assert!(ann.is_revoked() && new.envs(6).is_err() && new.envs(5).is_ok(), "the quota is the name's");
        tokens.renew("").unwrap();
        assert!(new.is_revoked() && tokens.find(SECRET.as_bytes()).is_none());
        drop((first, held));
        assert_eq!(ann.envs.taken.load(Ordering::Relaxed) + ann.sessions.taken.load(Ordering::Relaxed), 0);
    }
}
