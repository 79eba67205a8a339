//! Training curves as a CSV file.

use perturb_experiment::{BudgetAxis, EnvironmentCurves};
use perturb_text::Table;

use super::columns::MethodColumns;

/// Returns the file `curves.csv`, with a row for each point of each curve.
pub fn curves_table(all: &[EnvironmentCurves]) -> Table {
    let curves = all.iter().flat_map(|of| of.curves.iter().map(|curve| (&of.environment, curve)));
    let by = curves.flat_map(|(environment, curve)| BudgetAxis::ALL.map(|by| (environment, curve, by)));
    let lines: Vec<_> = by
        .flat_map(|(environment, curve, by)| curve.points(by).iter().map(move |point| (environment, curve, by, point)))
        .collect();
    Table::builder("curves.csv", &lines)
        .text("environment", |(environment, ..)| environment)
        .method(|(_, curve, ..)| &curve.method)
        .text("train", |(_, curve, ..)| curve.version)
        .number("runs", |(.., point)| point.success.runs)
        .text("by", |(_, _, by, _)| by)
        .number("progress", |(.., point)| point.progress)
        .number("return_mean", |(.., point)| point.episode_return.mean)
        .number("return_std", |(.., point)| point.episode_return.std.unwrap_or_default())
        .number("success_mean", |(.., point)| point.success.mean)
        .number("success_std", |(.., point)| point.success.std.unwrap_or_default())
        .build()
}
