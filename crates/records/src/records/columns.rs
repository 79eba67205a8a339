//! Recorded episodes as a table, with a row for each episode.

use perturb_files::AnyError;

use super::{Ending, EpisodeRecord, Records};
use crate::parquet_file::ColumnValues;

impl Ending {
    const NAMED: [(&str, Self); 3] =
        [("terminated", Self::Terminated), ("truncated", Self::Truncated), ("diverged", Self::Diverged)];

    /// Returns the name that files use.
    pub(crate) fn name(self) -> &'static str {
        Self::NAMED[self as usize].0
    }

    /// Parses a name that [`Ending::name`] returned.
    pub(crate) fn from_name(name: &str) -> Result<Self, AnyError> {
        let known = Self::NAMED.into_iter().find(|(known, _)| *known == name);
        known.map(|(_, ending)| ending).ok_or_else(|| format!("an ending is `{name}`").into())
    }
}

impl Records {
    /// Returns the columns with their names, in the order of the file that [`Records::read`] reads.
    pub fn columns(&self) -> Vec<(String, ColumnValues<'_>)> {
        let Self { about, episodes } = self;
        let rows = || episodes.iter();
        let texts = |of: fn(&EpisodeRecord) -> &str| ColumnValues::Text(rows().map(of).collect());
        let longs = |of: fn(&EpisodeRecord) -> u64| ColumnValues::Unsigned64(rows().map(of).collect());
        let ints = |of: fn(&EpisodeRecord) -> u32| ColumnValues::Unsigned32(rows().map(of).collect());
        let nth = |index: usize, of: fn(&EpisodeRecord) -> &Vec<f64>| {
            ColumnValues::Number(rows().map(|row| of(row).get(index).copied().unwrap_or(f64::NAN)).collect())
        };
        let parameters = about.parameters.iter().enumerate();
        let requested = parameters
            .map(|(index, parameter)| (format!("requested_{}", parameter.name), nth(index, |row| &row.requested)));
        let quantities = about.applied.iter().enumerate();
        let applied = quantities.map(|(index, name)| (format!("applied_{name}"), nth(index, |row| &row.applied)));
        let optional = |of: fn(&EpisodeRecord) -> Option<f64>| ColumnValues::Optional(rows().map(of).collect());
        let first = [
            ("set", texts(|row| &row.set)),
            ("seed", longs(|row| row.seed)),
            ("environment_index", ints(|row| row.environment_index)),
            ("episode_index", longs(|row| row.episode_index)),
        ];
        let last = [
            ("model_hash", texts(|row| &row.model_hash)),
            ("return", ColumnValues::Number(rows().map(|row| row.episode_return).collect())),
            ("length", ints(|row| row.length)),
            ("success", ColumnValues::Flag(rows().map(|row| row.success).collect())),
            ("ending", texts(|row| row.ending.name())),
            ("achieved", optional(|row| row.achieved)),
        ];
        let also = about.also.iter().map(|_| ("also_achieved".to_owned(), optional(|row| row.also_achieved)));
        let first = first.into_iter().map(|(name, values)| (name.to_owned(), values));
        let last = last.into_iter().map(|(name, values)| (name.to_owned(), values));
        first.chain(requested).chain(applied).chain(last).chain(also).collect()
    }
}
