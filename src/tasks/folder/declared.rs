//! The disturbances that a task's file configures: the body that is pushed, and the values of disturbances in versions
//! R and E.

use super::{
    elements::Elements,
    error::{Result, escaped},
    parameter::sets,
    rules::leaked,
    table::TomlTable,
};
use crate::env::{EnvironmentSpec, ParameterSpec, PushSpec, Version, check_distribution, disturbance};
use perturb_mujoco::{ElementKind, Index, Model};

const SETS: &[&str] = &["random", "extreme"];
const PUSH: &[&str] = &["body", "axes"];
const AXES: [&str; 3] = ["x", "y", "z"];

/// The body of a task that is pushed, and the description of its pushes.
#[derive(Clone, Copy)]
pub(super) struct Push {
    /// The index of the body that is pushed.
    pub(super) body: usize,
    pub(super) spec: PushSpec,
}

impl Push {
    /// Reads the table `push`. The default is the first body that can move, pushed along x and y. Returns `None` if no
    /// body can move.
    pub(super) fn new(table: Option<&TomlTable<'_>>, model: &Model, elements: &Elements) -> Result<Option<Self>> {
        // For each body, the index of the topmost body to which it is rigidly fixed, possibly its own index. Index 0 is
        // the world.
        let fixed_to = model.index_array(Index::BodyWeld);
        let mut body = (1..model.n_body()).find(|&body| fixed_to[body] != 0);
        let mut axes: &'static [usize] = &[0, 1];
        if let Some(table) = table {
            table.only(PUSH)?;
            if let Some(value) = table.get("body") {
                let found = elements.find(ElementKind::Body, &value)?;
                if fixed_to[found] == 0 {
                    return Err(value.error("this body cannot move; name one with a joint"));
                }
                body = Some(found);
            }
            if let Some(value) = table.get("axes") {
                let named = value.texts()?;
                let found: Vec<usize> = (0..AXES.len()).filter(|&axis| named.contains(&AXES[axis])).collect();
                if found.len() != named.len() {
                    return Err(value.error("expected one or more of \"x\", \"y\" and \"z\", each once"));
                }
                axes = Vec::leak(found);
            }
        }
        Ok(body.map(|body| {
            let along: Vec<&str> = axes.iter().map(|&axis| AXES[axis]).collect();
            let (name, along) = (elements.name(ElementKind::Body, body), along.join(" and "));
            let description = leaked(&format!("impulse of a push on {name} along {along}"));
            Self { body, spec: PushSpec { description, unit: "N s", axes } }
        }))
    }
}

/// Reads the table `disturbances`, whose keys are names of disturbances. Returns each named disturbance with its values
/// in versions R and E.
pub(super) fn read(top: &TomlTable<'_>, spec: &EnvironmentSpec) -> Result<Vec<ParameterSpec>> {
    let Some(value) = top.get("disturbances") else { return Ok(Vec::new()) };
    let table = value.table()?;
    let possible = disturbance::possible(spec);
    table.only(&possible.iter().map(|parameter| parameter.name).collect::<Vec<_>>())?;
    let mut declared = Vec::new();
    for parameter in possible {
        let Some(value) = table.get(parameter.name) else { continue };
        let table = value.table()?.at(format!("disturbance {}", escaped(parameter.name)));
        table.only(SETS)?;
        let (random, extreme) = sets(&table, (parameter.bounds.low, parameter.bounds.high), parameter.default)?;
        let own = ParameterSpec { random, extreme, ..parameter };
        for version in [Version::R, Version::E] {
            check_distribution(spec, &own, &own.distribution(version)).map_err(|error| table.error(error))?;
        }
        declared.push(own);
    }
    Ok(declared)
}
