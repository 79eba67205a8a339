//! Audits a session's draws of parameters: the token's role must allow each draw, and the ledger records it before it
//! happens.

use super::{
    Error,
    ledger::{Ledger, line_bytes},
};
use crate::{
    env::{self, Distribution, Draw, EnvironmentSpec, saved_draw},
    pool::{Batch, BatchSettings, ResetEntry},
    server::auth::Bearer,
};
use bytes::Bytes;
use perturb_protocol::{
    ledger::{self, DrawEnd, DrawStart, LedgerEvent, LedgerSession},
    region::Region,
};
use std::sync::{
    Arc,
    atomic::{AtomicU32, Ordering},
};

/// Checks and records the draws of parameters in one session of `perturb.v1` or one world of dm_env_rpc.
#[derive(Clone)]
pub struct DrawAuditor {
    bearer: Option<Bearer>,
    ledger: Option<Ledger>,
    session: u64,
    /// The number of draws that were refused so far.
    refused: Arc<AtomicU32>,
}

/// The maximum number of refusals of one session that the ledger records. Without this limit, a client could fill the
/// ledger by repeating a refused request.
const MAX_LOGGED_REFUSALS: u32 = 100;

/// The number of bytes of a ledger line that are charged as one step.
const LINE_BYTES_PER_STEP: usize = 16;

/// Draws that the ledger has recorded before they happen. If the draws then do not happen, the ledger must record this
/// as well.
#[derive(Default)]
pub struct PendingDraws(Vec<DrawStart>);

impl PendingDraws {
    /// Returns ledger entries that say that none of these draws happened.
    fn withdraw(self) -> Vec<DrawEnd> {
        self.0
            .into_iter()
            .map(|DrawStart { seed, index, count, .. }| DrawEnd { seed, index, count, episode: None })
            .collect()
    }
}

/// The next draw of an environment, and the distributions of its parameters.
#[derive(Clone, Copy)]
struct NextDraw<'a> {
    draw: Draw,
    distributions: &'a [Distribution],
}

impl DrawAuditor {
    /// Makes the auditor of a new session or world. `bearer` is the token of the session, or of the stream that makes
    /// the world; `None` if there is no token. `ledger` is `None` if the server has no ledger.
    pub fn new(bearer: Option<Bearer>, ledger: Option<Ledger>) -> Self {
        let session = ledger.as_ref().map_or(0, Ledger::session);
        Self { bearer, ledger, session, refused: Arc::default() }
    }

    /// Checks and records the draws of environments that a session is about to create.
    ///
    /// # Errors
    /// [`Error::NotAllowed`] if the role forbids a draw, [`Error::NoLedger`] if the ledger cannot be written,
    /// [`Error::Value`] if the ledger's line would be too long.
    pub async fn open(&self, settings: &BatchSettings) -> Result<PendingDraws, Error> {
        if self.is_exempt() {
            return Ok(PendingDraws::default());
        }
        let begins = settings.groups.iter().map(|group| {
            let draw = Draw {
                seed: group.episodes.seed,
                environment_index: group.episodes.environment_index,
                episode_index: 0,
            };
            (NextDraw { draw, distributions: &group.episodes.distributions }, group.size)
        });
        self.begin(settings.spec, begins, Vec::new()).await
    }

    /// Checks and records the draws of environments that are about to be reset.
    pub async fn reset(&self, batch: &Batch, entries: &[ResetEntry]) -> Result<PendingDraws, Error> {
        if self.is_exempt() {
            return Ok(PendingDraws::default());
        }
        let mut previous = Vec::new();
        let mut starts: Vec<(Draw, Arc<[Distribution]>)> = Vec::new();
        for ResetEntry { slot, seed, distributions, .. } in entries {
            if seed.is_none() && distributions.is_none() {
                continue; // the reset continues the current sequence of draws
            }
            let before = batch.draw(*slot);
            let next = match *seed {
                Some(seed) => Draw { seed, episode_index: 0, ..before },
                None => Draw { episode_index: before.episode_index + 1, ..before },
            };
            previous.push(before);
            let same = || batch.distributions(*slot);
            starts.push((next, distributions.as_ref().map_or_else(same, Arc::clone)));
        }
        if previous.is_empty() {
            return Ok(PendingDraws::default());
        }
        let begins = starts.iter().map(|(draw, distributions)| (NextDraw { draw: *draw, distributions }, 1));
        self.begin(batch.settings().spec, begins, previous).await
    }

