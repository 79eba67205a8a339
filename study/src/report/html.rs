//! A report as one HTML page, complete in itself: no network, no script, all pictures inside.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::{Figure, FigureData, Figures, MISSING, Report};
use crate::plot;
use crate::table::{Column, Entry, Table};

pub(super) const STYLE: &str = include_str!("style.css");
const METRICS: &str = "Default is the success rate of policies that were trained and tested on D, Interpolation that of \
                       policies trained and tested on R. Extrapolation is the geometric mean of three: trained on D and \
                       tested on R, trained on D and tested on E, trained on R and tested on E.";
const HEATMAPS: &str = "How the selected policies do over two parameters: means over runs. Colours are mean return and success \
                        rate, the same in all pictures of an environment. The whole line is R's box, dashed lines are E's, \
                        the ring is D.";
const COMPARISONS: &str = "Runs of two methods with the same seed, in each of the environments. P(X > Y) is the probability that \
                           a run of X is better than one of Y, where equal ones count half. Corrected p-values up to 0.05 \
                           are, all together, wrong with a probability of 5 % at most.";
const WORST: &str = "Mean return of the worst tenth of a test's episodes, and success in those parts of the parameter space that \
                     hold the worst tenth of contexts: half of the episodes say which these are, the other half their \
                     success. From recorded episodes; mean and deviation over runs.";
const FOOTING: &str = "How long the selected trainings were, of all environments together, and the success rate in training \
                       after as many steps, and as many episodes, as the trainings of all methods have.";
const SCENARIOS: &str = "The darker, the higher the success rate.";
/// A text of so many bytes is broken into lines.
const LONG: usize = 60;

/// What has a heading, and a place in the list of contents.
struct Section {
    id: &'static str,
    title: &'static str,
    notes: Markup,
    subsections: Vec<Subsection>,
}

struct Subsection {
    title: String,
    content: Markup,
}

/// The page.
pub fn html(report: &Report<'_>, figures: &Figures) -> String {
    let plain = |table: Table| table_subsection(&table, false);
    let shaded = |table: Table| table_subsection(&table, true);
    let section = |id, title, notes, subsections| Section { id, title, notes, subsections };
    let tables = |tables: Vec<Table>| tables.into_iter().map(plain).collect();
    let said = |text: &str| html! { p { (text) } };
    let gap_and_profiles = [plain(report.gap_table())].into_iter().chain(by_environment(&figures.profiles)).collect();
    let cells = report.tuned_table().into_iter().chain([report.selected_table()]).chain(report.failure_table());
    let cells = cells.map(plain).collect();
    let marks = report.marks_table().into_iter().map(plain).chain(by_environment(&figures.marks)).collect();
    let settings = report.settings_table().into_iter().map(plain).chain(by_environment(&figures.settings)).collect();
    let scenarios = report.scenario_tables().into_iter().map(shaded).collect();
    let worst = report.worst_tables().into_iter().map(shaded).collect();
    let comparisons = report.comparisons_table().into_iter().collect();
    let sets = report.set_table().into_iter().collect();
    let heatmap_notes = html! { p { (HEATMAPS) } (list(&figures.no_heatmaps)) };
    let sections = [
        section("metrics", "Default, Interpolation, Extrapolation", said(METRICS), tables(report.metrics_tables())),
        section("iqm", "Interquartile means", html! {}, vec![plain(report.iqm_table())]),
        section("profiles", "Optimality gap and performance profiles", html! {}, gap_and_profiles),
        section("comparisons", "Methods in pairs", said(COMPARISONS), tables(comparisons)),
        section("extrapolation", "What Extrapolation is made of", html! {}, tables(report.extrapolation_tables())),
        section("scenarios", "The nine scenarios", said(SCENARIOS), scenarios),
        section("worst", "The worst tenth", said(WORST), worst),
        section("parameters", "Success over parameters", html! {}, by_environment(&figures.parameters)),
        section("thresholds", "Success over the threshold", html! {}, by_environment(&figures.thresholds)),
        section("sets", "Own sets of parameters", html! {}, tables(sets)),
        section("marks", "Generalisation against training", html! {}, marks),
        section("settings", "What settings do", html! {}, settings),
        section("footing", "Trainings on an equal footing", said(FOOTING), tables(report.footing_tables())),
        section("curves", "Training curves", list(&figures.no_curves), by_environment(&figures.curves)),
        section("heatmaps", "Heatmaps", heatmap_notes, by_environment(&figures.heatmaps)),
        section("cells", "Cells", html! {}, cells),
    ];
    // Curves and heatmaps say what is missing.
    let always = |section: &&Section| ["curves", "heatmaps"].contains(&section.id) || !section.subsections.is_empty();
    let shown: Vec<&Section> = sections.iter().filter(always).collect();
    page(report, &shown).into_string()
}

fn page(report: &Report<'_>, sections: &[&Section]) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { "perturb: results" }
                link rel="icon" href="data:,";
                style { (PreEscaped(STYLE)) }
            }
            body {
                header {
                    h1 { "Results" }
                    @for line in &report.overview { p { (prose(line)) } }
                }
                nav aria-label="Contents" { ol { @for section in sections { (section.contents()) } } }
                main { @for section in sections { (section.body()) } }
            }
        }
    }
}

