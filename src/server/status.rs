//! Every refusal, and how a client is told of it; [`refusals`](super::refusals) has the code of each.

use super::session::lease;
use crate::{env, pool, proto, render};
use std::borrow::Cow;
use tonic::{Code, Status};

/// Why a request was refused. It changed nothing, but for an act that failed on its way.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Refusal {
    /// The environments refuse it.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The pool refuses it.
    #[error(transparent)]
    Pool(#[from] pool::Error),
    /// There is no picture.
    #[error(transparent)]
    Render(#[from] render::Error),
    /// A session cannot be taken up, or was.
    #[error(transparent)]
    Lease(#[from] lease::Error),
    /// The environment to be drawn has no state.
    #[error("the physics of slot {slot} diverged and left no state to draw; reset it first")]
    NothingToDraw {
        /// The environment's place in the batch.
        slot: usize,
    },
    /// A field has a value that it cannot have.
    #[error("{field} is {got}; expected {expected}")]
    Value {
        /// The field, by its path in the protocol; of dm_env_rpc the setting, action or property.
        field: Cow<'static, str>,
        /// What came.
        got: String,
        /// What would be right, and what to do.
        expected: String,
    },
    /// A request other than `open` on a session that is not open.
    #[error("{request} came before open; send open first")]
    NotOpen {
        /// The request.
        request: &'static str,
    },
    /// A second `open`.
    #[error("open came on a session that is open already; use reset, or start another session")]
    AlreadyOpen,
    /// A request that cannot come now.
    #[error("{request} came {when}; {advice}")]
    Order {
        /// The request.
        request: &'static str,
        /// When it came.
        when: Cow<'static, str>,
        /// What to do.
        advice: &'static str,
    },
    /// The server is full of sessions.
    #[error("all of this server's {limit} sessions are in use; close one, or try again later")]
    TooManySessions {
        /// The most there may be.
        limit: usize,
    },
    /// One peer has all the sessions that it may have.
    #[error("all of the {limit} sessions that one machine or user may have here are in use; close one")]
    TooManyOfAPeer {
        /// The most there may be.
        limit: usize,
    },
    /// A call without a token.
    #[error(
        "this server asks for a token, and none came; ask who runs it for one, and name the file that has it in \
         PERTURB_TOKEN_FILE, or send it as the metadata `authorization: Bearer TOKEN`"
    )]
    NoToken,
    /// A call with a token that is none here.
    #[error("this server does not know the token that came; ask who runs it for one that is good")]
    WrongToken,
    /// The session's token was taken out of the file of tokens.
    #[error("the token {name:?} was revoked, or has another role now; ask who runs this server")]
    RevokedToken {
        /// What it is called.
        name: String,
    },
    /// A token has all that it may have.
    #[error(
        "the token {name:?} may have {limit} {what} here, and {wanted} more would be too many; ask for less, or close"
    )]
    TooManyOfAToken {
        /// What it is called.
        name: String,
        /// What was asked for.
        wanted: usize,
        /// The most there may be.
        limit: usize,
        /// Sessions, environments or bytes in flight.
        what: &'static str,
    },
    /// A token's environments have stepped too fast for too long.
    #[error(
        "the token {name:?} may take {rate} steps a second here, and its sessions are {seconds} s ahead of that; step \
         fewer environments at a time or in fewer sessions, or try again later"
    )]
    TooFast {
        /// What it is called.
        name: String,
        /// The most steps a second.
        rate: u32,
        /// How long until it may step again.
        seconds: u64,
    },
    /// The token's role does not allow it.
    #[error(
        "a token of the role {role:?} may not draw from {region} of {environment}: {reason}; ask for what it may draw \
         from, or who runs this server for another token"
    )]
    NotAllowed {
        /// The role.
        role: String,
        /// The environment.
        environment: &'static str,
        /// What was to be drawn from.
        region: String,
        /// Why not.
        reason: String,
    },
    /// What would be drawn cannot be written down.
    #[error("this server writes down what is drawn, and cannot: {reason}; try again later, or tell who runs it")]
    NoLedger {
        /// Why not.
        reason: String,
    },
    /// The budget of bytes in flight is used up.
    #[error(
        "this needs {wanted} bytes, but {used} of the server's {limit} for what is in flight are in use; ask for less at \
         a time, read the replies that wait, or try again later"
    )]
    NoMemory {
        /// What was asked for.
        wanted: usize,
        /// In use.
        used: usize,
        /// The most there may be.
        limit: usize,
    },
    /// A message began and does not end.
    #[error(
        "a message began, and nothing more of it came for {seconds} s, or less than {rate} bytes a second in all; send \
         messages whole"
    )]
    Unfinished {
        /// The longest pause.
        seconds: u64,
        /// The least bytes a second.
        rate: usize,
    },
    /// A message is larger than its stream may send now.
    #[error("a message of {got} bytes came; at most {limit} are read here now")]
    TooLarge {
        /// Its length in bytes.
        got: usize,
        /// The most there may be.
        limit: usize,
    },
    /// The session sent nothing for too long.
    #[error(
        "the session was idle for {seconds} s, or was not opened in them, the most this server allows; start a new one"
    )]
    Idle {
        /// The limit.
        seconds: u64,
    },
    /// The server takes no new work.
    #[error("this server is shutting down; use another, or try again later")]
    Draining,
    /// dm_env_rpc: nothing has this name.
    #[error("{what} {name} is unknown; {known}")]
    Unknown {
        /// What was looked for: a world, a setting, an action, …
        what: &'static str,
        /// Its name or number, as it came.
        name: String,
        /// What there is.
        known: String,
    },
    /// dm_env_rpc: a request of agents on a stream that is none.
    #[error("{request} came from a stream that has joined no world; send join_world first")]
    NotJoined {
        /// The request.
        request: &'static str,
    },
    /// dm_env_rpc: a second `join_world`.
    #[error("join_world came from a stream that has joined {world:?}; leave that world first, or use another stream")]
    AlreadyJoined {
        /// The world that it has joined.
        world: String,
    },
    /// dm_env_rpc: a world has an agent and must not.
    #[error("world {world:?} has an agent; {request} can be done when the agent has left it")]
    Occupied {
        /// The world.
        world: String,
        /// What was asked for.
        request: &'static str,
    },
    /// dm_env_rpc: a world of others.
    #[error(
        "{request} came from a stream that has neither made world {world:?} nor is its agent; join it first, or have it \
         made with the setting shared"
    )]
    NotYours {
        /// The world.
        world: String,
        /// What was asked for.
        request: &'static str,
    },
    /// dm_env_rpc: the name that was asked for is another world's.
    #[error("a world {world:?} is there already; ask for another name, or for none")]
    Taken {
        /// The name.
        world: String,
    },
    /// There can be no name that nobody guesses.
    #[error("the system gives no random numbers; ask for no lease, or name a world by the setting world_name")]
    NoRandomness,
    /// dm_env_rpc: a property does not allow this.
    #[error("property {key:?} cannot be {access}; list_property tells what each property allows")]
    Forbidden {
        /// The property.
        key: String,
        /// What was asked for, as a participle.
        access: &'static str,
    },
    /// dm_env_rpc: an extension that this server does not have.
    #[error("extension {name:?} is unknown; this server has {known}")]
    UnknownExtension {
        /// The type of the message.
        name: String,
        /// The one that there is.
        known: &'static str,
    },
}

