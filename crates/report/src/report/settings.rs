//! Effects of settings: tests of every point of a grid, selected or not, by configuration and by the value of each
//! setting that differs.

use std::collections::{BTreeMap, BTreeSet};

use perturb_experiment::{Cell, CellResult, CellState, Results, distinct};
use perturb_records::statistics::{Bootstrapped, Summary, mean, mean_with_t_interval};
use perturb_records::{TestResult, TrainedOn};
use perturb_settings::Method;
use perturb_text::{Table, TableBuilder};

use super::columns::MethodColumns;
use super::numbers::or_empty;
use super::pictures::{Picture, PictureDrawing, file_name};
use super::{MISSING, Report};
use crate::plot::panels::{PanelLine, PanelPoint, Panels, PlotPanel, RATES};

/// A method's trainings on something, of all configurations, where there are several.
struct SettingsGrid<'a> {
    environment: &'a str,
    method: Method,
    trained_on: TrainedOn<'a>,
    cells: Vec<GridCell<'a>>,
}

struct GridCell<'a> {
    cell: &'a Cell,
    /// All as they are written, without the seed.
    settings: BTreeMap<String, String>,
    result: Option<&'a CellResult>,
}

/// Tests of what some configurations have learned at a moment.
pub(super) struct GridTest<'a> {
    environment: &'a str,
    method: Method,
    trained_on: TrainedOn<'a>,
    /// The setting whose value they share and the value, or of a single configuration its digits and all that differs.
    what: (String, String),
    configurations: usize,
    /// Since the start of the training; `None` at the end of trainings of different lengths.
    episodes: Option<u64>,
    at_the_end: bool,
    tested_on: &'a str,
    /// %, over the runs in which all configurations have it; in each their mean.
    success: Summary,
    /// The mean again, %, with its t interval over runs.
    interval: Option<[f64; 2]>,
}

/// Tests of the points of grids.
#[derive(Default)]
pub(super) struct GridTests<'a> {
    /// By configuration, in the plan's order.
    pub(super) configurations: Vec<GridTest<'a>>,
    /// By the value of a setting.
    pub(super) settings: Vec<GridTest<'a>>,
}

/// Returns the tests of the cells that the plan lists. Cells of a second stage are left out, since they have one
/// configuration.
pub(super) fn grid_tests<'a>(results: &'a Results<'a>) -> GridTests<'a> {
    let mut tests = GridTests::default();
    for grid in grids(results) {
        let varied = grid.varied();
        for configuration in distinct(grid.cells.iter().map(|of| &of.cell.configuration)) {
            let cells: Vec<_> = grid.cells.iter().filter(|of| of.cell.configuration == *configuration).collect();
            let settings = varied.iter().filter_map(|name| Some(format!("{name}={}", cells[0].settings.get(*name)?)));
            let what = (configuration.clone(), settings.collect::<Vec<_>>().join(" "));
            tests.configurations.extend(grid.tests(&what, &cells));
        }
        for name in varied {
            for value in distinct(grid.cells.iter().filter_map(|of| of.settings.get(name))) {
                let cells: Vec<_> = grid.cells.iter().filter(|of| of.settings.get(name) == Some(value)).collect();
                tests.settings.extend(grid.tests(&(name.to_owned(), value.clone()), &cells));
            }
        }
    }
    tests
}

fn grids<'a>(results: &'a Results<'a>) -> Vec<SettingsGrid<'a>> {
    let mut grids: Vec<SettingsGrid<'a>> = Vec::new();
    for (cell, state) in results.plan.cells.iter().zip(&results.states).filter(|(cell, _)| cell.tuned_as.is_none()) {
        let (environment, method) = (cell.config.common.environment.as_str(), cell.method());
        let trained_on = cell.trained_on();
        let is_of = |grid: &&mut SettingsGrid<'a>| {
            (grid.environment, &grid.method, grid.trained_on) == (environment, &method, trained_on)
        };
        let settings = cell.config.complete_table().into_iter().filter(|(name, _)| name != "seed");
        let settings = settings.map(|(name, value)| (name, value.to_string())).collect();
        let result = if let CellState::Done(result) = state { Some(&**result) } else { None };
        let cell = GridCell { cell, settings, result };
        match grids.iter_mut().find(is_of) {
            Some(grid) => grid.cells.push(cell),
            None => grids.push(SettingsGrid { environment, method, trained_on, cells: vec![cell] }),
        }
    }
    grids.retain(|grid| !grid.varied().is_empty());
    grids
}

