//! Answers the requests of one `perturb.v1` session, and enforces their legal order.

use super::{Error, convert, fields::SESSION_REQUEST, policy, price::price, sizes};
use crate::{
    env::Catalogue,
    pool::{Batch, Pool},
    proto::{self, session_request::Request, session_response::Response},
    render::Renderer,
    server::{
        audit::{draws::DrawAuditor, ledger::Ledger},
        auth::{Bearer, QuotaGuard},
        limits::{MAX_BYTES_BEFORE_OPEN, RequestLimits},
        net::access_log::SessionStats,
        session::{
            handler::{Reply, SessionHandler, StreamHandover},
            lease::{Leases, MAX_STORED_REPLIES},
        },
        transport::{
            budget::{Budget, MemoryReservation},
            precheck::Field,
        },
    },
};
use bytes::Bytes;
use std::sync::Arc;

/// An upper bound of the length of a `step` request without its actions, bytes.
const STEP_OVERHEAD_BYTES: usize = 32;

/// The parts of a server that all sessions of `perturb.v1` share.
pub struct ServerContext {
    /// The pool that runs the environments.
    pub pool: Arc<Pool>,
    /// The environments that sessions can open.
    pub catalogue: Arc<Catalogue>,
    /// The reply to a call for the catalogue.
    pub listing: proto::ListEnvironmentsResponse,
    /// The renderer that draws pictures of environments.
    pub renderer: Renderer,
    /// The ledger of all draws, if there is one.
    pub ledger: Option<Ledger>,
    /// The leases of sessions that may outlive their streams.
    pub leases: Leases<proto::SessionResponse>,
}

/// The state of a client's session. Dropping it frees its environments.
pub struct Session {
    context: Arc<ServerContext>,
    batch: Option<Batch>,
    bearer: Option<Bearer>,
    /// The guard that takes the session's environments from the quota of its token.
    env_quota: Option<QuotaGuard>,
    draws: DrawAuditor,
    budget: Budget,
    /// An upper bound of the length of one snapshot, bytes. The bound holds until a distribution gets more intervals.
    snapshot_bytes: usize,
    /// The memory reserved for the requests and replies of steps.
    step_memory: Option<MemoryReservation>,
    /// The memory reserved for the current policy's weights.
    weights_memory: Option<MemoryReservation>,
    /// The memory reserved for the current policy's activations. New weights for the same policy do not change this
    /// reservation.
    activations_memory: Option<MemoryReservation>,
}

impl Session {
    /// Makes a session that is not open yet. The session will reserve memory in `budget`.
    pub fn new(context: Arc<ServerContext>, bearer: Option<Bearer>, budget: Budget) -> Self {
        let draws = DrawAuditor::new(bearer.clone(), context.ledger.clone());
        Self {
            context,
            batch: None,
            bearer,
            env_quota: None,
            draws,
            budget,
            snapshot_bytes: 0,
            step_memory: None,
            weights_memory: None,
            activations_memory: None,
        }
    }

