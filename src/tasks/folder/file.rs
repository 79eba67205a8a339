//! Reads the file `task.toml`, compiles the model and builds the task.

use super::{
    attributes, checks,
    declared::{self, Push},
    elements::{Elements, actuator_name},
    environment::{FolderTask, Needs, Poses},
    error::{Error, Result, escaped},
    files::Files,
    mjcf::{self, Mjcf},
    number::{NumberDescription, channel_name, unique_channels},
    parameter::{AppliedQuantity, EditedParameter},
    picture,
    reading::Reading,
    recompilation::Recompilation,
    reset::InitialStateDistribution,
    reward::Term,
    rules::{Goal, Range, leaked},
    table::{self, TomlTable},
    template::Template,
};
use crate::{
    env::{ActionSpec, ChannelSpec, EnvironmentSpec, QuantitySpec},
    scene::Look,
};
use perturb_mujoco::{ElementKind, Flags, Index, Model, ModelField};
use perturb_protocol::{disturbance::CHANGED, names::is_spelled};

/// The keys at the top level of `task.toml`.
pub(super) const KEYS: &[&str] = &[
    "format",
    "name",
    "revision",
    "description",
    "model",
    "frame_skip",
    "step_limit",
    "poses",
    "observation",
    "reward",
    "healthy",
    "terminate_when_unhealthy",
    "success",
    "reset",
    "actions",
    "picture",
    "applied",
    "heatmap",
    "parameter",
    "push",
    "disturbances",
];
const ACTIONS: &[&str] = &["scaled", "range"];
/// The version of the format of `task.toml` that this server reads.
const FORMAT: u32 = 1;

const MAX_FRAME_SKIP: u32 = 1000;
const MAX_STEP_LIMIT: u32 = 1_000_000;
const MAX_REVISION: u32 = 1_000_000;
const MAX_TIMESTEP_SECONDS: f64 = 1.0;
const MAX_MODEL_BYTES: usize = 64 << 20;
const MAX_SIMULATION_BYTES: usize = 64 << 20;
const MAX_DOFS: usize = 256;
const MAX_ACTUATORS: usize = 2048;
const MAX_OBSERVATION: usize = 4096;
const MAX_PARAMETERS: usize = 32;
const MAX_TERMS: usize = 64;
const MAX_NAME_CHARS: usize = 64;

/// Builds the task of a folder from its `task.toml` and model.
///
/// # Errors
/// [`Error`] with the file, the line and what to do.
pub(super) fn read(files: &mut Files) -> Result<FolderTask> {
    let text = table::decode(table::FILE, files.task())?.to_owned();
    let document = table::parse(&text)?;
    let top = TomlTable::top(&text, &document);
    let format = top.require("format", "1")?;
    if format.integer(0, u32::MAX)? != FORMAT {
        return Err(format.error(format_args!("this server reads format {FORMAT}; a newer server may read this one")));
    }
    top.only(KEYS)?;
    let about = Header::new(&top)?;
    let main = top.require("model", "\"robot.xml\"")?.text()?;
    let mut mjcf = mjcf::read(files, main)?;
    // If parameters edit lengths, geoms that affect only pictures are removed from the physics, so that compilation is
    // faster. They are kept if the file refers to elements by index (`#3`), because removing geoms changes indices. They
    // are also kept if the model has rangefinders, which measure the distance to geoms of every kind.
    let refers_by_index = text.contains("\"#") || text.contains("'#");
    if edits_lengths(&top) && !refers_by_index && !mjcf.physics.xml.contains("<rangefinder") {
        mjcf.physics = attributes::without_visual_geoms(&mjcf.physics)?;
        mjcf.lacks_visual_geoms = true;
    }
    let model = compile(&mjcf, main)?;
    assemble(&top, about, (mjcf, model, main), files.hash())
}

/// Whether any parameter may edit a length. Such edits require that the model is compiled again. Errors in the tables
/// are ignored here, since they are reported later.
fn edits_lengths(top: &TomlTable<'_>) -> bool {
    let parameters = top.tables("parameter").unwrap_or_default();
    let mut edits = parameters.iter().flat_map(|table| table.tables("edit").unwrap_or_default());
    edits.any(|edit| matches!(edit.text("field"), Ok(Some("length" | "size" | "position" | "radius"))))
}

