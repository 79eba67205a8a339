//! The pictures of a report, and what is said of those that are missing.

use crate::against_training::{against_training, test_curves};
use crate::curves::{EnvironmentCurves, Footing};
use crate::folder::Folder;
use crate::heatmap::HeatmapOptions;
use crate::heatmaps::{HeatmapRecord, NoHeatmap, heatmap_places};
use crate::plot::{PlotError, Quantity, draw_curves, draw_tests, svg};
use crate::scheduler::count;
use crate::selection::MethodResults;

use super::{Picture, Report};

/// All pictures of a report.
#[derive(Clone, Debug, Default)]
pub struct Figures {
    /// Of all environments together.
    pub profiles: Vec<Figure>,
    /// One for each environment and version that was trained on.
    pub parameters: Vec<Figure>,
    /// One for each environment.
    pub thresholds: Vec<Figure>,
    /// One for each environment, quantity and footing.
    pub curves: Vec<Figure>,
    /// Of tests of the policies of earlier moments: one for each environment, version that was trained on, and quantity.
    pub marks: Vec<Figure>,
    /// What is said of curves that are missing.
    pub no_curves: Vec<String>,
    /// Heatmaps in rows, one of a method's trainings.
    pub heatmaps: Vec<Vec<Figure>>,
    /// What to do about heatmaps that are missing.
    pub no_heatmaps: Vec<String>,
}

/// A picture as it is shown, or the place of one that is missing.
#[derive(Clone, Debug)]
pub struct Figure {
    /// Figures of one environment stand together.
    pub environment: String,
    /// A few words for those who do not see it.
    pub name: String,
    /// What the picture shows, or why it is missing.
    pub caption: String,
    /// SVG and PNG are complete in themselves.
    pub picture: FigureData,
}

/// What is shown of a picture.
#[derive(Clone, Debug)]
pub enum FigureData {
    /// An SVG element.
    Svg(String),
    /// A PNG file.
    Png(Vec<u8>),
    /// There is none; the caption says why.
    Missing,
}

impl Figures {
    /// Draws the pictures of `report` and its training `curves`, and reads the heatmaps of its selections from `folder`.
    ///
    /// # Errors
    /// [`PlotError`].
    pub fn read(report: &Report<'_>, curves: &[EnvironmentCurves], folder: &Folder) -> Result<Self, PlotError> {
        let drawn = |pictures: Vec<Picture>| pictures.iter().map(Picture::figure).collect::<Result<_, _>>();
        let mut figures = Self {
            profiles: drawn(report.profiles_picture().into_iter().collect())?,
            parameters: drawn(report.parameter_pictures())?,
            thresholds: drawn(report.threshold_pictures())?,
            ..Self::default()
        };
        figures.add_marks(report.selections)?;
        figures.add_curves(curves)?;
        figures.add_heatmaps(report.selections, folder)?;
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
                    caption: format!("{name}. Lines are means over runs, bands their standard deviation."),
                    name,
                    picture: FigureData::Svg(svg(&draw_tests(&curves, trained_on, quantity))?),
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
                    name: format!("{environment}: {quantity} while training, over {by}"),
                    caption: format!(
                        "{environment}: {quantity} while training, over {by}, of the selected configurations. Lines are means \
                         over runs, bands their standard deviation."
                    ),
                    picture: FigureData::Svg(svg(&draw_curves(curves, quantity, by))?),
                });
            }
        }
        Ok(())
    }

    fn add_heatmaps(&mut self, selections: &[MethodResults<'_>], folder: &Folder) -> Result<(), PlotError> {
        let places = heatmap_places(selections);
        let mut missing = Vec::new();
        for row in places.chunk_by(|a, b| (a.environment, a.method) == (b.environment, b.method)) {
            let mut figures = Vec::new();
            for place in row {
                let (caption, picture) = match place.read(folder)? {
                    Ok(heatmap) => (format!("{place}{}", details(&heatmap.record)), FigureData::Png(heatmap.png)),
                    Err(why) => {
                        missing.push(why);
                        (format!("{place}: {why}."), FigureData::Missing)
                    }
                };
                figures.push(Figure {
                    environment: place.environment.to_owned(),
                    name: format!("{place}: mean return and success over two parameters"),
                    caption,
                    picture,
                });
            }
            self.heatmaps.push(figures);
        }
        self.no_heatmaps = advice(&missing, places.len());
        Ok(())
    }
}

/// What to do about the heatmaps that are missing, of so many.
fn advice(missing: &[NoHeatmap], all: usize) -> Vec<String> {
    let waiting = missing.iter().filter(|why| **why == NoHeatmap::NoResult).count();
    let makeable = missing.len() - waiting;
    let make = format!(
        "Heatmaps that are not there: {makeable} of {all}. `perturb heatmap DIR` makes them, where DIR is the folder of \
         these results."
    );
    let wait = format!("Heatmaps that wait for the results of their trainings: {waiting} of {all}.");
    [(makeable, make), (waiting, wait)].into_iter().filter(|(count, _)| *count > 0).map(|(_, advice)| advice).collect()
}

/// What a heatmap's caption says after who was tested.
fn details(record: &HeatmapRecord) -> String {
    let HeatmapOptions { parameters: [x, y], grid, episodes, seed, .. } = &record.options;
    let episodes = count(*episodes as usize, "episode");
    format!(
        " with seed {}: {x} and {y}, {grid} × {grid} points of {episodes}, test seed {seed}. Cell {}, checkpoint {}, \
         perturb {}.",
        record.train_seed, record.cell, record.checkpoint, record.commit
    )
}