    async fn open(&mut self, request: proto::Open) -> Result<SessionReply, Error> {
        if self.batch.is_some() {
            return Err(Error::AlreadyOpen);
        }
        let (autoreset_mode, unanswered) = (request.autoreset_mode, request.lease);
        if unanswered > MAX_STORED_REPLIES {
            return Err(Error::value(
                "open.lease",
                unanswered,
                format!("a number of unanswered requests, 0 … {MAX_STORED_REPLIES}"),
            ));
        }
        // Check the settings, and describe the environment as this session sees it.
        let max_envs = self.context.listing.max_batch_size as usize;
        let settings = convert::open(&self.context.catalogue, max_envs, request)?;
        let (observes_parameters, receipt_arrays) = (settings.observe_parameters, settings.receipt_arrays);
        let environment = self.context.listing.environments.iter().find(|entry| entry.name == settings.spec.name);
        let environment = environment.map(|entry| {
            let is_disturbed = settings.spec.parameters.len() > entry.parameters.len();
            let opened = if is_disturbed { entry.disturbed() } else { entry.clone() };
            opened.observed(observes_parameters)
        });
        // Reserve memory and quota, record the draws, create the environments.
        let envs = settings.size();
        // A batch larger than the pool gets no reservation: the pool then refuses it with a better message.
        let step_memory =
            (envs <= max_envs).then(|| self.budget.reserve(sizes::session(&settings, envs))).transpose()?;
        let env_quota = self.bearer.as_ref().map(|bearer| bearer.envs(envs)).transpose()?;
        let (pending, spec) = (self.draws.open(&settings).await?, settings.spec);
        let opened = Batch::open(&self.context.pool, settings).await;
        let (mut batch, observations, started) = opened.inspect_err(|_| self.draws.open_failed(spec, pending))?;
        self.draws.record_drop(&mut batch);
        if let Some(bearer) = &self.bearer {
            bearer.charge(0, envs as u64);
        }
        // Grant a lease, if the client requests one.
        let grant = match unanswered {
            0 => None,
            unanswered => self.context.leases.grant(self.bearer.clone(), unanswered as usize)?,
        };
        let lease = grant.as_ref().map_or_else(Bytes::new, |grant| Bytes::copy_from_slice(&grant.name));
        let lease_seconds = grant.as_ref().map_or(0, |grant| grant.time().as_secs() as u32);
        // Build the reply.
        let started = convert::started(started);
        let acts = true;
        let max_step_reply_bytes = environment
            .as_ref()
            .map_or(0, |environment| sizes::max_step_reply_bytes(batch.settings(), environment, envs) as u64);
        self.snapshot_bytes = batch.max_snapshot_bytes();
        let max_snapshot_reply_bytes = sizes::max_snapshot_reply_bytes(envs, self.snapshot_bytes) as u64;
        let opened = proto::Opened {
            environment,
            observations,
            started,
            autoreset_mode,
            acts,
            observes_parameters,
            receipt_arrays,
            lease,
            lease_seconds,
            max_step_reply_bytes,
            max_snapshot_reply_bytes,
            supports_contexts: true,
        };
        (self.batch, self.step_memory, self.env_quota) = (Some(batch), step_memory, env_quota);
        Ok(Reply { handover: grant.map(StreamHandover::Lease), ..reply(Response::Opened(opened)) })
    }

    async fn step(&mut self, request: proto::Step) -> Result<SessionReply, Error> {
        let batch = self.opened("step")?;
        convert::actions(batch.settings().spec, batch.size(), &request.actions)?;
        let stepped = batch.step(&request.actions).await?;
        self.forget_policy();
        Ok(reply(Response::Stepped(convert::stepped(stepped))))
    }

    async fn reset(&mut self, request: proto::Reset) -> Result<SessionReply, Error> {
        let batch = self.batch.as_mut().ok_or(Error::NotOpen { request: "reset" })?;
        let entries = convert::reset(batch, request)?;
        self.draws.reset(batch, &entries).await?;
        let (observations, started) = batch.reset(entries).await?;
        self.forget_policy();
        Ok(reply(Response::Reset(proto::ResetDone { observations, started: convert::started(started) })))
    }

    async fn snapshot(&mut self, request: proto::Snapshot) -> Result<SessionReply, Error> {
        let batch = self.opened("snapshot")?;
        let slots = convert::mask("snapshot.mask", batch.size(), &request.mask)?;
        let bytes = sizes::max_snapshot_reply_bytes(slots.len(), self.snapshot_bytes);
        let mut reservation = self.budget.reserve(bytes)?;
        let batch = self.opened("snapshot")?;
        let snapshots = batch.snapshot(slots).await?;
        reservation.resize(sizes::snapshot_bytes(&snapshots));
        Ok(Reply { memory: Some(reservation), ..reply(Response::Snapshot(proto::Snapshotted { snapshots })) })
    }

    async fn restore(&mut self, request: proto::Restore) -> Result<SessionReply, Error> {
        let batch = self.batch.as_mut().ok_or(Error::NotOpen { request: "restore" })?;
        let entries = convert::restore(batch.size(), request)?;
        let pending = self.draws.restore(batch, &entries).await?;
        let slots: Vec<usize> = entries.iter().map(|(slot, _)| *slot).collect();
        let observations = match batch.restore(entries).await {
            Ok(observations) => observations,
            Err(error) => {
                self.draws.restore_failed(batch, &slots, pending);
                return Err(error.into());
            }
        };
        self.forget_policy();
        Ok(reply(Response::Restore(proto::Restored { observations })))
    }

