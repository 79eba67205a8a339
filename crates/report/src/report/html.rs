//! A report as one HTML page, complete in itself: no network, no script, all pictures inside, and the files that its links
//! lead to.

use maud::{DOCTYPE, Markup, PreEscaped, html};
use perturb_text::{Column, Entry, Table};

use super::links::data_uri;
use super::{Figure, FigureData, Figures, MISSING, Report};
use crate::plot;

pub(super) const STYLE: &str = include_str!("style.css");
const METRICS: &str = "Default is the success rate of policies that were trained and tested on D, Interpolation that of \
                       policies trained and tested on R. Extrapolation is the geometric mean of three: trained on D and \
                       tested on R, trained on D and tested on E, trained on R and tested on E.";
const HEATMAPS: &str = "How the selected policies do over two parameters: means over runs. Colours are mean return and success \
                        rate, the same in all pictures of an environment; what lies beyond their scale has the colour of its \
                        end. Boxes are R's and E's, the ring is D.";
const COMPARISONS: &str = "Runs of two methods with the same seed, in each of the environments. P(X > Y) is the probability that \
                           a run of X is better than one of Y, where equal ones count half. Corrected p-values up to 0.05 \
                           are, all together, wrong with a probability of 5 % at most.";
const GAINS: &str = "Policies of the same method and seed, one trained on R and one on D, each with the configuration that was \
                     selected for what it was trained on, both tested on E, where neither was trained.";
const WORST: &str = "Mean return of the worst tenth of a test's episodes, and success in those parts of the parameter space that \
                     hold the worst tenth of contexts: half of the episodes say which these are, the other half their \
                     success. From recorded episodes; mean and deviation over runs.";
const FOOTING: &str = "How long the selected trainings were, of all environments together, and the success rate in training \
                       after as many steps, and as many episodes, as the trainings of all methods have.";
const SCENARIOS: &str = "The darker, the higher the success rate.";
/// Length from which a text is broken into lines, bytes.
const LONG: usize = 60;

/// A section with a heading and an entry in the list of contents.
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
    let gap_and_profiles = report.gap_table().into_iter().map(plain).chain(by_environment(&figures.profiles)).collect();
    let cells = report.tuned_table().into_iter().chain(report.selected_table()).chain(report.failure_table());
    let elsewhere = report.elsewhere_table().into_iter().collect();
    let cells = cells.map(plain).collect();
    let marks = report.marks_table().into_iter().map(plain).chain(by_environment(&figures.marks)).collect();
    let metrics = metrics(report, &figures.metrics);
    let settings = report.settings_table().into_iter().map(plain).chain(by_environment(&figures.settings)).collect();
    let scenarios = report.scenario_tables().into_iter().map(shaded).collect();
    let worst = report.worst_tables().into_iter().map(shaded).collect();
    let comparisons = report.comparisons_table().into_iter().collect();
    let gains = report.gains_table().into_iter().map(plain).chain(by_environment(&figures.gains)).collect();
    let sets = report.set_table().into_iter().collect();
    let heatmap_notes = html! { p { (HEATMAPS) } };
    let sections = [
        section("metrics", "Default, Interpolation, Extrapolation", said(METRICS), metrics),
        section("iqm", "Interquartile means", html! {}, report.iqm_table().into_iter().map(plain).collect()),
        section("profiles", "Optimality gap and performance profiles", html! {}, gap_and_profiles),
        section("comparisons", "Methods in pairs", said(COMPARISONS), tables(comparisons)),
        section("gains", "What training on R brings", said(GAINS), gains),
        section("extrapolation", "What Extrapolation is made of", html! {}, tables(report.extrapolation_tables())),
        section("scenarios", "The nine scenarios", said(SCENARIOS), scenarios),
        section("worst", "The worst tenth", said(WORST), worst),
        section("parameters", "Success over parameters", html! {}, by_environment(&figures.parameters)),
        section("thresholds", "Success over the threshold", html! {}, by_environment(&figures.thresholds)),
        section("sets", "Own sets of parameters", html! {}, tables(sets)),
        section("marks", "Generalisation against training", html! {}, marks),
        section("settings", "What settings do", html! {}, settings),
        section("footing", "Trainings on an equal footing", said(FOOTING), tables(report.footing_tables())),
        section("curves", "Training curves", html! {}, by_environment(&figures.curves)),
        section("heatmaps", "Heatmaps", heatmap_notes, by_environment(&figures.heatmaps)),
        section("cells", "Cells", html! {}, cells),
        section("elsewhere", "Trained elsewhere", html! {}, tables(elsewhere)),
    ];
    let shown: Vec<&Section> = sections.iter().filter(|section| !section.subsections.is_empty()).collect();
    let missing: Vec<String> = figures.no_curves.iter().chain(&figures.no_heatmaps).cloned().collect();
    page(report, &figures.finding, &shown, &missing).into_string()
}

