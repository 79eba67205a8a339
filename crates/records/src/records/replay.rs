//! Comparison of a recorded episode with its replay.

use super::EpisodeRecord;

impl EpisodeRecord {
    /// Describes the first difference of the replayed episode `got` from this record. Does not compare the seeds or the
    /// successes. Returns `None` if everything else is equal.
    pub fn difference(&self, got: &Self) -> Option<String> {
        let both = |field: fn(&Self) -> String| (field(self), field(got));
        let parts = [
            ("episode", both(|it| it.episode_index.to_string())),
            ("requested", both(|it| format!("{:?}", it.requested))),
            ("applied", both(|it| format!("{:?}", it.applied))),
            ("model", both(|it| it.model_hash.clone())),
            ("length", both(|it| it.length.to_string())),
            ("return", both(|it| format!("{:?}", it.episode_return))),
            ("ending", both(|it| format!("{:?}", it.ending))),
            ("achieved", both(|it| format!("{:?}", it.achieved))),
            ("second achieved value", both(|it| format!("{:?}", it.also_achieved))),
        ];
        let (what, (was, is)) = parts.into_iter().find(|(_, (recorded, got))| recorded != got)?;
        let Self { set, environment_index, episode_index, .. } = self;
        Some(format!("{set}, environment {environment_index}, episode {episode_index}: {what} was {was}, is {is}"))
    }
}