impl<'a> SettingsGrid<'a> {
    /// Settings that differ between configurations.
    fn varied(&self) -> Vec<&str> {
        let names: BTreeSet<&String> = self.cells.iter().flat_map(|of| of.settings.keys()).collect();
        let differs = |name: &&String| {
            let values: BTreeSet<_> = self.cells.iter().map(|of| of.settings.get(*name)).collect();
            values.len() > 1
        };
        names.into_iter().filter(differs).map(String::as_str).collect()
    }

    /// Returns the tests of `cells`, which share `what`, on each test set and after each number of episodes.
    fn tests(&self, what: &(String, String), cells: &[&GridCell<'a>]) -> Vec<GridTest<'a>> {
        let budgets: BTreeSet<u64> = cells.iter().map(|of| of.cell.config.common.episodes).collect();
        let one_end = if budgets.len() == 1 { budgets.first().copied() } else { None };
        let mut moments: BTreeSet<Option<u64>> = cells.iter().flat_map(|of| of.moments()).map(Some).collect();
        moments.insert(one_end);
        let names = distinct(cells.iter().flat_map(|of| &of.cell.tests.sets).map(|set| set.name.as_str()));
        let runs: BTreeSet<u32> = cells.iter().map(|of| of.cell.run).collect();
        let configurations = distinct(cells.iter().map(|of| &of.cell.configuration)).len();
        let mut tests = Vec::new();
        for (tested_on, &episodes) in names.iter().flat_map(|name| moments.iter().map(move |moment| (*name, moment))) {
            let rate = |run: &u32| {
                let of_run = cells.iter().filter(|of| of.cell.run == *run);
                let rates: Option<Vec<f64>> =
                    of_run.map(|of| of.test(episodes, tested_on).map(|test| test.success_percent)).collect();
                rates.map(|rates| mean(rates.into_iter()))
            };
            let rates: Vec<f64> = runs.iter().filter_map(rate).collect();
            let Some(success) = Summary::from_values(&rates) else { continue };
            let over_runs = mean_with_t_interval(&[rates]);
            tests.push(GridTest {
                environment: self.environment,
                method: self.method.clone(),
                trained_on: self.trained_on,
                what: what.clone(),
                configurations,
                episodes,
                at_the_end: episodes == one_end,
                tested_on,
                success,
                interval: over_runs.and_then(|number| number.interval_95),
            });
        }
        tests
    }
}

impl<'a> GridCell<'a> {
    fn moments(&self) -> impl Iterator<Item = u64> {
        self.cell.tests.marks.iter().copied().chain([self.cell.config.common.episodes])
    }

    /// Returns the test after `episodes` episodes, or at the end.
    fn test(&self, episodes: Option<u64>, tested_on: &str) -> Option<&'a TestResult> {
        let result = self.result?;
        let mark = episodes.filter(|&episodes| episodes != self.cell.config.common.episodes);
        let tests = mark.map_or(Some(&result.results), |mark| Some(&result.marks.get(&mark)?.results));
        tests?.get(tested_on)
    }
}

impl<'a> GridTest<'a> {
    /// Tests of the same trainings.
    fn is_with(&self, other: &Self) -> bool {
        self.is_of_grid(other) && self.what == other.what
    }

    fn is_of_grid(&self, other: &Self) -> bool {
        (self.environment, &self.method, self.trained_on) == (other.environment, &other.method, other.trained_on)
    }

