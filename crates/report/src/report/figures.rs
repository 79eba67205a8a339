//! The pictures of a report, and what is said of those that are missing.

use perturb_experiment::{BudgetAxis, EnvironmentCurves, MethodResults, NoHeatmap};

use crate::generalization_curves::{generalization_curves, test_curves};
use crate::plot::{CurveQuantity, Panels, PlotError, draw_curves, draw_tests, svg};

use super::figure::{Figure, FigureData};
use super::{HeatmapPicture, Picture, Report};

/// All pictures of a report.
#[derive(Clone, Debug, Default)]
pub struct Figures {
    /// The first figures of the page.
    pub finding: Vec<Figure>,
    /// The first figures for each environment, if the page begins with all together.
    pub metrics: Vec<Figure>,
    /// Performance profiles over all environments.
    pub profiles: Vec<Figure>,
    /// Paired differences over all environments.
    pub gains: Vec<Figure>,
    /// Success over parameters: a figure for each environment and training version.
    pub parameters: Vec<Figure>,
    /// Success over thresholds: a figure for each environment.
    pub thresholds: Vec<Figure>,
    /// A figure for each setting of a grid.
    pub settings: Vec<Figure>,
    /// Training curves: a figure for each environment, quantity and axis.
    pub curves: Vec<Figure>,
    /// Tests of intermediate policies: a figure for each environment, training version and quantity.
    pub marks: Vec<Figure>,
    /// Notes about missing curves.
    pub no_curves: Vec<String>,
    /// Heatmaps: a figure for each environment, pair of parameters, and method.
    pub heatmaps: Vec<Figure>,
    /// Advice about missing heatmaps.
    pub no_heatmaps: Vec<String>,
}

impl Figures {
    /// Draws the pictures of `report`, its training `curves` and the `heatmaps` of its selections.
    ///
    /// # Errors
    /// [`PlotError`].
    pub fn draw(
        report: &Report<'_>,
        curves: &[EnvironmentCurves],
        heatmaps: &[HeatmapPicture],
    ) -> Result<Self, PlotError> {
        let drawn = |pictures: Vec<Picture>| pictures.iter().map(Picture::figure).collect::<Result<_, _>>();
        let mut figures = Self {
            finding: drawn(report.finding_pictures())?,
            metrics: drawn(report.environment_pictures())?,
            profiles: drawn(report.profiles_picture().into_iter().collect())?,
            gains: drawn(report.gains_picture().into_iter().collect())?,
            parameters: drawn(report.parameter_pictures())?,
            thresholds: drawn(report.threshold_pictures())?,
            settings: drawn(report.settings_pictures())?,
            ..Self::default()
        };
        figures.add_marks(report.selections)?;
        figures.add_curves(curves)?;
        figures.heatmaps = heatmaps.iter().map(HeatmapPicture::figure).collect::<Result<_, _>>()?;
        figures.no_heatmaps = advice(heatmaps);
        Ok(figures)
    }

    fn add_marks(&mut self, selections: &[MethodResults<'_>]) -> Result<(), PlotError> {
        for (trained_on, curves) in test_curves(&generalization_curves(selections)) {
            let environment = &curves.environment;
            for quantity in CurveQuantity::ALL {
                let name =
                    format!("{environment}, trained on {trained_on}: {quantity} in tests after so many episodes");
                self.marks.push(Figure {
                    environment: environment.clone(),
                    file: format!("{environment}-{}-tests-{quantity}", trained_on.file_name()),
                    caption: format!("{name}. Lines are means over runs, bands their standard deviation."),
                    name,
                    picture: figure_data(&draw_tests(&curves, trained_on, quantity))?,
                });
            }
        }
        Ok(())
    }

    fn add_curves(&mut self, curves: &[EnvironmentCurves]) -> Result<(), PlotError> {
        for curves in curves {
            let environment = &curves.environment;
            if curves.curves.is_empty() {
                self.no_curves.push(format!("{environment}: no training with a result has its monitor.csv."));
                continue;
            }
            for (by, quantity) in
                BudgetAxis::ALL.into_iter().flat_map(|by| CurveQuantity::ALL.map(|quantity| (by, quantity)))
            {
                self.curves.push(Figure {
                    environment: environment.clone(),
                    file: format!("{environment}-{quantity}-over-{by}"),
                    name: format!("{environment}: {quantity} while training, over {by}"),
                    caption: format!(
                        "{environment}: {quantity} while training, over {by}, of the selected configurations. Lines are means \
                         over runs, bands their standard deviation."
                    ),
                    picture: figure_data(&draw_curves(curves, quantity, by))?,
                });
            }
        }
        Ok(())
    }
}

fn figure_data(panels: &Panels) -> Result<FigureData, PlotError> {
    Ok(FigureData::Svg { svg: svg(panels)?, csv: panels.table().to_csv() })
}

/// Returns advice about the missing heatmaps.
fn advice(heatmaps: &[HeatmapPicture]) -> Vec<String> {
    let all: usize = heatmaps.iter().map(|picture| picture.wanted).sum();
    let missing: Vec<NoHeatmap> = heatmaps.iter().flat_map(|picture| picture.missing.iter().copied()).collect();
    let waiting = missing.iter().filter(|why| **why == NoHeatmap::NoResult).count();
    let makeable = missing.len() - waiting;
    let make = format!(
        "Heatmaps that are not there: {makeable} of {all}. `perturb heatmap DIR` makes them, where DIR is the folder of \
         these results; `--x`, `--y` and `--base-version` say over what."
    );
    let wait = format!("Heatmaps that wait for the results of their trainings: {waiting} of {all}.");
    [(makeable, make), (waiting, wait)].into_iter().filter(|(count, _)| *count > 0).map(|(_, advice)| advice).collect()
}
