//! The parameters of a task. Each parameter has the numbers of the model that it edits, its bounds, and the values that
//! each version draws.

use super::{
    elements::Elements,
    error::{Result, escaped},
    reward::identifier,
    rules::leaked,
    table::{TomlTable, Value},
    target::{Change, KEYS, Target, Targets},
};
use crate::env::{Interval, ParameterSpec, QuantitySpec};
use perturb_mujoco::{Model, ModelField, Simulation};

const PARAMETER: &[&str] = &["name", "unit", "description", "edit", "default", "bounds", "random", "extreme"];
const EDIT: [&str; 2] = ["by", "factor"];
const APPLIED: [&str; 2] = ["name", "unit"];

/// An edit: the numbers of the model that a parameter changes in the same way.
#[derive(Debug, Clone)]
pub(super) struct ParameterEdit {
    pub(super) targets: Targets,
    pub(super) change: Change,
    factor: f64,
}

/// A parameter, and the edits of the model that it makes.
#[derive(Debug, Clone)]
pub(super) struct EditedParameter {
    pub(super) parameter: ParameterSpec,
    pub(super) edits: Vec<ParameterEdit>,
}

impl EditedParameter {
    /// Reads a parameter from its TOML table.
    pub(super) fn new(table: &TomlTable<'_>, model: &Model, elements: &Elements) -> Result<Self> {
        let name = table.require("name", "\"torso_mass\"")?;
        let name = identifier(&name, name.text()?)?;
        let table = &table.clone().at(format!("parameter {name}"));
        table.only(PARAMETER)?;
        let unit = table.text("unit")?.unwrap_or("1");
        let description = table.require("description", "\"mass of the torso, whose inertia follows\"")?.text()?;
        let edit = table.require("edit", "[{ body = \"torso\", field = \"mass\", by = \"set\" }]")?;
        let edits = edit.tables()?;
        let edits = edits.iter().map(|table| ParameterEdit::new(table, model, elements)).collect::<Result<Vec<_>>>()?;
        let Some(first) = edits.first() else { return Err(edit.error("the list is empty; name at least one edit")) };
        if edits.iter().any(|edit| edit.change != first.change) {
            return Err(
                edit.error("the edits of one parameter are all by = \"set\", all by = \"scale\", or all by = \"add\"")
            );
        }
        let default = default(table, model, &edits)?;
        let bounds_value = table.require("bounds", "[0.1, 100.0]")?;
        let bounds = bounds_value.interval()?;
        let (random, extreme) = sets(table, bounds, default)?;
        let parameter = ParameterSpec {
            default,
            random,
            extreme,
            ..ParameterSpec::new(leaked(name), leaked(unit), leaked(description), bounds)
        };
        let edited = Self { parameter, edits };
        edited.check_physical(&bounds_value, model)?;
        Ok(edited)
    }

    /// Refuses bounds at which an edited number would not be physical, such as a negative mass.
    fn check_physical(&self, bounds: &Value<'_>, model: &Model) -> Result<()> {
        let Interval { low, high } = self.parameter.bounds;
        for edit in &self.edits {
            for (target, value) in edit.targets.all.iter().flat_map(|target| [(target, low), (target, high)]) {
                let number = edit.number(target.value(model), value);
                if let Some((minimum, strict)) = edit.targets.minimum()
                    && (number < minimum || (strict && number == minimum))
                {
                    let (field, than) = (edit.targets.field, if strict { "above" } else { "at least" });
                    let problem = format!("{value} would make a {field} of {number}; expected {than} {minimum}");
                    return Err(bounds.error(problem));
                }
                if let (ModelField::JointRange | ModelField::ActuatorForceRange, at) = target.place() {
                    edit.check_range(bounds, model, (*target, at), value)?;
                }
            }
        }
        Ok(())
    }

