//! Draws training curves: a panel for each training version, D, R and E, below each other. There is a fourth panel if a
//! method was trained on R+E.

use std::ops::Range;

use perturb_experiment::{BudgetAxis, Curve, CurvePoint, EnvironmentCurves, distinct};
use perturb_protocol::Version;
use perturb_records::statistics::Summary;
use perturb_records::versions;
use perturb_settings::Method;

use super::panels::{PanelLine, PanelPoint, Panels, PlotPanel, RATES, index_of};

/// The quantity on the vertical axis of training curves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CurveQuantity {
    /// The mean undiscounted return.
    Return,
    /// The success rate, %.
    Success,
}

impl CurveQuantity {
    /// All quantities, in the order of the pictures.
    pub const ALL: [CurveQuantity; 2] = [CurveQuantity::Return, CurveQuantity::Success];

    /// Returns the quantity at a point of a curve.
    fn summary(self, point: &CurvePoint) -> Summary {
        match self {
            CurveQuantity::Return => point.episode_return,
            CurveQuantity::Success => point.success,
        }
    }
}

impl std::fmt::Display for CurveQuantity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            CurveQuantity::Return => "return",
            CurveQuantity::Success => "success",
        })
    }
}

/// Returns the picture of an environment's training curves, with a panel for each training version. `by` chooses the x
/// axis: episodes or steps.
pub fn draw_curves(curves: &EnvironmentCurves, quantity: CurveQuantity, by: BudgetAxis) -> Panels {
    let methods = distinct(curves.curves.iter().map(|curve| curve.method.clone()));
    let what = match quantity {
        CurveQuantity::Return => "mean return",
        CurveQuantity::Success => "success rate, %",
    };
    let environment = &curves.environment;
    let shown = what.trim_end_matches(", %");
    let (x, y) = ranges(&curves.curves, quantity, by);
    let versions = versions(|version| curves.curves.iter().any(|curve| curve.version == version));
    let panel = |version: Version| PlotPanel {
        caption: format!("trained on {version}"),
        x_name: by.to_string(),
        x: x.clone(),
        y_name: what.into(),
        y: y.clone(),
        lines: curves
            .curves
            .iter()
            .filter(|curve| curve.version == version)
            .map(|curve| line(curve, quantity, by, &methods))
            .collect(),
    };
    Panels {
        title: format!("{environment}: {shown} while training, over {by}"),
        panels: versions.into_iter().map(panel).collect(),
        legend: methods.iter().map(ToString::to_string).collect(),
        note: "Lines: means over runs; bands: their standard deviation.".into(),
    }
}

/// Returns the line of a curve, with its standard deviation as a band.
fn line(curve: &Curve, quantity: CurveQuantity, by: BudgetAxis, methods: &[Method]) -> PanelLine {
    let point = |point: &CurvePoint| {
        let Summary { mean, std, .. } = quantity.summary(point);
        let std = std.unwrap_or_default();
        PanelPoint { x: point.progress, y: mean, low: mean - std, high: mean + std }
    };
    PanelLine { index: index_of(methods, &curve.method), points: curve.points(by).iter().map(point).collect() }
}

/// Returns the ranges of the x and y axes, which all panels share.
fn ranges(curves: &[Curve], quantity: CurveQuantity, by: BudgetAxis) -> (Range<f64>, Range<f64>) {
    let longest = curves.iter().map(|curve| curve.total(by)).fold(0.0, f64::max);
    let x = 0.0..if longest > 0.0 { longest } else { 1.0 };
    if quantity == CurveQuantity::Success {
        return (x, RATES);
    }
    let values = curves.iter().flat_map(|curve| curve.points(by)).map(|point| quantity.summary(point));
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), summary| {
        let std = summary.std.unwrap_or_default();
        (low.min(summary.mean - std), high.max(summary.mean + std))
    });
    if low > high {
        return (x, 0.0..1.0);
    }
    let margin = 0.04 * (high - low).max(1e-3 * high.abs()).max(1e-9);
    (x, low - margin..high + margin)
}
