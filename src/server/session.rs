//! One session: the legal order of its requests, each answered once.

use super::{acting, conversation::Dialogue, convert, requests::Observed, status::Refusal};
use crate::{
    env::Catalogue,
    pool::{Batch, Pool},
    proto::{self, session_request::Request, session_response::Response},
    render::Renderer,
};
use std::sync::Arc;

/// What all sessions of a server share.
pub struct Shared {
    /// Where environments run.
    pub pool: Arc<Pool>,
    /// Which there are.
    pub catalogue: Arc<Catalogue>,
    /// The same, as the protocol tells it.
    pub listing: proto::ListEnvironmentsResponse,
    /// What draws them.
    pub renderer: Renderer,
}

/// A client's session. Dropping it frees its environments.
pub struct Session {
    shared: Arc<Shared>,
    batch: Option<Batch>,
}

impl Session {
    /// A session that is not open yet.
    pub fn new(shared: Arc<Shared>) -> Self {
        Self { shared, batch: None }
    }

    async fn open(&mut self, request: proto::Open) -> Result<proto::Opened, Refusal> {
        if self.batch.is_some() {
            return Err(Refusal::AlreadyOpen);
        }
        let autoreset_mode = request.autoreset_mode;
        let most = self.shared.listing.max_batch_size as usize;
        let settings = convert::open(&self.shared.catalogue, most, request)?;
        let observes_parameters = settings.observe_parameters;
        let environment = self.shared.listing.environments.iter().find(|entry| entry.name == settings.spec.name);
        let environment = environment.map(|entry| entry.observed(observes_parameters));
        let (batch, observations, started) = Batch::open(&self.shared.pool, settings).await?;
        self.batch = Some(batch);
        let started = convert::started(started);
        Ok(proto::Opened { environment, observations, started, autoreset_mode, acts: true, observes_parameters })
    }

    async fn step(&mut self, request: proto::Step) -> Result<proto::Stepped, Refusal> {
        let batch = self.opened("step")?;
        convert::actions(batch.settings().spec, batch.size(), &request.actions)?;
        Ok(convert::stepped(batch.step(&request.actions).await?))
    }

    async fn reset(&mut self, request: proto::Reset) -> Result<proto::ResetDone, Refusal> {
        let batch = self.opened("reset")?;
        let entries = convert::reset(batch, request)?;
        let (observations, started) = batch.reset(entries).await?;
        Ok(proto::ResetDone { observations, started: convert::started(started) })
    }

    async fn snapshot(&mut self, request: proto::Snapshot) -> Result<proto::Snapshotted, Refusal> {
        let batch = self.opened("snapshot")?;
        let slots = convert::mask("snapshot.mask", batch.size(), &request.mask)?;
        Ok(proto::Snapshotted { snapshots: batch.snapshot(slots).await? })
    }

    async fn restore(&mut self, request: proto::Restore) -> Result<proto::Restored, Refusal> {
        let batch = self.opened("restore")?;
        let entries = convert::restore(batch.size(), request)?;
        Ok(proto::Restored { observations: batch.restore(entries).await? })
    }

    async fn render(&mut self, request: proto::Render) -> Result<proto::Rendered, Refusal> {
        let batch = self.opened("render")?;
        let (slot, size) = convert::render(batch.size(), request)?;
        let scene = batch.scene(slot)?.ok_or(Refusal::NothingToDraw { slot })?;
        let pixels = self.shared.renderer.draw(scene, size).await?;
        Ok(proto::Rendered { pixels, width: size.width.into(), height: size.height.into() })
    }

    fn release(&mut self, request: &proto::Release) -> Result<proto::Released, Refusal> {
        let batch = self.opened("release")?;
        batch.release(&convert::release(batch.size(), request)?)?;
        Ok(proto::Released {})
    }

    async fn act(&mut self, request: proto::Act) -> Result<proto::Acted, Refusal> {
        let batch = self.opened("act")?;
        let turn = acting::turn(batch, request)?;
        Ok(acting::acted(batch.act(turn).await?))
    }

    fn save_player(&mut self) -> Result<proto::PlayerSaved, Refusal> {
        acting::saved(self.opened("save_player")?)
    }

    fn opened(&mut self, request: &'static str) -> Result<&mut Batch, Refusal> {
        self.batch.as_mut().ok_or(Refusal::NotOpen { request })
    }
}

impl Dialogue for Session {
    type Request = proto::SessionRequest;
    type Response = proto::SessionResponse;

    fn is_open(&self) -> bool {
        self.batch.is_some()
    }

    async fn answer(&mut self, request: Self::Request) -> Self::Response {
        let response = match request.request {
            Some(Request::Open(open)) => self.open(open).await.map(Response::Opened),
            Some(Request::Step(step)) => self.step(step).await.map(Response::Stepped),
            Some(Request::Reset(reset)) => self.reset(reset).await.map(Response::Reset),
            Some(Request::Snapshot(snapshot)) => self.snapshot(snapshot).await.map(Response::Snapshot),
            Some(Request::Restore(restore)) => self.restore(restore).await.map(Response::Restore),
            Some(Request::Render(render)) => self.render(render).await.map(Response::Render),
            Some(Request::Release(release)) => self.release(&release).map(Response::Release),
            Some(Request::Act(act)) => self.act(act).await.map(Response::Act),
            Some(Request::SavePlayer(_)) => self.save_player().map(Response::SavePlayer),
            None => Err(Refusal::value("request", "empty or of a kind this server does not know", "open, step, …")),
        };
        proto::SessionResponse { response: Some(response.unwrap_or_else(|refusal| Response::Error(refusal.into()))) }
    }
}

impl Observed for Session {
    const KINDS: &'static [&'static str] =
        &["open", "step", "reset", "snapshot", "restore", "render", "release", "act", "save_player", "unknown"];

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
            None => "unknown",
        }
    }

    fn refusal(response: &Self::Response) -> Option<&str> {
        match &response.response {
            Some(Response::Error(error)) => Some(&error.message),
            _ => None,
        }
    }
}