impl Refusal {
    /// A [`Refusal::Value`].
    pub fn value(field: impl Into<Cow<'static, str>>, got: impl ToString, expected: impl ToString) -> Self {
        Self::Value { field: field.into(), got: got.to_string(), expected: expected.to_string() }
    }

    /// The gRPC code of this refusal.
    pub fn code(&self) -> Code {
        self.kind().code()
    }
}

/// The refusal in-band: the session lives on.
impl From<Refusal> for proto::Error {
    fn from(refusal: Refusal) -> Self {
        Self { code: refusal.code() as i32, message: refusal.to_string() }
    }
}

/// The same of dm_env_rpc.
impl From<Refusal> for proto::google::rpc::Status {
    fn from(refusal: Refusal) -> Self {
        Self { code: refusal.code() as i32, message: refusal.to_string(), details: Vec::new() }
    }
}

/// The refusal as the end of a call.
impl From<Refusal> for Status {
    fn from(refusal: Refusal) -> Self {
        Status::new(refusal.code(), refusal.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refused_pictures_say_whose_fault_it_is() {
        let nothing = Refusal::NothingToDraw { slot: 7 };
        assert_eq!(nothing.code(), Code::FailedPrecondition);
        assert!(nothing.to_string().contains("slot 7"), "{nothing}");
        let code = |error: render::Error| Refusal::from(error).code();
        let (environment, reason) = ("Hopper", String::new());
        assert_eq!(code(render::Error::Missing { environment, reason: reason.clone() }), Code::FailedPrecondition);
        assert_eq!(code(render::Error::NoThread { reason: reason.clone() }), Code::ResourceExhausted);
        assert_eq!(code(render::Error::Failed { environment, reason }), Code::Internal);
        assert_eq!(code(render::Error::Defect), Code::Internal);
    }
}