/// The settings of a task that do not depend on the model.
struct Header {
    name: &'static str,
    revision: u32,
    description: &'static str,
    frame_skip: u32,
    step_limit: u32,
    poses: Poses,
}

impl Header {
    fn new(top: &TomlTable<'_>) -> Result<Self> {
        let name_value = top.require("name", "\"MyRobot\"")?;
        let name = name_value.text()?;
        let plain = name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        if !plain || !name.starts_with(|c: char| c.is_ascii_alphabetic()) || name.len() > MAX_NAME_CHARS {
            let problem = "is not a valid name of a task; expected a letter, then letters, digits and underscores, at \
                           most 64 characters";
            return Err(name_value.error(format_args!("{:?} {problem}", escaped(name))));
        }
        let built_in = crate::tasks::catalogue();
        if let Some(taken) = built_in.names().find(|known| is_spelled(name, known)) {
            let name = escaped(name);
            let problem = format!("{name:?} is the name of a built-in environment, {taken}; choose another name");
            return Err(name_value.error(problem));
        }
        let description = top.require("description", "\"Walk forward on two legs.\"")?;
        if !description.text()?.ends_with('.') {
            return Err(description.error("expected a sentence that ends with a full stop"));
        }
        let poses = match top.text("poses")? {
            None | Some("after") => Poses::After,
            Some("before") => Poses::Before,
            Some(other) => {
                let problem = format!("poses is {:?}; expected \"before\" or \"after\"", escaped(other));
                return Err(top.error(problem));
            }
        };
        Ok(Self {
            name: leaked(name),
            revision: top.get("revision").map_or(Ok(0), |value| value.integer(0, MAX_REVISION))?,
            description: leaked(description.text()?),
            frame_skip: top.require("frame_skip", "4")?.integer(1, MAX_FRAME_SKIP)?,
            step_limit: top.require("step_limit", "1000")?.integer(1, MAX_STEP_LIMIT)?,
            poses,
        })
    }
}

/// Compiles the model of the physics, and checks its size, timestep and numbers.
fn compile(mjcf: &Mjcf, main: &str) -> Result<Model> {
    let files: Vec<(&str, &[u8])> =
        mjcf.physics.files.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())).collect();
    let model = Model::from_files(&mjcf.physics.xml, &files).map_err(|error| match error {
        perturb_mujoco::Error::Compile { reason } => mjcf::explain(&mjcf.physics, main, &reason),
        other => Error::file(main, other),
    })?;
    let refuse = |problem: String| Err(Error::file(main, problem));
    let mebibytes = |bytes: usize| bytes.div_ceil(1 << 20);
    if model.n_v() > MAX_DOFS {
        return refuse(format!("the model has {} degrees of freedom, the limit is {MAX_DOFS}", model.n_v()));
    }
    if model.model_bytes() > MAX_MODEL_BYTES {
        let (own, most) = (mebibytes(model.model_bytes()), mebibytes(MAX_MODEL_BYTES));
        return refuse(format!(
            "the model takes {own} MiB without its pictures, the limit is {most} MiB; use smaller meshes"
        ));
    }
    if model.simulation_bytes() > MAX_SIMULATION_BYTES {
        let (own, most) = (mebibytes(model.simulation_bytes()), mebibytes(MAX_SIMULATION_BYTES));
        return refuse(format!(
            "a simulation of it would take {own} MiB, the limit is {most} MiB: lower njmax, nconmax or nstack in <size>"
        ));
    }
    let timestep = model.timestep();
    if !(timestep > 0.0 && timestep <= MAX_TIMESTEP_SECONDS) {
        return refuse(format!(
            "the timestep is {timestep} s; expected one within (0, 1] s in <option timestep=\"0.002\"/>"
        ));
    }
    if let Some(array) = model.float_arrays().into_iter().find(|array| array.values.iter().any(|x| !x.is_finite())) {
        return refuse(format!("the model has a number in {} that is not finite", array.name));
    }
    if model.n_u() == 0 {
        return refuse("the model has no actuators, so there are no actions; add some to <actuator>".into());
    }
    if model.n_u() > MAX_ACTUATORS {
        return refuse(format!("the model has {} actuators, the limit is {MAX_ACTUATORS}", model.n_u()));
    }
    Ok(model)
}

