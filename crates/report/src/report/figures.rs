//! The pictures of a report, and what is said of those that are missing.

use perturb_experiment::{EnvironmentCurves, Footing, MethodResults, NoHeatmap};

use crate::against_training::{against_training, test_curves};
use crate::plot::{Panels, PlotError, Quantity, draw_curves, draw_tests, svg};

use super::figure::{Figure, FigureData};
use super::{HeatmapPicture, Picture, Report};

/// All pictures of a report.
#[derive(Clone, Debug, Default)]
pub struct Figures {
    /// What the page opens with.
    pub finding: Vec<Figure>,
    /// The same of each environment, if the page opens with all together.
    pub metrics: Vec<Figure>,
    /// Of all environments together.
    pub profiles: Vec<Figure>,
    /// Of all environments together.
    pub gains: Vec<Figure>,
    /// One for each environment and version that was trained on.
    pub parameters: Vec<Figure>,
    /// One for each environment.
    pub thresholds: Vec<Figure>,
    /// One for each setting of a grid.
    pub settings: Vec<Figure>,
    /// One for each environment, quantity and footing.
    pub curves: Vec<Figure>,
    /// Of tests of the policies of earlier moments: one for each environment, version that was trained on, and quantity.
    pub marks: Vec<Figure>,
    /// What is said of curves that are missing.
    pub no_curves: Vec<String>,
    /// One for each environment, pair of parameters, and method.
    pub heatmaps: Vec<Figure>,
    /// What to do about heatmaps that are missing.
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
        for (trained_on, curves) in test_curves(&against_training(selections)) {
            let environment = &curves.environment;
            for quantity in Quantity::ALL {
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
            for (by, quantity) in Footing::ALL.into_iter().flat_map(|by| Quantity::ALL.map(|quantity| (by, quantity))) {
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

/// What to do about the heatmaps that are missing.
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
