//! Sources that provide the states of cells: an experiment's folder, a results table, or both.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use perturb_checkpoint::Counters;
use perturb_records::{ParameterCheck, ResultsTable, StudyPlan, TableRow, TestResult};

use crate::folder::{
    CellResult, CellState, ExperimentFolder, FailureRecord, FolderError, IntermediateEvaluation, Training,
};
use crate::plan::{Cell, Plan, PlanError};

/// Separator between the program versions in the column `commit` of a results table.
pub(crate) const COMMIT_SEPARATOR: &str = "; ";

/// A source that provides the states of cells.
pub trait CellStates {
    /// Reads the state of `cell`.
    ///
    /// # Errors
    /// [`FolderError`] if the state cannot be read.
    fn state(&self, cell: &Cell) -> Result<CellState, FolderError>;
}

impl ExperimentFolder {
    /// Reads the state of `cell`.
    ///
    /// # Errors
    /// [`FolderError`] if a file exists but cannot be read.
    pub fn state(&self, cell: &Cell) -> Result<CellState, FolderError> {
        self.cell(&cell.id).state()
    }
}

impl CellStates for ExperimentFolder {
    fn state(&self, cell: &Cell) -> Result<CellState, FolderError> {
        Self::state(self, cell)
    }
}

/// The results of one study in a results table. A study is an experiment whose results a table contains.
#[derive(Clone, Debug)]
pub struct StudyResults<'a> {
    rows: HashMap<&'a str, Vec<&'a TableRow>>,
}

impl<'a> StudyResults<'a> {
    /// Returns the results of `study`. They are empty if the table does not contain this study.
    pub fn new(table: &'a ResultsTable, study: &str) -> Self {
        Self { rows: table.of_study(study) }
    }

    /// Returns the rows of the cell with this id; an empty slice if it has none.
    pub fn rows(&self, cell: &str) -> &[&'a TableRow] {
        self.rows.get(cell).map_or(&[], Vec::as_slice)
    }
}

impl CellStates for StudyResults<'_> {
    fn state(&self, cell: &Cell) -> Result<CellState, FolderError> {
        let rows = self.rows(&cell.id);
        state_of(cell, rows).map_err(|reason| FolderError::Row { cell: cell.id.clone(), reason })
    }
}

/// The finished cells of all studies in a results table. Used to reuse results: a cell is found if a study's plan has a
/// cell with the same id, settings and tests.
#[derive(Debug)]
pub struct DoneCells<'a> {
    studies: Vec<(Plan, StudyResults<'a>)>,
}

impl<'a> DoneCells<'a> {
    /// Collects the finished cells of all studies in `table`.
    ///
    /// # Errors
    /// [`PlanError`] if the plan of a study cannot be parsed.
    pub fn new(table: &'a ResultsTable) -> Result<Self, PlanError> {
        let mut studies = Vec::new();
        for (name, plan) in &table.studies {
            studies.push((Plan::of_study(name, plan)?, StudyResults::new(table, name)));
        }
        Ok(Self { studies })
    }
}

impl CellStates for DoneCells<'_> {
    fn state(&self, cell: &Cell) -> Result<CellState, FolderError> {
        for (plan, results) in &self.studies {
            let is_same = |known: &Cell| known.config == cell.config && known.tests == cell.tests;
            if plan.find(&cell.id).is_none_or(|known| !is_same(known)) {
                continue;
            }
            if let done @ CellState::Done(_) = results.state(cell)? {
                return Ok(done);
            }
        }
        Ok(CellState::Missing)
    }
}

/// Two sources of cell states. The second one provides the states of cells that are missing in the first one.
pub struct LayeredStates<'a> {
    /// The source that is asked first.
    pub first: &'a dyn CellStates,
    /// The source of cells that are missing in the first source, if there is a second one.
    pub then: Option<&'a dyn CellStates>,
}

impl CellStates for LayeredStates<'_> {
    fn state(&self, cell: &Cell) -> Result<CellState, FolderError> {
        match (self.first.state(cell)?, self.then) {
            (CellState::Missing, Some(then)) => then.state(cell),
            (state, _) => Ok(state),
        }
    }
}

