//! Tables as text for a terminal and as Markdown.

use std::fmt::Write;

use super::{Entry, Report, Table};

/// For a terminal: columns under each other. The selected cells are left out; `selected.csv` has them.
pub fn text(report: &Report) -> String {
    let mut out = report.overview.join("\n");
    out.push('\n');
    for table in report.tables().filter(|table| **table != report.selected) {
        let widths = widths(table);
        let _ = writeln!(out, "\n{}", table.title); // writing to a String cannot fail, here and below
        let header: Vec<Entry> = table.header.iter().map(|name| name.as_str().into()).collect();
        for row in std::iter::once(&header).chain(&table.rows) {
            let cells: Vec<String> =
                row.iter().enumerate().map(|(i, entry)| aligned(table, i, entry, widths[i])).collect();
            let _ = writeln!(out, "{}", cells.join("  ").trim_end());
        }
    }
    out
}

/// As Markdown, for GitHub and the like.
pub fn markdown(report: &Report) -> String {
    let mut out = format!("# Results\n\n{}\n", report.overview.join("\n\n"));
    for table in report.tables() {
        let widths = widths(table);
        let _ = writeln!(out, "\n## {}\n", table.title);
        let line = |row: &[Entry]| {
            let cell = |(i, entry): (usize, &Entry)| aligned(table, i, &escaped(entry), widths[i]);
            format!("| {} |\n", row.iter().enumerate().map(cell).collect::<Vec<_>>().join(" | "))
        };
        let header: Vec<Entry> = table.header.iter().map(|name| name.as_str().into()).collect();
        out.push_str(&line(&header));
        let rule = |i: usize| if i < table.texts { "---" } else { "---:" };
        let _ = writeln!(out, "|{}|", (0..table.header.len()).map(rule).collect::<Vec<_>>().join("|"));
        table.rows.iter().for_each(|row| out.push_str(&line(row)));
    }
    out
}

fn escaped(entry: &Entry) -> Entry {
    entry.text.replace('|', "\\|").replace('\n', " ").into()
}

/// The widest text of each column.
fn widths(table: &Table) -> Vec<usize> {
    let width = |text: &str| text.chars().count();
    let mut widths: Vec<usize> = table.header.iter().map(|name| width(name)).collect();
    for row in &table.rows {
        for (widest, entry) in widths.iter_mut().zip(row) {
            *widest = (*widest).max(width(&entry.text));
        }
    }
    widths
}

/// Texts to the left, numbers to the right.
fn aligned(table: &Table, column: usize, entry: &Entry, width: usize) -> String {
    if column < table.texts { format!("{:<width$}", entry.text) } else { format!("{:>width$}", entry.text) }
}
