//! A training whose server plays: it learns here, between rollouts that are played there.

use std::time::{Duration, Instant};

use super::learning::{Learning, keep_alive};
use super::{Outcome, Result};
use crate::client::{Servers, Session};
use crate::logging::Progress;
use crate::rollout::RemoteCollector;
use perturb_study::interrupt::StopFlag;

/// A training and what its server plays.
pub(super) struct Remote<'a> {
    session: Session<'a>,
    collector: RemoteCollector,
    learning: Learning<'a>,
}

impl<'a> Remote<'a> {
    pub(super) fn new(session: Session<'a>, collector: RemoteCollector, learning: Learning<'a>) -> Self {
        Self { session, collector, learning }
    }

    /// Trains until the training ends.
    ///
    /// # Errors
    /// Whatever ends it early.
    pub(super) fn run(
        mut self,
        servers: &Servers,
        stop: &StopFlag,
        report: &mut dyn FnMut(&Progress),
    ) -> Result<Outcome> {
        loop {
            match self.iterate(servers, stop, report) {
                Ok(None) => {}
                Ok(Some(outcome)) => return Ok(outcome),
                Err(error) => return Err(self.learning.failed(error)),
            }
        }
    }

    /// A rollout and an update.
    fn iterate(
        &mut self,
        servers: &Servers,
        stop: &StopFlag,
        report: &mut dyn FnMut(&Progress),
    ) -> Result<Option<Outcome>> {
        let Self { session, collector, learning } = self;
        let asked = Instant::now();
        let experience = learning.experience();
        let (weights, rollout, tally) = learning.collecting();
        collector.collect(session, weights, experience, rollout, |episode| tally.note(episode))?;
        let waited = asked.elapsed();
        let progress = keep_alive(servers, learning.last_update(), || learning.learn(Duration::ZERO, waited))?;
        report(&progress);
        let turn = learning.turn(progress, stop)?;
        if (turn.save || !turn.marks.is_empty())
            && let Some((player, normalisers)) = collector.state(session)?
        {
            learning.keep(&turn, &normalisers)?;
            if turn.save {
                learning.save(session.snapshot(0..session.num_envs())?, player, normalisers)?;
            }
        }
        if turn.ends { learning.end(&turn).map(Some) } else { Ok(None) }
    }
}
