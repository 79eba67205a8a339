//! Collects rollouts of several runs whose actions are chosen in this process. All runs share a session and step
//! together.
//!
//! Each run has its own weights, random streams, logs and checkpoint, and its own slots of the session. So it gives the
//! same bytes as if it were trained alone.

use std::ops::Range;
use std::time::{Duration, Instant};

use bytes::Bytes;
use perturb_policy::{Normalisers, Player, PlayerTrainingState};

use super::start::{options, start_or_resume};
use super::trainer::Trainer;
use super::{CollectRollouts, Collected, Result, Run, TrainOutcome, TrainRequest};
use crate::client::{ClientSession, OpenOptions, Servers, StepReply};
use crate::rollout::Collector;

/// Collects the rollouts of runs that share a session: every step is one request for the environments of all runs.
pub(super) struct ClientSide<'a> {
    session: ClientSession<'a>,
    /// The state of each run, in the order of slots.
    lanes: Vec<ClientLane>,
    /// Whether runs act and are updated in reverse order. The order alternates at every update, so that the run that
    /// was updated last comes first. Its weights are still in the processor's caches, which are too small for all runs.
    is_reversed: bool,
    /// The encoded actions of all runs, in the order of slots.
    actions: Vec<u8>,
    reply: StepReply,
    times: StepTimes,
}

/// Time spent since the session was opened, by activity.
#[derive(Clone, Copy, Debug, Default)]
struct StepTimes {
    acting: Duration,
    waiting: Duration,
}

/// The state of a run in the shared session.
struct ClientLane {
    /// The index of the run.
    index: usize,
    slots: Range<usize>,
    collector: Collector,
    /// The times spent before the current rollout began; `None` between rollouts.
    begun: Option<StepTimes>,
}

impl<'a> ClientSide<'a> {
    /// Opens a session for all `entries`, at least one, and starts or resumes their runs. If a run cannot start, calls
    /// `ended` with its index and the error.
    ///
    /// # Errors
    /// An error if the session cannot be opened.
    pub(super) fn open<'d>(
        servers: &'a Servers,
        entries: Vec<(usize, TrainRequest<'d>)>,
        threads: usize,
        ended: &mut dyn FnMut(usize, Result<TrainOutcome>),
    ) -> Result<(Self, Vec<Run<'d>>)> {
        let options: Vec<OpenOptions> = entries.iter().map(|(_, entry)| options(entry.start.config())).collect();
        let mut observations = Vec::new();
        let mut session = ClientSession::open_together(servers, &options, &mut observations)?;
        let size = session.observation_size();
        let mut lanes = Vec::new();
        let mut runs = Vec::new();
        let mut failed = Vec::new();
        let mut first = 0;
        for ((index, entry), options) in entries.into_iter().zip(&options) {
            // Each run has the next slots of the batch, with their first observations.
            let slots = first..first + options.num_envs;
            first = slots.end;
            let observations = &observations[slots.start * size..slots.end * size];
            match start_or_resume(entry, &mut session, slots.clone(), observations, threads) {
                Ok((trainer, player)) => {
                    lanes.push(ClientLane { index, slots, collector: Collector::new(player), begun: None });
                    runs.push(Run { index, trainer, end: None });
                }
                Err(error) => {
                    failed.push(slots);
                    ended(index, Err(error));
                }
            }
        }
        let reply = StepReply::default();
        let times = StepTimes::default();
        let mut client_side = Self { session, lanes, is_reversed: false, actions: Vec::new(), reply, times };
        failed.into_iter().rev().try_for_each(|slots| client_side.release_slots(slots))?;
        Ok((client_side, runs))
    }

