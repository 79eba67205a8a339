//! Reasons for rejecting a token, or a request that was made with it.

use crate::server::error::{ErrorKind, RequestError};

/// Why a token was rejected, or why a request exceeds the limits of its token.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A call has no token, but this server requires one.
    #[error(
        "this server requires a token, and none was sent; ask its operator for one, and name the file that has it in \
         PERTURB_TOKEN_FILE, or send it as the metadata `authorization: Bearer TOKEN`"
    )]
    NoToken,
    /// A call has a token that this server does not know.
    #[error("this server does not know the token that was sent; ask its operator for a valid one")]
    WrongToken,
    /// The session's token was removed from the token file, or its role was changed there.
    #[error("the token {name:?} was revoked, or has another role now; ask the operator of this server")]
    RevokedToken {
        /// The token's name.
        name: String,
    },
    /// The request would exceed one of the token's quotas.
    #[error(
        "the token {name:?} may have {limit} {what} here, and {wanted} more would be too many; ask for less, or \
         close a session"
    )]
    QuotaExceeded {
        /// The token's name.
        name: String,
        /// The amount that was requested.
        wanted: usize,
        /// The maximum amount for the token.
        limit: usize,
        /// The unit: sessions, environments or bytes in flight.
        what: &'static str,
    },
    /// The token's sessions have run more steps than its rate allows, and would have to wait for too long.
    #[error(
        "the token {name:?} may take {rate} steps per second here, including the price of other requests, and its \
         sessions are {seconds} s ahead of that; step fewer environments at a time or in fewer sessions, or try \
         again later"
    )]
    TooFast {
        /// The token's name.
        name: String,
        /// The maximum rate, steps per second.
        rate: u32,
        /// The time after which the token's environments may step again, s.
        seconds: u64,
    },
}

impl RequestError for Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::NoToken => ErrorKind::NoToken,
            Self::WrongToken => ErrorKind::WrongToken,
            Self::RevokedToken { .. } => ErrorKind::RevokedToken,
            Self::QuotaExceeded { wanted, limit, .. } if wanted > limit => ErrorKind::MoreThanTokenQuota,
            Self::QuotaExceeded { .. } => ErrorKind::TokenQuota,
            Self::TooFast { .. } => ErrorKind::TokenRate,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::error::ErrorCounters;

    #[test]
    fn each_kind_is_counted_separately() {
        let counters = ErrorCounters::default();
        let of_a_token = |wanted| Error::QuotaExceeded { name: "ann".into(), wanted, limit: 4, what: "sessions" };
        for error in [of_a_token(5), of_a_token(1), of_a_token(4), Error::NoToken] {
            counters.count(error.kind());
        }
        let counted: Vec<_> = counters.counts().filter(|(_, count)| *count > 0).collect();
        let expected = [(ErrorKind::NoToken, 1), (ErrorKind::MoreThanTokenQuota, 1), (ErrorKind::TokenQuota, 2)];
        assert_eq!(counted, expected);
    }
}
