//! The numbers of a report as CSV; an empty field is a number that there is not.

use super::super::plan::Method;
use super::super::selection::{Group, Metric, Results, average, interquartile};
use super::super::statistics::Summary;
use super::{PaperCell, RESAMPLES, by_environment, paper_average, paper_cell};
use crate::{Scenario, Version};

/// Files by name: `metrics.csv`, `iqm.csv`, `scenarios.csv` and `selected.csv`.
///
/// # Errors
/// [`csv::Error`], which writing to memory does not give.
pub fn csv_files(results: &Results<'_>, groups: &[Group]) -> Result<Vec<(&'static str, Vec<u8>)>, csv::Error> {
    Ok(vec![
        ("metrics.csv", metrics(results, groups)?),
        ("iqm.csv", iqm(results, groups)?),
        ("scenarios.csv", scenarios(groups)?),
        ("selected.csv", selected(results, groups)?),
    ])
}

type Lines = Result<Vec<u8>, csv::Error>;

fn metrics(results: &Results<'_>, groups: &[Group]) -> Lines {
    let mut file = File::new(&["metric", "runs", "mean", "std", "paper_mean", "paper_std", "difference"], true)?;
    let environments = results.plan.environments();
    let mut line =
        |environment: &str, method: &Method, metric: Metric, ours: Option<Summary>, paper: Option<PaperCell>| {
            let difference = ours.zip(paper).map(|(ours, paper)| ours.mean - paper.mean);
            let [runs, mean, std] = summary(ours);
            let numbers =
                [number(paper.map(|paper| paper.mean)), number(paper.and_then(|paper| paper.std)), number(difference)];
            file.add(environment, method, [metric.to_string(), runs, mean, std].into_iter().chain(numbers))
        };
    for group in groups {
        for metric in Metric::ALL {
            let paper = paper_cell(&group.environment, &group.method, metric);
            line(&group.environment, &group.method, metric, group.summary(metric), paper)?;
        }
    }
    for method in results.plan.methods() {
        for metric in Metric::ALL {
            let ours = by_environment(groups, &method, &environments).and_then(|groups| average(&groups, metric));
            line("Average", &method, metric, ours, paper_average(&environments, &method, metric))?;
        }
    }
    file.finish()
}

fn iqm(results: &Results<'_>, groups: &[Group]) -> Lines {
    let mut file = File::new(&["metric", "runs", "iqm", "low_95", "high_95"], false)?;
    let environments = results.plan.environments();
    for method in results.plan.methods() {
        for metric in Metric::ALL {
            let groups = by_environment(groups, &method, &environments);
            let iqm = groups.and_then(|groups| interquartile(&groups, metric, RESAMPLES));
            let runs = iqm.map_or(0, |(_, runs)| runs).to_string();
            let [low, high] = [0, 1].map(|end| number(iqm.and_then(|(iqm, _)| Some(iqm.interval_95?[end]))));
            file.add("", &method, [metric.to_string(), runs, number(iqm.map(|(iqm, _)| iqm.iqm)), low, high])?;
        }
    }
    file.finish()
}

fn scenarios(groups: &[Group]) -> Lines {
    let mut file = File::new(&["train", "test", "runs", "mean", "std"], true)?;
    for group in groups {
        for scenario in Scenario::all() {
            let [runs, mean, std] = summary(group.scenario(scenario));
            let fields = [scenario.train.to_string(), scenario.test.to_string(), runs, mean, std];
            file.add(&group.environment, &group.method, fields)?;
        }
    }
    file.finish()
}

fn selected(results: &Results<'_>, groups: &[Group]) -> Lines {
    let columns = ["train", "run", "seed", "cell", "success_d", "success_r", "success_e", "commit", "command"];
    let mut file = File::new(&columns, true)?;
    for group in groups {
        for (run, selected) in &group.runs {
            for (version, cell) in Version::ALL.into_iter().zip(selected.cells) {
                let Some(result) = cell.and_then(|cell| results.result(cell)) else { continue };
                let rates = selected.rates[version as usize].map(number);
                let seed = result.training.seed.to_string();
                let names = [version.to_string(), run.to_string(), seed, result.id.clone()];
                let commits = result.commits().collect::<Vec<_>>().join("; ");
                let origin = [commits, result.command.clone()];
                file.add(&group.environment, &group.method, names.into_iter().chain(rates).chain(origin))?;
            }
        }
    }
    file.finish()
}

/// Lines that begin with an environment, if it has one, and a method.
struct File {
    writer: csv::Writer<Vec<u8>>,
    by_environment: bool,
}

impl File {
    fn new(columns: &[&str], by_environment: bool) -> Result<Self, csv::Error> {
        let mut writer = csv::Writer::from_writer(Vec::new());
        let environment = by_environment.then_some("environment");
        let method = ["algorithm", "architecture", "episodes_per_trial"];
        writer.write_record(environment.into_iter().chain(method).chain(columns.iter().copied()))?;
        Ok(Self { writer, by_environment })
    }

    fn add(
        &mut self,
        environment: &str,
        method: &Method,
        fields: impl IntoIterator<Item = String>,
    ) -> Result<(), csv::Error> {
        let environment = self.by_environment.then(|| environment.to_owned());
        let trials = method.episodes_per_trial.map(|episodes| episodes.to_string()).unwrap_or_default();
        let method = [method.algorithm.clone(), method.architecture.clone(), trials];
        self.writer.write_record(environment.into_iter().chain(method).chain(fields))
    }

    fn finish(self) -> Lines {
        self.writer.into_inner().map_err(|error| error.into_error().into())
    }
}

fn number(number: Option<f64>) -> String {
    number.map(|number| number.to_string()).unwrap_or_default()
}

fn summary(summary: Option<Summary>) -> [String; 3] {
    let runs = summary.map_or(0, |summary| summary.runs).to_string();
    [runs, number(summary.map(|summary| summary.mean)), number(summary.and_then(|summary| summary.deviation()))]
}