/// Tables, of each environment with its figure.
fn metrics(report: &Report<'_>, figures: &[Figure]) -> Vec<Subsection> {
    let with_figure = |table: Table| {
        let Subsection { title, content } = table_subsection(&table, false);
        let figures: Vec<&Figure> = figures.iter().filter(|figure| figure.environment == title).collect();
        Subsection { title, content: html! { (content) @if !figures.is_empty() { (figure_grid(&figures)) } } }
    };
    let ties = report.ties_table().map(|table| table_subsection(&table, false));
    report.metrics_tables().into_iter().map(with_figure).chain(ties).collect()
}

/// Results come first, and last how they were made and which figures are missing.
fn page(report: &Report<'_>, finding: &[Figure], sections: &[&Section], missing: &[String]) -> Markup {
    let title = report.title();
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) " · perturb" }
                link rel="icon" href="data:,";
                style { (PreEscaped(STYLE)) }
            }
            body {
                nav aria-label="Contents" {
                    ol {
                        li { a href="#finding" { "Finding" } }
                        @for section in sections { (section.contents()) }
                        li { a href="#provenance" { "Provenance" } }
                    }
                }
                main {
                    header {
                        h1 { (title) }
                        @for said in report.abstract_paragraphs() { p.abstract { (prose(&said)) } }
                    }
                    section id="finding" aria-label="Finding" {
                        @for said in report.finding_sentences() { p { (prose(&said)) } }
                        @for one in finding { div.opening { (figure(one)) } }
                    }
                    @for section in sections { (section.body()) }
                    section id="provenance" {
                        h2 { "Provenance" }
                        (facts(report))
                        div.notes { @for line in &report.overview { p { (prose(line)) } } (list(missing)) }
                    }
                }
            }
        }
    }
}

/// Names with what there is to say, and the plan's files.
fn facts(report: &Report<'_>) -> Markup {
    html! {
        dl.facts {
            @if !report.plan.text.is_empty() {
                dt { "plan" }
                dd {
                    @for (i, (name, content)) in report.plan.files().enumerate() {
                        @if i > 0 { ", " }
                        a download=(name) href=(data_uri("text/plain", content)) { (name) }
                    }
                }
            }
            @for (name, said) in report.facts() { dt { (name) } dd { (prose(&said)) } }
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
                        // Pictures of all environments together have no title.
                        @for (i, subsection) in self.subsections.iter().enumerate().filter(|(_, it)| !it.title.is_empty()) {
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

/// Returns the names that apply; `None` if none does.
fn classes(names: &[(&str, bool)]) -> Option<String> {
    let applying: Vec<&str> = names.iter().filter(|(_, applies)| *applies).map(|(name, _)| *name).collect();
    (!applying.is_empty()).then(|| applying.join(" "))
}

fn by_environment(figures: &[Figure]) -> Vec<Subsection> {
    let of_environments = figures.chunk_by(|a, b| a.environment == b.environment);
    let subsection = |of: &[Figure]| Subsection {
        title: of[0].environment.clone(),
        content: html! {
            @if !of[0].environment.is_empty() { h3 { (of[0].environment) } }
            (figure_grid(&of.iter().collect::<Vec<_>>()))
        },
    };
    of_environments.map(subsection).collect()
}

/// Side by side where there is room.
fn figure_grid(figures: &[&Figure]) -> Markup {
    html! { div.figures { @for one in figures { (figure(one)) } } }
}

fn figure(Figure { file, name, caption, picture, .. }: &Figure) -> Markup {
    html! {
        figure class=[matches!(picture, FigureData::Missing).then_some("missing")] {
            @match picture {
                FigureData::Missing => figcaption { (caption) },
                FigureData::Svg { svg, csv } => {
                    // Named for those who do not see it.
                    div role="img" aria-label=(name) { (PreEscaped(svg)) }
                    figcaption {
                        (caption)
                        span.files {
                            a download=(format!("{file}.svg")) href=(data_uri("image/svg+xml", svg.as_bytes())) { "SVG" }
                            " "
                            a download=(format!("{file}.csv")) href=(data_uri("text/csv", csv)) { "CSV" }
                        }
                    }
                }
            }
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

/// Returns the part of a title before its details.
fn short(title: &str) -> &str {
    let end = [": ", " over "].iter().filter_map(|separator| title.find(separator)).min();
    &title[..end.unwrap_or(title.len())]
}
