//! A report as one HTML page, complete in itself: no network, no script, pictures as inline SVG.

use std::fmt::Write;

use super::super::plot;
use super::{Entry, Report, Table};

const STYLE: &str = "
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 2rem auto; padding: 0 1rem;
  max-width: 76rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.5rem; } h3 { font-size: 1rem; margin: 1.5rem 0 .4rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .88rem; }
th, td { padding: .2rem .6rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap; }
th { border-bottom: 2px solid #888; } .text { text-align: left; } .missing { color: #767676; font-style: italic; }
.long { white-space: normal; }
figure { margin: 1rem 0; } figure svg { max-width: 100%; height: auto; } figcaption { color: #444; font-size: .9rem; }
@media print { body { margin: 0; max-width: none; } h2, h3 { break-after: avoid; } tr, figure { break-inside: avoid; }
  td { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
";

/// The page; `figures` are pictures with their captions, as SVG.
pub fn html(report: &Report, figures: &[(String, String)]) -> String {
    let mut out = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\">\n<title>perturb: results</title>\n\
         <link rel=\"icon\" href=\"data:,\">\n<style>{STYLE}</style>\n</head>\n<body>\n<h1>Results</h1>\n"
    );
    for line in &report.overview {
        let _ = writeln!(out, "<p>{}</p>", escaped(line)); // writing to a String cannot fail, here and below
    }
    out.push_str("<h2>Default, Interpolation, Extrapolation</h2>\n");
    report.metrics.iter().for_each(|table| write_table(&mut out, table, false));
    write_table(&mut out, &report.iqm, false);
    out.push_str("<h2>The nine scenarios</h2>\n<p>The darker, the higher the success rate.</p>\n");
    report.scenarios.iter().for_each(|table| write_table(&mut out, table, true));
    if !figures.is_empty() {
        out.push_str("<h2>Training curves</h2>\n");
        for (caption, svg) in figures {
            let _ = writeln!(out, "<figure>\n{svg}\n<figcaption>{}</figcaption>\n</figure>", escaped(caption));
        }
    }
    out.push_str("<h2>Cells</h2>\n");
    write_table(&mut out, &report.selected, false);
    if !report.failures.rows.is_empty() {
        write_table(&mut out, &report.failures, false);
    }
    out.push_str("</body>\n</html>\n");
    out
}

fn write_table(out: &mut String, table: &Table, heat: bool) {
    let _ = writeln!(out, "<h3>{}</h3>\n<div class=\"wide\"><table>\n<thead><tr>", escaped(&table.title));
    for (i, name) in table.header.iter().enumerate() {
        let class = if i < table.texts { " class=\"text\"" } else { "" };
        let _ = write!(out, "<th{class} scope=\"col\">{}</th>", escaped(name));
    }
    out.push_str("</tr></thead>\n<tbody>\n");
    for row in &table.rows {
        out.push_str("<tr>");
        for (i, entry) in row.iter().enumerate() {
            write_entry(out, entry, i < table.texts, heat);
        }
        out.push_str("</tr>\n");
    }
    out.push_str("</tbody></table></div>\n");
}

fn write_entry(out: &mut String, entry: &Entry, is_text: bool, heat: bool) {
    let class = match (entry.text.as_str(), is_text) {
        (super::MISSING, _) => " class=\"missing\"",
        (text, true) if text.len() > 60 => " class=\"text long\"",
        (_, true) => " class=\"text\"",
        _ => "",
    };
    let style = match entry.heat.filter(|_| heat) {
        Some(percent) => {
            let (r, g, b) = plot::shade(percent / 100.0);
            let ink = if plot::is_dark((r, g, b)) { "#fff" } else { "#000" };
            format!(" style=\"background:#{r:02x}{g:02x}{b:02x};color:{ink}\"")
        }
        None => String::new(),
    };
    let _ = write!(out, "<td{class}{style}>{}</td>", escaped(&entry.text));
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
