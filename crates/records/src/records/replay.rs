//! Comparison of a recorded episode with its replay.

use super::EpisodeRecord;

impl EpisodeRecord {
    /// Describes the first difference of the replayed episode `got` from this record. Returns `None` if there is none.
    pub fn difference(&self, got: &Self) -> Option<String> {
        let what = |told: fn(&Self) -> String| (told(self), told(got));
        let parts = [
            ("episode", what(|it| it.episode_index.to_string())),
            ("requested", what(|it| format!("{:?}", it.requested))),
            ("applied", what(|it| format!("{:?}", it.applied))),
            ("model", what(|it| it.model_hash.clone())),
            ("length", what(|it| it.length.to_string())),
            ("return", what(|it| format!("{:?}", it.episode_return))),
            ("ending", what(|it| format!("{:?}", it.ending))),
            ("achieved", what(|it| format!("{:?}", it.achieved))),
            ("the other it achieved", what(|it| format!("{:?}", it.also_achieved))),
        ];
        let (what, (was, is)) = parts.into_iter().find(|(_, (recorded, got))| recorded != got)?;
        let Self { set, environment_index, episode_index, .. } = self;
        Some(format!("{set}, environment {environment_index}, episode {episode_index}: {what} was {was}, is {is}"))
    }
}
