//! Reads TOML values. Errors have the line and the key of the mistake.

use super::error::{Error, Result, escaped};
use perturb_protocol::names::did_you_mean;
use std::ops::Range;
use toml::{
    Spanned,
    de::{DeTable, DeValue},
};

/// The name of the file in error messages.
pub(super) const FILE: &str = "task.toml";

/// A table of the file. `place` names it in error messages, such as `parameter friction`; it is empty for the top-level
/// table.
#[derive(Clone)]
pub(super) struct TomlTable<'a> {
    text: &'a str,
    entries: &'a DeTable<'a>,
    pub(super) place: String,
    span: Range<usize>,
}

/// A value in a table. `place` names it in error messages.
pub(super) struct Value<'a> {
    text: &'a str,
    value: &'a DeValue<'a>,
    pub(super) place: String,
    span: Range<usize>,
}

/// Decodes a UTF-8 text, and removes a byte order mark. `name` is the file's name for errors.
///
/// # Errors
/// [`Error`] if the bytes are not UTF-8.
pub(super) fn decode<'a>(name: &str, bytes: &'a [u8]) -> Result<&'a str> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    std::str::from_utf8(bytes).map_err(|error| {
        let line = 1 + bytes[..error.valid_up_to()].iter().filter(|&&byte| byte == b'\n').count();
        Error::line(name, line, "the file is not UTF-8; save it in that encoding")
    })
}

/// Parses the text of `task.toml`.
///
/// # Errors
/// [`Error`] with the line if the text is not TOML.
pub(super) fn parse(text: &str) -> Result<Spanned<DeTable<'_>>> {
    DeTable::parse(text).map_err(|error| {
        let line = line_of(text, error.span().map_or(0, |span| span.start));
        Error::line(FILE, line, format_args!("this is not TOML: {}", escaped(error.message())))
    })
}

fn line_of(text: &str, offset: usize) -> usize {
    1 + text.bytes().take(offset).filter(|&byte| byte == b'\n').count()
}

/// Creates an error about the table or value `place`, with the line of this byte offset.
fn error(text: &str, offset: usize, place: &str, problem: impl std::fmt::Display) -> Error {
    let line = line_of(text, offset);
    match place {
        "" => Error::line(FILE, line, problem),
        place => Error::line(FILE, line, format_args!("{place}: {problem}")),
    }
}

impl<'a> TomlTable<'a> {
    /// The top-level table of a document with this text.
    pub(super) fn top(text: &'a str, document: &'a Spanned<DeTable<'a>>) -> Self {
        Self { text, entries: document.get_ref(), place: String::new(), span: 0..0 }
    }

    /// Creates an error about this table.
    pub(super) fn error(&self, problem: impl std::fmt::Display) -> Error {
        error(self.text, self.span.start, &self.place, problem)
    }

    /// Sets the name of this table in error messages.
    pub(super) fn at(mut self, place: impl Into<String>) -> Self {
        self.place = place.into();
        self
    }

    /// Refuses keys that are not among `known`.
    pub(super) fn only(&self, known: &[&str]) -> Result<()> {
        for key in self.entries.keys() {
            let name = key.get_ref().as_ref();
            if !known.contains(&name) {
                let hint = did_you_mean(name, known.iter().copied());
                let problem = format!("unknown key {:?}{hint}; there are {}", escaped(name), known.join(", "));
                return Err(error(self.text, key.span().start, &self.place, problem));
            }
        }
        Ok(())
    }

    /// Returns the value of a key, if the key is present.
    pub(super) fn get(&self, key: &str) -> Option<Value<'a>> {
        let value = self.entries.get(key)?;
        let place = if self.place.is_empty() { key.to_owned() } else { format!("{}: {key}", self.place) };
        Some(Value { text: self.text, value: value.get_ref(), place, span: value.span() })
    }

    /// Whether a key is present.
    pub(super) fn has(&self, key: &str) -> bool {
        self.entries.contains_key(key)
    }

    /// Returns the value of a required key. `example` is a value for the error message if the key is missing.
    pub(super) fn require(&self, key: &str, example: &str) -> Result<Value<'a>> {
        self.get(key).ok_or_else(|| self.error(format_args!("{key} is missing; give for instance {key} = {example}")))
    }

    /// Returns the key of `keys` that is present, and its value.
    ///
    /// # Errors
    /// An error if none or several of the keys are present.
    pub(super) fn one_of(&self, keys: &[&'static str]) -> Result<(&'static str, Value<'a>)> {
        let mut found = keys.iter().filter_map(|&key| Some((key, self.get(key)?)));
        let (key, value) = found.next().ok_or_else(|| self.error(format_args!("give one of {}", keys.join(", "))))?;
        match found.next() {
            None => Ok((key, value)),
            Some((second, _)) => Err(self.error(format_args!("give either {key} or {second}, not both"))),
        }
    }

    /// Returns the finite number of a key; `None` if the key is absent.
    pub(super) fn number(&self, key: &str) -> Result<Option<f64>> {
        self.get(key).map(|value| value.number()).transpose()
    }

    /// Returns the text of a key; `None` if the key is absent.
    pub(super) fn text(&self, key: &str) -> Result<Option<&'a str>> {
        self.get(key).map(|value| value.text()).transpose()
    }

    /// Returns the boolean of a key; `None` if the key is absent.
    pub(super) fn flag(&self, key: &str) -> Result<Option<bool>> {
        self.get(key).map(|value| value.flag()).transpose()
    }

    /// Returns the list of tables of a key; empty if the key is absent. Errors name the tables `key[i]`.
    pub(super) fn tables(&self, key: &str) -> Result<Vec<TomlTable<'a>>> {
        self.get(key).map_or(Ok(Vec::new()), |value| value.tables())
    }
}

