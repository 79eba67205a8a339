//! Tables, which can be written as text for a terminal, as Markdown and as CSV. Equal tables give equal bytes on every
//! machine.

use std::ops::Range;

use comfy_table::presets::{ASCII_MARKDOWN, NOTHING};
use comfy_table::{CellAlignment, TableStyle};

/// A table to be displayed or written to a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// The title, which may serve as the name of the table's file.
    pub title: String,
    /// The columns, from left to right.
    pub columns: Vec<Column>,
    /// The rows. Each has one entry for each column.
    pub rows: Vec<Vec<Entry>>,
}

/// The heading and the kind of a column.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// The heading.
    pub name: String,
    /// A heading above several neighbouring columns, if the columns' own headings are not sufficient.
    pub group: Option<String>,
    /// Whether the entries are numbers. Numbers are aligned to the right, texts to the left.
    pub is_number: bool,
}

/// The content of one row in one column.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// The displayed text.
    pub text: String,
    /// A percentage that may be shown as a background colour.
    pub heat: Option<f64>,
}

impl<T: std::fmt::Display> From<T> for Entry {
    fn from(shown: T) -> Self {
        Self { text: shown.to_string(), heat: None }
    }
}

/// Builds a table column by column. Each row is made from one value of type `R`.
pub struct TableBuilder<'r, R> {
    sources: &'r [R],
    table: Table,
}

impl Table {
    /// Starts a table with a row for each of `sources`, and without columns.
    pub fn builder<R>(title: impl Into<String>, sources: &[R]) -> TableBuilder<'_, R> {
        let rows = vec![Vec::new(); sources.len()];
        TableBuilder { sources, table: Table { title: title.into(), columns: Vec::new(), rows } }
    }

    /// Renders the table as aligned text, without the title.
    pub fn to_text(&self) -> String {
        self.drawn(NOTHING, str::to_owned).trim_fmt()
    }

    /// Renders the table as text for a terminal that is `width` characters wide. If not all columns fit, the table is
    /// divided into several blocks, one below the other. Every block starts with the leftmost columns of texts.
    pub fn to_text_within(&self, width: usize) -> String {
        let keys = self.columns.iter().take_while(|column| !column.is_number).count();
        let fits = |text: &str| text.lines().all(|line| line.chars().count() <= width);
        if keys == self.columns.len() || !fits(&self.with_columns(0..keys, keys..keys).to_text()) {
            return self.to_text();
        }
        let (mut blocks, mut first): (Vec<String>, usize) = (Vec::new(), keys);
        while first < self.columns.len() {
            let mut ends = (first + 1..=self.columns.len()).filter(|&end| self.may_begin(end));
            let with = |end: usize| (end, self.with_columns(0..keys, first..end).to_text());
            // Shows at least one column, even if it does not fit.
            let narrowest = ends.next().map_or_else(|| with(self.columns.len()), with);
            let (end, block) = ends.map(with).take_while(|(_, text)| fits(text)).last().unwrap_or(narrowest);
            blocks.push(block);
            first = end;
        }
        blocks.join("\n\n")
    }

    /// Returns whether a new block may begin with the column at index `place`. The index after the last column is
    /// always allowed. A column that has the same name as another column must stay in the block of the column before
    /// it.
    fn may_begin(&self, place: usize) -> bool {
        let Some(column) = self.columns.get(place) else { return true };
        self.columns.iter().filter(|other| other.name == column.name).count() == 1
    }

    fn with_columns(&self, some: Range<usize>, more: Range<usize>) -> Table {
        let columns = [&self.columns[some.clone()], &self.columns[more.clone()]].concat();
        let row = |row: &Vec<Entry>| [&row[some.clone()], &row[more.clone()]].concat();
        Table { title: self.title.clone(), columns, rows: self.rows.iter().map(row).collect() }
    }

    /// Renders the table as GitHub-flavoured Markdown, without the title.
    pub fn to_markdown(&self) -> String {
        self.drawn(ASCII_MARKDOWN, |text| text.replace('|', "\\|").replace('\n', " ")).to_string()
    }

    /// Encodes the table as CSV: a header line, and a line for each row.
    pub fn to_csv(&self) -> Vec<u8> {
        let names = self.columns.iter().map(|column| &column.name).collect();
        let rows = self.rows.iter().map(|row| row.iter().map(|entry| &entry.text).collect());
        let mut writer = csv::Writer::from_writer(Vec::new());
        for line in std::iter::once::<Vec<&String>>(names).chain(rows) {
            writer.write_record(line).expect("all lines are as long, and memory takes them");
        }
        writer.into_inner().expect("memory takes what is left")
    }

    fn drawn(&self, style: TableStyle, shown: impl Fn(&str) -> String) -> comfy_table::Table {
        let mut drawn = comfy_table::Table::new();
        drawn.load_style(style).set_header(self.columns.iter().map(|column| &column.name));
        drawn.add_rows(self.rows.iter().map(|row| row.iter().map(|entry| shown(&entry.text))));
        let numbers = drawn.column_iter_mut().zip(&self.columns).filter(|(_, column)| column.is_number);
        numbers.for_each(|(drawn, _)| drawn.set_cell_alignment(CellAlignment::Right));
        drawn
    }
}