    async fn render(&mut self, request: proto::Render) -> Result<SessionReply, Error> {
        let batch = self.opened("render")?;
        let (slot, size) = convert::render(batch.size(), request)?;
        let scene = batch.scene(slot)?.ok_or(Error::NothingToDraw { slot })?;
        let reservation = self.budget.reserve(sizes::picture(size))?;
        let pixels = self.context.renderer.draw(scene, size).await?;
        let rendered = proto::Rendered { pixels, width: size.width.into(), height: size.height.into() };
        Ok(Reply { memory: Some(reservation), ..reply(Response::Render(rendered)) })
    }

    async fn release(&mut self, request: proto::Release) -> Result<SessionReply, Error> {
        let batch = self.batch.as_mut().ok_or(Error::NotOpen { request: "release" })?;
        let slots = convert::release(batch.size(), &request)?;
        self.draws.release(batch, &slots);
        batch.release(&slots).await?;
        self.forget_policy();
        if let Some(env_quota) = &mut self.env_quota {
            env_quota.release(slots.len());
        }
        Ok(reply(Response::Release(proto::Released {})))
    }

    async fn act(&mut self, request: proto::Act) -> Result<SessionReply, Error> {
        let batch = self.batch.as_mut().ok_or(Error::NotOpen { request: "act" })?;
        let reserve = |bytes: usize| (bytes > 0).then(|| self.budget.reserve(bytes)).transpose();
        let weights_memory = reserve(sizes::weights(&request))?;
        let activations_memory = reserve(sizes::activations(&request, batch.size()))?;
        let is_new = request.policy.is_some();
        let rollout = policy::rollout_request(batch, self.bearer.as_ref().and_then(|bearer| bearer.rate()), request)?;
        let reservation = self.budget.reserve(sizes::max_rollout_bytes(&rollout, batch))?;
        self.weights_memory = weights_memory.or(self.weights_memory.take());
        if is_new {
            self.activations_memory = activations_memory;
        }
        let acted = batch.act(rollout).await;
        if batch.policy_runner().is_none() {
            self.forget_policy(); // the policy failed
        }
        let acted = policy::rollout_response(acted?);
        Ok(Reply { memory: Some(reservation), ..reply(Response::Act(acted)) })
    }

    /// Frees the memory that was reserved for the policy, after the batch has discarded the policy.
    fn forget_policy(&mut self) {
        (self.weights_memory, self.activations_memory) = (None, None);
    }

    fn save_player(&mut self) -> Result<SessionReply, Error> {
        Ok(reply(Response::SavePlayer(policy::player_saved(self.opened("save_player")?)?)))
    }

    async fn resume(&mut self, request: proto::Resume) -> Result<SessionReply, Error> {
        if self.batch.is_some() {
            return Err(Error::Order {
                request: "resume",
                when: "on a session that is open".into(),
                advice: "send it as the first request of a new stream",
            });
        }
        let proto::Resume { lease, last_reply } = request;
        let ticket = self.context.leases.resume(&lease, self.bearer.as_ref(), last_reply).await?;
        let resumed = proto::Resumed { last_reply: ticket.last_reply };
        Ok(Reply { handover: Some(StreamHandover::Resume(ticket)), ..reply(Response::Resumed(resumed)) })
    }

    fn opened(&mut self, request: &'static str) -> Result<&mut Batch, Error> {
        self.batch.as_mut().ok_or(Error::NotOpen { request })
    }
}

/// A reply in this protocol.
type SessionReply = Reply<proto::SessionResponse>;

fn reply(response: Response) -> SessionReply {
    Reply::new(proto::SessionResponse { response: Some(response) })
}

