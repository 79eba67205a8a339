//! The heatmaps of an experiment: each shows the success rate of a selected policy over two parameters.
//!
//! ```text
//! DIR/heatmaps/ID-X-Y.csv      success rates of the policy of cell ID over the parameters X and Y
//! DIR/heatmaps/ID-X-Y.parquet  the episodes behind these rates
//! DIR/heatmaps/ID-X-Y.json     the record: options and checksums; written last
//! DIR/heatmaps/ID-X-Y-R.…      the same files, with the other parameters drawn from R
//! ```
//!
//! The record contains checksums of the CSV file and of the cell's `result.json`. So a heatmap counts as current only
//! if its CSV file belongs to the record, and the result has not been replaced since. Pictures are drawn from the CSV
//! file when they are needed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use perturb_files::{self as files, delete, read_if_exists, write_atomically, write_json};
use perturb_records::{Axis, Heatmap, HeatmapKind, HeatmapOptions, TrainedOn, heatmap_table};
use perturb_settings::Method;
use serde::{Deserialize, Serialize};

use crate::folder::{ExperimentFolder, FolderError};
use crate::plan::Cell;
use crate::selection::{MethodResults, Selected};

/// Format version of the records. It is raised when older programs could misread them.
const FORMAT_VERSION: u32 = 2;

/// A position in the report for the heatmaps of one policy: environment, method, training distribution and run. It
/// exists even while there is no heatmap or no policy.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatmapPlace<'a> {
    /// The environment's name.
    pub environment: &'a str,
    /// The method: algorithm, architecture and kind of observation.
    pub method: &'a Method,
    /// The training distribution.
    pub trained_on: TrainedOn<'a>,
    /// The run, from 1.
    pub run: u32,
    /// The selected policy; `None` while no cell of this run has a result.
    pub selected: Option<Selected<'a>>,
}

/// The content of `ID-X-Y.json`, which describes a heatmap. It depends only on the cell's result, the program and the
/// options.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeatmapRecord {
    /// The format version of the file.
    format_version: u32,
    /// The id of the cell.
    pub cell: String,
    /// CRC-32C of the cell's `result.json`, in hexadecimal.
    result: String,
    /// The identifier of the policy's weights, see the learner's `Checkpoint::id`.
    pub checkpoint: String,
    /// The seed of the training.
    pub train_seed: u64,
    /// The options of the test that made the heatmap.
    #[serde(flatten)]
    pub options: HeatmapOptions,
    /// The x and y axes.
    pub axes: [Axis; 2],
    /// The program's version and the commit that it was built from.
    pub commit: String,
    /// CRC-32C of `ID-X-Y.csv`, in hexadecimal.
    figures: String,
}

/// A heatmap read from an experiment's folder. It belongs to the current result of its cell.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredHeatmap {
    /// The description of the heatmap: options, checkpoint and program version.
    pub record: HeatmapRecord,
    /// The success rates of the heatmap, with their axes.
    pub heatmap: Heatmap,
}

/// The reason why a [`HeatmapPlace`] has no heatmap.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum NoHeatmap {
    /// The training has no result yet.
    #[error("no heatmap, since this training has no result yet")]
    NoResult,
    /// No complete heatmap was found.
    #[error("no complete heatmap was found")]
    NotMade,
    /// The result of the cell was replaced after the heatmap was made.
    #[error("the heatmap is of an earlier result")]
    Outdated,
    /// The grid or the number of episodes differs from the heatmap of an earlier run, so the two heatmaps cannot be
    /// averaged.
    #[error("the heatmap's grid or number of episodes differs from that of an earlier run")]
    NotAlike,
}

