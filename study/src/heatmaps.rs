//! The heatmaps of an experiment: one for each training that was selected in the first run.
//!
//! ```text
//! DIR/heatmaps/ID.csv .svg .png .parquet  of the cell ID
//! DIR/heatmaps/ID.json           what they show; written last
//! ```
//!
//! The record holds checksums of the pictures and of the cell's result. Pictures of two records, or of a result that
//! has been replaced since, are therefore never taken for current ones.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::folder::{Folder, FolderError};
use super::heatmap::{Heatmap, HeatmapOptions, heatmap_table};
use super::plan::{Cell, TrainedOn};
use super::plot::{self, PlotError};
use super::selection::{MethodResults, Selected};
use crate::Method;
use crate::files::{self, delete, read_if_there, write_atomically, write_json};

/// Of the records; raised when older programs could misread them.
const FORMAT_VERSION: u32 = 1;

/// A heatmap that an experiment has room for.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatmapPlace<'a> {
    /// The environment's name.
    pub environment: &'a str,
    /// What was trained.
    pub method: &'a Method,
    /// Where it was trained.
    pub trained_on: TrainedOn<'a>,
    /// What was selected in the first run; `None` if nothing has a result.
    pub selected: Option<Selected<'a>>,
}

/// `ID.json`: what a heatmap shows. It depends on nothing but the results, the program and the settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeatmapRecord {
    /// Of this layout.
    format_version: u32,
    /// The cell.
    pub cell: String,
    /// CRC-32C of its `result.json`.
    result: String,
    /// What the checkpoint's weights are called, see the learner's `Checkpoint::id`.
    pub checkpoint: String,
    /// Of the training.
    pub train_seed: u64,
    /// How it was tested.
    #[serde(flatten)]
    pub options: HeatmapOptions,
    /// The program's version and the commit that it was built from.
    pub commit: String,
    /// CRC-32C of the files, by their endings.
    files: BTreeMap<String, String>,
}

/// A heatmap that belongs to the current results.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredHeatmap {
    /// What it shows.
    pub record: HeatmapRecord,
    /// As it is in the file.
    pub png: Vec<u8>,
}

/// Why there is no heatmap at a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoHeatmap {
    /// The training was not done yet.
    #[error("no heatmap, since this training has no result yet")]
    NoResult,
    /// Nor is one that was not made completely.
    #[error("the heatmap has not been made")]
    NotMade,
    /// The result has been replaced.
    #[error("the heatmap is of an earlier result")]
    Outdated,
}

/// All heatmaps that a plan has room for, in the order of `selections` and of what it trains on.
pub fn heatmap_places<'a>(selections: &'a [MethodResults<'a>]) -> Vec<HeatmapPlace<'a>> {
    let of_selection = |selection: &'a MethodResults<'a>| {
        let MethodResults { environment, method, runs, .. } = selection;
        let first = runs.values().next().into_iter().flat_map(|run| &run.0);
        first.map(move |(&trained_on, &selected)| HeatmapPlace { environment, method, trained_on, selected })
    };
    selections.iter().flat_map(of_selection).collect()
}

impl HeatmapPlace<'_> {
    /// The heatmap that is there, or why there is none.
    ///
    /// # Errors
    /// [`FolderError`] if a file is there that cannot be read.
    pub fn read(&self, folder: &Folder) -> Result<Result<StoredHeatmap, NoHeatmap>, FolderError> {
        let Some(Selected { cell, .. }) = self.selected else { return Ok(Err(NoHeatmap::NoResult)) };
        let Some(text) = read_if_there(&file(folder, &cell.id, "json"))? else { return Ok(Err(NoHeatmap::NotMade)) };
        // One that is not understood is made again like one that is not there.
        let Ok(record) = serde_json::from_slice::<HeatmapRecord>(&text) else { return Ok(Err(NoHeatmap::NotMade)) };
        if record.format_version != FORMAT_VERSION || record.cell != cell.id {
            return Ok(Err(NoHeatmap::NotMade));
        }
        if Some(&record.result) != result_checksum(folder, cell)?.as_ref() {
            return Ok(Err(NoHeatmap::Outdated));
        }
        let mut png = Vec::new();
        for (ending, expected) in &record.files {
            match read_if_there(&file(folder, &cell.id, ending))? {
                Some(content) if checksum(&content) == *expected => {
                    if ending == "png" {
                        png = content;
                    }
                }
                _ => return Ok(Err(NoHeatmap::NotMade)),
            }
        }
        Ok(if png.is_empty() { Err(NoHeatmap::NotMade) } else { Ok(StoredHeatmap { record, png }) })
    }
}

impl std::fmt::Display for HeatmapPlace<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}, {} trained on {}", self.environment, self.method, self.trained_on)
    }
}

/// Keeps `heatmap` of the policy called `checkpoint` as that of `cell`; gives the path without endings.
///
/// # Errors
/// [`PlotError`]; then there is none.
pub fn store_heatmap(
    folder: &Folder,
    cell: &Cell,
    checkpoint: String,
    options: HeatmapOptions,
    heatmap: &Heatmap,
) -> Result<PathBuf, PlotError> {
    let record_path = file(folder, &cell.id, "json");
    let result = result_checksum(folder, cell)?;
    delete(&record_path)?;
    let mut files = BTreeMap::new();
    for (ending, content) in heatmap_files(heatmap)? {
        write_atomically(&file(folder, &cell.id, ending), &content)?;
        files.insert(ending.to_owned(), checksum(&content));
    }
    let record = HeatmapRecord {
        format_version: FORMAT_VERSION,
        cell: cell.id.clone(),
        result: result.unwrap_or_default(),
        checkpoint,
        train_seed: cell.config.common.seed,
        options,
        commit: crate::VERSION.into(),
        files,
    };
    write_json(&record_path, &record)?;
    Ok(record_path.with_extension(""))
}

