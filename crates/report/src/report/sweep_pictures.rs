//! Pictures of success over parameters and over the threshold.

use perturb_experiment::distinct;
use perturb_protocol::Version;
use perturb_records::{RecordedParameter, Scenario, TrainedOn};

use super::Report;
use super::pictures::{Picture, PictureDrawing};
use super::sweeps::{AtParameter, AtThreshold, SweepPoint, side};
use crate::plot::panels::{PanelLine, Panels, PlotPanel, RATES, index_of};

/// The explanation of a band.
const WILSON: &str = "All runs together; bands: 95 % Wilson intervals.";

impl Report<'_> {
    /// Returns a picture for each environment and training distribution, with a panel for each parameter.
    pub(super) fn parameter_pictures(&self) -> Vec<Picture> {
        let all = self.over_parameters.iter();
        let all: Vec<_> = all.filter(|row| Version::ALL.iter().any(|it| it.to_string() == row.tested_on)).collect();
        let mut pictures = Vec::new();
        for environment in self.scope.environments.iter().copied() {
            for trained_on in Version::KNOWN.map(TrainedOn::Version).into_iter().chain([TrainedOn::Unknown]) {
                let is_of = |row: &&&SweepPoint<'_, AtParameter<'_>>| {
                    row.environment == environment && row.trained_on == trained_on
                };
                let rows: Vec<_> = all.iter().filter(is_of).copied().collect();
                if !rows.is_empty() {
                    pictures.push(self.parameter_picture(environment, trained_on, &rows));
                }
            }
        }
        pictures
    }

    fn parameter_picture(
        &self,
        environment: &str,
        trained_on: TrainedOn<'_>,
        rows: &[&SweepPoint<'_, AtParameter<'_>>],
    ) -> Picture {
        let trained = match trained_on {
            TrainedOn::Unknown => "whose training's parameters are not known".to_owned(),
            trained_on => format!("trained on {trained_on}"),
        };
        let methods = &self.scope.methods;
        let parameters = distinct(rows.iter().map(|row| &row.at.parameter.name));
        let panel = |name: &&String| {
            let rows: Vec<_> = rows.iter().copied().filter(|row| row.at.parameter.name == **name).collect();
            let RecordedParameter { name, unit, .. } = rows[0].at.parameter;
            // A line ends where a test ends, and where it draws nothing.
            let joined = |a: &&SweepPoint<'_, AtParameter<'_>>, b: &&SweepPoint<'_, AtParameter<'_>>| {
                (a.method, a.tested_on, a.at.bin.high) == (b.method, b.tested_on, b.at.bin.low)
            };
            let line = |rows: &[&SweepPoint<'_, AtParameter<'_>>]| PanelLine {
                index: index_of(methods, rows[0].method),
                points: rows.iter().map(|row| row.point((row.at.bin.low + row.at.bin.high) / 2.0)).collect(),
            };
            let low = rows.iter().map(|row| row.at.bin.low).fold(f64::INFINITY, f64::min);
            let high = rows.iter().map(|row| row.at.bin.high).fold(f64::NEG_INFINITY, f64::max);
            PlotPanel {
                caption: name.clone(),
                x_name: if unit == "1" { name.clone() } else { format!("{name}, {unit}") },
                x: low..high,
                y_name: "success rate, %".into(),
                y: RATES,
                lines: rows.chunk_by(joined).map(line).collect(),
                mark: None,
            }
        };
        let panels = Panels {
            title: format!("{environment}, {trained}: success over each parameter"),
            panels: parameters.iter().map(panel).collect(),
            legend: methods.iter().map(ToString::to_string).collect(),
            note: WILSON.into(),
        };
        Picture {
            environment: environment.into(),
            file: format!("{environment}-{}-parameters", trained_on.file_name()),
            name: format!("{environment}: success over each parameter, {trained}"),
            caption: format!(
                "{environment}: success of policies {trained}, by the value that a parameter had in tests on R \
                 (inside) and on E (outside), where the others are drawn, too. All runs together; bands are 95 % Wilson \
                 intervals."
            ),
            data: panels.table(),
            drawing: PictureDrawing::Panels(panels),
        }
    }

    /// Returns a picture for each environment, with a panel for each scenario of a metric.
    pub(super) fn threshold_pictures(&self) -> Vec<Picture> {
        let of_environments = self.over_thresholds.chunk_by(|a, b| a.environment == b.environment);
        of_environments.map(|rows| self.threshold_picture(rows)).collect()
    }

    fn threshold_picture(&self, rows: &[SweepPoint<'_, AtThreshold<'_>>]) -> Picture {
        use Version::{D, E, R};
        let methods = &self.scope.methods;
        let (environment, criterion) = (rows[0].environment, rows[0].at.criterion);
        let ends = |row: &[SweepPoint<'_, AtThreshold<'_>>]| {
            row.first().map(|a| a.at.threshold).zip(row.last().map(|b| b.at.threshold))
        };
        let of_lines =
            || rows.chunk_by(|a, b| (a.method, a.trained_on, a.tested_on) == (b.method, b.trained_on, b.tested_on));
        let (low, high) = of_lines().next().and_then(ends).unwrap_or_default();
        let unit = if criterion.unit == "1" { String::new() } else { format!(", {}", criterion.unit) };
        let panel = |scenario: Scenario| {
            let is_of = |row: &SweepPoint<'_, AtThreshold<'_>>| {
                row.trained_on == TrainedOn::Version(scenario.train) && row.tested_on == scenario.test.to_string()
            };
            let line = |rows: &[SweepPoint<'_, AtThreshold<'_>>]| PanelLine {
                index: index_of(methods, rows[0].method),
                points: rows.iter().map(|row| row.point(row.at.threshold)).collect(),
            };
            PlotPanel {
                caption: format!("trained on {}, tested on {}", scenario.train, scenario.test),
                x_name: format!("{} {} …{unit}", criterion.quantity, side(criterion)),
                x: low..if high > low { high } else { low + 1.0 },
                y_name: "success rate, %".into(),
                y: RATES,
                lines: of_lines().filter(|rows| is_of(&rows[0])).map(line).collect(),
                mark: Some(criterion.threshold),
            }
        };
        let scenarios = [(D, D), (R, R), (D, R), (D, E), (R, E)].map(|(train, test)| Scenario { train, test });
        let panels = Panels {
            title: format!("{environment}: success over the threshold of success; dotted: the rule's"),
            panels: scenarios.map(panel).into_iter().filter(|panel| !panel.lines.is_empty()).collect(),
            legend: methods.iter().map(ToString::to_string).collect(),
            note: WILSON.into(),
        };
        Picture {
            environment: environment.into(),
            file: format!("{environment}-thresholds"),
            name: format!("{environment}: success over the threshold of success"),
            caption: format!(
                "{environment}: success by other thresholds than the rule's, {criterion}, which the dotted line marks. All \
                 runs together; bands are 95 % Wilson intervals."
            ),
            data: panels.table(),
            drawing: PictureDrawing::Panels(panels),
        }
    }
}
