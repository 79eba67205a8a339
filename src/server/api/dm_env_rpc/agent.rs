//! Answers the requests of one `dm_env_rpc.v1` stream, and enforces their legal order.

use super::{
    Error,
    fields::ENVIRONMENT_REQUEST,
    properties,
    runner::Runner,
    settings, specs,
    world::JoinedWorld,
    worlds::{Caller, Worlds},
};
use crate::{
    proto::dm_env_rpc::v1::{
        self as rpc, environment_request::Payload as Request, environment_response::Payload as Response,
    },
    server::{
        auth::Bearer,
        limits::{MAX_BYTES_BEFORE_OPEN, RequestLimits},
        net::access_log::SessionStats,
        session::{
            self,
            admission::Sessions,
            handler::{Reply, SessionHandler},
        },
        shutdown::ShutdownPhase,
        transport::precheck::Field,
    },
};
use std::sync::Arc;

/// The price of `create_world`, in steps: the price of opening a session with one environment in `perturb.v1`.
const WORLD_PRICE: u64 = 17;
/// The price of `reset` and `reset_world`, in steps: the price of beginning a new trial in one environment by a `reset`
/// in `perturb.v1`.
const NEW_TRIAL_PRICE: u64 = 3;
/// The maximum length of a request, bytes. Valid requests are far shorter, because a world has one environment. An
/// invalid request up to this length gets an in-band error; a longer request ends the stream.
const MAX_REQUEST_BYTES: usize = 1 << 20;

/// The state of a client's stream. Dropping the state makes the agent leave its joined world, and frees the worlds that
/// the stream made. A world that another stream's agent has joined is not freed.
pub(super) struct Agent {
    worlds: Arc<Worlds>,
    caller: Caller,
    sessions: Sessions,
    joined: Option<JoinedWorld>,
    stats: SessionStats,
}

impl Agent {
    /// Makes the state of a new stream, which has joined no world.
    pub(super) fn new(worlds: Arc<Worlds>, bearer: Option<Bearer>, sessions: Sessions) -> Self {
        let caller = worlds.caller(bearer);
        Self { worlds, caller, sessions, joined: None, stats: SessionStats::default() }
    }

    async fn create_world(&mut self, request: rpc::CreateWorldRequest) -> Result<rpc::CreateWorldResponse, Error> {
        if self.sessions.phase() != ShutdownPhase::Running {
            return Err(session::Error::Draining.into());
        }
        let (settings, version, ownership) = settings::create(self.worlds.catalogue(), &request.settings)?;
        self.worlds.check_name_is_free(&self.caller, &ownership)?;
        let env_quota = self.caller.envs(1)?;
        let runner = Runner::open(self.worlds.pool(), settings, version, self.worlds.draws(&self.caller)).await?;
        Ok(rpc::CreateWorldResponse { world_name: self.worlds.add(&self.caller, runner, ownership, env_quota)? })
    }

    async fn join_world(&mut self, request: rpc::JoinWorldRequest) -> Result<rpc::JoinWorldResponse, Error> {
        if let Some(joined) = &self.joined {
            return Err(Error::AlreadyJoined { world: joined.world.name().into() });
        }
        settings::check_none("join_world", &request.settings)?;
        let (world, runner) = self.worlds.join(&self.caller, &request.world_name)?;
        // The world is stored before the first `await`: if the client disconnects there, dropping the agent leaves the
        // world.
        let joined = self.joined.insert(JoinedWorld { world, runner });
        self.stats = SessionStats { environment: Some(joined.world.spec().name), envs: 1, ..self.stats };
        joined.runner.finish_abandoned().await;
        Ok(rpc::JoinWorldResponse { specs: Some(specs::action_observation_specs(joined.world.spec())) })
    }

    async fn step(&mut self, request: rpc::StepRequest) -> Result<rpc::StepResponse, Error> {
        let JoinedWorld { world, runner } = self.joined("step")?;
        specs::check_requested(&request.requested_observations)?;
        let outcome = if runner.is_running() {
            let actions = specs::actions(world.spec(), &request.actions)?;
            let outcome = runner.step(&actions, world.take_interruption()).await?;
            self.stats.steps += 1;
            outcome
        } else {
            let changes = world.take_changes();
            let begun = runner.begin(changes.clone()).await;
            begun.inspect_err(|_| world.restore_changes(changes))?
        };
        Ok(specs::response(&outcome, &request.requested_observations))
    }

    fn reset(&mut self, request: rpc::ResetRequest) -> Result<rpc::ResetResponse, Error> {
        let JoinedWorld { world, runner } = self.joined("reset")?;
        world.change(settings::change(world.spec(), "reset", &request.settings)?)?;
        runner.stop();
        Ok(rpc::ResetResponse { specs: Some(specs::action_observation_specs(world.spec())) })
    }