/// Returns a place for the heatmaps of each policy in `selections` that the experiment trained. The places have the
/// order of `selections`, then of training distributions and runs. A run without a policy has a place too.
pub fn heatmap_places<'a>(selections: &'a [MethodResults<'a>]) -> Vec<HeatmapPlace<'a>> {
    let mut places = Vec::new();
    for MethodResults { environment, method, runs, .. } in selections.iter().filter(|row| !row.method.external) {
        let trained_on: BTreeSet<TrainedOn<'a>> = runs.values().flat_map(|run| run.selected.keys().copied()).collect();
        for trained_on in trained_on {
            places.extend(runs.iter().map(|(&run, of_run)| {
                let selected = of_run.cell_trained_on(trained_on);
                HeatmapPlace { environment, method, trained_on, run, selected }
            }));
        }
    }
    places
}

/// Lists the kinds of heatmaps in `folder` by environment. A kind consists of the two parameters and the version that
/// other parameters are drawn from. Outdated heatmaps are included.
///
/// # Errors
/// Errors of the operating system.
pub fn heatmap_kinds<'a>(
    folder: &ExperimentFolder,
    places: &[HeatmapPlace<'a>],
) -> files::Result<BTreeMap<&'a str, BTreeSet<HeatmapKind>>> {
    let ids = places.iter().filter_map(|place| Some((place.selected?.cell.id.as_str(), place.environment)));
    let environments: BTreeMap<&str, &'a str> = ids.collect();
    let mut kinds: BTreeMap<&str, BTreeSet<HeatmapKind>> = BTreeMap::new();
    let lists = folder.heatmaps().iter().map(|path| files::list(path)).collect::<files::Result<Vec<_>>>()?;
    for path in lists.into_iter().flatten() {
        if path.extension().is_none_or(|ending| ending != "json") {
            continue;
        }
        let Some(record) = read_if_exists(&path)?.and_then(|text| HeatmapRecord::parse(&text)) else { continue };
        if let Some(environment) = environments.get(record.cell.as_str()) {
            kinds.entry(environment).or_default().insert(record.options.kind());
        }
    }
    Ok(kinds)
}

impl HeatmapRecord {
    /// Parses a record. Returns `None` if it is damaged or of another format version, so that its heatmap is made
    /// again.
    fn parse(text: &[u8]) -> Option<Self> {
        serde_json::from_slice(text).ok().filter(|record: &Self| record.format_version == FORMAT_VERSION)
    }
}

impl HeatmapPlace<'_> {
    /// Reads the heatmap of `kind` at this place. The inner error is the reason why there is none.
    ///
    /// # Errors
    /// [`FolderError`] if a file exists but cannot be read.
    pub fn read(
        &self,
        folder: &ExperimentFolder,
        kind: &HeatmapKind,
    ) -> Result<Result<StoredHeatmap, NoHeatmap>, FolderError> {
        let Some(Selected { cell, .. }) = self.selected else { return Ok(Err(NoHeatmap::NoResult)) };
        let mut missing = NoHeatmap::NotMade;
        for path in folder.heatmaps() {
            match self.read_at(&path.join(heatmap_name(cell, kind)), folder, cell, kind)? {
                Ok(stored) => return Ok(Ok(stored)),
                Err(NoHeatmap::NotMade) => {}
                Err(reason) => missing = reason,
            }
        }
        Ok(Err(missing))
    }

    /// Reads the heatmap whose files are `path` with the extensions `csv` and `json`.
    fn read_at(
        &self,
        path: &Path,
        folder: &ExperimentFolder,
        cell: &Cell,
        kind: &HeatmapKind,
    ) -> Result<Result<StoredHeatmap, NoHeatmap>, FolderError> {
        let record = read_if_exists(&path.with_added_extension("json"))?.and_then(|text| HeatmapRecord::parse(&text));
        let Some(record) = record.filter(|record| record.cell == cell.id && record.options.kind() == *kind) else {
            return Ok(Err(NoHeatmap::NotMade));
        };
        if Some(&record.result) != result_checksum(folder, cell)?.as_ref() {
            return Ok(Err(NoHeatmap::Outdated));
        }
        let figures = read_if_exists(&path.with_added_extension("csv"))?;
        let figures = figures.filter(|figures| checksum(figures) == record.figures);
        let heatmap = figures.and_then(|figures| record.blank(self.environment).with_points(&figures));
        Ok(heatmap.map_or(Err(NoHeatmap::NotMade), |heatmap| Ok(StoredHeatmap { record, heatmap })))
    }
}

impl HeatmapRecord {
    /// Returns a heatmap with the options of this record, and no points yet.
    fn blank(&self, environment: &str) -> Heatmap {
        let HeatmapOptions { base, grid, episodes, fixed, .. } = self.options.clone();
        let (environment, axes) = (environment.to_owned(), self.axes.clone());
        Heatmap { environment, axes, base, fixed, grid, episodes, points: Vec::new() }
    }
}

impl std::fmt::Display for HeatmapPlace<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}, {} trained on {}, run {}", self.environment, self.method, self.trained_on, self.run)
    }
}

/// Returns the path, without extension, to which a new heatmap of `cell` is written.
pub fn heatmap_path(folder: &ExperimentFolder, cell: &Cell, kind: &HeatmapKind) -> PathBuf {
    folder.heatmaps().swap_remove(0).join(heatmap_name(cell, kind))
}

/// Returns the name of a heatmap's files, without extension.
fn heatmap_name(cell: &Cell, kind: &HeatmapKind) -> String {
    format!("{}-{kind}", cell.id)
}