    /// Steps all environments once.
    fn step(&mut self, runs: &mut [Run<'_>]) -> Result<()> {
        let Self { session, lanes, is_reversed, actions, reply, times } = self;
        let start = Instant::now();
        // Chooses the actions of all runs.
        for (lane, run) in in_order(lanes.iter_mut().zip(runs.iter_mut()), *is_reversed) {
            let acted = lane.act(session, &mut run.trainer, *times);
            run.store_error(acted, true)?;
        }
        actions.clear();
        // A run that has just failed is stepped with its old actions, and the reply is ignored.
        lanes.iter().for_each(|lane| actions.extend_from_slice(lane.collector.player().actions()));
        let sent = Instant::now();
        session.step(actions, reply)?;
        let received = Instant::now();
        times.waiting += received - sent;
        // Appends the step to the rollout of each run.
        for (lane, run) in lanes.iter_mut().zip(runs.iter_mut()).filter(|(_, run)| run.end.is_none()) {
            let taken = lane.take(reply, &mut run.trainer);
            run.store_error(taken, true)?;
        }
        times.acting += (sent - start) + received.elapsed();
        Ok(())
    }

    /// Returns the lane of the run with this index.
    fn lane(&mut self, index: usize) -> Option<&mut ClientLane> {
        self.lanes.iter_mut().find(|lane| lane.index == index)
    }

    /// Frees the slots of a run that has ended or failed. Runs with higher slots get lower slots, so that no gap
    /// remains.
    fn release_slots(&mut self, slots: Range<usize>) -> Result<()> {
        if self.lanes.is_empty() {
            return Ok(()); // the whole session is closed soon
        }
        self.session.release(slots.clone())?;
        for lane in self.lanes.iter_mut().filter(|lane| lane.slots.start >= slots.end) {
            lane.slots = lane.slots.start - slots.len()..lane.slots.end - slots.len();
        }
        Ok(())
    }
}

impl CollectRollouts for ClientSide<'_> {
    fn collect(&mut self, runs: &mut [Run<'_>]) -> Result<Vec<Collected>> {
        loop {
            self.step(runs)?;
            let Self { lanes, is_reversed, times, .. } = self;
            let is_whole = |(lane, run): &(&mut ClientLane, &Run<'_>)| run.end.is_none() && lane.collector.is_done();
            let whole = in_order(lanes.iter_mut().zip(runs.iter()), *is_reversed).filter(is_whole);
            let collected: Vec<Collected> = whole.map(|(lane, _)| lane.collected(*times)).collect();
            if !collected.is_empty() {
                self.is_reversed = !self.is_reversed;
                return Ok(collected);
            }
            if runs.iter().any(|run| run.end.is_some()) {
                return Ok(collected);
            }
        }
    }

    fn player(&mut self, index: usize) -> Option<&mut Player> {
        self.lane(index).map(|lane| lane.collector.player_mut())
    }

    fn player_state(&mut self, index: usize) -> Result<Option<(PlayerTrainingState, Normalisers)>> {
        let player = self.lane(index).map(|lane| lane.collector.player());
        Ok(player.and_then(|player| Some((player.state()?, player.normalisers().clone()))))
    }

    fn snapshots(&mut self, index: usize) -> Result<Vec<Bytes>> {
        let slots = self.lane(index).map_or(0..0, |lane| lane.slots.clone());
        Ok(self.session.snapshot(slots)?)
    }

    fn release(&mut self, index: usize) -> Result<()> {
        let Some(place) = self.lanes.iter().position(|lane| lane.index == index) else { return Ok(()) };
        let ClientLane { slots, .. } = self.lanes.remove(place);
        self.release_slots(slots)
    }

    fn is_shared(&self) -> bool {
        true
    }
}

impl ClientLane {
    /// Chooses the next actions. Starts a rollout first if none is in progress.
    fn act(&mut self, session: &mut ClientSession<'_>, trainer: &mut Trainer<'_>, now: StepTimes) -> Result<()> {
        if self.begun.is_none() {
            self.begun = Some(now);
            let until = trainer.collect_until();
            let (rollout, _) = trainer.collecting();
            let slots = self.slots.clone();
            let reset = |observations: &mut [f32]| session.reset(slots, observations);
            self.collector.begin(until, rollout, reset)?;
        }
        self.collector.act()?;
        Ok(())
    }

    /// Appends this run's part of `reply` to its rollout. Finishes the rollout after its last step.
    fn take(&mut self, reply: &StepReply, trainer: &mut Trainer<'_>) -> Result<()> {
        let (rollout, tally) = trainer.collecting();
        let slice = reply.slice(self.slots.clone());
        self.collector.take(&slice, rollout, |episode| tally.note(episode))?;
        if self.collector.is_done() {
            self.collector.finish(rollout)?;
        }
        Ok(())
    }

    /// Ends the collection of a complete rollout. Returns the times that choosing actions and waiting for servers took.
    fn collected(&mut self, now: StepTimes) -> Collected {
        let begun = self.begun.take().unwrap_or(now);
        Collected { index: self.index, acting: now.acting - begun.acting, waiting: now.waiting - begun.waiting }
    }
}

/// Returns the items in order or, if `is_reversed` is set, in reverse order.
fn in_order<T>(mut items: impl DoubleEndedIterator<Item = T>, is_reversed: bool) -> impl Iterator<Item = T> {
    std::iter::from_fn(move || if is_reversed { items.next_back() } else { items.next() })
}