    /// Returns the array and the index of each number of the model that the parameter edits.
    pub(super) fn places(&self) -> impl Iterator<Item = (ModelField, usize)> + '_ {
        self.targets().map(Target::place)
    }

    /// Returns the targets of all edits.
    pub(super) fn targets(&self) -> impl Iterator<Item = Target> + '_ {
        self.edits.iter().flat_map(|edit| edit.targets.all.iter().copied())
    }

    /// Applies a value to a simulation whose model is `pristine`. Lengths are skipped, since `pristine` was already
    /// compiled with the edited lengths.
    pub(super) fn apply(&self, pristine: &Model, simulation: &mut Simulation, value: f64) {
        for edit in &self.edits {
            for &target in edit.targets.all.iter().filter(|target| !target.is_recompiled()) {
                match edit.change {
                    Change::Scale => target.scale(pristine, simulation, value),
                    _ => target.set(pristine, simulation, edit.number(target.value(pristine), value)),
                }
            }
        }
    }

    /// Whether applying the value would leave the model `pristine` unchanged.
    pub(super) fn is_pristine(&self, pristine: &Model, value: f64) -> bool {
        self.edits.iter().all(|edit| {
            edit.targets.all.iter().filter(|target| !target.is_recompiled()).all(|target| {
                let own = target.value(pristine);
                edit.number(own, value).to_bits() == own.to_bits()
            })
        })
    }

    /// Reads the parameter's value back from the edited `model`. If the parameter's targets have different values,
    /// returns the value that differs most from `requested`. `own` is the folder's model without edits. `compiled` is
    /// the model with edited lengths but without other edits.
    pub(super) fn read_back(&self, (own, compiled): (&Model, &Model), model: &Model, requested: f64) -> f64 {
        let values = self.edits.iter().flat_map(|edit| {
            edit.targets.all.iter().map(|target| {
                let pristine = if target.is_recompiled() { own } else { compiled };
                match edit.change {
                    Change::Set => edit.value_from_number(target.value(model)),
                    Change::Scale => target.factor(pristine, model),
                    Change::Add => edit.value_from_number(target.value(model) - target.value(pristine)),
                }
            })
        });
        let farther = |a: f64, b: f64| if (b - requested).abs() > (a - requested).abs() { b } else { a };
        values.reduce(farther).unwrap_or(requested)
    }
}

impl ParameterEdit {
    fn new(table: &TomlTable<'_>, model: &Model, elements: &Elements) -> Result<Self> {
        table.only(&[&KEYS[..], &EDIT].concat())?;
        let by = table.require("by", "\"set\"")?;
        let change = match by.text()? {
            "set" => Change::Set,
            "scale" => Change::Scale,
            "add" => Change::Add,
            other => {
                let problem = format!("{:?} is unknown; expected set, scale or add", escaped(other));
                return Err(by.error(problem));
            }
        };
        let factor = match table.get("factor") {
            None => 1.0,
            Some(value) if change == Change::Scale => {
                return Err(value.error("factor goes with set and add; the value of scale is a factor itself"));
            }
            Some(value) => match value.number()? {
                0.0 => return Err(value.error("a factor of 0 would make the edit do nothing")),
                factor => factor,
            },
        };
        Ok(Self { targets: Targets::new(table, model, elements, change)?, change, factor })
    }

    /// Returns the number that replaces the unedited number `own` if the parameter has this `value`.
    pub(super) fn number(&self, own: f64, value: f64) -> f64 {
        match self.change {
            Change::Set => self.factor * value,
            Change::Scale => own * value,
            Change::Add => own + self.factor * value,
        }
    }

    /// Returns the parameter's value for which this edit sets its targets to `number`, or adds `number` to them.
    fn value_from_number(&self, number: f64) -> f64 {
        if self.factor.abs() == 1.0 { number * self.factor } else { number / self.factor }
    }

    /// Refuses a value that would make a range empty.
    fn check_range(&self, bounds: &Value<'_>, model: &Model, (target, at): (Target, usize), value: f64) -> Result<()> {
        let (field, number) = (target.place().0, self.number(target.value(model), value));
        let own = model.field(field);
        let is_lower = matches!(target, Target::Number(..)) && at % 2 == 0;
        let is_empty = match target {
            Target::Number(..) if is_lower => number >= own[at + 1],
            Target::Number(..) => number <= own[at - 1],
            Target::Ends(..) => value <= 0.0,
            _ => number <= 0.0,
        };
        if is_empty { Err(bounds.error(format_args!("{value} would make an empty range"))) } else { Ok(()) }
    }
}

