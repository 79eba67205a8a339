//! Selects rows of a results table by their values in some columns, and groups rows with equal values.

use std::str::FromStr;

use perturb_protocol::names;
use perturb_settings::ValueError;

use super::{ResultsTable, TableRow};

/// The accepted values of a column or of a setting, written `algorithm=a2c,ppo` or `seed=2..6`.
#[derive(Clone, Debug, PartialEq)]
pub struct RowFilter {
    /// The name of the column or setting.
    pub column: String,
    accepted: Vec<AcceptedValue>,
}

#[derive(Clone, Debug, PartialEq)]
enum AcceptedValue {
    Text(String),
    /// All numbers from the first to the second, including both.
    Interval(f64, f64),
}

/// A group of rows with equal values in some columns. Holds a name that is made of these values, and the rows.
pub type NamedRows<'a> = (String, Vec<&'a TableRow>);

impl FromStr for RowFilter {
    type Err = ValueError;

    fn from_str(text: &str) -> Result<Self, ValueError> {
        let wrong = || {
            ValueError::new(
                "a choice of rows",
                format!("`{text}`"),
                "COLUMN=VALUES, e.g. algorithm=a2c,ppo or seed=2..6",
            )
        };
        let (column, values) =
            text.split_once('=').filter(|(column, _)| !column.trim().is_empty()).ok_or_else(wrong)?;
        let accepted = |value: &str| {
            let number = |text: &str| text.trim().parse::<f64>().ok();
            match value.split_once("..") {
                Some((low, high)) => Some(AcceptedValue::Interval(number(low)?, number(high)?)),
                None => Some(AcceptedValue::Text(value.trim().to_owned())),
            }
        };
        let accepted = values.split(',').map(accepted).collect::<Option<Vec<_>>>().ok_or_else(wrong)?;
        Ok(Self { column: column.trim().to_owned(), accepted })
    }
}

impl RowFilter {
    fn accepts(&self, value: &str) -> bool {
        let number = value.parse::<f64>().ok();
        self.accepted.iter().any(|accepted| match accepted {
            AcceptedValue::Interval(low, high) => number.is_some_and(|number| (*low..=*high).contains(&number)),
            AcceptedValue::Text(text) => match (number, text.parse::<f64>()) {
                (Some(number), Ok(accepted)) => number == accepted,
                _ => names::is_spelled(text, value),
            },
        })
    }
}

impl ResultsTable {
    /// Returns the rows that all `filters` accept, grouped by their values in the columns or settings `by`. Takes the
    /// rows of `study`, or of all studies if it is `None`. Groups are in the order of their first row. In the name of a
    /// group, a number has the form `COLUMN=NUMBER`, and a text stands without its column. A text with spaces, quotes
    /// or equals signs is quoted.
    ///
    /// # Errors
    /// [`ValueError`] for an unknown column.
    pub fn choose(
        &self,
        study: Option<&str>,
        filters: &[RowFilter],
        by: &[String],
    ) -> Result<Vec<NamedRows<'_>>, ValueError> {
        let filtered: Vec<(&RowFilter, Vec<String>)> = filters
            .iter()
            .map(|filter| self.values(&filter.column).map(|values| (filter, values)))
            .collect::<Result<_, ValueError>>()?;
        let by: Vec<(&String, Vec<String>)> = by
            .iter()
            .map(|column| self.values(column).map(|values| (column, values)))
            .collect::<Result<_, ValueError>>()?;
        let mut groups: Vec<NamedRows<'_>> = Vec::new();
        for (place, row) in self.rows().iter().enumerate() {
            let is_chosen = study.is_none_or(|study| row.study == study)
                && filtered.iter().all(|(filter, values)| filter.accepts(&values[place]));
            if !is_chosen {
                continue;
            }
            let part = |(column, values): &(&String, Vec<String>)| match &values[place] {
                number if number.parse::<f64>().is_ok() => format!("{column}={number}"),
                // Quoted, so that groups with different values never have the same name.
                text if text.contains([' ', '"', '=']) => format!("{text:?}"),
                text => text.clone(),
            };
            let name = by.iter().map(part).collect::<Vec<_>>().join(" ");
            match groups.iter_mut().find(|(known, _)| *known == name) {
                Some((_, rows)) => rows.push(row),
                None => groups.push((name, vec![row])),
            }
        }
        Ok(groups)
    }

    /// Returns the values of a column or of a setting, for each row; empty where a row has none.
    fn values(&self, name: &str) -> Result<Vec<String>, ValueError> {
        let columns = self.columns();
        if let Some((_, values)) = columns.iter().find(|(column, _)| column == name) {
            return Ok((0..self.rows().len()).map(|row| values.value_text(row)).collect());
        }
        let setting = |row: &TableRow| {
            let settings: serde_json::Value = serde_json::from_str(&row.settings).unwrap_or_default();
            settings.get(name).map(|value| value.as_str().map_or_else(|| value.to_string(), str::to_owned))
        };
        let values: Vec<Option<String>> = self.rows().iter().map(setting).collect();
        if values.iter().all(Option::is_none) {
            let columns = columns.iter().map(|(column, _)| column.as_str()).collect::<Vec<_>>().join(", ");
            return Err(ValueError::new("a column", format!("`{name}`"), format!("a setting, or one of {columns}")));
        }
        Ok(values.into_iter().map(Option::unwrap_or_default).collect())
    }
}
