//! Readings: lists of named numbers that a task reads from the simulation, for observations, rewards and rules.

use super::{
    elements::Elements,
    error::{Result, escaped, listed},
    number::{Number, NumberDescription, Stage, StepActions},
    reading_source::Source,
    table::{TomlTable, Value},
};
use perturb_mujoco::{DataField as Array, ElementKind, Model, Simulation};

/// The keys of a reading that say what is read. Each reading has exactly one of them.
const SUBJECTS: [&str; 12] = [
    "joint",
    "body",
    "site",
    "geom",
    "com",
    "from",
    "sensor",
    "actuator",
    "action",
    "previous_action",
    "constant",
    "time",
];
/// The other keys of a reading.
const OPTIONS: [&str; 6] = ["to", "get", "axes", "without", "scale", "clip"];

/// A list of numbers that a task reads, with an optional scale and clipping range for all of them.
#[derive(Debug, Clone)]
pub(super) struct Reading {
    numbers: Vec<Number>,
    entries: Vec<NumberDescription>,
    scale: f64,
    clip: Option<(f64, f64)>,
}

impl Reading {
    /// Reads the definition of a reading from its TOML table.
    pub(super) fn new(table: &TomlTable<'_>, model: &Model, elements: &Elements) -> Result<Self> {
        table.only(&[&SUBJECTS[..], &OPTIONS].concat())?;
        let (subject, value) = table.one_of(&SUBJECTS).map_err(|_| {
            let subjects = SUBJECTS.join(", ");
            table.error(format_args!("this reads nothing, or more than one thing; name one of {subjects}"))
        })?;
        let source = Source { table, model, elements };
        let mut all = source.numbers(subject, &value)?;
        if subject != "from" && table.has("to") {
            return Err(table.error("`to` goes with `from`: the vector from one point to another"));
        }
        if let Some(axes) = table.get("axes") {
            source.only_axes(&axes, &mut all)?;
        }
        if let Some(without) = table.get("without") {
            for name in without.texts()? {
                let fits = |entry: &NumberDescription| entry.name == name || entry.element == name;
                let is_left_out =
                    subject == "joint" && elements.names(ElementKind::Joint).iter().any(|joint| joint == name);
                if !is_left_out && !all.iter().any(|(_, entry)| fits(entry)) {
                    let there = listed(all.iter().map(|(_, entry)| entry.name.as_str()));
                    return Err(without.error(format_args!("there is no {:?} to leave out of {there}", escaped(name))));
                }
                all.retain(|(_, entry)| !fits(entry));
            }
        }
        if all.is_empty() {
            return Err(table.error("nothing is left to be read"));
        }
        let scale = table.number("scale")?.unwrap_or(1.0);
        let clip = table.get("clip").map(|value| clip(&value)).transpose()?;
        let (numbers, mut entries): (Vec<_>, Vec<_>) = all.into_iter().unzip();
        for entry in &mut entries {
            (entry.low, entry.high) = range((entry.low, entry.high), scale, clip);
            if scale != 1.0 {
                entry.unit = "1";
                entry.channel.push_str("_scaled");
            }
        }
        Ok(Self { numbers: join(numbers), entries, scale, clip })
    }

    /// Returns the length of the list.
    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    /// The names, units and ranges of the numbers.
    pub(super) fn entries(&self) -> &[NumberDescription] {
        &self.entries
    }

    /// Returns the computation that MuJoCo must do before the numbers can be read.
    pub(super) fn stage(&self) -> Stage {
        self.numbers.iter().map(Number::stage).max().unwrap_or(Stage::State)
    }

    /// Whether the reading includes external forces on bodies, which MuJoCo does not compute by default.
    pub(super) fn needs_external_forces(&self) -> bool {
        self.numbers.iter().any(|number| matches!(number, Number::Array(Array::BodyExternalForces, ..)))
    }

    /// Appends the numbers, scaled and clipped, to `out`.
    pub(super) fn read(&self, simulation: &Simulation, context: &StepActions<'_>, out: &mut Vec<f64>) {
        let begin = out.len();
        for number in &self.numbers {
            number.read(simulation, context, out);
        }
        if self.scale != 1.0 {
            out[begin..].iter_mut().for_each(|value| *value *= self.scale);
        }
        if let Some((low, high)) = self.clip {
            out[begin..].iter_mut().for_each(|value| *value = value.clamp(low, high));
        }
    }
}

fn clip(value: &Value<'_>) -> Result<(f64, f64)> {
    if value.is_list() {
        let (low, high) = value.interval()?;
        return Ok((low, high));
    }
    match value.number()? {
        limit if limit > 0.0 => Ok((-limit, limit)),
        limit => Err(value.error(format_args!("{limit} is not above 0; give a limit, or [low, high]"))),
    }
}

fn range((low, high): (f64, f64), scale: f64, clip: Option<(f64, f64)>) -> (f64, f64) {
    let ends = if scale == 0.0 { [0.0, 0.0] } else { [low * scale, high * scale] };
    let (low, high) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
    let (low, high) = clip.map_or((low, high), |(least, most)| (low.clamp(least, most), high.clamp(least, most)));
    if low < high { (low, high) } else { (low, low + 1.0) }
}

/// Joins consecutive numbers of the same array to one [`Number::Array`], which is faster to read.
fn join(numbers: Vec<Number>) -> Vec<Number> {
    let mut joined: Vec<Number> = Vec::new();
    for number in numbers {
        if let (Some(Number::Array(last, first, length)), Number::Array(array, next, 1)) = (joined.last_mut(), &number)
            && last == array
            && *first + *length == *next
        {
            *length += 1;
            continue;
        }
        joined.push(number);
    }
    joined
}
