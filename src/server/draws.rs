//! What a session draws from: whether its token's role allows it, and that it stands in the ledger before it happens.

use super::{ledger::Ledger, status::Refusal, tokens::Bearer};
use crate::{
    env::{Distribution, Draw, EnvironmentSpec, Error, saved_draw},
    pool::{Batch, BatchSettings, ResetEntry},
};
use bytes::Bytes;
use perturb_protocol::{
    ledger::{self, Begin, End, Event, Who},
    region::Region,
};

/// Of one session, or one world.
#[derive(Clone)]
pub struct Draws {
    bearer: Option<Bearer>,
    ledger: Option<Ledger>,
    session: u64,
}

/// An environment that begins to draw.
struct Next<'a> {
    draw: Draw,
    distributions: &'a [Distribution],
}

impl Draws {
    /// Of a new session with this token.
    pub fn new(bearer: Option<Bearer>, ledger: Option<Ledger>) -> Self {
        let session = ledger.as_ref().map_or(0, Ledger::session);
        Self { bearer, ledger, session }
    }

    /// Before environments are made.
    ///
    /// # Errors
    /// [`Refusal::NotAllowed`], [`Refusal::NoLedger`]; so the others.
    pub async fn open(&self, settings: &BatchSettings) -> Result<(), Refusal> {
        if self.is_free() {
            return Ok(());
        }
        let begins = settings.groups.iter().map(|group| {
            let draw = Draw {
                seed: group.episodes.seed,
                environment_index: group.episodes.environment_index,
                episode_index: 0,
            };
            (Next { draw, distributions: &group.episodes.distributions }, group.size)
        });
        self.begin(settings.spec, begins, Vec::new()).await
    }

    /// Before environments are reset.
    pub async fn reset(&self, batch: &Batch, entries: &[ResetEntry]) -> Result<(), Refusal> {
        if self.is_free() {
            return Ok(());
        }
        let (mut befores, mut nows) = (Vec::new(), Vec::new());
        for ResetEntry { slot, seed, distributions, .. } in entries {
            if seed.is_none() && distributions.is_none() {
                continue; // it goes on as before
            }
            let before = batch.draw(*slot);
            let next = match *seed {
                Some(seed) => Draw { seed, episode_index: 0, ..before },
                None => Draw { episode_index: before.episode_index + 1, ..before },
            };
            befores.push(before);
            let same = || batch.distributions(*slot);
            nows.push((next, distributions.as_ref().map_or_else(same, |new| new.to_vec())));
        }
        if befores.is_empty() {
            return Ok(());
        }
        let begins = nows.iter().map(|(draw, distributions)| (Next { draw: *draw, distributions }, 1));
        self.begin(batch.settings().spec, begins, befores).await
    }

    /// Before environments are restored.
    pub async fn restore(&self, batch: &Batch, entries: &[(usize, Bytes)]) -> Result<(), Refusal> {
        if self.is_free() || entries.is_empty() {
            return Ok(());
        }
        let spec = batch.settings().spec;
        let saved: Result<Vec<_>, Error> = entries.iter().map(|(_, snapshot)| saved_draw(spec, snapshot)).collect();
        let mut nows = Vec::new();
        for saved in saved? {
            let boxes = saved.distributions.chunks(spec.parameters.len().max(1));
            let are_drawn =
                |of_box: &[Distribution]| of_box.iter().zip(&saved.values).all(|(set, value)| set.contains(*value));
            if !boxes.clone().any(are_drawn) {
                // A client wrote them into the snapshot: they hold until the trial ends.
                nows.push((saved.draw, saved.values.iter().copied().map(Distribution::fixed).collect()));
            }
            nows.push((saved.draw, saved.distributions));
        }
        let befores = entries.iter().map(|(slot, _)| batch.draw(*slot)).collect();
        let begins = nows.iter().map(|(draw, distributions)| (Next { draw: *draw, distributions }, 1));
        self.begin(spec, begins, befores).await
    }

