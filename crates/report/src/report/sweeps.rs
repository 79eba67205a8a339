//! Success rate over the value of a parameter, from the recorded episodes of all runs together.

use perturb_experiment::{MethodResults, Recorded, distinct};
use perturb_protocol::Version;
use perturb_records::outcomes::{Bin, Outcomes, PolicyOutcomes, SuccessCount, bins, success_within};
use perturb_records::{RecordedParameter, TrainedOn};
use perturb_settings::Method;
use perturb_text::Table;

use super::Report;
use super::columns::MethodColumns;
use super::index::{ReportIndex, trained_on};
use super::pictures::{Picture, PictureDrawing};
use crate::plot::panels::{PanelLine, PanelPoint, Panels, PlotPanel, RATES, index_of};

/// The successes of a method in one bin of a parameter's range, counted over all runs.
pub(super) struct SweepPoint<'a> {
    environment: &'a str,
    method: &'a Method,
    trained_on: TrainedOn<'a>,
    tested_on: &'a str,
    parameter: &'a RecordedParameter,
    bin: Bin,
    runs: usize,
    counted: SuccessCount,
}

/// The selected policies of a method and a training distribution that have recorded episodes, one for each run.
struct PolicyGroup<'a> {
    method: &'a Method,
    trained_on: TrainedOn<'a>,
    policies: Vec<&'a PolicyOutcomes>,
}

impl<'a> PolicyGroup<'a> {
    /// Returns the outcomes of the test `tested_on`, for each run that has it.
    fn tests(&self, tested_on: &'a str) -> impl Iterator<Item = &'a Outcomes> {
        self.policies.iter().filter_map(move |policy| policy.test(tested_on))
    }
}

/// Counts successes over each parameter that varies in a test. All methods of an environment have the same bins. Bins
/// without episodes are left out.
pub(super) fn over_parameters<'a>(
    scope: &ReportIndex<'a>,
    selections: &'a [MethodResults<'a>],
    recorded: &'a Recorded,
) -> Vec<SweepPoint<'a>> {
    let mut all = Vec::new();
    for rows in selections.chunk_by(|a, b| a.environment == b.environment) {
        let environment = rows[0].environment;
        // Collects the selected policies that have recorded episodes, by method and training distribution.
        let group = |row: &'a MethodResults<'a>, trained_on: TrainedOn<'a>| {
            let selected = row.runs.values().filter_map(|run| run.trained_on(trained_on));
            let policies = selected.filter_map(|selected| recorded.policy(&selected)).collect();
            PolicyGroup { method: &row.method, trained_on, policies }
        };
        let groups =
            rows.iter().flat_map(|row| trained_on(row).into_iter().map(move |trained_on| group(row, trained_on)));
        let groups: Vec<_> = groups.filter(|group| !group.policies.is_empty()).collect();
        let Some(parameters) = groups.first().map(|group| &group.policies[0].parameters) else { continue };
        for &tested_on in &scope.tested_on {
            // Divides the range of each parameter into bins, and counts the successes of each group of policies in each
            // bin.
            for (place, parameter) in parameters.iter().enumerate() {
                let bins = bins(groups.iter().flat_map(|group| group.tests(tested_on)), place);
                for group in &groups {
                    let tests = group.tests(tested_on);
                    let by_run: Vec<Vec<SuccessCount>> = tests.map(|test| success_within(test, place, &bins)).collect();
                    let PolicyGroup { method, trained_on, .. } = *group;
                    for (index, &bin) in bins.iter().enumerate() {
                        let counted: SuccessCount = by_run.iter().map(|bins| bins[index]).sum();
                        let runs = by_run.len();
                        if counted.episodes > 0 {
                            all.push(SweepPoint {
                                environment,
                                method,
                                trained_on,
                                tested_on,
                                parameter,
                                bin,
                                runs,
                                counted,
                            });
                        }
                    }
                }
            }
        }
    }
    all
}

