//! Rules of a task: ranges of readings, which define health and goals, and the success rule of an episode.

use super::{
    elements::Elements,
    error::Result,
    number::{StepActions, unique_channels},
    reading::Reading,
    table::{TomlTable, Value},
};
use crate::env::{Achievement, QuantitySpec, SuccessComparison, SuccessRuleSpec};
use perturb_mujoco::{Model, Simulation};

const RANGE: &[&str] = &["of", "above", "below", "from", "to"];
const SUCCESS: &[&str] = &[
    "description",
    "greatest",
    "least",
    "last",
    "steps",
    "first",
    "last_steps",
    "longest",
    "quantity",
    "unit",
    "at_least",
    "at_most",
];
const ACHIEVEMENTS: [&str; 7] = ["greatest", "least", "last", "steps", "first", "last_steps", "longest"];

/// A condition: all numbers of a reading lie in a range.
#[derive(Debug, Clone)]
pub(super) struct Range {
    reading: Reading,
    above: Option<f64>,
    below: Option<f64>,
    from: Option<f64>,
    to: Option<f64>,
}

impl Range {
    /// Reads a range from its TOML table.
    pub(super) fn new(table: &TomlTable<'_>, model: &Model, elements: &Elements) -> Result<Self> {
        table.only(RANGE)?;
        let of = table.require("of", "{ joint = \"root\", get = \"position\" }")?.table()?;
        let range = Self {
            reading: Reading::new(&of, model, elements)?,
            above: table.number("above")?,
            below: table.number("below")?,
            from: table.number("from")?,
            to: table.number("to")?,
        };
        let (low, high) = (range.above.or(range.from), range.below.or(range.to));
        if range.above.is_some() && range.from.is_some() || range.below.is_some() && range.to.is_some() {
            return Err(
                table.error("give above or from, and below or to: above and below are strict, from and to are not")
            );
        }
        match (low, high) {
            (None, None) => Err(table.error("the range has no limit; give above, below, from or to")),
            (Some(low), Some(high)) if low >= high => {
                Err(table.error(format_args!("no number lies between {low} and {high}; give the smaller one first")))
            }
            _ => Ok(range),
        }
    }

    /// Reads a list of ranges from their TOML tables.
    pub(super) fn list(tables: &[TomlTable<'_>], model: &Model, elements: &Elements) -> Result<Vec<Self>> {
        tables.iter().map(|table| Self::new(table, model, elements)).collect()
    }

    /// The reading whose numbers must lie in the range.
    pub(super) fn reading(&self) -> &Reading {
        &self.reading
    }

    /// Whether all numbers of the reading are finite and lie in the range. `numbers` is a buffer that is overwritten.
    pub(super) fn holds(&self, simulation: &Simulation, context: &StepActions<'_>, numbers: &mut Vec<f64>) -> bool {
        numbers.clear();
        self.reading.read(simulation, context, numbers);
        numbers.iter().all(|&x| {
            x.is_finite()
                && self.above.is_none_or(|above| x > above)
                && self.below.is_none_or(|below| x < below)
                && self.from.is_none_or(|from| x >= from)
                && self.to.is_none_or(|to| x <= to)
        })
    }
}

/// The rule by which a reading's values after each step give the value that the episode achieved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Aggregate {
    Greatest,
    Least,
    Last,
}

/// The success rule of a task, with the readings that it needs.
#[derive(Debug, Clone)]
pub(super) struct Goal {
    /// The reading whose value the rule compares; `None` if the rule counts steps.
    pub(super) achieved: Option<(Aggregate, Reading)>,
    /// The conditions of the goal, if the rule counts steps at which the goal is met; otherwise empty.
    pub(super) ranges: Vec<Range>,
    pub(super) rule: SuccessRuleSpec,
}

impl Goal {
    /// Reads the success rule from the TOML table `success`, for episodes of at most `step_limit` steps.
    pub(super) fn new(table: &TomlTable<'_>, model: &Model, elements: &Elements, step_limit: u32) -> Result<Self> {
        table.only(SUCCESS)?;
        let description = table.require("description", "\"the torso came 10 m far\"")?.text()?;
        let (key, value) = table.one_of(&ACHIEVEMENTS)?;
        let (comparison, threshold) = match (table.number("at_least")?, table.number("at_most")?) {
            (Some(threshold), None) => (SuccessComparison::AtLeast, threshold),
            (None, Some(threshold)) => (SuccessComparison::AtMost, threshold),
            _ => return Err(table.error("give at_least or at_most: the threshold for the achieved value")),
        };
        // The key says what the rule compares: steps, steps at which ranges hold, or the greatest, least or last value
        // of a reading.
        let ranges = |value: &Value<'_>| Range::list(&value.tables()?, model, elements);
        let mut goal = Self {
            achieved: None,
            ranges: Vec::new(),
            rule: SuccessRuleSpec {
                description: leaked(description),
                achievement: Achievement::Length,
                comparison,
                threshold,
            },
        };
        goal.rule.achievement = match key {
            "steps" if !value.flag()? => {
                return Err(value.error("expected true; leave it out to compare something else"));
            }
            "steps" => Achievement::Length,
            "first" | "last_steps" | "longest" => {
                goal.ranges = ranges(&value)?;
                match key {
                    "first" => Achievement::FirstGoal,
                    "last_steps" => Achievement::LastGoals,
                    _ => Achievement::LongestGoals,
                }
            }
            _ => {
                let reading = Reading::new(&value.table()?, model, elements)?;
                let [entry] = reading.entries() else {
                    return Err(value.error(format_args!("this reads {} numbers; expected one", reading.len())));
                };
                let name = match table.text("quantity")? {
                    Some(name) => name.to_owned(),
                    None => unique_channels([entry].into_iter()).concat(),
                };
                let quantity = QuantitySpec {
                    name: leaked(&name),
                    unit: table.text("unit")?.map_or(entry.unit, |unit| leaked(unit)),
                };
                let aggregate = match key {
                    "greatest" => Aggregate::Greatest,
                    "least" => Aggregate::Least,
                    _ => Aggregate::Last,
                };
                goal.achieved = Some((aggregate, reading));
                Achievement::Own(quantity)
            }
        };
        // A number of steps has no unit, and must be possible within the step limit.
        if goal.achieved.is_none() {
            if let Some(unit) = table.get("unit").or_else(|| table.get("quantity")) {
                return Err(unit.error("this rule counts steps, so it takes neither unit nor quantity; leave it out"));
            }
            if !(1.0..=f64::from(step_limit)).contains(&threshold) || threshold.fract() != 0.0 {
                return Err(table.error(format_args!("{threshold} is not a number of steps within 1 … {step_limit}")));
            }
        }
        Ok(goal)
    }
}

/// Leaks a text, so that it lives as long as the process, as an [`EnvironmentSpec`](crate::env::EnvironmentSpec)
/// requires.
pub(super) fn leaked(text: &str) -> &'static str {
    Box::leak(text.to_owned().into_boxed_str())
}
