//! Pictures of the heatmaps that an experiment has: one for each environment, pair of parameters, and method.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::Path;

use super::pictures::file_name;
use super::{Figure, FigureData};
use crate::Method;
use crate::files::{delete, list, write_atomically};
use crate::folder::{Folder, FolderError};
use crate::heatmap::{Heatmap, HeatmapPoint};
use crate::heatmaps::{HeatmapKind, HeatmapPlace, HeatmapRecord, NoHeatmap, heatmap_kinds, heatmap_places};
use crate::plan::distinct;
use crate::plot::{HeatmapColumn, HeatmapPanels, PlotError, common_returns, save, svg};
use crate::scheduler::count;
use crate::selection::MethodResults;
use crate::table::Table;

/// What a method's policies do over two parameters: a column for each thing that they were trained on, the mean over runs.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatmapPicture {
    /// The environment's name.
    pub environment: String,
    /// What its files are called, without their endings.
    pub file: String,
    /// A few words for those who do not see it.
    pub name: String,
    /// What it shows, or why it is missing.
    pub caption: String,
    /// `None` if nothing is there.
    pub panels: Option<HeatmapPanels>,
    /// What is shown, as `FILE.csv`.
    pub figures: Table,
    /// Heatmaps that it could be of.
    pub wanted: usize,
    /// Why others of these are not there.
    pub missing: Vec<NoHeatmap>,
}

/// A picture in the making: its scale is that of all of its environment.
struct Draft<'a> {
    environment: &'a str,
    method: &'a Method,
    kind: Option<&'a HeatmapKind>,
    columns: Vec<Column<'a>>,
}

/// The policies that were trained on the same.
struct Column<'a> {
    places: &'a [HeatmapPlace<'a>],
    records: Vec<HeatmapRecord>,
    missing: Vec<(u32, NoHeatmap)>,
    mean: Option<Heatmap>,
}

/// Those of everything in `folder` that belongs to `selections`; without pictures where nothing does.
///
/// # Errors
/// [`FolderError`] if a file is there that cannot be read.
pub fn heatmap_pictures(selections: &[MethodResults<'_>], folder: &Folder) -> Result<Vec<HeatmapPicture>, FolderError> {
    let places = heatmap_places(selections);
    let kinds = heatmap_kinds(folder, &places)?;
    let mut pictures = Vec::new();
    for places in places.chunk_by(|a, b| a.environment == b.environment) {
        let mut of_environment: Vec<Option<&HeatmapKind>> =
            kinds.get(places[0].environment).into_iter().flatten().map(Some).collect();
        if of_environment.is_empty() {
            of_environment.push(None);
        }
        let mut drafts = Vec::new();
        for kind in of_environment {
            for places in places.chunk_by(|a, b| a.method == b.method) {
                drafts.push(Draft::read(folder, kind, places)?);
            }
        }
        let shown = drafts.iter().flat_map(|draft| &draft.columns).filter_map(|column| column.mean.as_ref());
        let returns = common_returns(places[0].environment, shown);
        pictures.extend(drafts.iter().map(|draft| draft.picture(&returns)));
    }
    Ok(pictures)
}

impl<'a> Draft<'a> {
    fn read(
        folder: &Folder,
        kind: Option<&'a HeatmapKind>,
        places: &'a [HeatmapPlace<'a>],
    ) -> Result<Self, FolderError> {
        let mut columns: Vec<Column<'a>> = Vec::new();
        // All of a picture have the points of its first.
        let mut first: Option<Heatmap> = None;
        for places in places.chunk_by(|a, b| a.trained_on == b.trained_on) {
            let mut column = Column { places, records: Vec::new(), missing: Vec::new(), mean: None };
            let mut heatmaps = Vec::new();
            for place in places {
                let read = match kind {
                    Some(kind) => place.read(folder, kind)?,
                    None => Err(if place.selected.is_some() { NoHeatmap::NotMade } else { NoHeatmap::NoResult }),
                };
                match read {
                    Ok(stored) => {
                        let alike =
                            [first.get_or_insert_with(|| stored.heatmap.clone()).clone(), stored.heatmap.clone()];
                        if Heatmap::mean(&alike).is_some() {
                            column.records.push(stored.record);
                            heatmaps.push(stored.heatmap);
                        } else {
                            column.missing.push((place.run, NoHeatmap::NotAlike));
                        }
                    }
                    Err(why) => column.missing.push((place.run, why)),
                }
            }
            column.mean = Heatmap::mean(&heatmaps);
            columns.push(column);
        }
        Ok(Self { environment: places[0].environment, method: places[0].method, kind, columns })
    }

    fn picture(&self, returns: &Range<f64>) -> HeatmapPicture {
        let Self { environment, method, kind, columns } = self;
        let over = kind.map_or_else(String::new, |kind| {
            let HeatmapKind { parameters: [x, y], base } = kind;
            let drawn =
                if *base == crate::Version::D { String::new() } else { format!(", the others drawn from {base}") };
            format!(" over {x} and {y}{drawn}")
        });
        let of = format!("{environment}, {method}: mean return and success{over}");
        let first = columns.iter().find_map(|column| column.mean.as_ref());
        let tested = first.map(|Heatmap { grid, episodes, .. }| {
            format!("{grid} × {grid} points of {}", count(*episodes as usize, "episode"))
        });
        let panels = first.zip(tested.as_ref()).map(|(heatmap, tested)| HeatmapPanels {
            title: vec![format!("{environment}, {method}"), format!("{tested} of each policy; {}", heatmap.others())],
            axes: heatmap.axes.clone(),
            returns: returns.clone(),
            columns: columns.iter().map(Column::panel).collect(),
        });
        HeatmapPicture {
            environment: (*environment).to_owned(),
            file: kind.map_or_else(String::new, |kind| format!("{environment}-{}-heatmap-{kind}", file_name(method))),
            caption: tested.map_or_else(|| format!("{of}: {}.", self.why()), |tested| self.caption(&of, &tested)),
            name: of,
            panels,
            figures: self.figures(),
            wanted: columns.iter().map(|column| column.places.len()).sum(),
            missing: columns.iter().flat_map(|column| column.missing.iter().map(|(_, why)| *why)).collect(),
        }
    }

    /// Why nothing is there.
    fn why(&self) -> String {
        said(self.columns.iter().flat_map(|column| &column.missing))
    }

    fn caption(&self, of: &str, tested: &str) -> String {
        let records = || self.columns.iter().flat_map(|column| &column.records);
        let seeds: BTreeSet<u64> = records().map(|record| record.options.seed).collect();
        let commits: BTreeSet<&str> = records().map(|record| record.commit.as_str()).collect();
        let columns: Vec<String> = self.columns.iter().map(Column::told).collect();
        format!(
            "{of}. Means over runs: {}. {tested} of each policy, test {} {}. perturb {}.",
            columns.join("; "),
            if seeds.len() == 1 { "seed" } else { "seeds" },
            listed(seeds),
            listed(commits)
        )
    }

    /// A line for each column and point.
    fn figures(&self) -> Table {
        let of_column = |column: &'_ Column<'a>| {
            let (trained_on, runs) = (column.places[0].trained_on.to_string(), column.records.len());
            let points = column.mean.iter().flat_map(|mean| mean.points.clone());
            points.map(move |point| (trained_on.clone(), runs, point)).collect::<Vec<_>>()
        };
        let lines: Vec<(String, usize, HeatmapPoint)> = self.columns.iter().flat_map(of_column).collect();
        let [x, y] = self.kind.map_or_else(Default::default, |kind| kind.parameters.clone());
        Table::of(self.environment, &lines)
            .text("train", |(trained_on, ..)| trained_on)
            .number("runs", |(_, runs, _)| runs)
            .number(x, |(.., point)| point.x)
            .number(y, |(.., point)| point.y)
            .number("mean_return", |(.., point)| point.mean_return)
            .number("success_percent", |(.., point)| point.success_percent)
            .build()
    }
}