/// The files of a heatmap with their endings: csv, svg and png.
///
/// # Errors
/// [`PlotError`].
pub fn heatmap_files(heatmap: &Heatmap) -> Result<[(&'static str, Vec<u8>); 3], PlotError> {
    Ok([
        ("csv", heatmap_table(heatmap).to_csv()),
        ("svg", plot::svg(heatmap)?.into_bytes()),
        ("png", plot::png(heatmap)?),
    ])
}

fn file(folder: &Folder, id: &str, ending: &str) -> PathBuf {
    folder.path().join("heatmaps").join(format!("{id}.{ending}"))
}

/// Of a cell's result as it is on the disk.
fn result_checksum(folder: &Folder, cell: &Cell) -> files::Result<Option<String>> {
    Ok(read_if_there(&folder.cell(&cell.id).path().join("result.json"))?.map(|content| checksum(&content)))
}

fn checksum(content: &[u8]) -> String {
    format!("{:08x}", crc32c::crc32c(content))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Axis, HeatmapPoint, Plan, Version, fixture};

    const PLAN: &str = "environments = ['Pendulum', 'Elsewhere']\nversions = ['D', 'E']\nruns = 2
        [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

    fn heatmap() -> Heatmap {
        let axis = |name: &str| Axis {
            name: name.into(),
            unit: "1".into(),
            low: 0.0,
            high: 1.0,
            random: vec![(0.4, 0.6)],
            extreme: vec![(0.0, 0.4), (0.6, 1.0)],
        };
        Heatmap {
            environment: "Pendulum".into(),
            policy: "a2c ff".into(),
            axes: ["mass", "length"].map(axis),
            grid: 2,
            episodes: 1,
            points: [(1.0, 0.0), (2.0, 0.0), (3.0, 50.0), (4.0, 100.0)]
                .map(|(mean_return, success_percent)| HeatmapPoint { x: 0.0, y: 0.0, mean_return, success_percent })
                .into(),
        }
    }

    fn options() -> HeatmapOptions {
        HeatmapOptions {
            parameters: ["mass", "length"].map(str::to_owned),
            grid: 2,
            episodes: 1,
            seed: 1,
            fixed: Default::default(),
        }
    }

    #[test]
    fn a_heatmap_is_current_only_while_it_and_its_result_are_whole() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let folder = Folder::new(directory.path());
        let cell = &plan.cells[0];
        let result = folder.cell(&cell.id).path().join("result.json");
        write_atomically(&result, b"{}").unwrap();
        let (method, done) = (cell.method(), fixture::result(cell, [0.0; 3], 0.0));
        let selected = Some(Selected { cell, result: &done });
        let place = HeatmapPlace {
            environment: "Pendulum",
            method: &method,
            trained_on: TrainedOn::Version(Version::D),
            selected,
        };
        assert_eq!(place.read(&folder).unwrap(), Err(NoHeatmap::NotMade));
        let nobody = HeatmapPlace { selected: None, ..place.clone() };
        assert_eq!(nobody.read(&folder).unwrap(), Err(NoHeatmap::NoResult));

        let store = || store_heatmap(&folder, cell, "00000001-0a".into(), options(), &heatmap()).unwrap();
        let path = store();
        assert_eq!(path, directory.path().join("heatmaps").join(&cell.id));
        let stored = place.read(&folder).unwrap().unwrap();
        assert!(stored.png.starts_with(b"\x89PNG"));
        assert_eq!((&stored.record.cell, &stored.record.options), (&cell.id, &options()));

        for ending in ["png", "svg", "csv", "json"] {
            let damaged = path.with_extension(ending);
            let content = std::fs::read(&damaged).unwrap();
            std::fs::write(&damaged, &content[..content.len() / 2]).unwrap();
            assert_eq!(place.read(&folder).unwrap(), Err(NoHeatmap::NotMade), "half a {ending}");
            store();
            assert_eq!(std::fs::read(&damaged).unwrap(), content, "the same bytes again");
        }
        write_atomically(&result, b"{ }").unwrap();
        assert_eq!(place.read(&folder).unwrap(), Err(NoHeatmap::Outdated));
        store();
        assert!(place.read(&folder).unwrap().is_ok());
        std::fs::remove_file(path.with_extension("svg")).unwrap();
        assert_eq!(place.read(&folder).unwrap(), Err(NoHeatmap::NotMade));
        let left: Vec<_> = std::fs::read_dir(directory.path().join("heatmaps")).unwrap().collect();
        assert_eq!(left.len(), 3, "nothing temporary");
    }

    #[test]
    fn there_is_room_for_what_the_plan_trains_and_the_first_run_selects() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let done = |cell: &Cell| cell.id.starts_with("Pendulum-a2c-ff-D").then_some(([0.0; 3], 0.0));
        let results = fixture::results(&plan, done);
        let selections = results.select();
        let places = heatmap_places(&selections);
        let shown: Vec<String> = places.iter().map(ToString::to_string).collect();
        let expected = ["Pendulum, a2c ff trained on D", "Pendulum, a2c ff trained on E"];
        assert_eq!((shown[..2] == expected, shown.len()), (true, 4), "none on R");
        let runs: Vec<_> = places.iter().map(|place| place.selected.map(|selected| selected.cell.run)).collect();
        assert_eq!(runs, [Some(1), None, None, None]);
    }
}