/// Builds the task from the parsed file and the compiled model. `hash` is the hash of the folder's files.
fn assemble(
    top: &TomlTable<'_>,
    about: Header,
    (mjcf, model, main): (Mjcf, Model, &str),
    hash: String,
) -> Result<FolderTask> {
    // The parts of the task that read the model, but do not edit it.
    let elements = Elements::new(&model);
    let observation = top.require("observation", "[{ joint = \"*\", get = \"position\" }]")?.tables()?;
    let observation =
        observation.iter().map(|table| Reading::new(table, &model, &elements)).collect::<Result<Vec<_>>>()?;
    let n_observed: usize = observation.iter().map(Reading::len).sum();
    if !(1..=MAX_OBSERVATION).contains(&n_observed) {
        return Err(top.error(format_args!("observation has {n_observed} numbers; expected 1 to {MAX_OBSERVATION}")));
    }
    let reward = reward(top, &model, &elements)?;
    let healthy = Range::list(&top.tables("healthy")?, &model, &elements)?;
    let success = top.require("success", "{ description = \"it stood to the end\", steps = true, at_least = 1000 }")?;
    let goal = Goal::new(&success.table()?, &model, &elements, about.step_limit)?;
    let reset = top.get("reset").map(|value| value.table()).transpose()?;
    let reset = InitialStateDistribution::new(reset.as_ref(), &model, &elements)?;
    let picture = top.get("picture").map(|value| value.table()).transpose()?;
    let view = picture::view(picture.as_ref(), &model, &elements)?;
    let (controls, scaled) = controls(top, &model, &elements)?;
    // The parameters, and the template that applies their edits.
    let (parameters, applied) = parameters(top, &model, &elements)?;
    let recompilation = Recompilation::new(&top.tables("parameter")?, &parameters, &mjcf, &model)?;
    let heatmap_axes = heatmap_axes(top, &parameters)?;
    let Mjcf { picture, statistic, .. } = mjcf;
    let mut template = Template::new(model, &statistic).map_err(|error| Error::file(main, error))?;
    template.prepare(&parameters, recompilation);
    let push = top.get("push").map(|value| value.table()).transpose()?;
    let push = Push::new(push.as_ref(), &template.model, &elements)?;
    let needs = Needs::new(&observation, &reward, &healthy, &goal);
    // The specification. Its closure `make` is set in `load`, when the task has its final address.
    let quantities =
        parameters.iter().map(|edited| QuantitySpec { name: edited.parameter.name, unit: edited.parameter.unit });
    let spec = EnvironmentSpec {
        name: about.name,
        revision: about.revision,
        description: about.description,
        make: &|| Err(crate::env::Error::Model { environment: "", reason: "it is not loaded yet".into() }),
        parameters: leaked_list(parameters.iter().map(|edited| edited.parameter)),
        observation: observation_channels(&observation),
        action: ActionSpec::Continuous(action_channels(&template.model, &elements, &controls, scaled)),
        state: state_channels(&template.model, &elements),
        reward_terms: leaked_list(reward.iter().map(|term| term.about)),
        applied: leaked_list(quantities.chain(applied.iter().map(|applied| applied.quantity))),
        step_limit: about.step_limit,
        control_timestep: template.model.timestep() * f64::from(about.frame_skip),
        step_cost: step_cost(&template.model, about.frame_skip),
        push: push.map(|push| push.spec),
        success: goal.rule,
        code_success: None,
        heatmap_axes,
    };
    let disturbances = declared::read(top, &spec)?;
    let look = Look {
        name: about.name,
        mjcf: leaked(&picture.xml),
        files: Box::leak(picture.files.into_boxed_slice()),
        scenery: None,
        view,
    };
    Ok(FolderTask {
        spec,
        template,
        hash,
        look,
        frame_skip: about.frame_skip,
        poses: about.poses,
        observation,
        reward,
        healthy,
        terminate_when_unhealthy: top.flag("terminate_when_unhealthy")?.unwrap_or(true),
        goal,
        reset,
        controls,
        scaled,
        parameters,
        applied,
        pushed_body: push.map(|push| push.body),
        disturbances,
        needs,
        has_total_mass: mjcf.has_total_mass,
    })
}

