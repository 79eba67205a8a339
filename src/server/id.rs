//! Random names that cannot be guessed.

use super::error::{ErrorKind, RequestError};

/// 128 random bits.
pub type Id = [u8; 16];

/// The operating system gives no random bits, so a name could be guessed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the system gives no random numbers; ask for no lease, or name a world by the setting world_name")]
pub struct NoRandomness;

impl RequestError for NoRandomness {
    fn kind(&self) -> ErrorKind {
        ErrorKind::NoRandomness
    }
}

/// Returns 128 random bits of the operating system. They do not depend on any seed.
///
/// # Errors
/// [`NoRandomness`].
pub fn random() -> Result<Id, NoRandomness> {
    let mut bytes = Id::default();
    let got = rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty());
    if got.is_ok_and(|n| n == bytes.len()) { Ok(bytes) } else { Err(NoRandomness) }
}