    /// Checks and records the draws of environments that are about to be restored.
    pub async fn restore(&self, batch: &Batch, entries: &[(usize, Bytes)]) -> Result<PendingDraws, Error> {
        if self.is_exempt() || entries.is_empty() {
            return Ok(PendingDraws::default());
        }
        let spec = batch.settings().spec;
        let saved: Result<Vec<_>, env::Error> =
            entries.iter().map(|(_, snapshot)| saved_draw(spec, snapshot)).collect();
        let mut starts: Vec<(Draw, Arc<[Distribution]>)> = Vec::new();
        for saved in saved? {
            let boxes = saved.distributions.chunks(spec.parameters.len().max(1));
            let are_drawn =
                |of_box: &[Distribution]| of_box.iter().zip(&saved.values).all(|(set, value)| set.contains(*value));
            if !boxes.clone().any(are_drawn) {
                // The snapshot's parameters cannot have come from its distributions, so the client may have forged the
                // snapshot. The parameters stay in force until the trial ends, so they are checked like a draw.
                starts.push((saved.draw, saved.values.iter().copied().map(Distribution::fixed).collect()));
            }
            starts.push((saved.draw, saved.distributions.into()));
        }
        let previous = entries.iter().map(|(slot, _)| batch.draw(*slot)).collect();
        let begins = starts.iter().map(|(draw, distributions)| (NextDraw { draw: *draw, distributions }, 1));
        self.begin(spec, begins, previous).await
    }

    /// Records that the draws of `pending` did not happen, because the environments could not be created.
    pub fn open_failed(&self, spec: &EnvironmentSpec, pending: PendingDraws) {
        self.note(spec, Vec::new(), Vec::new(), pending.withdraw());
    }

    /// Records that the draws of `pending` did not happen, because the environments in `slots` could not be restored.
    /// These environments continue as before.
    pub fn restore_failed(&self, batch: &Batch, slots: &[usize], pending: PendingDraws) {
        let spec = batch.settings().spec;
        let previous: Vec<_> = slots.iter().map(|slot| (batch.draw(*slot), batch.distributions(*slot))).collect();
        let begins = previous.iter().map(|(draw, distributions)| (NextDraw { draw: *draw, distributions }, 1));
        let (regions, begins) = group_begins(spec, begins);
        self.note(spec, regions, begins, pending.withdraw());
    }

    /// Records that the environments in `slots`, which the session is about to release, end their draws.
    pub fn release(&self, batch: &Batch, slots: &[usize]) {
        if self.ledger.is_some() {
            let previous = slots.iter().map(|slot| batch.draw(*slot));
            self.note(batch.settings().spec, Vec::new(), Vec::new(), group_ends(previous));
        }
    }

    /// Arranges that the ledger records the end of the batch's draws when the batch is dropped.
    pub fn record_drop(&self, batch: &mut Batch) {
        if self.ledger.is_some() {
            let (own, spec) = (self.clone(), batch.settings().spec);
            let record = move |previous: Vec<Draw>| own.note(spec, Vec::new(), Vec::new(), group_ends(previous));
            batch.when_freed(Box::new(record));
        }
    }

    /// Checks that the token's role allows draws from these distributions. Records a refusal in the ledger.
    pub fn check(&self, spec: &EnvironmentSpec, distributions: &[Distribution]) -> Result<(), Error> {
        let Some(role) = self.bearer.as_ref().and_then(|bearer| bearer.role()) else { return Ok(()) };
        let region = spec.region(distributions);
        let Err(reason) = role.check(spec, &region) else { return Ok(()) };
        if let Some(ledger) = &self.ledger
            && self.refused.fetch_add(1, Ordering::Relaxed) < MAX_LOGGED_REFUSALS
        {
            self.write_later(
                ledger,
                LedgerEvent::Refused { who: self.ledger_session(spec), region: region.clone(), reason: reason.clone() },
            );
        }
        Err(Error::NotAllowed { role: role.name().into(), environment: spec.name, region: region.to_string(), reason })
    }

    /// Charges the token for a ledger line of `bytes` bytes, so that the token's rate also limits the growth of the
    /// ledger.
    fn charge_line(&self, bytes: usize) {
        if let Some(bearer) = &self.bearer {
            bearer.charge(0, bytes.div_ceil(LINE_BYTES_PER_STEP) as u64);
        }
    }

