//! A report as one HTML page, complete in itself: no network, no script, all pictures inside.

use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::super::plot;
use super::{Entry, Figure, FigureData, Figures, Report, Table};

const STYLE: &str = include_str!("style.css");
const METRICS: &str = "Default is the success rate of policies that were trained and tested on D, Interpolation that of \
                       policies trained and tested on R. Extrapolation is the geometric mean of three: trained on D and \
                       tested on R, trained on D and tested on E, trained on R and tested on E.";
const HEATMAPS: &str = "How the policies that were selected in the first run do over two parameters. Colours are mean \
                        return and success rate; the whole line is R's box, dashed lines are E's.";

/// The page.
pub fn html(report: &Report, figures: &Figures) -> String {
    let mut page = Page::default();
    page.section("metrics", "Default, Interpolation, Extrapolation", &[METRICS]);
    report.metrics.iter().for_each(|table| page.table(table, Look::Plain));
    page.section("iqm", "Interquartile means", &[]);
    page.table(&report.iqm, Look::Plain);
    page.section("scenarios", "The nine scenarios", &["The darker, the higher the success rate."]);
    page.columns(|page| report.scenarios.iter().for_each(|table| page.table(table, Look::Shaded)));
    page.section("curves", "Training curves", &[]);
    figures.curves.iter().for_each(|figure| page.figure(figure));
    page.notes(&figures.no_curves);
    page.section("heatmaps", "Heatmaps", &[HEATMAPS]);
    page.notes(&figures.no_heatmaps);
    figures.heatmaps.iter().for_each(|row| page.row(row));
    page.section("cells", "Cells", &[]);
    page.table(&report.selected, Look::Plain);
    if !report.failures.rows.is_empty() {
        page.table(&report.failures, Look::Plain);
    }
    page.finish(&report.overview)
}

/// How a table looks.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Look {
    Plain,
    /// Shares have a colour.
    Shaded,
}

/// A page that grows from the top.
#[derive(Default)]
struct Page {
    body: String,
    sections: Vec<Section>,
}

/// What the list of contents has of a section.
struct Section {
    id: &'static str,
    title: &'static str,
    /// Parts with their ids.
    parts: Vec<(String, String)>,
}

// Writing to a String cannot fail: its results are not looked at.
impl Page {
    fn section(&mut self, id: &'static str, title: &'static str, notes: &[&str]) {
        if !self.sections.is_empty() {
            self.body.push_str("</section>\n");
        }
        let _ = writeln!(self.body, "<section id=\"{id}\">\n<h2>{title}</h2>");
        for note in notes {
            let _ = writeln!(self.body, "<p>{}</p>", prose(note));
        }
        self.sections.push(Section { id, title, parts: Vec::new() });
    }

    /// The attribute that makes something the part `name` of the current section, for the list of contents; nothing if
    /// there is such a part already.
    fn part(&mut self, name: &str) -> String {
        let Some(section) = self.sections.last_mut() else { return String::new() };
        if section.parts.iter().any(|(_, known)| known == name) {
            return String::new();
        }
        let id = format!("{}-{}", section.id, section.parts.len() + 1);
        section.parts.push((id.clone(), name.to_owned()));
        format!(" id=\"{id}\"")
    }

    /// What `content` writes stands side by side where there is room.
    fn columns(&mut self, content: impl FnOnce(&mut Self)) {
        self.body.push_str("<div class=\"columns\">\n");
        content(self);
        self.body.push_str("</div>\n");
    }

    /// Figures side by side, under their environment's name if it is new.
    fn row(&mut self, figures: &[Figure]) {
        let Some(first) = figures.first() else { return };
        let id = self.part(&first.environment);
        if !id.is_empty() {
            let _ = writeln!(self.body, "<h3{id}>{}</h3>", escaped(&first.environment));
        }
        let _ = writeln!(self.body, "<div class=\"row\" style=\"--columns:{}\">", figures.len());
        figures.iter().for_each(|figure| self.figure(figure));
        self.body.push_str("</div>\n");
    }

    fn notes(&mut self, notes: &[String]) {
        if notes.is_empty() {
            return;
        }
        self.body.push_str("<ul class=\"missing\">\n");
        for note in notes {
            let _ = writeln!(self.body, "<li>{}</li>", prose(note));
        }
        self.body.push_str("</ul>\n");
    }

