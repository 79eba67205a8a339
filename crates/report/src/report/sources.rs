//! The inputs of a report: an experiment (a folder or a study in a results table), assessments of agents that were
//! trained outside of the experiment, or both.

use std::path::{Path, PathBuf};

use perturb_experiment::{
    CellStates, EnvironmentCurves, ExperimentFolder, ExportError, FolderError, Plan, PlanError, Recorded, Results,
    Selection, StudyResults, add_assessed, export, judged_as_in, read_curves,
};
use perturb_records::{
    ExternalEvaluation, ExternalEvaluationError, FILE, ParameterCheck, Records, RecordsError, ResultsTable,
    StudyEpisodes, TableError,
};
use perturb_settings::ValueError;

use super::comparison::comparisons_of;
use super::{EnvironmentComparison, HeatmapPictures, Report, heatmap_pictures};
use crate::plot::PlotError;

/// The name of the study when a folder is exported to a table.
const EXPORTED: &str = "experiment";

/// The inputs of a report. [`ReportInputs::read`] reads them and computes the report.
#[derive(Clone, Debug, Default)]
pub struct ReportInputs {
    /// The folder of the experiment; `None` if the report is of a study or of assessments alone.
    pub folder: Option<ExperimentFolder>,
    /// The study of a results table; `None` if the report is of a folder or of assessments alone.
    pub study: Option<StudySource>,
    /// The selection rule to use in place of the plan's; `None` for the plan's own rule.
    pub rule: Option<Selection>,
    /// Assessments of agents that were trained outside of the experiment, in the order in which the report shows them.
    pub assessed: Vec<ExternalEvaluation>,
}

/// A study in a results table: an experiment whose results the table contains.
#[derive(Clone, Debug)]
pub struct StudySource {
    table: ResultsTable,
    name: String,
    /// The path as the user gave it, `FILE.parquet` or `FILE.parquet/STUDY`.
    path: PathBuf,
    /// The path of the study's recorded episodes. The file may be missing.
    episodes: PathBuf,
}

/// The reason why a report cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum ReportError {
    #[error(transparent)]
    ExternalEvaluation(#[from] ExternalEvaluationError),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Plot(#[from] PlotError),
    #[error(transparent)]
    Value(#[from] ValueError),
    #[error(transparent)]
    Export(#[from] ExportError),
    #[error(transparent)]
    Records(#[from] RecordsError),
    #[error(transparent)]
    Table(#[from] TableError),
    /// The table has no study with this name, or it has several studies and the path names none of them.
    #[error(
        "{} has no study `{study}`: give one of them as {}/STUDY: {}",
        table.display(), table.display(), known.join(", ")
    )]
    NoStudy { table: PathBuf, study: String, known: Vec<String> },
    /// The folder contains neither an experiment nor an assessment.
    #[error(
        "{} holds neither an experiment (plan.toml) nor an assessment (assessment.json): give the --out of `perturb run`, \
         the folder of Assessment.save, or the study of a results table, FILE.parquet/STUDY",
        path.display()
    )]
    Neither { path: PathBuf },
    /// The inputs contain two experiments.
    #[error(
        "{} and {} are both experiments: a report takes one experiment and any number of assessments",
        first.display(), second.display()
    )]
    Experiments { first: PathBuf, second: PathBuf },
}

/// A report with its training curves, comparisons and heatmaps.
pub struct ReportBundle<'a> {
    /// The report with its numbers.
    pub report: Report<'a>,
    /// The training curves of each environment.
    pub curves: &'a [EnvironmentCurves],
    /// Comparisons of agents that were trained outside of the experiment, for each environment with several of them.
    pub comparisons: Vec<EnvironmentComparison>,
    /// The pictures of heatmaps.
    pub heatmaps: &'a HeatmapPictures,
}

impl ReportInputs {
    /// Adds the input at `path`: the folder of an experiment or of an assessment, or a study in a results table.
    ///
    /// # Errors
    /// [`ReportError`] if `path` is none of these, cannot be read, or is a second experiment.
    pub fn add(&mut self, path: &Path) -> Result<(), ReportError> {
        let folder = ExperimentFolder::new(path);
        if ExternalEvaluation::is_in(path) {
            self.assessed.push(ExternalEvaluation::read(path)?);
            return Ok(());
        }
        let first = match (&self.folder, &self.study) {
            (Some(folder), _) => Some(folder.path().to_owned()),
            (None, study) => study.as_ref().map(|study| study.path.clone()),
        };
        if let Some(study) = StudySource::find(path)? {
            self.study = Some(study);
        } else if folder.require_plan().is_ok() {
            self.folder = Some(folder);
        } else {
            return Err(ReportError::Neither { path: path.to_owned() });
        }
        first.map_or(Ok(()), |first| Err(ReportError::Experiments { first, second: path.to_owned() }))
    }

    /// Returns the requested selection rule if it differs from the plan's rule, otherwise `None`.
    ///
    /// # Errors
    /// [`ReportError`] if the plan cannot be read.
    pub fn another_rule(&self) -> Result<Option<Selection>, ReportError> {
        let Some(rule) = self.rule else { return Ok(None) };
        let plan = match (&self.folder, &self.study) {
            (Some(folder), _) => Plan::load(&folder.require_plan()?)?,
            (None, Some(study)) => study.plan()?,
            (None, None) => return Ok(None),
        };
        Ok((rule != plan.selection).then_some(rule))
    }

