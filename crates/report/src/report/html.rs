//! Renders a report as one self-contained HTML page: without scripts or network access, with all pictures and
//! downloadable files inside.

use maud::{DOCTYPE, Markup, PreEscaped, html};
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, percent_encode};
use perturb_experiment::{BudgetAxis, distinct};
use perturb_text::{Column, Entry, Table};

use super::comparison::EnvironmentComparison;
use super::finding::listed;
use super::{MISSING, Picture, PictureDrawing, Report, ReportBundle};
use crate::plot::{self, CurveQuantity, PlotError, draw_curves, svg};

pub(super) const STYLE: &str = include_str!("style.css");
const METRICS: &str = "Default is the success rate of policies that were trained and tested on D. Interpolation is the success \
                       rate of policies that were trained and tested on R. Extrapolation is the geometric mean of three \
                       success rates: trained on D and tested on R, trained on D and tested on E, trained on R and tested \
                       on E.";
const SCENARIOS: &str = "Mean ± standard deviation over runs; in brackets, the 95 % interval for the rate of these policies, \
                         given the number of test episodes. A darker colour means a higher success rate.";
const STATISTICS: &str = "Pairs are runs of two methods with the same seed, in each of the environments. P(X > Y) is the \
                          probability that a run of X is better than a run of Y; equal runs count half. If all corrected \
                          p-values up to 0.05 are taken as differences, the probability that any of them is false is at \
                          most 5 %.";
const SURFACES: &str = "Results of the selected policies over parameters. Heatmaps are means over runs. Colours show mean \
                        return and success rate, with the same scales in all pictures of an environment; a value beyond a \
                        scale has the colour of the scale's end. The boxes show R and E, and the ring shows D.";
/// Characters that a `data:` URI must percent-encode.
const ENCODED: &AsciiSet =
    &NON_ALPHANUMERIC.remove(b'-').remove(b'_').remove(b'.').remove(b',').remove(b'/').remove(b'=');
/// Length of a text in a table, in bytes, above which it is broken into lines.
const LONG: usize = 60;

/// A section of the page, with a heading and an entry in the list of contents.
struct Section {
    id: &'static str,
    title: &'static str,
    notes: &'static str,
    subsections: Vec<Subsection>,
}

/// A part of a section with its own heading.
struct Subsection {
    title: String,
    content: Markup,
}

impl ReportBundle<'_> {
    /// Renders the report with all pictures as one self-contained HTML page.
    ///
    /// # Errors
    /// [`PlotError`] if a picture cannot be drawn.
    pub fn page(&self) -> Result<String, PlotError> {
        let report = &self.report;
        let finding = report.finding_pictures().iter().map(figure).collect::<Result<Vec<_>, _>>()?;
        let tables = report.iqm_table().into_iter().chain(report.comparisons_table());
        let mut statistics: Vec<_> = tables.map(|table| table_subsection(&table, false)).collect();
        statistics.extend(by_environment(&Vec::from_iter(report.profiles_picture()))?);
        let scenarios = report.scenario_tables().iter().map(|table| table_subsection(table, true)).collect();
        let mut surfaces = report.parameter_pictures();
        surfaces.extend(self.heatmaps.pictures.iter().cloned());
        let place = |name: &str| report.scope.environments.iter().position(|known| *known == name);
        surfaces.sort_by_key(|picture| place(&picture.environment));
        let section = |id, title, notes, subsections| Section { id, title, notes, subsections };
        let sections = [
            section("metrics", "Default, Interpolation, Extrapolation", METRICS, self.metrics()?),
            section("comparison", "Comparison", "", self.comparisons.iter().map(comparison_subsection).collect()),
            section("scenarios", "The nine scenarios", SCENARIOS, scenarios),
            section("statistics", "Statistics over environments", STATISTICS, statistics),
            section("curves", "Training curves", "", by_environment(&self.curve_pictures())?),
            section("heatmaps", "Success over parameters", SURFACES, by_environment(&surfaces)?),
        ];
        let shown: Vec<&Section> = sections.iter().filter(|section| !section.subsections.is_empty()).collect();
        let without = self.curves.iter().filter(|of| of.curves.is_empty());
        let without = without.map(|of| format!("{}: no training with a result has its monitor.csv.", of.environment));
        let missing: Vec<String> = without.chain(self.heatmaps.advice()).collect();
        Ok(page(report, &finding, &shown, &missing).into_string())
    }

    /// Returns the tables of metrics as subsections. The table of an environment is followed by the environment's
    /// picture.
    fn metrics(&self) -> Result<Vec<Subsection>, PlotError> {
        let pictures = self.report.environment_pictures();
        let with_figure = |table: Table| {
            let Subsection { title, content } = table_subsection(&table, false);
            let own: Vec<_> = pictures.iter().filter(|picture| picture.environment == title).cloned().collect();
            let figures = figures(&own)?;
            Ok(Subsection { title, content: html! { (content) (figures) } })
        };
        self.report.metrics_tables().into_iter().map(with_figure).collect()
    }

    /// Returns the pictures of training curves: return and success of each environment, over episodes and over steps.
    fn curve_pictures(&self) -> Vec<Picture> {
        let mut pictures = Vec::new();
        for curves in self.curves.iter().filter(|of| !of.curves.is_empty()) {
            let environment = &curves.environment;
            let both = BudgetAxis::ALL.into_iter().flat_map(|by| CurveQuantity::ALL.map(|quantity| (by, quantity)));
            pictures.extend(both.map(|(by, quantity)| {
                let panels = draw_curves(curves, quantity, by);
                let name = format!("{environment}: {quantity} while training, over {by}");
                Picture {
                    environment: environment.clone(),
                    file: format!("{environment}-{quantity}-over-{by}"),
                    caption: format!(
                        "{name}, of the selected configurations. Lines are means over runs, bands their standard deviation."
                    ),
                    name,
                    data: panels.table(),
                    drawing: PictureDrawing::Panels(panels),
                }
            }));
        }
        pictures
    }
}