impl Report<'_> {
    /// Returns the file `parameters.csv`: success in each bin of each parameter.
    pub(super) fn parameters_file(&self) -> Table {
        Table::builder("parameters.csv", &self.over_parameters)
            .text("environment", |row| row.environment)
            .method(|row| row.method)
            .text("train", |row| row.trained_on)
            .text("test", |row| row.tested_on)
            .text("parameter", |row| &row.parameter.name)
            .text("unit", |row| &row.parameter.unit)
            .number("low", |row| row.bin.low)
            .number("high", |row| row.bin.high)
            .number("runs", |row| row.runs)
            .number("episodes", |row| row.counted.episodes)
            .number("successes", |row| row.counted.successes)
            .number("success_percent", |row| row.counted.rate())
            .number("low_95", |row| row.counted.interval()[0])
            .number("high_95", |row| row.counted.interval()[1])
            .build()
    }

    /// Returns a picture for each environment and training version, and for policies of unknown training. A picture has
    /// a panel for each parameter. Only tests on D, R and E are shown. Trainings on the plan's own parameter sets are
    /// left out.
    pub(super) fn parameter_pictures(&self) -> Vec<Picture> {
        let is_of_version = |row: &&SweepPoint<'_>| Version::ALL.iter().any(|it| it.to_string() == row.tested_on);
        let all: Vec<_> = self.over_parameters.iter().filter(is_of_version).collect();
        let mut pictures = Vec::new();
        for &environment in &self.scope.environments {
            for trained_on in Version::KNOWN.map(TrainedOn::Version).into_iter().chain([TrainedOn::Unknown]) {
                let is_of = |row: &&SweepPoint<'_>| (row.environment, row.trained_on) == (environment, trained_on);
                let rows: Vec<_> = all.iter().copied().filter(is_of).collect();
                if !rows.is_empty() {
                    pictures.push(self.parameter_picture(environment, trained_on, &rows));
                }
            }
        }
        pictures
    }

    /// Returns the picture of an environment and a training distribution. `rows` are all points of the picture.
    fn parameter_picture(&self, environment: &str, trained_on: TrainedOn<'_>, rows: &[&SweepPoint<'_>]) -> Picture {
        let trained = match trained_on {
            TrainedOn::Unknown => "with an unknown training distribution".to_owned(),
            trained_on => format!("trained on {trained_on}"),
        };
        let parameters = distinct(rows.iter().map(|row| &row.parameter.name));
        let of = |name: &String| rows.iter().copied().filter(|row| row.parameter.name == *name).collect::<Vec<_>>();
        let panels = Panels {
            title: format!("{environment}, {trained}: success over each parameter"),
            panels: parameters.iter().map(|name| self.parameter_panel(&of(name))).collect(),
            legend: self.scope.methods.iter().map(ToString::to_string).collect(),
            note: "All runs together; bands: 95 % Wilson intervals.".into(),
        };
        Picture {
            environment: environment.into(),
            file: format!("{environment}-{}-parameters", trained_on.file_name()),
            name: format!("{environment}: success over each parameter, {trained}"),
            caption: format!(
                "{environment}: success of policies {trained}, by the value that a parameter had in tests on R \
                 (inside) and on E (outside), in which the other parameters are drawn as well. All runs together; \
                 bands are 95 % Wilson intervals."
            ),
            data: panels.table(),
            drawing: PictureDrawing::Panels(panels),
        }
    }

    /// Returns the panel of a parameter. `rows` are all points of this parameter.
    fn parameter_panel(&self, rows: &[&SweepPoint<'_>]) -> PlotPanel {
        let RecordedParameter { name, unit, .. } = rows[0].parameter;
        // A line joins neighbouring bins of the same method and test. It is interrupted at bins without episodes.
        let joined = |a: &&SweepPoint<'_>, b: &&SweepPoint<'_>| {
            (a.method, a.tested_on, a.bin.high) == (b.method, b.tested_on, b.bin.low)
        };
        let point = |SweepPoint { bin, counted, .. }: &&SweepPoint<'_>| {
            let [low, high] = counted.interval();
            PanelPoint { x: (bin.low + bin.high) / 2.0, y: counted.rate(), low, high }
        };
        let line = |rows: &[&SweepPoint<'_>]| PanelLine {
            index: index_of(&self.scope.methods, rows[0].method),
            points: rows.iter().map(point).collect(),
        };
        let low = rows.iter().map(|row| row.bin.low).fold(f64::INFINITY, f64::min);
        let high = rows.iter().map(|row| row.bin.high).fold(f64::NEG_INFINITY, f64::max);
        PlotPanel {
            caption: name.clone(),
            x_name: if unit == "1" { name.clone() } else { format!("{name}, {unit}") },
            x: low..high,
            y_name: "success rate, %".into(),
            y: RATES,
            lines: rows.chunk_by(joined).map(line).collect(),
        }
    }
}
