//! From what a report is made: an experiment's folder, assessments of agents that were trained elsewhere, or both.

use std::path::{Path, PathBuf};

use perturb_experiment::{
    EnvironmentCurves, Folder, FolderError, Plan, PlanError, Recorded, Results, Selection, VerifyError, add_assessed,
    judged_as_in, read_curves, verify,
};
use perturb_records::{ExternalEvaluation, ExternalEvaluationError};
use perturb_settings::ValueError;

use super::{Figures, HeatmapPicture, Report, heatmap_pictures, html};
use crate::plot::PlotError;

/// The inputs of a report.
#[derive(Clone, Debug, Default)]
pub struct ReportInputs {
    /// An experiment; `None` for assessments alone.
    pub folder: Option<Folder>,
    /// In the place of its plan's.
    pub rule: Option<Selection>,
    /// In the order of their rows.
    pub assessed: Vec<ExternalEvaluation>,
}

/// Why there is no report.
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
    Verify(#[from] VerifyError),
    /// A folder has neither.
    #[error(
        "{} holds neither an experiment (plan.toml) nor an assessment (assessment.json): give the --out of `perturb run`, \
         or the folder of Assessment.save",
        path.display()
    )]
    Neither { path: PathBuf },
    /// There are two experiments.
    #[error("{} and {} are both experiments: a report is of one, and of any number of assessments", first.display(), second.display())]
    Experiments { first: PathBuf, second: PathBuf },
}

/// A report with what is drawn beside its own numbers.
pub struct ReportBundle<'a> {
    /// The numbers.
    pub report: Report<'a>,
    /// The training curves.
    pub curves: &'a [EnvironmentCurves],
    /// The heatmaps.
    pub heatmaps: &'a [HeatmapPicture],
}

impl ReportInputs {
    /// Adds what is in the folder `path`.
    ///
    /// # Errors
    /// [`ReportError`] if there is nothing, or a second experiment.
    pub fn add(&mut self, path: &Path) -> Result<(), ReportError> {
        let folder = Folder::new(path);
        if ExternalEvaluation::is_in(path) {
            self.assessed.push(ExternalEvaluation::read(path)?);
        } else if folder.require_plan().is_err() {
            return Err(ReportError::Neither { path: path.to_owned() });
        } else if let Some(first) = self.folder.replace(folder) {
            return Err(ReportError::Experiments { first: first.path().to_owned(), second: path.to_owned() });
        }
        Ok(())
    }

    /// The rule by which configurations are selected, if it is another one than the plan's.
    ///
    /// # Errors
    /// [`ReportError`].
    pub fn another_rule(&self) -> Result<Option<Selection>, ReportError> {
        let Some((folder, rule)) = self.folder.as_ref().zip(self.rule) else { return Ok(None) };
        let of_plan = Plan::load(&folder.require_plan()?)?.selection;
        Ok((rule != of_plan).then_some(rule))
    }

    /// Reads everything, and gives the report to `make`.
    ///
    /// # Errors
    /// [`ReportError`], and those of `make`.
    pub fn read<T, E: From<ReportError>>(self, make: impl FnOnce(ReportBundle<'_>) -> Result<T, E>) -> Result<T, E> {
        let Self { folder, rule, assessed } = self;
        let plan = match &folder {
            None => Plan::without_cells(),
            Some(folder) => plan_of(folder, rule)?,
        };
        let assessed = assessed.into_iter().map(|one| judged_as_in(&plan, one)).collect::<Result<Vec<_>, _>>();
        let assessed = assessed.map_err(ReportError::from)?;
        let results = match &folder {
            None => Results { plan: &plan, states: Vec::new() },
            Some(folder) => Results::read(&plan, folder).map_err(ReportError::from)?,
        };
        let mut selections = results.select();
        let mut recorded = Recorded::new(&selections);
        let mut curves = Vec::new();
        if let Some(folder) = &folder {
            verify(&results, folder, |result, records| recorded.add(result, records)).map_err(ReportError::from)?;
            curves = read_curves(&selections, folder).map_err(ReportError::from)?;
        }
        add_assessed(&mut selections, &assessed);
        let heatmaps = heatmap_pictures(&selections, folder.as_ref()).map_err(ReportError::from)?;
        let report = Report::new(&results, &selections, &recorded, &curves);
        make(ReportBundle { report, curves: &curves, heatmaps: &heatmaps })
    }
}

impl ReportBundle<'_> {
    /// Everything as one HTML page that needs nothing else.
    ///
    /// # Errors
    /// [`PlotError`].
    pub fn page(&self) -> Result<String, PlotError> {
        Ok(html(&self.report, &Figures::draw(&self.report, self.curves, self.heatmaps)?))
    }
}

fn plan_of(folder: &Folder, rule: Option<Selection>) -> Result<Plan, ReportError> {
    let plan = Plan::load(&folder.require_plan()?)?;
    let rule = rule.unwrap_or(plan.selection);
    Ok(plan.with_rule(rule)?.with_selected_cells(folder)?)
}
