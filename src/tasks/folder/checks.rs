//! Checks, when a folder is loaded, that the edits of parameters can have an effect.

use super::{
    elements::Elements,
    error::{Result, escaped},
    parameter::{EditedParameter, ParameterEdit},
    table::TomlTable,
    target::{Change, is_limited, without_effect},
};
use perturb_mujoco::{ElementKind, Index, Model, ModelField, Options};

/// Minimal dimension (`condim`) of a contact with torsional friction.
const TORSION_DIMENSION: i32 = 4;
/// Minimal dimension (`condim`) of a contact with rolling friction.
const ROLL_DIMENSION: i32 = 6;

/// Checks that each edit of a parameter can change the physics.
///
/// # Errors
/// [`super::Error`] with the parameter and the reason, if an edit cannot change the physics.
pub(super) fn check(
    tables: &[TomlTable<'_>],
    parameters: &[EditedParameter],
    model: &Model,
    elements: &Elements,
) -> Result<()> {
    for (i, (table, parameter)) in tables.iter().zip(parameters).enumerate() {
        let table = &table.clone().at(format!("parameter {}", parameter.parameter.name));
        same_number(table, parameter, &parameters[..i])?;
        for edit in &parameter.edits {
            switched_off(table, edit, model)?;
            if edit.change == Change::Scale && edit.targets.all.iter().all(|target| target.is_zero(model)) {
                let field = edit.targets.field;
                return Err(without_effect(
                    table,
                    format_args!("the {field} is 0 in the model, and so is every multiple of it; use by = \"set\""),
                ));
            }
            match (edit.targets.subject, edit.targets.field) {
                ("geom", "radius") => {}
                ("geom", field) => friction(table, edit, (parameter, parameters), model, elements, field)?,
                ("joint", "range") | ("actuator", "forcerange") => limits(table, edit, model)?,
                ("option", "wind") => wind(table, parameters, model)?,
                _ => {}
            }
        }
    }
    Ok(())
}

/// Refuses a parameter that edits a number of the model twice, or a number that an earlier parameter edits.
fn same_number(table: &TomlTable<'_>, parameter: &EditedParameter, earlier: &[EditedParameter]) -> Result<()> {
    let mut seen = std::collections::HashMap::new();
    for other in earlier {
        seen.extend(other.places().map(|place| (place, other.parameter.name)));
    }
    for edit in &parameter.edits {
        for target in &edit.targets.all {
            if let Some(other) = seen.insert(target.place(), parameter.parameter.name) {
                let (subject, field) = (edit.targets.subject, edit.targets.field);
                let what = if subject == "option" { field.to_owned() } else { format!("the {field} of a {subject}") };
                return Err(table.error(if other == parameter.parameter.name {
                    format!("it edits {what} twice; name each element once")
                } else {
                    format!("{what} is edited by parameter {other}, too; let one parameter edit it")
                }));
            }
        }
    }
    Ok(())
}

/// Refuses edits of a part of the physics, such as contacts, if the model's flags switch this part off.
fn switched_off(table: &TomlTable<'_>, edit: &ParameterEdit, model: &Model) -> Result<()> {
    let flags = model.options().disable_flags;
    let (bits, what) = match (edit.targets.subject, edit.targets.field) {
        ("geom" | "pair", _) => (Options::DISABLE_CONTACT | Options::DISABLE_CONSTRAINT, "contacts"),
        ("joint", "range") => (Options::DISABLE_LIMIT | Options::DISABLE_CONSTRAINT, "limits"),
        ("joint", "frictionloss") => (Options::DISABLE_FRICTION_LOSS | Options::DISABLE_CONSTRAINT, "friction losses"),
        ("joint", "damping" | "stiffness") | ("tendon", _) => (Options::DISABLE_PASSIVE, "passive forces"),
        ("option", "wind" | "density" | "viscosity") => (Options::DISABLE_PASSIVE, "passive forces"),
        ("option", "gravity") => (Options::DISABLE_GRAVITY, "gravity"),
        ("actuator", _) => (Options::DISABLE_ACTUATION, "actuation"),
        _ => return Ok(()),
    };
    if flags & bits == 0 {
        return Ok(());
    }
    Err(without_effect(table, format_args!("the model switches {what} off by a <flag>; leave the flag out")))
}

/// Refuses edits of the range of a joint or actuator that has no limits.
fn limits(table: &TomlTable<'_>, edit: &ParameterEdit, model: &Model) -> Result<()> {
    let free = edit.targets.ids.iter().zip(&edit.targets.names);
    let mut free = free.filter(|(id, _)| !is_limited(model, edit.targets.subject, **id));
    match free.next() {
        None => Ok(()),
        Some((_, name)) => {
            let attribute = if edit.targets.subject == "joint" { "limited" } else { "forcelimited" };
            let (subject, name) = (edit.targets.subject, escaped(name));
            Err(without_effect(table, format_args!("{subject} {name:?} has no limits; give it {attribute}=\"true\"")))
        }
    }
}

/// Refuses edits of the wind if the model has no air: density and viscosity are 0 and no parameter edits them.
fn wind(table: &TomlTable<'_>, parameters: &[EditedParameter], model: &Model) -> Result<()> {
    let is_edited =
        |field: ModelField| parameters.iter().any(|other| other.places().any(|(edited, _)| edited == field));
    let has_medium = [ModelField::Density, ModelField::Viscosity]
        .into_iter()
        .any(|field| model.field(field)[0] > 0.0 || is_edited(field));
    if has_medium {
        return Ok(());
    }
    Err(without_effect(table, "there is no air; give the model <option density=\"1.2\" viscosity=\"0.00002\"/>"))
}

/// Refuses edits of a geom's friction that no contact would use, for all or some of the parameter's values.
fn friction(
    table: &TomlTable<'_>,
    edit: &ParameterEdit,
    (parameter, parameters): (&EditedParameter, &[EditedParameter]),
    model: &Model,
    elements: &Elements,
    field: &str,
) -> Result<()> {
    let geoms = &edit.targets.ids;
    // At least one of the edited geoms must have a possible contact with the edited kind of friction.
    let contacts: Vec<Contact> = geoms.iter().flat_map(|&geom| contacts_of(model, geom)).collect();
    if contacts.is_empty() {
        let name = escaped(edit.targets.names.first().map_or("", String::as_str));
        let why = if model.options().collision == 1 || model.count(ElementKind::Pair) > 0 {
            "it touches only in declared pairs, which have their own friction; edit the pairs"
        } else {
            "it can touch nothing; see its contype and conaffinity"
        };
        return Err(without_effect(table, format_args!("geom {name:?}: {why}")));
    }
    let (needed, word) = match field {
        "friction" => (3, "sliding"),
        "friction_torsion" => (TORSION_DIMENSION, "torsional"),
        _ => (ROLL_DIMENSION, "rolling"),
    };
    if contacts.iter().all(|contact| contact.dimension < needed) {
        let most = contacts.iter().map(|contact| contact.dimension).max().unwrap_or(0);
        return Err(without_effect(
            table,
            format_args!(
                "its contacts have condim {most}, which has no {word} friction; give the geoms condim=\"{needed}\""
            ),
        ));
    }
    // The indices of all edited frictions. The comparison below skips other geoms whose friction is edited, too.
    let edited: Vec<usize> = parameters
        .iter()
        .flat_map(EditedParameter::places)
        .filter(|(array, _)| *array == ModelField::GeomFriction)
        .map(|(_, at)| at)
        .collect();
    let column =
        ["friction", "friction_torsion", "friction_roll"].iter().position(|&known| known == field).unwrap_or(0);
    let others = contacts.iter().filter(|contact| {
        contact.dimension >= needed && !contact.has_priority && !edited.contains(&(3 * contact.other + column))
    });
    let limit = |contact: &Contact| {
        if contact.other_has_priority {
            f64::INFINITY
        } else {
            model.field(ModelField::GeomFriction)[3 * contact.other + column]
        }
    };
    // MuJoCo uses the larger friction of two touching geoms, so an edited friction below the other geom's has no
    // effect. If any of the other geoms are fixed, the limit is the maximum of their frictions, because robots walk on
    // them. Otherwise the limit is the minimum of the moving geoms' frictions. In this second case there is no limit if
    // an edited geom has priority in a contact, or if the friction of a geom that it can touch is edited, too.
    let fixed = others.clone().filter(|contact| contact.other_is_fixed).max_by(|a, b| limit(a).total_cmp(&limit(b)));
    let moving = others.min_by(|a, b| limit(a).total_cmp(&limit(b)));
    let counts = |contact: &&Contact| contact.dimension >= needed;
    let is_edited = |contact: &Contact| edited.contains(&(3 * contact.other + column));
    let free = contacts.iter().filter(counts).any(|contact| contact.has_priority || is_edited(contact));
    let Some(worst) = fixed.or(moving.filter(|_| !free)) else { return Ok(()) };
    let least = smallest(edit, parameter, model);
    let limit = limit(worst);
    if least >= limit {
        return Ok(());
    }
    let (own, other) =
        (escaped(elements.name(ElementKind::Geom, worst.own)), escaped(elements.name(ElementKind::Geom, worst.other)));
    Err(table.error(if limit.is_finite() {
        format!(
            "below {limit} it would do nothing: MuJoCo takes the larger friction of two geoms that touch, and {other:?} \
             has {limit}; begin the bounds there, give {own:?} priority=\"1\", or edit {other:?}, too"
        )
    } else {
        format!(
            "it has no effect: {other:?} has a higher priority than {own:?}, and MuJoCo takes its friction; edit {other:?}"
        )
    }))
}

/// Returns the smallest number that an edit can write into the model, at the lower or upper bound of the parameter.
fn smallest(edit: &ParameterEdit, parameter: &EditedParameter, model: &Model) -> f64 {
    let bounds = parameter.parameter.bounds;
    let numbers = edit
        .targets
        .all
        .iter()
        .flat_map(|target| [bounds.low, bounds.high].map(|value| edit.number(target.value(model), value)));
    numbers.fold(f64::INFINITY, f64::min)
}

/// A possible contact of the edited geom `own` with the geom `other`.
struct Contact {
    own: usize,
    other: usize,
    dimension: i32,
    has_priority: bool,
    other_has_priority: bool,
    other_is_fixed: bool,
}

/// Whether a geom can touch any other geom.
pub(super) fn can_touch(model: &Model, geom: usize) -> bool {
    let mut declared = model.index_array(Index::PairGeom1).iter().chain(model.index_array(Index::PairGeom2));
    declared.any(|&other| other as usize == geom) || !contacts_of(model, geom).is_empty()
}

/// Returns the possible contacts of a geom with other geoms. Leaves out the pairs that the model declares.
fn contacts_of(model: &Model, geom: usize) -> Vec<Contact> {
    // The value 1 of the option `collision` means that only declared pairs can touch.
    if model.options().collision == 1 {
        return Vec::new();
    }
    let (body, weld, parent) =
        (model.index_array(Index::GeomBody), model.index_array(Index::BodyWeld), model.index_array(Index::BodyParent));
    let (contact_type, affinity) =
        (model.index_array(Index::GeomContactType), model.index_array(Index::GeomContactAffinity));
    let (priority, dimension) =
        (model.index_array(Index::GeomPriority), model.index_array(Index::GeomContactDimension));
    let pairs = model.index_array(Index::PairGeom1).iter().zip(model.index_array(Index::PairGeom2));
    let declared: Vec<(usize, usize)> = pairs.map(|(&a, &b)| (a as usize, b as usize)).collect();
    let weld_of = |geom: usize| weld[body[geom] as usize];
    let can_touch = |&other: &usize| {
        let (own, theirs) = (weld_of(geom), weld_of(other));
        // Bodies that are welded together count as one body. `parent_of` returns the parent of such a body.
        let parent_of = |body: i32| weld[parent[body as usize] as usize];
        let fits = contact_type[geom] & affinity[other] != 0 || contact_type[other] & affinity[geom] != 0;
        let related = own != 0 && theirs != 0 && (parent_of(own) == theirs || parent_of(theirs) == own);
        let is_declared = declared.contains(&(geom, other)) || declared.contains(&(other, geom));
        other != geom && own != theirs && fits && !related && !is_declared
    };
    (0..model.n_geom())
        .filter(can_touch)
        .map(|other| Contact {
            own: geom,
            other,
            dimension: match priority[geom].cmp(&priority[other]) {
                std::cmp::Ordering::Greater => dimension[geom],
                std::cmp::Ordering::Less => dimension[other],
                std::cmp::Ordering::Equal => dimension[geom].max(dimension[other]),
            },
            has_priority: priority[geom] > priority[other],
            other_has_priority: priority[other] > priority[geom],
            other_is_fixed: weld_of(other) == 0,
        })
        .collect()
}
