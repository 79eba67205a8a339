//! Trainings whose servers play: each has a session of its own, and learns here when a rollout has come.
//!
//! While one learns, the others' rollouts are played. None waits for another, and none shares anything with it but this
//! thread and the room where it learns, so that its bytes are those that it has alone.

use std::time::{Duration, Instant};

use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;

use super::learning::{Learning, keep_alive};
use super::{Outcome, Result};
use crate::client::{ClientError, Played, Servers, Session};
use crate::logging::Progress;
use crate::policy::Room;
use crate::rollout::RemoteCollector;
use perturb_study::interrupt::StopFlag;

/// A training and what its server plays.
pub(super) struct Remote<'a> {
    /// Among those that were begun together.
    index: usize,
    session: Session<'a>,
    collector: RemoteCollector,
    learning: Learning<'a>,
    /// How long all had waited when the rollout was asked for.
    waited: Duration,
}

/// What trainings share, and are told.
struct Together<'a> {
    servers: &'a Servers,
    stop: &'a StopFlag,
    /// Where feed-forward policies learn, if there are several.
    room: Option<Room>,
    /// How long no training had anything to learn from.
    waited: Duration,
}

/// Trains until every training has ended, and tells how each did.
///
/// # Errors
/// A room for gradients that cannot be had.
pub(super) fn run(
    servers: &Servers,
    trainings: Vec<Remote<'_>>,
    stop: &StopFlag,
    report: &mut dyn FnMut(usize, &Progress),
    ended: &mut dyn FnMut(usize, Result<Outcome>),
) -> Result<()> {
    let room = if let [first, _, ..] = trainings.as_slice() { first.learning.room()? } else { None };
    let mut together = Together { servers, stop, room, waited: Duration::ZERO };
    let mut playing = FuturesUnordered::new();
    for mut remote in trainings.into_iter().map(Box::new) {
        match remote.ask(Duration::ZERO) {
            Ok(()) => playing.push(remote.played()),
            Err(error) => ended(remote.index, Err(remote.learning.failed(error))),
        }
    }
    loop {
        let idle = Instant::now();
        let Some((mut remote, played)) = servers.block_on(playing.next()) else { return Ok(()) };
        together.waited += idle.elapsed();
        match remote.take(played, &mut together, report) {
            Ok(None) => playing.push(remote.played()),
            Ok(Some(outcome)) => ended(remote.index, Ok(outcome)),
            Err(error) => ended(remote.index, Err(remote.learning.failed(error))),
        }
    }
}

impl<'a> Remote<'a> {
    /// Training number `index` in a session of its own.
    pub(super) fn new(index: usize, session: Session<'a>, collector: RemoteCollector, learning: Learning<'a>) -> Self {
        Self { index, session, collector, learning, waited: Duration::ZERO }
    }

    /// Asks for a rollout.
    fn ask(&mut self, waited: Duration) -> Result<()> {
        self.waited = waited;
        let until = self.learning.collect_until();
        let weights = self.learning.weights();
        Ok(self.session.ask_to_play(self.collector.begin(weights, until))?)
    }

    /// Waits for what was asked for.
    async fn played(mut self: Box<Self>) -> (Box<Self>, std::result::Result<Played, ClientError>) {
        let played = self.session.played().await;
        (self, played)
    }

    /// Takes what was played, learns from it when it is whole, and asks for more unless the training has ended.
    fn take(
        &mut self,
        played: std::result::Result<Played, ClientError>,
        together: &mut Together<'_>,
        report: &mut dyn FnMut(usize, &Progress),
    ) -> Result<Option<Outcome>> {
        let Self { index, session, collector, learning, waited } = self;
        let (rollout, tally) = learning.collecting();
        if let Some(rest) = collector.take(session, &played?, rollout, |episode| tally.note(episode))? {
            session.ask_to_play(rest)?;
            return Ok(None);
        }
        let waiting = together.waited - *waited;
        let progress = keep_alive(together.servers, learning.last_update(), || match &mut together.room {
            Some(room) => learning.learn_in(room, None, Duration::ZERO, waiting),
            None => learning.learn(None, Duration::ZERO, waiting),
        })?;
        report(*index, &progress);
        let turn = learning.turn(progress, together.stop)?;
        if (turn.save || !turn.marks.is_empty())
            && let Some((player, normalisers)) = collector.state(session)?
        {
            learning.keep(&turn, &normalisers)?;
            if turn.save {
                learning.save(session.snapshot(0..session.num_envs())?, player, normalisers)?;
            }
        }
        if turn.ends {
            return learning.end(&turn).map(Some);
        }
        self.ask(together.waited)?;
        Ok(None)
    }
}