impl<'r, R> TableBuilder<'r, R> {
    /// Returns the values from which the rows are made.
    pub fn sources(&self) -> &'r [R] {
        self.sources
    }

    /// Adds a column of texts.
    pub fn text<E: Into<Entry>>(self, name: impl Into<String>, entry: impl Fn(&'r R) -> E) -> Self {
        self.column(Column { name: name.into(), group: None, is_number: false }, entry)
    }

    /// Adds a column of numbers.
    pub fn number<E: Into<Entry>>(self, name: impl Into<String>, entry: impl Fn(&'r R) -> E) -> Self {
        self.column(Column { name: name.into(), group: None, is_number: true }, entry)
    }

    /// Adds a column with the given heading, which may have a group.
    pub fn column<E: Into<Entry>>(self, column: Column, entry: impl Fn(&'r R) -> E) -> Self {
        self.push_column(column, &|source| entry(source).into())
    }

    /// Adds a column. `entry` is a trait object, so that this code is compiled once for each type of row and not for
    /// each closure.
    fn push_column(mut self, column: Column, entry: &dyn Fn(&'r R) -> Entry) -> Self {
        self.table.columns.push(column);
        for (row, source) in self.table.rows.iter_mut().zip(self.sources) {
            row.push(entry(source));
        }
        self
    }

    /// Builds the table, with a row for each source.
    pub fn build(self) -> Table {
        self.table
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let sources = [("ppo ff", Some(93.25)), ("a|b\nc", None)];
        let number = |number: Option<f64>| number.map_or_else(String::new, |number| number.to_string());
        Table::builder("A title", &sources)
            .text("method", |(method, _)| method)
            .number("success, %", |(_, success)| number(*success))
            .build()
    }

    #[test]
    fn numbers_stand_on_the_right() {
        insta::assert_snapshot!(table().to_text(), @r"
         method  success, %
         ppo ff       93.25
         a|b
         c
        ");
    }

    #[test]
    fn a_table_that_is_wider_than_the_terminal_goes_on_below() {
        let sources = [("ppo ff", 93.25), ("a2c ff", 1.5)];
        let mut table = Table::builder("", &sources).text("method", |(method, _)| method);
        for metric in ["Default", "Interpolation", "Extrapolation"] {
            table = table.number(metric, |(_, success)| success).number("paper", |_| 70);
        }
        let table = table.build();
        let whole = table.to_text();
        let width = whole.lines().map(str::len).max().unwrap();
        assert_eq!(table.to_text_within(width), whole);
        insta::assert_snapshot!(table.to_text_within(width - 1), @r"
         method  Default  paper  Interpolation  paper
         ppo ff    93.25     70          93.25     70
         a2c ff      1.5     70            1.5     70

         method  Extrapolation  paper
         ppo ff          93.25     70
         a2c ff            1.5     70
        ");
        assert_eq!(table.to_text_within(10).lines().filter(|line| line.contains("method")).count(), 3);
        assert_eq!(table.to_text_within(5), whole, "not even the methods have room");
        let texts = Table::builder("", &sources).text("method", |(method, _)| method).build();
        assert_eq!(texts.to_text_within(5), texts.to_text());
    }

    #[test]
    fn markdown_keeps_a_row_on_a_line_and_its_bars_apart() {
        insta::assert_snapshot!(table().to_markdown(), @r"
        | method | success, % |
        |--------|------------|
        | ppo ff |      93.25 |
        | a\|b c |            |
        ");
    }

    #[test]
    fn csv_quotes_texts_and_leaves_unknown_values_empty() {
        insta::assert_snapshot!(String::from_utf8(table().to_csv()).unwrap(), @r#"
        method,"success, %"
        ppo ff,93.25
        "a|b
        c",
        "#);
    }
}