/// Renders the page. Results come first. The last section says how the results were made and which pictures are
/// missing.
fn page(report: &Report<'_>, finding: &[Markup], sections: &[&Section], missing: &[String]) -> Markup {
    let title = report.title();
    html! {
        (DOCTYPE)
        html lang="en" {
            (head(&title))
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
                        @for one in finding { div.opening { (one) } }
                    }
                    @for section in sections { (section.body()) }
                    section id="provenance" {
                        h2 { "Provenance" }
                        (plan(report))
                        div.notes { @for line in &report.provenance { p { (prose(line)) } } (list(missing)) }
                    }
                }
            }
        }
    }
}

/// Renders the head of a page, with the style sheet.
fn head(title: &str) -> Markup {
    html! {
        head {
            meta charset="utf-8";
            meta name="viewport" content="width=device-width, initial-scale=1";
            meta name="color-scheme" content="light dark";
            title { (title) " · perturb" }
            link rel="icon" href="data:,";
            style { (PreEscaped(STYLE)) }
        }
    }
}

/// Renders a comparison as a separate HTML page.
pub fn comparison_page(of: &EnvironmentComparison) -> String {
    let conditions = distinct(of.comparison.means.iter().map(|row| row.condition.as_str()));
    let title = format!("{} on {}", listed(&conditions), of.environment);
    let content = comparison_subsection(of).content;
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            (head(&title))
            body.single { main { h1 { (title) } section id="comparison" { (content) } } }
        }
    };
    page.into_string()
}

/// Renders a comparison: its verdict, its tables, and a note on the intervals.
fn comparison_subsection(of: &EnvironmentComparison) -> Subsection {
    let tables = of.tables().into_iter().map(|table| table_subsection(&table, false).content);
    let content = html! {
        p { (of.comparison.verdict) "." }
        @for table in tables { (table) }
        p.notes { (of.note()) }
    };
    Subsection { title: of.environment.clone(), content }
}

/// Renders the plan's date, and links to download its files.
fn plan(report: &Report<'_>) -> Markup {
    html! {
        @if !report.plan.text.is_empty() {
            p.notes {
                @if !report.plan.date.is_empty() { (report.plan.date) ". " }
                "Plan: "
                @for (i, (name, content)) in report.plan.files().enumerate() {
                    @if i > 0 { ", " }
                    a download=(name) href=(data_uri("text/plain", content)) { (name) }
                }
            }
        }
    }
}

impl Section {
    /// Returns the HTML id of a subsection.
    fn subsection_id(&self, index: usize) -> String {
        format!("{}-{}", self.id, index + 1)
    }