    /// Before environments are freed that a session gives back.
    pub fn release(&self, batch: &Batch, slots: &[usize]) {
        if let Some(ledger) = &self.ledger {
            let befores: Vec<Draw> = slots.iter().map(|slot| batch.draw(*slot)).collect();
            ledger.note(self.event(batch.settings().spec, Vec::new(), Vec::new(), &befores));
        }
    }

    /// Has a batch's end written down.
    pub fn follow(&self, batch: &mut Batch) {
        if let Some(ledger) = self.ledger.clone() {
            let (own, spec) = (self.clone(), batch.settings().spec);
            batch.when_freed(Box::new(move |befores| ledger.note(own.event(spec, Vec::new(), Vec::new(), &befores))));
        }
    }

    /// Whether a token may draw from there; what is refused is written down.
    pub fn check(&self, spec: &EnvironmentSpec, distributions: &[Distribution]) -> Result<(), Refusal> {
        let Some(role) = self.bearer.as_ref().and_then(|bearer| bearer.role()) else { return Ok(()) };
        let region = spec.region(distributions);
        let Err(reason) = role.check(spec, &region) else { return Ok(()) };
        if let Some(ledger) = &self.ledger {
            ledger.note(Event::Refused { who: self.who(spec), region: region.clone(), reason: reason.clone() });
        }
        Err(Refusal::NotAllowed {
            role: role.name().into(),
            environment: spec.name,
            region: region.to_string(),
            reason,
        })
    }

    /// Whether nothing is asked or written.
    fn is_free(&self) -> bool {
        self.ledger.is_none() && self.bearer.as_ref().is_none_or(|bearer| bearer.role().is_none())
    }

    /// Checks what begins, each for so many environments, and writes it down, with what ends for it.
    async fn begin<'a>(
        &self,
        spec: &EnvironmentSpec,
        begins: impl Iterator<Item = (Next<'a>, usize)>,
        ends: Vec<Draw>,
    ) -> Result<(), Refusal> {
        let mut last: Option<&[Distribution]> = None;
        let (mut regions, mut written): (Vec<Region>, Vec<Begin>) = (Vec::new(), Vec::new());
        for (Next { draw, distributions }, count) in begins {
            if last != Some(distributions) {
                self.check(spec, distributions)?;
                regions.push(spec.region(distributions));
                last = Some(distributions);
            }
            let Draw { seed, environment_index: index, episode_index: episode } = draw;
            let next = Begin { seed, index, count: count as u32, region: regions.len() as u32 - 1, episode };
            match written.last_mut() {
                // Neighbours draw alike.
                Some(last)
                    if (last.seed, last.region, last.episode) == (seed, next.region, episode)
                        && last.index.wrapping_add(last.count) == index =>
                {
                    last.count += next.count;
                }
                _ => written.push(next),
            }
        }
        match &self.ledger {
            Some(ledger) => ledger.write(self.event(spec, regions, written, &ends)).await,
            None => Ok(()),
        }
    }

    fn who(&self, spec: &EnvironmentSpec) -> Who {
        Who {
            session: self.session,
            token: self.bearer.as_ref().map(|bearer| bearer.name().into()),
            environment: spec.name.into(),
            revision: spec.revision,
        }
    }

    fn event(&self, spec: &EnvironmentSpec, regions: Vec<Region>, begins: Vec<Begin>, ended: &[Draw]) -> Event {
        let mut ends: Vec<End> = Vec::new();
        for &Draw { seed, environment_index: index, episode_index: episode } in ended {
            match ends.last_mut() {
                Some(last)
                    if (last.seed, last.episode, last.index.wrapping_add(last.count)) == (seed, episode, index) =>
                {
                    last.count += 1;
                }
                _ => ends.push(End { seed, index, count: 1, episode }),
            }
        }
        Event::Draws(ledger::Draws { who: self.who(spec), regions, begins, ends })
    }
}
