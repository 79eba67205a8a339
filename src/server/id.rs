//! Names that nobody guesses.

use super::error::{ErrorKind, RequestError};

/// 128 random bits.
pub type Id = [u8; 16];

/// There can be no name that nobody guesses.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the system gives no random numbers; ask for no lease, or name a world by the setting world_name")]
pub struct NoRandomness;

impl RequestError for NoRandomness {
    fn kind(&self) -> ErrorKind {
        ErrorKind::NoRandomness
    }
}

/// 128 bits of the system's, which no seed has anything to do with.
///
/// # Errors
/// [`NoRandomness`].
pub fn random() -> Result<Id, NoRandomness> {
    let mut bytes = Id::default();
    let got = rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty());
    if got.is_ok_and(|n| n == bytes.len()) { Ok(bytes) } else { Err(NoRandomness) }
}
