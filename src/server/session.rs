//! One session: the legal order of its requests, each answered once.

use super::{convert, status::Refusal};
use crate::{
    env::Catalogue,
    pool::{Batch, Pool},
    proto::{self, session_request::Request, session_response::Response},
    render::Renderer,
};
use std::sync::Arc;

/// A client's session. Dropping it frees its environments.
pub struct Session {
    pool: Arc<Pool>,
    catalogue: Arc<Catalogue>,
    listing: Arc<proto::ListEnvironmentsResponse>,
    renderer: Arc<Renderer>,
    batch: Option<Batch>,
}

impl Session {
    /// A session that is not open yet.
    pub fn new(
        pool: Arc<Pool>,
        catalogue: Arc<Catalogue>,
        listing: Arc<proto::ListEnvironmentsResponse>,
        renderer: Arc<Renderer>,
    ) -> Self {
        Self { pool, catalogue, listing, renderer, batch: None }
    }

    /// Whether it owns environments.
    pub fn is_open(&self) -> bool {
        self.batch.is_some()
    }

    /// Answers a request.
    pub async fn answer(&mut self, request: proto::SessionRequest) -> proto::SessionResponse {
        let response = match request.request {
            Some(Request::Open(open)) => self.open(open).await.map(Response::Opened),
            Some(Request::Step(step)) => self.step(step).await.map(Response::Stepped),
            Some(Request::Reset(reset)) => self.reset(reset).await.map(Response::Reset),
            Some(Request::Snapshot(snapshot)) => self.snapshot(snapshot).await.map(Response::Snapshot),
            Some(Request::Restore(restore)) => self.restore(restore).await.map(Response::Restore),
            Some(Request::Render(render)) => self.render(render).await.map(Response::Render),
            None => Err(Refusal::value("request", "empty or of a kind this server does not know", "open, step, …")),
        };
        let response = response.unwrap_or_else(|refusal| {
            tracing::debug!(%refusal, "refused a request");
            Response::Error(refusal.into())
        });
        proto::SessionResponse { response: Some(response) }
    }

    async fn open(&mut self, request: proto::Open) -> Result<proto::Opened, Refusal> {
        if self.batch.is_some() {
            return Err(Refusal::AlreadyOpen);
        }
        let autoreset_mode = request.autoreset_mode;
        let settings = convert::open(&self.catalogue, request)?;
        tracing::debug!(environment = settings.spec.name, batch_size = settings.size, "opening a session");
        let environment = self.listing.environments.iter().find(|entry| entry.name == settings.spec.name).cloned();
        let (batch, observations, started) = Batch::open(&self.pool, settings).await?;
        self.batch = Some(batch);
        Ok(proto::Opened { environment, observations, started: convert::started(started), autoreset_mode })
    }

    async fn step(&mut self, request: proto::Step) -> Result<proto::Stepped, Refusal> {
        let batch = self.opened("step")?;
        convert::actions(batch.settings().spec, batch.settings().size, &request.actions)?;
        Ok(convert::stepped(batch.step(&request.actions).await?))
    }

    async fn reset(&mut self, request: proto::Reset) -> Result<proto::ResetDone, Refusal> {
        let batch = self.opened("reset")?;
        let entries = convert::reset(batch.settings(), request, |slot| batch.distributions(slot))?;
        let (observations, started) = batch.reset(entries).await?;
        Ok(proto::ResetDone { observations, started: convert::started(started) })
    }

    async fn snapshot(&mut self, request: proto::Snapshot) -> Result<proto::Snapshotted, Refusal> {
        let batch = self.opened("snapshot")?;
        let slots = convert::mask("snapshot.mask", batch.settings().size, &request.mask)?;
        Ok(proto::Snapshotted { snapshots: batch.snapshot(slots).await? })
    }

    async fn restore(&mut self, request: proto::Restore) -> Result<proto::Restored, Refusal> {
        let batch = self.opened("restore")?;
        let entries = convert::restore(batch.settings().size, request)?;
        Ok(proto::Restored { observations: batch.restore(entries).await? })
    }

    async fn render(&mut self, request: proto::Render) -> Result<proto::Rendered, Refusal> {
        let batch = self.opened("render")?;
        let (slot, size) = convert::render(batch.settings().size, request)?;
        let scene = batch.scene(slot)?.ok_or(Refusal::NothingToDraw { slot })?;
        let pixels = self.renderer.draw(scene, size).await?;
        Ok(proto::Rendered { pixels, width: size.width.into(), height: size.height.into() })
    }

    fn opened(&mut self, request: &'static str) -> Result<&mut Batch, Refusal> {
        self.batch.as_mut().ok_or(Refusal::NotOpen { request })
    }
}