fn reward(top: &TomlTable<'_>, model: &Model, elements: &Elements) -> Result<Vec<Term>> {
    let value = top.require("reward", "[{ name = \"alive\", constant = 1.0 }]")?;
    let (mut terms, mut n_remembered): (Vec<Term>, usize) = (Vec::new(), 0);
    for table in value.tables()? {
        let term = Term::new(&table, model, elements, n_remembered)?;
        if terms.iter().any(|other| other.about.name == term.about.name) {
            return Err(
                table.error(format_args!("there are two terms {:?}; give each a name of its own", term.about.name))
            );
        }
        n_remembered += term.remembered().map_or(0, Reading::len);
        terms.push(term);
    }
    if (1..=MAX_TERMS).contains(&terms.len()) {
        return Ok(terms);
    }
    Err(value.error(format_args!("there are {} terms; expected 1 to {MAX_TERMS}", terms.len())))
}

/// Returns the range of each control, and whether actions are scaled so that ±1 are the ends of the range.
fn controls(top: &TomlTable<'_>, model: &Model, elements: &Elements) -> Result<(Vec<(f64, f64)>, bool)> {
    let table = top.get("actions").map(|value| value.table()).transpose()?;
    let (mut scaled, mut given) = (false, None);
    if let Some(table) = &table {
        table.only(ACTIONS)?;
        scaled = table.flag("scaled")?.unwrap_or(false);
        given = table.get("range").map(|value| value.interval()).transpose()?;
    }
    let range = |actuator: usize| {
        let limited = model.flags(Flags::ActuatorControlLimited)[actuator] != 0;
        let own = &model.field(ModelField::ActuatorControlRange)[2 * actuator..][..2];
        match (limited, given) {
            (true, _) => Ok((own[0], own[1])),
            (false, Some(range)) => Ok(range),
            (false, None) => {
                let name = actuator_name(model, elements, actuator);
                Err(top.error(format_args!(
                    "actuator {:?} has no range of control; give it ctrllimited=\"true\" and ctrlrange, or give \
                     actions = {{ range = [-1.0, 1.0] }} for all that have none",
                    escaped(&name)
                )))
            }
        }
    };
    let controls = (0..model.n_u()).map(range).collect::<Result<Vec<_>>>()?;
    Ok((controls, scaled))
}

fn parameters(
    top: &TomlTable<'_>,
    model: &Model,
    elements: &Elements,
) -> Result<(Vec<EditedParameter>, Vec<AppliedQuantity>)> {
    let tables = top.tables("parameter")?;
    if tables.len() > MAX_PARAMETERS {
        return Err(top.error(format_args!("there are {} parameters, the limit is {MAX_PARAMETERS}", tables.len())));
    }
    let mut names = std::collections::BTreeSet::new();
    let mut unique = |table: &TomlTable<'_>, name: &'static str| {
        if name.starts_with(CHANGED) {
            let problem = format!("names of values after a change begin with {CHANGED:?}; choose another name");
            return Err(table.error(format_args!("{name}: {problem}")));
        }
        let problem = "there are two parameters or applied quantities of this name; give each a name of its own";
        if names.insert(name) { Ok(()) } else { Err(table.error(format_args!("{name}: {problem}"))) }
    };
    let mut parameters = Vec::new();
    for table in &tables {
        let parameter = EditedParameter::new(table, model, elements)?;
        unique(table, parameter.parameter.name)?;
        parameters.push(parameter);
    }
    let mut applied = Vec::new();
    for table in top.tables("applied")? {
        let quantity = AppliedQuantity::new(&table, model, elements)?;
        unique(&table, quantity.quantity.name)?;
        applied.push(quantity);
    }
    checks::check(&tables, &parameters, model, elements)?;
    Ok((parameters, applied))
}

