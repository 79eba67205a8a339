//! Draws the heatmaps of several policies side by side.

use perturb_experiment::distinct;
use perturb_records::{Heatmap, HeatmapPoint, heatmap_table};
use perturb_text::{Table, count};

use crate::plot::{HeatmapColumn, HeatmapPanels, common_returns};

/// The heatmap of a policy, with the policy's description for captions.
#[derive(Clone, Debug, PartialEq)]
pub struct PolicyHeatmap {
    /// The method, e.g. "ppo ff".
    pub method: String,
    /// The training distribution, e.g. "D".
    pub trained_on: String,
    /// The seed of the training.
    pub seed: u64,
    /// The heatmap of the policy.
    pub heatmap: Heatmap,
}

/// Returns a picture of heatmaps side by side, and a table of its numbers. Each combination of method and training
/// distribution is a column, which shows the mean over its policies. Returns `None` if there are no policies, or if
/// their heatmaps have different axes, grids or other options.
pub fn policies_side_by_side(policies: &[PolicyHeatmap]) -> Option<(HeatmapPanels, Table)> {
    let heatmaps: Vec<Heatmap> = policies.iter().map(|policy| policy.heatmap.clone()).collect();
    let all = Heatmap::mean(&heatmaps)?;
    let methods = distinct(policies.iter().map(|policy| &policy.method));
    let mut columns: Vec<(String, usize, Heatmap)> = Vec::new();
    for (method, trained_on) in distinct(policies.iter().map(|policy| (&policy.method, &policy.trained_on))) {
        let of: Vec<&PolicyHeatmap> =
            policies.iter().filter(|policy| (&policy.method, &policy.trained_on) == (method, trained_on)).collect();
        let mean = Heatmap::mean(&of.iter().map(|policy| policy.heatmap.clone()).collect::<Vec<_>>())?;
        let what =
            if methods.len() > 1 { format!("{method} on {trained_on}") } else { format!("trained on {trained_on}") };
        let who = if of.len() > 1 { format!("{} policies", of.len()) } else { format!("seed {}", of[0].seed) };
        columns.push((format!("{what}, {who}"), of.len(), mean));
    }
    let Heatmap { environment, grid, episodes, axes, .. } = &all;
    let name = if methods.len() > 1 { environment.clone() } else { format!("{environment}, {}", methods[0]) };
    let tested = format!("{grid} × {grid} points of {}; {}", count(*episodes as usize, "episode"), all.others());
    let panels = HeatmapPanels {
        title: vec![name, tested],
        axes: axes.clone(),
        returns: common_returns(environment, columns.iter().map(|(.., mean)| mean)),
        columns: columns
            .iter()
            .map(|(caption, _, mean)| HeatmapColumn { caption: caption.clone(), content: Ok(mean.clone()) })
            .collect(),
    };
    Some((panels, table(&columns)))
}

/// Returns a table with a row for each column of the picture and grid point. For a single column of the picture, the
/// table leaves out the caption and the number of policies.
fn table(columns: &[(String, usize, Heatmap)]) -> Table {
    if let [(.., mean)] = columns {
        return heatmap_table(mean);
    }
    let of = |(caption, policies, mean): &(String, usize, Heatmap)| {
        mean.points.iter().map(|point| (caption.clone(), *policies, *point)).collect::<Vec<_>>()
    };
    let lines: Vec<(String, usize, HeatmapPoint)> = columns.iter().flat_map(of).collect();
    let axes = columns.first().map(|(.., mean)| mean.axes.clone().map(|axis| axis.name)).unwrap_or_default();
    points_table(["trained", "policies"], axes, &lines)
}

/// Returns a table with a row for each point of several heatmaps. Each of `lines` has the heatmap's caption, the number
/// of averaged policies and the point. `names` are the headers of the first two columns; `x` and `y` are the names of
/// the axes.
pub(crate) fn points_table(names: [&str; 2], [x, y]: [String; 2], lines: &[(String, usize, HeatmapPoint)]) -> Table {
    Table::builder("", lines)
        .text(names[0], |(which, ..)| which)
        .number(names[1], |(_, policies, _)| policies)
        .number(x, |(.., point)| point.x)
        .number(y, |(.., point)| point.y)
        .number("mean_return", |(.., point)| point.mean_return)
        .number("success_percent", |(.., point)| point.success_percent)
        .build()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture;

    fn policy(method: &str, trained_on: &str, seed: u64, success: f64) -> PolicyHeatmap {
        let heatmap = fixture::heatmap(2, |mass, _| (mass + success, success));
        PolicyHeatmap { method: method.into(), trained_on: trained_on.into(), seed, heatmap }
    }

    fn captions(policies: &[PolicyHeatmap]) -> (String, Vec<String>) {
        let (panels, _) = policies_side_by_side(policies).unwrap();
        (panels.title[0].clone(), panels.columns.into_iter().map(|column| column.caption).collect())
    }

    #[test]
    fn policies_trained_alike_are_averaged() {
        let policies = [policy("ppo ff", "D", 1, 0.0), policy("ppo ff", "R", 1, 30.0), policy("ppo ff", "D", 2, 100.0)];
        let (panels, table) = policies_side_by_side(&policies).unwrap();
        let success: Vec<f64> =
            panels.columns.iter().map(|column| column.content.as_ref().unwrap().points[0].success_percent).collect();
        assert_eq!(success, [50.0, 30.0]);
        assert_eq!(panels.returns, -1600.0..-200.0, "the environment's");
        let csv = String::from_utf8(table.to_csv()).unwrap();
        let begin = "trained,policies,mass,length,mean_return,success_percent\n\
                     \"trained on D, 2 policies\",2,0.75,0.75,50.75,50\n";
        assert!(csv.starts_with(begin), "{csv}");
        let (title, columns) = captions(&policies);
        assert_eq!(
            (title.as_str(), columns),
            ("Pendulum, ppo ff", ["trained on D, 2 policies", "trained on R, seed 1"].map(str::to_owned).into())
        );
        let (title, columns) = captions(&[policies[0].clone(), policy("a2c ff", "D", 7, 0.0)]);
        assert_eq!(
            (title.as_str(), columns),
            ("Pendulum", ["ppo ff on D, seed 1", "a2c ff on D, seed 7"].map(str::to_owned).into())
        );
    }

    #[test]
    fn single_column_shows_its_mean() {
        let one = policy("ppo ff", "D", 1, 0.0);
        let (_, table) = policies_side_by_side(std::slice::from_ref(&one)).unwrap();
        assert_eq!(table, heatmap_table(&one.heatmap));
        let other = PolicyHeatmap { heatmap: fixture::heatmap(3, |_, _| (0.0, 0.0)), ..one.clone() };
        assert_eq!(policies_side_by_side(&[one, other]), None);
        assert_eq!(policies_side_by_side(&[]), None);
    }
}