    /// Reads all inputs, computes the report, and passes it to `make`. Returns the result of `make`. The report borrows
    /// from the inputs, so it exists only during this call.
    ///
    /// # Errors
    /// [`ReportError`] if the inputs cannot be read, and the errors of `make`.
    pub fn read<T, E: From<ReportError>>(self, make: impl FnOnce(ReportBundle<'_>) -> Result<T, E>) -> Result<T, E> {
        let Self { folder, study, rule, assessed } = self;
        let mut checks = Vec::new();
        let study = match &folder {
            Some(folder) => Some(StudySource::exported(folder, &mut checks)?),
            None => study,
        };
        let rows = study.as_ref().map(|study| StudyResults::new(&study.table, &study.name));
        let states = rows.as_ref().map(|rows| rows as &dyn CellStates);
        let plan = match (&folder, &study) {
            (Some(folder), _) => Plan::load(&folder.require_plan().map_err(ReportError::from)?),
            (None, Some(study)) => study.plan(),
            (None, None) => Ok(Plan::without_cells()),
        };
        let plan = selected_plan(plan.map_err(ReportError::from)?, states, rule)?;
        let assessed = assessed.into_iter().map(|one| judged_as_in(&plan, one)).collect::<Result<Vec<_>, _>>();
        let assessed = assessed.map_err(ReportError::from)?;
        let results = match states {
            None => Results { plan: &plan, states: Vec::new() },
            Some(states) => Results::read(&plan, states).map_err(ReportError::from)?,
        };
        let mut selections = results.select();
        let mut recorded = Recorded::new(&selections);
        if let Some(study) = &study {
            study.add_episodes(folder.as_ref(), &results, &mut recorded, &mut checks)?;
        }
        let curves = folder.as_ref().map(|folder| read_curves(&selections, folder)).transpose();
        let curves = curves.map_err(ReportError::from)?.unwrap_or_default();
        add_assessed(&mut selections, &assessed);
        let heatmaps = heatmap_pictures(&selections, folder.as_ref()).map_err(ReportError::from)?;
        let report = Report::new(&results, &selections, &recorded, &checks);
        make(ReportBundle { report, curves: &curves, comparisons: comparisons_of(&assessed), heatmaps: &heatmaps })
    }
}

impl StudySource {
    /// Exports the results in `folder` to a table in memory. Adds the comparisons of requested and applied parameters
    /// in recorded episodes to `checks`.
    fn exported(folder: &ExperimentFolder, checks: &mut Vec<ParameterCheck>) -> Result<Self, ReportError> {
        let plan = Plan::load(&folder.require_plan()?)?;
        let rows = export(&plan, folder, EXPORTED, |_, records| checks.push(records.agreement()))?;
        let mut table = ResultsTable::default();
        table.merge(EXPORTED, plan.for_table(), rows);
        let path = folder.path().to_owned();
        Ok(Self { table, name: EXPORTED.into(), episodes: PathBuf::new(), path })
    }

    /// Reads the recorded episodes of selected cells, if they exist, into `recorded`. For a study without a folder,
    /// also adds the comparisons of requested and applied parameters in all its episodes to `checks`. For a folder,
    /// `exported` has already added these comparisons.
    fn add_episodes(
        &self,
        folder: Option<&ExperimentFolder>,
        results: &Results<'_>,
        recorded: &mut Recorded,
        checks: &mut Vec<ParameterCheck>,
    ) -> Result<(), ReportError> {
        let Some(folder) = folder else {
            let episodes = StudyEpisodes::read_if_exists(&self.episodes)?.unwrap_or_default();
            for result in results.done() {
                let records = episodes.of_cell(&result.id);
                checks.extend(records.map(Records::agreement));
                records.into_iter().for_each(|records| recorded.add(result, records));
            }
            return Ok(());
        };
        for result in results.done() {
            if !recorded.wants(&result.id) {
                continue;
            }
            match Records::read(&folder.cell(&result.id).path().join(FILE)) {
                Err(RecordsError::Missing { .. }) => {}
                records => recorded.add(result, &records?),
            }
        }
        Ok(())
    }

    /// Reads the study that `path` names: `FILE.parquet/STUDY`, or `FILE.parquet` if it contains a single study.
    /// Returns `None` if `path` does not lead to a Parquet file.
    fn find(path: &Path) -> Result<Option<Self>, ReportError> {
        let Some((file, table, study)) = ResultsTable::find(path)? else { return Ok(None) };
        let known: Vec<String> = table.studies.keys().cloned().collect();
        let name = match &known[..] {
            [only] if study.is_empty() => only.clone(),
            _ if known.contains(&study) => study,
            _ => return Err(ReportError::NoStudy { table: file, study, known }),
        };
        let episodes = StudyEpisodes::path(file.parent().unwrap_or(Path::new("")), &name);
        Ok(Some(Self { table, name, path: path.to_owned(), episodes }))
    }

    /// Returns the plan of the study, expanded.
    fn plan(&self) -> Result<Plan, PlanError> {
        self.table.studies.get(&self.name).map_or_else(
            || Ok(Plan::without_cells()), // unreachable: `find` has checked that the table has the study
            |plan| Plan::of_study(&self.name, plan),
        )
    }
}

/// Returns the plan with the cells that its selection adds. If `rule` is given, it replaces the plan's selection rule.
fn selected_plan(plan: Plan, states: Option<&dyn CellStates>, rule: Option<Selection>) -> Result<Plan, ReportError> {
    let Some(states) = states else { return Ok(plan) };
    let rule = rule.unwrap_or(plan.selection);
    Ok(plan.with_rule(rule)?.with_selected_cells(states)?)
}
