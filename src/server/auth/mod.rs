//! Authentication: the tokens of the token file, with their names, digests, quotas and roles. A layer checks the token
//! of each call.

mod error;
pub mod file_watcher;
mod layer;
mod quota;
mod rate_limiter;
mod role;
mod token_file;

pub use error::Error;
pub use layer::{AuthLayer, AuthService};
pub use quota::QuotaGuard;
pub use role::TokenRole;
pub use token_file::{TokenFileError, new_token};

use super::net::{managed_io::ConnectionHandle, peer_limiter::Peer};
use crate::env::Catalogue;
use quota::{Quota, QuotaKind};
use rate_limiter::{MAX_WAIT, RateLimiter, TooFast};
use sha2::{Digest, Sha256};
use std::{
    sync::{
        Arc, PoisonError, RwLock,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};
use subtle::ConstantTimeEq;
use token_file::{ParsedToken, TokenEntry};
use tokio::sync::Notify;
use tonic::{body::Body, codegen::http};

/// An entry of the token file: a client's token, with its role and quotas.
pub struct Token {
    name: String,
    /// The SHA-256 digest of the secret text.
    digest: [u8; 32],
    role: Option<Arc<TokenRole>>,
    revoked: AtomicBool,
    /// Wakes the tasks that wait in [`Token::revoked`].
    revoked_notify: Notify,
    /// The quotas, which belong to the token's name: a token that replaces another token of the same name shares them.
    quotas: Arc<Quotas>,
}

/// A token's quotas, rate limit and counters.
#[derive(Default)]
struct Quotas {
    sessions: Quota,
    envs: Quota,
    bytes: Quota,
    rate_limiter: RateLimiter,
    steps: AtomicU64,
    refusals: AtomicU64,
}

/// A snapshot of a token's usage.
pub struct TokenUsage {
    /// The token's name.
    pub name: String,
    /// The number of open sessions.
    pub sessions: usize,
    /// The number of environments in use.
    pub envs: usize,
    /// The number of bytes in flight.
    pub bytes: usize,
    /// The total number of steps so far, summed over all environments.
    pub steps: u64,
    /// The total time that the token's requests have waited for its rate limit so far.
    pub waited: Duration,
    /// The number of refused requests and sessions so far.
    pub refusals: u64,
}

/// The token with which a call was authenticated.
pub type Bearer = Arc<Token>;

impl Token {
    /// The token's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Counts steps, and charges them to the rate limit. Call it after the steps ran, because their number is not known
    /// earlier. `price` is the price of other work, in steps; it is charged but not counted.
    pub fn charge(&self, steps: u64, price: u64) {
        self.quotas.steps.fetch_add(steps, Ordering::Relaxed);
        self.quotas.rate_limiter.charge(steps + price);
    }

    /// Counts a refused request or session.
    pub fn count_error(&self) {
        self.quotas.refusals.fetch_add(1, Ordering::Relaxed);
    }

    fn usage(&self) -> TokenUsage {
        let Quotas { sessions, envs, bytes, rate_limiter, steps, refusals } = &*self.quotas;
        TokenUsage {
            name: self.name.clone(),
            sessions: sessions.taken(),
            envs: envs.taken(),
            bytes: bytes.taken(),
            steps: steps.load(Ordering::Relaxed),
            waited: rate_limiter.waited(),
            refusals: refusals.load(Ordering::Relaxed),
        }
    }

    /// The maximum number of steps per second, summed over the token's environments; `None` for no limit.
    pub fn rate(&self) -> Option<u32> {
        self.quotas.rate_limiter.rate()
    }

    /// Waits until the token's rate allows further steps, at most 30 s.
    ///
    /// # Errors
    /// [`Error::TooFast`], as soon as it is known that the wait would be longer.
    pub async fn acquire_steps(&self) -> Result<(), Error> {
        self.acquire_within(MAX_WAIT).await
    }

    /// Waits until the token's rate has allowed all steps that were charged before this call.
    ///
    /// # Errors
    /// [`Error::TooFast`], as soon as it is known that the wait would be longer than `max_wait`.
    pub async fn acquire_within(&self, max_wait: Duration) -> Result<(), Error> {
        let acquired = self.quotas.rate_limiter.acquire(max_wait).await;
        acquired.map_err(|TooFast { rate, ahead }| Error::TooFast {
            name: self.name.clone(),
            rate,
            seconds: ahead.as_secs(),
        })
    }

    /// The role, which limits the distributions that the token's sessions may draw from; `None` for no limit.
    pub fn role(&self) -> Option<&TokenRole> {
        self.role.as_deref()
    }

    /// Whether the token was removed from the token file, or its role was changed there.
    fn is_revoked(&self) -> bool {
        self.revoked.load(Ordering::Acquire)
    }

    /// Waits until the token is revoked. Returns the error for the token's further requests.
    pub async fn revoked(&self) -> Error {
        loop {
            let notified = self.revoked_notify.notified();
            if self.is_revoked() {
                return Error::RevokedToken { name: self.name.clone() };
            }
            notified.await;
        }
    }

    fn revoke(&self) {
        self.revoked.store(true, Ordering::Release);
        self.revoked_notify.notify_waiters();
    }

    /// Takes one session from the token's quota until the guard is dropped.
    ///
    /// # Errors
    /// [`Error::QuotaExceeded`], if the quota of sessions is used up.
    pub fn session(self: &Arc<Self>) -> Result<QuotaGuard, Error> {
        self.take(1, QuotaKind::Sessions)
    }

    /// Takes `count` environments from the token's quota until the guard is dropped.
    ///
    /// # Errors
    /// [`Error::QuotaExceeded`], if the quota has fewer environments left.
    pub fn envs(self: &Arc<Self>, count: usize) -> Result<QuotaGuard, Error> {
        self.take(count, QuotaKind::Environments)
    }

    /// Returns an empty guard of the quota of bytes in flight. [`QuotaGuard::grow`] takes bytes.
    pub fn reserve_bytes(self: &Arc<Self>) -> QuotaGuard {
        QuotaGuard::empty(Arc::clone(self), QuotaKind::Bytes)
    }

    fn take(self: &Arc<Self>, count: usize, kind: QuotaKind) -> Result<QuotaGuard, Error> {
        let mut held = QuotaGuard::empty(Arc::clone(self), kind);
        held.grow(count)?;
        Ok(held)
    }
}

/// The tokens that are currently valid.
#[derive(Clone, Default)]
pub struct Tokens {
    good: Arc<RwLock<Vec<Bearer>>>,
    /// The environments that parameter sets of the token file may name.
    catalogue: Arc<Catalogue>,
}

impl Tokens {
    /// Makes an empty collection of tokens. The token file may later refer to the environments of `catalogue`.
    pub fn new(catalogue: Catalogue) -> Self {
        Self { good: Arc::default(), catalogue: Arc::new(catalogue) }
    }

    /// The number of tokens.
    pub fn count(&self) -> usize {
        self.good.read().unwrap_or_else(PoisonError::into_inner).len()
    }

    /// Returns the present usage of each token.
    pub fn usage(&self) -> Vec<TokenUsage> {
        self.good.read().unwrap_or_else(PoisonError::into_inner).iter().map(|token| token.usage()).collect()
    }

    /// Replaces the tokens with the tokens in `text`, the new contents of the token file. A token whose name, digest
    /// and role are unchanged keeps its sessions; all other old tokens are revoked.
    ///
    /// # Errors
    /// [`TokenFileError`], if the text is invalid; the tokens are unchanged then.
    pub fn reload(&self, text: &str) -> Result<(), TokenFileError> {
        let listed = token_file::parse(&self.catalogue, text)?;
        let mut tokens = self.good.write().unwrap_or_else(PoisonError::into_inner);
        let mut renewed = Vec::with_capacity(listed.len());
        for ParsedToken { digest, entry, role } in listed {
            let TokenEntry { name, max_sessions, max_envs, max_steps_per_second, max_bytes, .. } = entry;
            // A new token of the same name shares the quotas of the previous one, which may still be in use.
            let before = tokens.iter().find(|token| token.name == name);
            let quotas = before.map_or_else(Default::default, |token| Arc::clone(&token.quotas));
            quotas.sessions.set_limit(max_sessions);
            quotas.envs.set_limit(max_envs);
            quotas.bytes.set_limit(max_bytes);
            quotas.rate_limiter.set_rate(max_steps_per_second);
            renewed.push(match before.filter(|token| token.digest == digest && token.role == role) {
                Some(token) => Arc::clone(token),
                None => Arc::new(Token {
                    name,
                    digest,
                    role,
                    revoked: AtomicBool::new(false),
                    revoked_notify: Notify::new(),
                    quotas,
                }),
            });
        }
        let gone = |token: &&Bearer| !renewed.iter().any(|kept| Arc::ptr_eq(kept, token));
        tokens.iter().filter(gone).for_each(|token| token.revoke());
        *tokens = renewed;
        Ok(())
    }

    /// Returns the token whose digest matches the text `shown`. Compares all digests, each in constant time.
    fn find(&self, shown: &[u8]) -> Option<Bearer> {
        let digest: [u8; 32] = Sha256::digest(shown).into();
        let tokens = self.good.read().unwrap_or_else(PoisonError::into_inner);
        let fits = |token: &Bearer| bool::from(token.digest.ct_eq(&digest));
        tokens.iter().fold(None, |found, token| if fits(token) { Some(token) } else { found }).cloned()
    }

    /// Returns the token of a call. Returns `None` for calls over a Unix socket, which need no token.
    ///
    /// # Errors
    /// [`Error::NoToken`] if the call has no token, [`Error::WrongToken`] if its token is unknown.
    fn authenticate(&self, request: &http::Request<Body>) -> Result<Option<Bearer>, Error> {
        let peer = request.extensions().get::<ConnectionHandle>().map(|connection| connection.peer);
        if matches!(peer, Some(Peer::User(_))) {
            return Ok(None);
        }
        let header = request.headers().get(http::header::AUTHORIZATION).ok_or(Error::NoToken)?.as_bytes();
        let (scheme, token) = header.split_at_checked("Bearer ".len()).ok_or(Error::NoToken)?;
        if !scheme.eq_ignore_ascii_case(b"Bearer ") {
            return Err(Error::NoToken);
        }
        let bearer = self.find(token).ok_or(Error::WrongToken)?;
        tracing::debug!(token = bearer.name(), path = request.uri().path(), ?peer, "a call");
        Ok(Some(bearer))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    const SECRET: &str = "correct-horse-battery";

    fn tokens_of(text: &str) -> Result<Tokens, TokenFileError> {
        let tokens = Tokens::new(crate::tasks::catalogue());
        tokens.reload(text).map(|()| tokens)
    }

    fn file(token: &str, more: &str) -> String {
        format!("[[token]]\nname = \"ann\"\ntoken = \"{token}\"\n{more}")
    }

    #[test]
    fn a_token_is_found_by_its_text_or_digest() {
        let (token, entry) = new_token("bob \"the\" builder").unwrap();
        let tokens = tokens_of(&(entry + &file(SECRET, ""))).unwrap();
        let name = |shown: &str| tokens.find(shown.as_bytes()).map(|token| token.name().to_owned());
        assert_eq!(name(SECRET).as_deref(), Some("ann"));
        assert_eq!(name(&token).as_deref(), Some("bob \"the\" builder"));
        assert_eq!(name(&SECRET[1..]), None);
        assert_eq!(name(""), None);
        assert_eq!(tokens.count(), 2);
    }

    #[rstest]
    #[case::not_toml("[[token]]\nname =", 2, "not valid TOML")]
    #[case::unknown_key("# a\n[[token]]\nname = \"ann\"\ntokn = \"x\"", 4, "unknown field `tokn`")]
    #[case::no_name("[[token]]\ntoken = \"correct-horse-battery\"", 1, "missing field `name`")]
    #[case::neither("\n\n[[token]]\nname = \"ann\"", 3, "neither")]
    #[case::both(&file(SECRET, "sha256 = \"00\""), 1, "both")]
    #[case::no_digest("[[token]]\nname = \"ann\"\nsha256 = \"correct-horse-battery\"", 1, "64 hexadecimal")]
    #[case::short(&file("correct-horse", ""), 1, "fewer than 16")]
    #[case::spaces(&file("correct horse battery", ""), 1, "visible")]
    #[case::no_number(&file(SECRET, "max_envs = \"correct-horse-battery\""), 4, "a value is invalid")]
    #[case::empty(&file(SECRET, "max_envs = 0"), 1, "leave the token out")]
    #[case::no_bytes(&file(SECRET, "max_bytes = 0"), 1, "leave the token out")]
    #[case::no_steps(&file(SECRET, "max_steps_per_second = 0"), 1, "leave the token out")]
    #[case::too_many_steps(&file(SECRET, "max_steps_per_second = 5000000000"), 4, "a value is invalid")]
    #[case::twice(&(file(SECRET, "") + &file("another-horse-battery", "")), 4, "two tokens called \"ann\"")]
    #[case::shared(&(file(SECRET, "") + &file(SECRET, "").replace("ann", "bob")), 4, "of another entry")]
    fn invalid_file_is_refused_with_line_but_not_token(#[case] text: &str, #[case] line: usize, #[case] part: &str) {
        let wrong = tokens_of(text).err().unwrap();
        assert_eq!(wrong.line, line, "{wrong}");
        let words = wrong.to_string();
        assert!(words.contains(part) && words.contains("expected [[token]]"), "{words}");
        assert!(!words.contains("correct"), "it tells the token: {words}");
    }

    #[test]
    fn a_new_file_revokes_and_a_broken_one_changes_nothing() {
        let tokens = tokens_of(&file(SECRET, "max_envs = 8\nmax_sessions = 1")).unwrap();
        let ann = tokens.find(SECRET.as_bytes()).unwrap();
        let mut held = ann.envs(6).unwrap();
        assert!(ann.envs(3).is_err());
        held.release(1);
        assert!(ann.envs(3).is_ok());
        assert!(tokens.reload("[[token]]").is_err());
        assert!(tokens.find(SECRET.as_bytes()).is_some() && !ann.is_revoked());
        tokens.reload(&file(SECRET, "max_envs = 10")).unwrap();
        assert!(!ann.is_revoked() && ann.envs(6).is_err() && ann.envs(5).is_ok(), "what it has is remembered");
        let first = ann.session().unwrap();
        assert!(ann.session().is_ok(), "that quota is gone");
        let renewed = file("another-horse-battery", "max_envs = 10");
        tokens.reload(&renewed).unwrap();
        let new = tokens.find(b"another-horse-battery").unwrap();
        assert!(ann.is_revoked() && new.envs(6).is_err() && new.envs(5).is_ok(), "the quota is the name's");
        tokens.reload("").unwrap();
        assert!(new.is_revoked() && tokens.find(SECRET.as_bytes()).is_none());
        drop((first, held));
        assert_eq!((ann.usage().envs, ann.usage().sessions), (0, 0));
    }
}