    fn table(&mut self, table: &Table, look: Look) {
        let id = self.part(&table.title);
        let out = &mut self.body;
        let _ = writeln!(out, "<div>\n<h3{id}>{}</h3>", escaped(&table.title));
        out.push_str("<div class=\"wide\"><table>\n<thead>\n");
        // Where each span of columns begins.
        let starts: Vec<usize> =
            table.spans.iter().scan(0, |next, (_, width)| Some((*next, *next += width).0)).collect();
        if !table.spans.is_empty() {
            out.push_str("<tr>");
            for (name, width) in &table.spans {
                let class = if name.is_empty() { "" } else { " class=\"span\" scope=\"colgroup\"" };
                let _ = write!(out, "<th{class} colspan=\"{width}\">{}</th>", escaped(name));
            }
            out.push_str("</tr>\n");
        }
        out.push_str("<tr>");
        for (i, name) in table.header.iter().enumerate() {
            // The first column of a span is what the span is called; the others say what they are instead.
            let own = table.spans.iter().any(|(span, _)| span == name);
            let name = if own { "here" } else { name };
            let class = class(&[(i < table.texts, "text"), (i > 0 && starts.contains(&i), "start")]);
            let _ = write!(out, "<th{class} scope=\"col\">{}</th>", escaped(name));
        }
        out.push_str("</tr>\n</thead>\n<tbody>\n");
        for (row, entries) in table.rows.iter().enumerate() {
            // A line above a method's first row, where methods have several.
            let first = |row: usize| table.rows.get(row).and_then(|row| row.first());
            let next = look == Look::Shaded && row > 0 && first(row) != first(row - 1);
            let _ = write!(out, "<tr{}>", class(&[(next, "next")]));
            for (i, entry) in entries.iter().enumerate() {
                write_entry(out, entry, i < table.texts, i > 0 && starts.contains(&i), look);
            }
            out.push_str("</tr>\n");
        }
        out.push_str("</tbody>\n</table></div>\n</div>\n");
    }

    fn figure(&mut self, figure: &Figure) {
        let Figure { environment, name, caption, picture } = figure;
        let id = self.part(environment);
        let out = &mut self.body;
        let missing = matches!(picture, FigureData::Missing);
        let _ = writeln!(out, "<figure{id}{}>", class(&[(missing, "missing")]));
        match picture {
            FigureData::Missing => {}
            FigureData::Svg(svg) => {
                // Named for those who do not see it.
                let svg = svg.replacen("<svg ", &format!("<svg role=\"img\" aria-label=\"{}\" ", escaped(name)), 1);
                let _ = writeln!(out, "{svg}");
            }
            FigureData::Png(png) => {
                let size = png_size(png).map_or_else(String::new, |(width, height)| {
                    format!(" width=\"{}\" height=\"{}\"", width / plot::PNG_SCALE, height / plot::PNG_SCALE)
                });
                let data = STANDARD.encode(png);
                let _ = writeln!(out, "<img alt=\"{}\"{size} src=\"data:image/png;base64,{data}\">", escaped(name));
            }
        }
        let _ = writeln!(out, "<figcaption>{}</figcaption>\n</figure>", escaped(caption));
    }

    fn finish(self, overview: &[String]) -> String {
        let mut out = format!(
            "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" \
             content=\"width=device-width, initial-scale=1\">\n<title>perturb: results</title>\n\
             <link rel=\"icon\" href=\"data:,\">\n<style>\n{STYLE}</style>\n</head>\n<body>\n<header>\n<h1>Results</h1>\n"
        );
        for line in overview {
            let _ = writeln!(out, "<p>{}</p>", prose(line));
        }
        out.push_str("</header>\n<nav aria-label=\"Contents\">\n<ol>\n");
        for Section { id, title, parts } in &self.sections {
            let _ = write!(out, "<li><a href=\"#{id}\">{title}</a>");
            if parts.len() > 1 {
                let links: Vec<String> =
                    parts.iter().map(|(id, name)| format!("<a href=\"#{id}\">{}</a>", escaped(short(name)))).collect();
                let _ = write!(out, " <span>{}</span>", links.join(" · "));
            }
            out.push_str("</li>\n");
        }
        let _ = write!(out, "</ol>\n</nav>\n<main>\n{}</section>\n</main>\n</body>\n</html>\n", self.body);
        out
    }
}

/// What comes before a title's details.
fn short(title: &str) -> &str {
    let end = [": ", " over "].iter().filter_map(|separator| title.find(separator)).min();
    &title[..end.unwrap_or(title.len())]
}

fn write_entry(out: &mut String, entry: &Entry, is_text: bool, starts: bool, look: Look) {
    let class = class(&[
        (is_text, "text"),
        (is_text && entry.text.len() > 60, "long"),
        (entry.text == super::MISSING, "missing"),
        (starts, "start"),
    ]);
    let style = match entry.heat.filter(|_| look == Look::Shaded) {
        Some(percent) => {
            let (r, g, b) = plot::shade(percent / 100.0);
            let ink = if plot::is_dark((r, g, b)) { "#fff" } else { "#000" };
            format!(" style=\"background:#{r:02x}{g:02x}{b:02x};color:{ink}\"")
        }
        None => String::new(),
    };
    let _ = write!(out, "<td{class}{style}>{}</td>", escaped(&entry.text));
}

/// The attribute with those names whose condition holds; nothing if there are none.
fn class(names: &[(bool, &str)]) -> String {
    let names: Vec<&str> = names.iter().filter(|(holds, _)| *holds).map(|(_, name)| *name).collect();
    if names.is_empty() { String::new() } else { format!(" class=\"{}\"", names.join(" ")) }
}

/// Width and height of a PNG file, pixels: the first numbers of its first chunk.
fn png_size(png: &[u8]) -> Option<(u32, u32)> {
    let number = |from: usize| Some(u32::from_be_bytes(png.get(from..from + 4)?.try_into().ok()?));
    Some((number(16)?, number(20)?))
}

/// A sentence, in which `names` stand between backticks.
fn prose(text: &str) -> String {
    let part = |(i, part)| if i % 2 == 1 { format!("<code>{part}</code>") } else { str::to_owned(part) };
    escaped(text).split('`').enumerate().map(part).collect()
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