/// Writes the CSV file and the record of `heatmap` for `cell`. `checkpoint` identifies the tested policy.
///
/// # Errors
/// Errors of the operating system. If a file cannot be written, no current heatmap remains at [`heatmap_path`], because
/// the old record is deleted first.
pub fn store_heatmap(
    folder: &ExperimentFolder,
    cell: &Cell,
    checkpoint: String,
    options: HeatmapOptions,
    heatmap: &Heatmap,
) -> files::Result<()> {
    let path = heatmap_path(folder, cell, &options.kind());
    let record_path = path.with_added_extension("json");
    let result = result_checksum(folder, cell)?;
    delete(&record_path)?;
    let figures = heatmap_table(heatmap).to_csv();
    write_atomically(&path.with_added_extension("csv"), &figures)?;
    let record = HeatmapRecord {
        format_version: FORMAT_VERSION,
        cell: cell.id.clone(),
        result: result.unwrap_or_default(),
        checkpoint,
        train_seed: cell.config.common.seed,
        options,
        axes: heatmap.axes.clone(),
        commit: crate::VERSION.into(),
        figures: checksum(&figures),
    };
    write_json(&record_path, &record)
}

/// Returns the checksum of a cell's `result.json`; `None` if there is no such file.
fn result_checksum(folder: &ExperimentFolder, cell: &Cell) -> files::Result<Option<String>> {
    Ok(read_if_exists(&folder.cell(&cell.id).path().join("result.json"))?.map(|content| checksum(&content)))
}

/// Returns the CRC-32C of `content` in hexadecimal.
fn checksum(content: &[u8]) -> String {
    format!("{:08x}", crc32c::crc32c(content))
}

#[cfg(test)]
mod tests {
    use perturb_protocol::Version;

    use super::*;
    use crate::fixture;
    use crate::plan::Plan;

    const PLAN: &str = "environments = ['Pendulum', 'Elsewhere']\nversions = ['D', 'E']\nruns = 2
        [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

    fn heatmap() -> Heatmap {
        fixture::heatmap(2, |x, y| (x / 3.0, 100.0 * y / 1.5))
    }

    fn options(base: Version) -> HeatmapOptions {
        let Heatmap { axes, grid, episodes, fixed, .. } = heatmap();
        HeatmapOptions { parameters: axes.map(|axis| axis.name), base, grid, episodes, seed: 1, fixed }
    }

    #[test]
    fn a_heatmap_is_current_only_while_it_and_its_result_are_whole() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(directory.path());
        let cell = &plan.cells[0];
        let result = folder.cell(&cell.id).path().join("result.json");
        write_atomically(&result, b"{}").unwrap();
        let (method, done) = (cell.method(), fixture::result(cell, [0.0; 3], 0.0));
        let place = HeatmapPlace {
            environment: "Pendulum",
            method: &method,
            trained_on: TrainedOn::Version(Version::D),
            run: 1,
            selected: Some(Selected { cell, result: &done }),
        };
        let kind = options(Version::D).kind();
        assert_eq!(place.read(&folder, &kind).unwrap(), Err(NoHeatmap::NotMade));
        let nobody = HeatmapPlace { selected: None, ..place.clone() };
        assert_eq!(nobody.read(&folder, &kind).unwrap(), Err(NoHeatmap::NoResult));

        let store = || store_heatmap(&folder, cell, "00000001-0a".into(), options(Version::D), &heatmap()).unwrap();
        store();
        let path = heatmap_path(&folder, cell, &kind);
        assert_eq!(path, directory.path().join("heatmaps").join(format!("{}-mass-length", cell.id)));
        let stored = place.read(&folder, &kind).unwrap().unwrap();
        assert_eq!((stored.record.cell, stored.record.options), (cell.id.clone(), options(Version::D)));
        assert_eq!(stored.heatmap, heatmap(), "to the last digit");

        for ending in ["csv", "json"] {
            let damaged = path.with_added_extension(ending);
            let content = std::fs::read(&damaged).unwrap();
            for write in [&content[..content.len() / 2], b""] {
                std::fs::write(&damaged, write).unwrap();
                assert_eq!(place.read(&folder, &kind).unwrap(), Err(NoHeatmap::NotMade), "half a {ending}");
            }
            std::fs::remove_file(&damaged).unwrap();
            assert_eq!(place.read(&folder, &kind).unwrap(), Err(NoHeatmap::NotMade), "no {ending}");
            store();
            assert_eq!(std::fs::read(&damaged).unwrap(), content, "the same bytes again");
        }
        let figures = path.with_added_extension("csv");
        let text = std::fs::read_to_string(&figures).unwrap();
        std::fs::write(&figures, text.replace(",50\n", ",51\n")).unwrap();
        assert_eq!(place.read(&folder, &kind).unwrap(), Err(NoHeatmap::NotMade), "other figures");
        store();
        let record = path.with_added_extension("json");
        let text = std::fs::read_to_string(&record).unwrap();
        std::fs::write(&record, text.replace("\"format_version\": 2", "\"format_version\": 1")).unwrap();
        assert_eq!(place.read(&folder, &kind).unwrap(), Err(NoHeatmap::NotMade), "of an older program");
        store();
        write_atomically(&result, b"{ }").unwrap();
        assert_eq!(place.read(&folder, &kind).unwrap(), Err(NoHeatmap::Outdated));
        store();
        assert!(place.read(&folder, &kind).unwrap().is_ok());
        let left: Vec<_> = std::fs::read_dir(directory.path().join("heatmaps")).unwrap().collect();
        assert_eq!(left.len(), 2, "nothing temporary");

        let mine = folder.clone().with_new_heatmaps(directory.path().join("mine"));
        assert!(place.read(&mine, &kind).unwrap().is_ok(), "the experiment's own is read");
        files::delete(&record).unwrap();
        store_heatmap(&mine, cell, "00000001-0a".into(), options(Version::D), &heatmap()).unwrap();
        assert!(place.read(&mine, &kind).unwrap().is_ok(), "written elsewhere");
        assert_eq!(place.read(&folder, &kind).unwrap(), Err(NoHeatmap::NotMade));
    }