impl Plan {
    /// Expands the plan of a study from a results table. `name` is the study's name.
    ///
    /// # Errors
    /// [`PlanError`], which names the study.
    pub fn of_study(name: &str, study: &StudyPlan) -> Result<Self, PlanError> {
        let read_csv_file = |file: &str| {
            let content = study.csv_files.get(file).map(|content| content.clone().into_bytes());
            content.ok_or_else(|| format!("`{file}`, which is not in the table"))
        };
        Self::parse_with(&format!("the study {name}"), study.plan.clone(), Path::new(""), &read_csv_file)
    }

    /// Returns the plan with its CSV files, as a results table stores it.
    pub fn for_table(&self) -> StudyPlan {
        let text = |content: &Vec<u8>| String::from_utf8_lossy(content).into_owned();
        let csv_files = self.csv_files.iter().map(|(name, content)| (name.clone(), text(content)));
        StudyPlan { plan: self.text.clone(), csv_files: csv_files.collect() }
    }
}

/// Reconstructs the state of a cell from its rows in a results table. Rows must be in the order of the export:
/// intermediate policies first, then the final policy.
fn state_of(cell: &Cell, rows: &[&TableRow]) -> Result<CellState, String> {
    let Some(last) = rows.last() else { return Ok(CellState::Missing) };
    let commits: Vec<String> = last.commit.split(COMMIT_SEPARATOR).map(str::to_owned).collect();
    let (commit, earlier) = commits.split_last().ok_or("it names no program")?;
    if let Some(reason) = &last.failure {
        let (id, reason, commit) = (cell.id.clone(), reason.clone(), commit.clone());
        return Ok(CellState::Failed(FailureRecord { id, reason, commit, requires_restart: true }));
    }
    // The rows of the final policy are at the end. They have the same number of episodes and different test sets.
    let last_before_final = rows.iter().enumerate().rposition(|(place, row)| {
        let repeats = rows[place + 1..].iter().any(|later| later.tested_on == row.tested_on);
        row.after_episodes != last.after_episodes || repeats
    });
    let (of_marks, of_final) = rows.split_at(last_before_final.map_or(0, |place| place + 1));
    let mut marks: BTreeMap<u64, IntermediateEvaluation> = BTreeMap::new();
    for row in of_marks {
        let (set, result) = tested(row)?;
        let agreement = ParameterCheck { episodes: 0, largest: None };
        let mark = IntermediateEvaluation { counters: counters(row), results: BTreeMap::new(), agreement };
        let mark = marks.entry(row.after_episodes.unwrap_or_default()).or_insert(mark);
        mark.results.insert(set, result);
    }
    let results = of_final.iter().map(|row| tested(row)).collect::<Result<BTreeMap<_, _>, _>>()?;
    let settings = serde_json::from_str(&last.settings).map_err(|error| format!("its settings: {error}"))?;
    Ok(CellState::Done(Box::new(CellResult {
        format_version: CellResult::FORMAT_VERSION,
        id: cell.id.clone(),
        training: Training {
            environment: last.environment.clone(),
            environment_revision: last.revision.and_then(|it| u32::try_from(it).ok()).ok_or("it has no revision")?,
            model_hash: last.model_hash.clone().unwrap_or_default(),
            version: cell.config.common.version,
            set: cell.set.clone(),
            method: cell.method(),
            configuration: cell.configuration.clone(),
            run: last.run,
            seed: last.seed,
            counters: counters(last),
            settings,
        },
        results,
        marks,
        agreement: None,
        commit: commit.clone(),
        earlier_commits: earlier.to_vec(),
        command: String::new(),
    })))
}

/// Returns the test of a row: the name of its set, and its result.
fn tested(row: &TableRow) -> Result<(String, TestResult), String> {
    let figures = row.tested_on.clone().zip(row.result());
    figures.ok_or_else(|| "a row has neither a test nor a failure".into())
}

/// Returns the episodes and steps of a row's policy.
fn counters(row: &TableRow) -> Counters {
    let (episodes, timesteps) = (row.after_episodes.unwrap_or_default(), row.timesteps.unwrap_or_default());
    Counters { episodes, timesteps, ..Counters::default() }
}