impl SessionHandler for Session {
    type Request = proto::SessionRequest;
    type Response = proto::SessionResponse;
    type Error = Error;
    const FIELDS: &'static [Field] = SESSION_REQUEST;
    const PROTOCOL: &'static str = "perturb.v1";
    const KINDS: &'static [&'static str] = &[
        "open",
        "step",
        "reset",
        "snapshot",
        "restore",
        "render",
        "release",
        "act",
        "save_player",
        "resume",
        "unknown",
    ];
    const RESUMES: Option<fn(&Self::Request) -> bool> =
        Some(|request| matches!(request.request, Some(Request::Resume(_))));

    fn kind(request: &Self::Request) -> &'static str {
        match request.request {
            Some(Request::Open(_)) => "open",
            Some(Request::Step(_)) => "step",
            Some(Request::Reset(_)) => "reset",
            Some(Request::Snapshot(_)) => "snapshot",
            Some(Request::Restore(_)) => "restore",
            Some(Request::Render(_)) => "render",
            Some(Request::Release(_)) => "release",
            Some(Request::Act(_)) => "act",
            Some(Request::SavePlayer(_)) => "save_player",
            Some(Request::Resume(_)) => "resume",
            None => "unknown",
        }
    }

    fn request_limits(&self) -> RequestLimits {
        match &self.batch {
            None => {
                let entries = self.context.listing.max_batch_size as usize;
                RequestLimits { bytes: MAX_BYTES_BEFORE_OPEN, entries, covered: 0 }
            }
            Some(batch) => RequestLimits {
                bytes: sizes::max_request_bytes(batch),
                entries: batch.size(),
                covered: sizes::step_request(batch.settings(), batch.size()) + STEP_OVERHEAD_BYTES,
            },
        }
    }

    fn is_open(&self) -> bool {
        self.batch.is_some()
    }

    fn stats(&self) -> SessionStats {
        self.batch.as_ref().map_or_else(SessionStats::default, |batch| SessionStats {
            environment: Some(batch.settings().spec.name),
            envs: batch.settings().size(),
            steps: batch.steps(),
        })
    }

    fn price(&self, request: &Self::Request) -> u64 {
        price(request.request.as_ref(), self.batch.as_ref())
    }

    async fn close(&mut self) {
        if let Some(batch) = self.batch.take() {
            batch.close().await;
        }
        (self.env_quota, self.step_memory) = (None, None);
        self.forget_policy();
    }

    async fn answer(&mut self, request: Self::Request) -> Result<SessionReply, Error> {
        // This future is moved, and it is as large as its largest branch. Boxing all branches but `step` keeps steps
        // cheap.
        match request.request {
            Some(Request::Open(open)) => Box::pin(self.open(open)).await,
            Some(Request::Step(step)) => self.step(step).await,
            Some(Request::Reset(reset)) => Box::pin(self.reset(reset)).await,
            Some(Request::Snapshot(snapshot)) => Box::pin(self.snapshot(snapshot)).await,
            Some(Request::Restore(restore)) => Box::pin(self.restore(restore)).await,
            Some(Request::Render(render)) => Box::pin(self.render(render)).await,
            Some(Request::Release(release)) => Box::pin(self.release(release)).await,
            Some(Request::Act(act)) => Box::pin(self.act(act)).await,
            Some(Request::SavePlayer(_)) => self.save_player(),
            Some(Request::Resume(resume)) => Box::pin(self.resume(resume)).await,
            None => Err(Error::value("request", "empty or of a kind this server does not know", "open, step, …")),
        }
    }

    fn draws_ahead(&self) -> bool {
        self.batch.as_ref().is_some_and(Batch::draws_ahead)
    }

    fn draw_ahead(&mut self) {
        if let Some(batch) = &mut self.batch {
            batch.draw_ahead();
        }
    }

    /// A step may be pipelined behind another step, if [`Batch::step_queue`] allows it and the token has no rate limit.
    fn pipeline(&self, request: &Self::Request) -> Option<impl FnOnce(Self::Request) + Send + use<>> {
        let batch = self.batch.as_ref().filter(|_| matches!(request.request, Some(Request::Step(_))))?;
        let has_no_rate = self.bearer.as_ref().is_none_or(|bearer| bearer.rate().is_none());
        let queue = batch.step_queue().filter(|_| has_no_rate)?;
        Some(move |request: Self::Request| {
            if let Some(Request::Step(proto::Step { actions })) = request.request
                && convert::actions(queue.spec, queue.size, &actions).is_ok()
            {
                queue.enqueue(actions);
            }
        })
    }

    fn error_response(error: Error) -> Self::Response {
        proto::SessionResponse { response: Some(Response::Error(error.into())) }
    }
}