    /// Nothing is drawn around a single run, and nothing where there is no one moment.
    fn point(&self) -> Option<PanelPoint> {
        let [low, high] = self.interval.unwrap_or([self.success.mean; 2]);
        Some(PanelPoint { x: self.episodes? as f64, y: self.success.mean, low, high })
    }
}

impl Report<'_> {
    /// By the value of each setting, at the end of each training; `None` without a grid.
    pub(super) fn settings_table(&self) -> Option<Table> {
        let ends: Vec<&GridTest<'_>> = self.grid_tests.settings.iter().filter(|test| test.at_the_end).collect();
        let of_value: Vec<&[&GridTest<'_>]> = ends.chunk_by(|a, b| a.is_with(b)).collect();
        let title = "What settings do: success at the end, in each run the mean over all configurations with that value, with \
                     the 95 % t interval over runs (settings.csv and configurations.csv have every moment and \
                     configuration)";
        let mut table = Table::builder(title, &of_value)
            .text("environment", |tests| tests[0].environment)
            .text("method", |tests| &tests[0].method)
            .text("trained on", |tests| tests[0].trained_on)
            .text("setting", |tests| &tests[0].what.0)
            .text("value", |tests| &tests[0].what.1)
            .number("configurations", |tests| tests[0].configurations);
        for name in distinct(self.grid_tests.settings.iter().map(|test| test.tested_on)) {
            table = table.number(format!("on {name}"), move |tests| {
                tests.iter().find(|test| test.tested_on == name).map_or_else(
                    || MISSING.to_owned(),
                    |test| Bootstrapped { point: test.success.mean, interval_95: test.interval, runs: 0 }.to_string(),
                )
            });
        }
        let table = table.number("runs", |tests| tests[0].success.runs).build();
        (!table.rows.is_empty()).then_some(table)
    }

    pub(super) fn settings_file(&self) -> Table {
        file("settings.csv", &self.grid_tests.settings, ["setting", "value"])
            .number("configurations", |test| test.configurations)
            .build()
    }

    pub(super) fn configurations_file(&self) -> Table {
        file("configurations.csv", &self.grid_tests.configurations, ["configuration", "settings"]).build()
    }

    /// Returns a picture for each setting of a method that differs, if intermediate policies were tested. The picture
    /// has a panel for each test set.
    pub(super) fn settings_pictures(&self) -> Vec<Picture> {
        let same = |a: &GridTest<'_>, b: &GridTest<'_>| a.is_of_grid(b) && a.what.0 == b.what.0;
        let of_settings = self.grid_tests.settings.chunk_by(same);
        let moments = |tests: &&[GridTest<'_>]| distinct(tests.iter().filter_map(|test| test.episodes)).len();
        of_settings.filter(|tests| moments(tests) > 1).map(picture).collect()
    }
}

fn file<'r, 'a>(name: &str, tests: &'r [GridTest<'a>], what: [&str; 2]) -> TableBuilder<'r, GridTest<'a>> {
    Table::builder(name, tests)
        .text("environment", |test| test.environment)
        .method(|test| &test.method)
        .text("train", |test| test.trained_on)
        .text(what[0], |test| &test.what.0)
        .text(what[1], |test| &test.what.1)
        .number("episodes", |test| test.episodes.map_or_else(String::new, |episodes| episodes.to_string()))
        .text("test", |test| test.tested_on)
        .summary(|test| Some(test.success))
        .number("low_95", |test| or_empty(test.interval.map(|interval| interval[0])))
        .number("high_95", |test| or_empty(test.interval.map(|interval| interval[1])))
}

/// Returns the picture of one setting.
fn picture(tests: &[GridTest<'_>]) -> Picture {
    let GridTest { environment, method, trained_on, what: (setting, _), .. } = &tests[0];
    let values = distinct(tests.iter().map(|test| &test.what.1));
    let names = distinct(tests.iter().map(|test| test.tested_on));
    let longest = tests.iter().filter_map(|test| test.episodes).max().unwrap_or_default();
    let line = |(index, value): (usize, &&String), name: &str| {
        let of = tests.iter().filter(|test| test.what.1 == **value && test.tested_on == name);
        PanelLine { index, points: of.filter_map(GridTest::point).collect() }
    };
    let panel = |name: &&str| PlotPanel {
        caption: format!("tested on {name}"),
        x_name: "episodes".into(),
        x: 0.0..longest as f64,
        y_name: "success rate, %".into(),
        y: RATES,
        lines: values.iter().enumerate().map(|value| line(value, name)).collect(),
        mark: None,
    };
    let of = format!("{environment}, {method} trained on {trained_on}");
    let panels = Panels {
        title: format!("{of}: success by {setting}"),
        panels: names.iter().map(panel).collect(),
        legend: values.iter().map(|value| format!("{setting} = {value}")).collect(),
        note: "Bands: 95 % t intervals over runs.".into(),
    };
    Picture {
        environment: (*environment).into(),
        file: format!("{environment}-{}-{}-{setting}", file_name(method), trained_on.file_name()),
        name: format!("{of}: what {setting} does"),
        caption: format!(
            "{of}: success in tests after so many episodes, by {setting}. Lines are means over all configurations with that \
             value and over runs, bands their 95 % t interval over runs."
        ),
        data: panels.table(),
        drawing: PictureDrawing::Panels(panels),
    }
}

#[cfg(test)]
#[path = "settings_tests.rs"]
mod tests;