    fn write_later(&self, ledger: &Ledger, event: LedgerEvent) {
        self.charge_line(line_bytes(&event));
        ledger.write_later(event);
    }

    /// Whether draws need neither a check nor a record.
    fn is_exempt(&self) -> bool {
        self.ledger.is_none() && self.bearer.as_ref().is_none_or(|bearer| bearer.role().is_none())
    }

    /// Checks draws that are about to begin, and records them, with the draws that they replace (`ends`), in one ledger
    /// line. Each item of `begins` stands for one or more successive environments: the draw of the first one, and their
    /// number.
    async fn begin<'a>(
        &self,
        spec: &EnvironmentSpec,
        begins: impl Iterator<Item = (NextDraw<'a>, usize)> + Clone,
        ends: Vec<Draw>,
    ) -> Result<PendingDraws, Error> {
        let mut last: Option<&[Distribution]> = None;
        for (NextDraw { distributions, .. }, _) in begins.clone() {
            if !last.replace(distributions).is_some_and(|last| is_same(last, distributions)) {
                self.check(spec, distributions)?;
            }
        }
        let Some(ledger) = &self.ledger else { return Ok(PendingDraws::default()) };
        let (regions, begins) = group_begins(spec, begins);
        let pending = PendingDraws(begins.clone());
        let bytes = ledger.write(self.event(spec, regions, begins, group_ends(ends))).await?;
        self.charge_line(bytes);
        Ok(pending)
    }

    fn note(&self, spec: &EnvironmentSpec, regions: Vec<Region>, begins: Vec<DrawStart>, ends: Vec<DrawEnd>) {
        if let Some(ledger) = &self.ledger {
            self.write_later(ledger, self.event(spec, regions, begins, ends));
        }
    }

    fn ledger_session(&self, spec: &EnvironmentSpec) -> LedgerSession {
        LedgerSession {
            session: self.session,
            token: self.bearer.as_ref().map(|bearer| bearer.name().into()),
            environment: spec.name.into(),
            revision: spec.revision,
        }
    }

    fn event(
        &self,
        spec: &EnvironmentSpec,
        regions: Vec<Region>,
        begins: Vec<DrawStart>,
        ends: Vec<DrawEnd>,
    ) -> LedgerEvent {
        LedgerEvent::Draws(ledger::DrawRecord { who: self.ledger_session(spec), regions, begins, ends })
    }
}

/// Whether two lists of distributions are equal. Environments mostly share a list, which is not compared then.
fn is_same(one: &[Distribution], other: &[Distribution]) -> bool {
    std::ptr::eq(one, other) || one == other
}

/// Groups successive environments that begin draws of the same seed, region and episode. Returns the regions and the
/// groups. A group refers to its region by index.
fn group_begins<'a>(
    spec: &EnvironmentSpec,
    begins: impl Iterator<Item = (NextDraw<'a>, usize)>,
) -> (Vec<Region>, Vec<DrawStart>) {
    let mut last: Option<&[Distribution]> = None;
    let (mut regions, mut group_begins): (Vec<Region>, Vec<DrawStart>) = (Vec::new(), Vec::new());
    for (NextDraw { draw, distributions }, count) in begins {
        if !last.replace(distributions).is_some_and(|last| is_same(last, distributions)) {
            regions.push(spec.region(distributions));
        }
        let Draw { seed, environment_index: index, episode_index: episode } = draw;
        let region = regions.len() as u32 - 1;
        match group_begins.last_mut() {
            Some(last)
                if (last.seed, last.region, last.episode) == (seed, region, episode)
                    && last.index.wrapping_add(last.count) == index =>
            {
                last.count += count as u32;
            }
            _ => group_begins.push(DrawStart { seed, index, count: count as u32, region, episode }),
        }
    }
    (regions, group_begins)
}

/// Groups successive environments that end draws of the same seed and episode.
fn group_ends(draws: impl IntoIterator<Item = Draw>) -> Vec<DrawEnd> {
    let mut group_ends: Vec<DrawEnd> = Vec::new();
    for Draw { seed, environment_index: index, episode_index } in draws {
        let episode = Some(episode_index);
        match group_ends.last_mut() {
            Some(last) if (last.seed, last.episode, last.index.wrapping_add(last.count)) == (seed, episode, index) => {
                last.count += 1;
            }
            _ => group_ends.push(DrawEnd { seed, index, count: 1, episode }),
        }
    }
    group_ends
}