    fn reset_world(&mut self, request: rpc::ResetWorldRequest) -> Result<rpc::ResetWorldResponse, Error> {
        let world = self.worlds.find_owned(&self.caller, &request.world_name, "reset_world")?;
        world.change(settings::change(world.spec(), "reset_world", &request.settings)?)?;
        match &mut self.joined {
            Some(joined) if joined.world.name() == world.name() => joined.runner.stop(),
            _ => world.interrupt(),
        }
        Ok(rpc::ResetWorldResponse {})
    }

    fn destroy_world(&mut self, request: &rpc::DestroyWorldRequest) -> Result<rpc::DestroyWorldResponse, Error> {
        self.worlds.destroy(&self.caller, &request.world_name)?;
        Ok(rpc::DestroyWorldResponse {})
    }

    fn leave(&mut self) {
        if let Some(JoinedWorld { world, mut runner }) = self.joined.take() {
            runner.stop();
            self.worlds.leave(&self.caller, &world, runner);
        }
    }

    fn joined(&mut self, request: &'static str) -> Result<&mut JoinedWorld, Error> {
        self.joined.as_mut().ok_or(Error::NotJoined { request })
    }
}

impl Drop for Agent {
    fn drop(&mut self) {
        self.leave();
        self.worlds.stream_ended(&self.caller);
    }
}

impl SessionHandler for Agent {
    type Request = rpc::EnvironmentRequest;
    type Response = rpc::EnvironmentResponse;
    type Error = Error;
    const FIELDS: &'static [Field] = ENVIRONMENT_REQUEST;
    const PROTOCOL: &'static str = "dm_env_rpc.v1";
    const KINDS: &'static [&'static str] = &[
        "create_world",
        "join_world",
        "step",
        "reset",
        "reset_world",
        "leave_world",
        "destroy_world",
        "extension",
        "unknown",
    ];
    const RESUMES: Option<fn(&Self::Request) -> bool> = None;

    fn kind(request: &Self::Request) -> &'static str {
        match request.payload {
            Some(Request::CreateWorld(_)) => "create_world",
            Some(Request::JoinWorld(_)) => "join_world",
            Some(Request::Step(_)) => "step",
            Some(Request::Reset(_)) => "reset",
            Some(Request::ResetWorld(_)) => "reset_world",
            Some(Request::LeaveWorld(_)) => "leave_world",
            Some(Request::DestroyWorld(_)) => "destroy_world",
            Some(Request::Extension(_)) => "extension",
            None => "unknown",
        }
    }

    fn request_limits(&self) -> RequestLimits {
        RequestLimits {
            bytes: if self.is_open() { MAX_REQUEST_BYTES } else { MAX_BYTES_BEFORE_OPEN },
            entries: 1,
            covered: 0,
        }
    }

    /// Whether the stream has joined a world, or has made a world that still exists.
    fn is_open(&self) -> bool {
        self.joined.is_some() || self.worlds.has_world_of(&self.caller)
    }

    fn stats(&self) -> SessionStats {
        self.stats
    }

    fn price(&self, request: &Self::Request) -> u64 {
        match request.payload {
            Some(Request::Step(_)) => 0,
            Some(Request::CreateWorld(_)) => WORLD_PRICE,
            Some(Request::Reset(_) | Request::ResetWorld(_)) => NEW_TRIAL_PRICE,
            _ => 1,
        }
    }

    /// Does nothing: the worlds that the stream made are freed when the agent is dropped.
    async fn close(&mut self) {}

    async fn answer(&mut self, request: Self::Request) -> Result<Reply<Self::Response>, Error> {
        let response = match request.payload {
            Some(Request::CreateWorld(create)) => self.create_world(create).await.map(Response::CreateWorld),
            Some(Request::JoinWorld(join)) => self.join_world(join).await.map(Response::JoinWorld),
            Some(Request::Step(step)) => self.step(step).await.map(Response::Step),
            Some(Request::Reset(reset)) => self.reset(reset).map(Response::Reset),
            Some(Request::ResetWorld(reset)) => self.reset_world(reset).map(Response::ResetWorld),
            Some(Request::LeaveWorld(_)) => {
                self.leave();
                Ok(Response::LeaveWorld(rpc::LeaveWorldResponse {}))
            }
            Some(Request::DestroyWorld(destroy)) => self.destroy_world(&destroy).map(Response::DestroyWorld),
            Some(Request::Extension(any)) => {
                properties::answer(self.worlds.catalogue(), self.joined.as_ref(), &any).map(Response::Extension)
            }
            None => {
                let expected = "create_world, join_world, step, …";
                Err(Error::value("request", "empty or of a kind this server does not know", expected))
            }
        };
        response.map(|payload| Reply::new(rpc::EnvironmentResponse { payload: Some(payload) }))
    }

    /// Returns `None`: a world has one environment, whose steps mostly run on the calling thread. Pipelining would gain
    /// little.
    fn pipeline(&self, _request: &Self::Request) -> Option<impl FnOnce(Self::Request) + Send + use<>> {
        None::<fn(Self::Request)>
    }

    fn error_response(error: Error) -> Self::Response {
        rpc::EnvironmentResponse { payload: Some(Response::Error(error.into())) }
    }
}