/// Returns the two parameters that heat maps show: those that the file names, otherwise the first two. `None` if there
/// are fewer than two.
fn heatmap_axes(top: &TomlTable<'_>, parameters: &[EditedParameter]) -> Result<Option<[&'static str; 2]>> {
    let names: Vec<&'static str> = parameters.iter().map(|edited| edited.parameter.name).collect();
    let Some(value) = top.get("heatmap") else {
        return Ok(match names[..] {
            [x, y, ..] => Some([x, y]),
            _ => None,
        });
    };
    let axes = value.texts()?;
    let known = |axis: &&str| names.iter().copied().find(|name| name == axis);
    match axes.iter().map(known).collect::<Option<Vec<_>>>().as_deref() {
        Some(&[x, y]) if x != y => Ok(Some([x, y])),
        _ => Err(value.error(format_args!("expected the names of two parameters; there are {}", names.join(", ")))),
    }
}

fn leaked_list<T>(items: impl Iterator<Item = T>) -> &'static [T] {
    Box::leak(items.collect::<Vec<T>>().into_boxed_slice())
}

fn observation_channels(observation: &[Reading]) -> &'static [ChannelSpec] {
    let entries = || observation.iter().flat_map(Reading::entries);
    let names = unique_channels(entries());
    let channel = |(name, entry): (String, &NumberDescription)| {
        ChannelSpec::new(leaked(&name), entry.unit, entry.low, entry.high)
    };
    leaked_list(names.into_iter().zip(entries()).map(channel))
}

fn action_channels(
    model: &Model,
    elements: &Elements,
    controls: &[(f64, f64)],
    scaled: bool,
) -> &'static [ChannelSpec] {
    let mut names: Vec<String> = Vec::new();
    for actuator in 0..model.n_u() {
        let name = channel_name(&actuator_name(model, elements, actuator));
        names.push(if names.contains(&name) { format!("{name}_{actuator}") } else { name });
    }
    let channel = |(name, &(low, high)): (&String, &(f64, f64))| {
        let (low, high) = if scaled { (-1.0, 1.0) } else { (low, high) };
        ChannelSpec::new(leaked(name), "1", low, high)
    };
    leaked_list(names.iter().zip(controls).map(channel))
}

/// Returns the entries of an exact state: positions, then velocities. The bounds of the entries are far beyond the
/// values of any episode, and exclude only absurd numbers.
fn state_channels(model: &Model, elements: &Elements) -> &'static [ChannelSpec] {
    let mut channels = Vec::new();
    for is_velocity in [false, true] {
        for joint in 0..model.n_joint() {
            let name = channel_name(elements.name(ElementKind::Joint, joint));
            let (position, velocity): (&[&str], &[&str]) = match model.index_array(Index::JointType)[joint] {
                0 => (&["_x", "_y", "_z", "_qw", "_qx", "_qy", "_qz"], &["_vx", "_vy", "_vz", "_wx", "_wy", "_wz"]),
                1 => (&["_qw", "_qx", "_qy", "_qz"], &["_wx", "_wy", "_wz"]),
                _ => (&[""], &["_velocity"]),
            };
            let is_slide = model.index_array(Index::JointType)[joint] == 2;
            for part in if is_velocity { velocity } else { position } {
                let is_length = is_slide || matches!(*part, "_x" | "_y" | "_z" | "_vx" | "_vy" | "_vz");
                let (unit, limit) = match (is_velocity, part.starts_with("_q"), is_length) {
                    (false, true, _) => ("1", 2.0),
                    (false, false, true) => ("m", 1e4),
                    (false, false, false) => ("rad", 1e3),
                    (true, _, true) => ("m/s", 1e4),
                    (true, ..) => ("rad/s", 1e4),
                };
                let mut full = format!("{name}{part}");
                if channels.iter().any(|channel: &ChannelSpec| channel.name == full) {
                    full = format!("{full}_{}", channels.len());
                }
                channels.push(ChannelSpec::new(leaked(&full), unit, -limit, limit));
            }
        }
    }
    leaked_list(channels.into_iter())
}

/// Estimates the computing time of a step in µs from the size of the model, see [`EnvironmentSpec::step_cost`].
fn step_cost(model: &Model, frame_skip: u32) -> f64 {
    let (dofs, geoms) = (model.n_v() as f64, model.n_geom() as f64);
    // The integrator RK4 computes the dynamics four times in each timestep.
    let stages = if model.options().integrator == 1 { 4.0 } else { 1.0 };
    f64::from(frame_skip) * stages * (2.0 + 0.35 * dofs + 0.02 * dofs * dofs + 0.3 * geoms)
}