impl<'a> Value<'a> {
    /// Creates an error about this value.
    pub(super) fn error(&self, problem: impl std::fmt::Display) -> Error {
        error(self.text, self.span.start, &self.place, problem)
    }

    fn wrong(&self, expected: &str) -> Error {
        self.error(format_args!("this is of type {}; expected {expected}", self.value.type_str()))
    }

    /// Returns the value as a finite number.
    pub(super) fn number(&self) -> Result<f64> {
        let number = match self.value {
            DeValue::Float(number) => number.as_str().replace('_', "").parse::<f64>().ok(),
            DeValue::Integer(number) => i64::from_str_radix(number.as_str(), number.radix()).ok().map(|n| n as f64),
            _ => return Err(self.wrong("a number")),
        };
        number.filter(|number| number.is_finite()).ok_or_else(|| self.error("expected a finite number"))
    }

    /// Returns the value as a whole number in `low` … `high`.
    pub(super) fn integer(&self, low: u32, high: u32) -> Result<u32> {
        let DeValue::Integer(number) = self.value else { return Err(self.wrong("a whole number")) };
        let parsed = i64::from_str_radix(number.as_str(), number.radix()).ok();
        let inside = parsed.and_then(|n| u32::try_from(n).ok()).filter(|n| (low..=high).contains(n));
        inside.ok_or_else(|| self.error(format_args!("{} is not within {low} … {high}", number.as_str())))
    }

    /// Returns the value as a text.
    pub(super) fn text(&self) -> Result<&'a str> {
        self.value.as_str().ok_or_else(|| self.wrong("a text in quotes"))
    }

    /// Returns the value as a boolean.
    pub(super) fn flag(&self) -> Result<bool> {
        self.value.as_bool().ok_or_else(|| self.wrong("true or false"))
    }

    /// Whether this is a table.
    pub(super) fn is_table(&self) -> bool {
        self.value.is_table()
    }

    /// Whether this is a list.
    pub(super) fn is_list(&self) -> bool {
        self.value.is_array()
    }

    /// Returns the value as a table.
    pub(super) fn table(&self) -> Result<TomlTable<'a>> {
        let entries = self.value.as_table().ok_or_else(|| self.wrong("a table, as { key = value }"))?;
        Ok(TomlTable { text: self.text, entries, place: self.place.clone(), span: self.span.clone() })
    }

    /// Returns the elements of a list. Errors name them `key[i]`.
    pub(super) fn list(&self) -> Result<Vec<Value<'a>>> {
        let list = self.value.as_array().ok_or_else(|| self.wrong("a list, as [first, second]"))?;
        let element = |(i, value): (usize, &'a Spanned<DeValue<'a>>)| Value {
            text: self.text,
            value: value.get_ref(),
            place: format!("{}[{i}]", self.place),
            span: value.span(),
        };
        Ok(list.iter().enumerate().map(element).collect())
    }

    /// Returns the value as a list of tables.
    pub(super) fn tables(&self) -> Result<Vec<TomlTable<'a>>> {
        self.list()?.iter().map(Value::table).collect()
    }

    /// Returns the value as a list of finite numbers.
    pub(super) fn numbers(&self) -> Result<Vec<f64>> {
        self.list()?.iter().map(Value::number).collect()
    }

    /// Returns the value as an interval: a list of two numbers, of which the first is not larger.
    pub(super) fn interval(&self) -> Result<(f64, f64)> {
        match self.numbers()?[..] {
            [low, high] if low <= high => Ok((low, high)),
            [low, high] => {
                Err(self.error(format_args!("[{low}, {high}] is not an interval: give the smaller number first")))
            }
            ref other => Err(self.error(format_args!("expected an interval of two numbers, not {}", other.len()))),
        }
    }

    /// Returns the value as a list of texts: a text counts as a list of one. The list must not be empty.
    pub(super) fn texts(&self) -> Result<Vec<&'a str>> {
        if !self.is_list() {
            return Ok(vec![self.text()?]);
        }
        let texts = self.list()?.iter().map(Value::text).collect::<Result<Vec<_>>>()?;
        if texts.is_empty() { Err(self.error("the list is empty; name at least one")) } else { Ok(texts) }
    }
}