    /// Renders the section's entry in the list of contents, with links to its subsections.
    fn contents(&self) -> Markup {
        html! {
            li {
                a href={ "#" (self.id) } { (self.title) }
                @if self.subsections.len() > 1 {
                    " "
                    span {
                        // The subsection of pictures over all environments has no title.
                        @for (i, subsection) in self.subsections.iter().enumerate().filter(|(_, it)| !it.title.is_empty()) {
                            @if i > 0 { " · " }
                            a href={ "#" (self.subsection_id(i)) } { (short(&subsection.title)) }
                        }
                    }
                }
            }
        }
    }

    /// Renders the section.
    fn body(&self) -> Markup {
        html! {
            section id=(self.id) {
                h2 { (self.title) }
                @if !self.notes.is_empty() { p { (self.notes) } }
                @for (i, subsection) in self.subsections.iter().enumerate() {
                    div id=(self.subsection_id(i)) { (subsection.content) }
                }
            }
        }
    }
}

/// Renders a table. With `shaded`, numbers have a background colour, and a line separates methods.
fn table_subsection(table: &Table, shaded: bool) -> Subsection {
    let groups: Vec<&[Column]> = table.columns.chunk_by(|a, b| a.group == b.group).collect();
    // Whether a column starts a group of columns, except the first group.
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
                                // If a column has the same name as its group, the header shows "here" instead. The name
                                // is already in the group's header above it.
                                @if column.group.as_ref() == Some(&column.name) { "here" } @else { (column.name) }
                            }
                        }
                    }
                }
                tbody {
                    @for (row, entries) in table.rows.iter().enumerate() {
                        // The class `next` draws a line above the first row of each method.
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

/// Renders an entry of a table. `starts` marks the first column of a group.
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

/// Returns the CSS classes that apply, separated by spaces; `None` if none applies.
fn classes(names: &[(&str, bool)]) -> Option<String> {
    let applying: Vec<&str> = names.iter().filter(|(_, applies)| *applies).map(|(name, _)| *name).collect();
    (!applying.is_empty()).then(|| applying.join(" "))
}

/// Renders pictures as subsections, one for each environment. Pictures of an environment must follow each other.
fn by_environment(pictures: &[Picture]) -> Result<Vec<Subsection>, PlotError> {
    let subsection = |of: &[Picture]| {
        let (title, figures) = (of[0].environment.clone(), figures(of)?);
        let content = html! { @if !title.is_empty() { h3 { (title) } } (figures) };
        Ok(Subsection { title, content })
    };
    pictures.chunk_by(|a, b| a.environment == b.environment).map(subsection).collect()
}

/// Renders pictures as figures, side by side if there is room.
fn figures(pictures: &[Picture]) -> Result<Markup, PlotError> {
    let figures = pictures.iter().map(figure).collect::<Result<Vec<_>, _>>()?;
    Ok(html! { @if !figures.is_empty() { div.figures { @for one in figures { (one) } } } })
}

/// Renders a picture with its caption, and links to download it as SVG and as CSV.
fn figure(Picture { file, name, caption, drawing, data, .. }: &Picture) -> Result<Markup, PlotError> {
    let svg = svg(drawing)?;
    Ok(html! {
        figure {
            // The label is for screen readers.
            div role="img" aria-label=(name) { (PreEscaped(&svg)) }
            figcaption {
                (caption)
                span.files {
                    a download=(format!("{file}.svg")) href=(data_uri("image/svg+xml", svg.as_bytes())) { "SVG" }
                    " "
                    a download=(format!("{file}.csv")) href=(data_uri("text/csv", &data.to_csv())) { "CSV" }
                }
            }
        }
    })
}

/// Returns a `data:` URI that contains `content`, so that links work without other files.
fn data_uri(media_type: &str, content: &[u8]) -> String {
    format!("data:{media_type};charset=utf-8,{}", percent_encode(content, ENCODED))
}

/// Renders notes as a list; nothing if there are none.
fn list(notes: &[String]) -> Markup {
    html! { @if !notes.is_empty() { ul.missing { @for note in notes { li { (prose(note)) } } } } }
}

/// Renders a text. Words between backticks become code.
fn prose(text: &str) -> Markup {
    html! { @for (i, part) in text.split('`').enumerate() { @if i % 2 == 1 { code { (part) } } @else { (part) } } }
}

/// Returns the start of a title, before ": " or " over ", for the list of contents.
fn short(title: &str) -> &str {
    let end = [": ", " over "].iter().filter_map(|separator| title.find(separator)).min();
    &title[..end.unwrap_or(title.len())]
}