/// Returns the value of version D: the file's `default`, otherwise the value that leaves the model unchanged.
fn default(table: &TomlTable<'_>, model: &Model, edits: &[ParameterEdit]) -> Result<f64> {
    if let Some(default) = table.number("default")? {
        return Ok(default);
    }
    let own = |edit: &ParameterEdit| -> Vec<f64> {
        match edit.change {
            Change::Set => edit.targets.all.iter().map(|target| edit.value_from_number(target.value(model))).collect(),
            Change::Scale => vec![1.0],
            Change::Add => vec![0.0],
        }
    };
    let mut values: Vec<f64> = edits.iter().flat_map(own).collect();
    values.sort_by(f64::total_cmp);
    values.dedup();
    match values[..] {
        [value] => Ok(value + 0.0),
        _ => {
            let shown = values.iter().take(6).map(f64::to_string).collect::<Vec<_>>().join(", ");
            let problem =
                format!("its targets have {shown} in the model; say which is the default, or use by = \"scale\"");
            Err(table.error(problem))
        }
    }
}

/// Reads the interval of version R and the two intervals of version E. The intervals of E must adjoin the interval of
/// R, one below and one above.
pub(super) fn sets(table: &TomlTable<'_>, bounds: (f64, f64), default: f64) -> Result<(Interval, [Interval; 2])> {
    let within = |value: &Value<'_>, name: &str, (low, high): (f64, f64)| {
        if bounds.0 <= low && high <= bounds.1 {
            return Ok(());
        }
        let (least, most) = bounds;
        Err(value.error(format_args!("{name} [{low}, {high}] is not within its bounds [{least}, {most}]")))
    };
    let value = table.require("random", "[0.8, 1.2]")?;
    let random = value.interval()?;
    within(&value, "random", random)?;
    if !(random.0 <= default && default <= random.1) {
        let problem = format!("the default, {default}, is not within random [{}, {}]", random.0, random.1);
        return Err(value.error(problem));
    }
    let value = table.require("extreme", "[[0.5, 0.8], [1.2, 1.5]]")?;
    let extreme = value.list()?.iter().map(Value::interval).collect::<Result<Vec<_>>>()?;
    let [below, above] = extreme[..] else {
        return Err(value.error(format_args!("expected two intervals, below and above random, not {}", extreme.len())));
    };
    if below.1 != random.0 || above.0 != random.1 {
        let (low, high) = random;
        let problem = format!(
            "the first interval must end where random begins, at {low}, and the second begin where random ends, at {high}"
        );
        return Err(value.error(problem));
    }
    within(&value, "extreme", below)?;
    within(&value, "extreme", above)?;
    Ok((Interval::new(random.0, random.1), [Interval::new(below.0, below.1), Interval::new(above.0, above.1)]))
}

/// A number of the model that receipts report in addition to the parameters.
#[derive(Debug, Clone)]
pub(super) struct AppliedQuantity {
    pub(super) quantity: QuantitySpec,
    target: Target,
}

impl AppliedQuantity {
    /// Reads an applied quantity from its TOML table.
    pub(super) fn new(table: &TomlTable<'_>, model: &Model, elements: &Elements) -> Result<Self> {
        table.only(&[&KEYS[..], &APPLIED].concat())?;
        let name = table.require("name", "\"torso_mass\"")?;
        let name = identifier(&name, name.text()?)?;
        let targets = Targets::new(table, model, elements, Change::Scale)?;
        if targets.field == "size" {
            return Err(table.error("a size is not a number; name a length or a radius"));
        }
        let [target] = targets.all[..] else {
            let problem = format!("this names {} numbers; name one", targets.all.len());
            return Err(table.error(problem));
        };
        let quantity = QuantitySpec { name: leaked(name), unit: leaked(table.text("unit")?.unwrap_or("1")) };
        Ok(Self { quantity, target })
    }

    /// Returns the quantity's value in a model.
    pub(super) fn read(&self, model: &Model) -> f64 {
        self.target.value(model)
    }
}