impl Column<'_> {
    fn panel(&self) -> HeatmapColumn {
        let content = self.mean.clone().ok_or_else(|| said(self.missing.iter()));
        HeatmapColumn { caption: format!("trained on {}, {}", self.places[0].trained_on, self.runs()), content }
    }

    /// How many runs are there.
    fn runs(&self) -> String {
        match (self.records.len(), self.places.len()) {
            (there, all) if there == all => count(all, "run"),
            (there, all) => format!("{there} of {}", count(all, "run")),
        }
    }

    fn told(&self) -> String {
        let told = format!("{} trained on {}", self.runs(), self.places[0].trained_on);
        let why = |(run, why): &(u32, NoHeatmap)| format!("run {run}: {why}");
        match self.missing.iter().map(why).collect::<Vec<_>>() {
            missing if missing.is_empty() => told,
            missing => format!("{told} ({})", missing.join(", ")),
        }
    }
}

impl HeatmapPicture {
    /// As the page shows it.
    pub(super) fn figure(&self) -> Result<Figure, PlotError> {
        let Self { environment, file, name, caption, panels, figures, .. } = self.clone();
        let picture = match panels {
            Some(panels) => FigureData::Svg { svg: svg(&panels)?, csv: figures.to_csv() },
            None => FigureData::Missing,
        };
        Ok(Figure { environment, file, name, caption, picture })
    }

    /// Writes it into the folder `out` as SVG, PNG and CSV; whether there is something to write.
    ///
    /// # Errors
    /// [`PlotError`].
    fn save(&self, out: &Path) -> Result<bool, PlotError> {
        let Some(panels) = &self.panels else { return Ok(false) };
        save(panels, &out.join(&self.file))?;
        write_atomically(&out.join(format!("{}.csv", self.file)), &self.figures.to_csv())?;
        Ok(true)
    }
}

/// Writes `pictures` into the folder `out`, and deletes those that it has of heatmaps that are gone; the names, without
/// endings, of what was written.
///
/// # Errors
/// [`PlotError`].
pub fn save_heatmaps<'a>(pictures: &'a [HeatmapPicture], out: &Path) -> Result<Vec<&'a str>, PlotError> {
    let mut written = Vec::new();
    for picture in pictures {
        if picture.save(out)? {
            written.push(picture.file.as_str());
        }
    }
    for path in list(out)? {
        let name = path.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        if name.contains("-heatmap-") && !written.contains(&name.as_str()) {
            delete(&path)?;
        }
    }
    Ok(written)
}

/// Reasons, each once.
fn said<'a>(missing: impl Iterator<Item = &'a (u32, NoHeatmap)>) -> String {
    distinct(missing.map(|(_, why)| why.to_string())).join("; ")
}

fn listed(items: impl IntoIterator<Item = impl ToString>) -> String {
    items.into_iter().map(|item| item.to_string()).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
#[path = "heatmap_pictures_tests.rs"]
mod tests;