impl Section {
    fn subsection_id(&self, index: usize) -> String {
        format!("{}-{}", self.id, index + 1)
    }

    fn contents(&self) -> Markup {
        html! {
            li {
                a href={ "#" (self.id) } { (self.title) }
                @if self.subsections.len() > 1 {
                    " "
                    span {
                        @for (i, subsection) in self.subsections.iter().enumerate() {
                            @if i > 0 { " · " }
                            a href={ "#" (self.subsection_id(i)) } { (short(&subsection.title)) }
                        }
                    }
                }
            }
        }
    }

    fn body(&self) -> Markup {
        html! {
            section id=(self.id) {
                h2 { (self.title) }
                (self.notes)
                // Tables of few columns stand side by side where there is room.
                div class=[(self.id == "scenarios").then_some("columns")] {
                    @for (i, subsection) in self.subsections.iter().enumerate() {
                        div id=(self.subsection_id(i)) { (subsection.content) }
                    }
                }
            }
        }
    }
}

fn table_subsection(table: &Table, shaded: bool) -> Subsection {
    let groups: Vec<&[Column]> = table.columns.chunk_by(|a, b| a.group == b.group).collect();
    // Where each but the first group of columns begins.
    let starts = |column: usize| {
        groups.len() > 1 && column > 0 && table.columns[column].group != table.columns[column - 1].group
    };
    let content = html! {
        h3 { (table.title) }
        div.wide {
            table {
                thead {
                    @if groups.len() > 1 {
                        tr {
                            @for columns in &groups {
                                @if let Some(name) = &columns[0].group {
                                    th.span scope="colgroup" colspan=(columns.len()) { (name) }
                                } @else {
                                    th colspan=(columns.len()) {}
                                }
                            }
                        }
                    }
                    tr {
                        @for (i, column) in table.columns.iter().enumerate() {
                            th class=[classes(&[("text", !column.is_number), ("start", starts(i))])] scope="col" {
                                // The first column of a group is what the group is called; the others are not.
                                @if column.group.as_ref() == Some(&column.name) { "here" } @else { (column.name) }
                            }
                        }
                    }
                }
                tbody {
                    @for (row, entries) in table.rows.iter().enumerate() {
                        // A line above a method's first row, where methods have several.
                        @let next = shaded && row > 0 && entries[0] != table.rows[row - 1][0];
                        tr class=[next.then_some("next")] {
                            @for (i, (entry, column)) in entries.iter().zip(&table.columns).enumerate() {
                                (cell(entry, column, starts(i), shaded))
                            }
                        }
                    }
                }
            }
        }
    };
    Subsection { title: table.title.clone(), content }
}

fn cell(entry: &Entry, column: &Column, starts: bool, shaded: bool) -> Markup {
    let style = entry.heat.filter(|_| shaded).map(|percent| {
        let colour = plot::shade(percent / 100.0);
        let (ink, (r, g, b)) = (if plot::is_dark(colour) { "#fff" } else { "#000" }, colour);
        format!("background:#{r:02x}{g:02x}{b:02x};color:{ink}")
    });
    let class = classes(&[
        ("text", !column.is_number),
        ("long", !column.is_number && entry.text.len() > LONG),
        ("missing", entry.text == MISSING),
        ("start", starts),
    ]);
    html! { td class=[class] style=[style] { (entry.text) } }
}

/// Those names that apply; `None` if none does.
fn classes(names: &[(&str, bool)]) -> Option<String> {
    let applying: Vec<&str> = names.iter().filter(|(_, applies)| *applies).map(|(name, _)| *name).collect();
    (!applying.is_empty()).then(|| applying.join(" "))
}

fn by_environment(figures: &[Figure]) -> Vec<Subsection> {
    let of_environments = figures.chunk_by(|a, b| a.environment == b.environment);
    of_environments
        .map(|of| Subsection { title: of[0].environment.clone(), content: html! { @for one in of { (figure(one)) } } })
        .collect()
}

fn figure(Figure { name, caption, picture, .. }: &Figure) -> Markup {
    html! {
        figure class=[matches!(picture, FigureData::Missing).then_some("missing")] {
            @match picture {
                FigureData::Missing => {}
                // Named for those who do not see it.
                FigureData::Svg(svg) => div role="img" aria-label=(name) { (PreEscaped(svg)) }
            }
            figcaption { (caption) }
        }
    }
}

fn list(notes: &[String]) -> Markup {
    html! { @if !notes.is_empty() { ul.missing { @for note in notes { li { (prose(note)) } } } } }
}

/// A sentence, in which `names` stand between backticks.
fn prose(text: &str) -> Markup {
    html! { @for (i, part) in text.split('`').enumerate() { @if i % 2 == 1 { code { (part) } } @else { (part) } } }
}

/// What comes before a title's details.
fn short(title: &str) -> &str {
    let end = [": ", " over "].iter().filter_map(|separator| title.find(separator)).min();
    &title[..end.unwrap_or(title.len())]
}