    #[test]
    fn heatmaps_of_several_kinds_stand_beside_each_other() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(directory.path());
        let results = fixture::results(&plan, |_| Some(([0.0; 3], 0.0)));
        let selections = results.select();
        let places = heatmap_places(&selections);
        let cell = places[0].selected.unwrap().cell;
        write_atomically(&folder.cell(&cell.id).path().join("result.json"), b"{}").unwrap();
        let length_first = |base| {
            let Heatmap { axes: [x, y], .. } = heatmap();
            let parameters = [y.name.clone(), x.name.clone()];
            let axes = [y, x];
            (HeatmapOptions { parameters, ..options(base) }, Heatmap { axes, base, ..heatmap() })
        };
        let drawn = (options(Version::R), Heatmap { base: Version::R, ..heatmap() });
        let all = [(options(Version::D), heatmap()), drawn, length_first(Version::D)];
        for (options, heatmap) in &all {
            store_heatmap(&folder, cell, "1".into(), options.clone(), heatmap).unwrap();
        }
        for (options, heatmap) in all {
            let stored = places[0].read(&folder, &options.kind()).unwrap().unwrap();
            assert_eq!((stored.record.options, stored.heatmap), (options, heatmap));
        }
        // A record whose kind differs from the kind in its file name is ignored.
        let of = |base| heatmap_path(&folder, cell, &options(base).kind());
        for ending in ["csv", "json"] {
            let [from, to] = [Version::R, Version::E].map(|base| of(base).with_added_extension(ending));
            std::fs::copy(from, to).unwrap();
        }
        assert_eq!(places[0].read(&folder, &options(Version::E).kind()).unwrap(), Err(NoHeatmap::NotMade));
        // A heatmap of a cell that was not selected is not listed.
        let mut elsewhere = plan.cells[1].clone();
        elsewhere.id = "elsewhere".into();
        store_heatmap(&folder, &elsewhere, "1".into(), length_first(Version::E).0, &heatmap()).unwrap();
        std::fs::write(directory.path().join("heatmaps/damaged.json"), "{").unwrap();
        let kinds = heatmap_kinds(&folder, &places).unwrap();
        let shown: Vec<String> = kinds["Pendulum"].iter().map(ToString::to_string).collect();
        assert_eq!(
            (kinds.len(), shown),
            (1, ["length-mass", "mass-length", "mass-length-R"].map(str::to_owned).into())
        );
    }

    #[test]
    fn every_training_distribution_and_run_of_the_plan_has_a_place() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let done = |cell: &Cell| (cell.id.starts_with("Pendulum-a2c-ff-D") && cell.run == 1).then_some(([0.0; 3], 0.0));
        let results = fixture::results(&plan, done);
        let selections = results.select();
        let places = heatmap_places(&selections);
        let shown: Vec<String> = places.iter().map(ToString::to_string).collect();
        let expected =
            ["D, run 1", "D, run 2", "E, run 1", "E, run 2"].map(|it| format!("Pendulum, a2c ff trained on {it}"));
        assert_eq!((&shown[..4], shown.len()), (&expected[..], 8), "none on R");
        let runs: Vec<_> = places.iter().map(|place| place.selected.map(|selected| selected.cell.run)).collect();
        assert_eq!(runs[..2], [Some(1), None]);
        assert!(runs[2..].iter().all(Option::is_none));
    }
}
