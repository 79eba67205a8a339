//! `perturb envs`.

use std::io::Write;

use anyhow::Result;
use serde_json::{Value, json};

use super::args::EnvsArgs;
use super::{Ending, servers};
use crate::proto::{Channel, Distribution, Environment, ListEnvironmentsResponse, action_space::Kind};

pub(super) fn run(args: &EnvsArgs) -> Result<Ending> {
    let catalogue = servers(&args.server, 0)?.catalogue()?;
    let mut out = std::io::stdout().lock();
    if args.json {
        writeln!(out, "{}", serde_json::to_string_pretty(&document(&catalogue))?)?;
        return Ok(Ending::Done);
    }
    for environment in &catalogue.environments {
        print(&mut out, environment)?;
    }
    Ok(Ending::Done)
}

fn print(out: &mut impl Write, environment: &Environment) -> std::io::Result<()> {
    writeln!(out, "{} (v{})  {}", environment.name, environment.revision, environment.description)?;
    let seconds = f64::from(environment.step_limit) * environment.control_timestep;
    writeln!(out, "  at most {} steps ({seconds:.0} s)", environment.step_limit)?;
    let names = |channels: &[Channel]| channels.iter().map(|channel| channel.name.clone()).collect::<Vec<_>>();
    writeln!(out, "  observation  {}", names(&environment.observation).join(", "))?;
    let action = match environment.action.as_ref().and_then(|action| action.kind.as_ref()) {
        Some(Kind::Discrete(discrete)) => format!("one of {}", discrete.names.join(", ")),
        Some(Kind::Continuous(continuous)) => format!("numbers: {}", names(&continuous.channels).join(", ")),
        None => "unknown".into(),
    };
    writeln!(out, "  action       {action}")?;
    if let Some(success) = &environment.success {
        writeln!(out, "  success      {}", success.description)?;
    }
    writeln!(out, "  {:<18} {:<8} {:>8}  {:<20} E", "parameter", "unit", "D", "R")?;
    for parameter in &environment.parameters {
        writeln!(
            out,
            "  {:<18} {:<8} {:>8}  {:<20} {}",
            parameter.name,
            parameter.unit,
            parameter.default_value,
            show(parameter.random.as_ref()),
            show(parameter.extreme.as_ref())
        )?;
    }
    writeln!(out)
}

/// Intervals as mathematicians write them.
fn show(distribution: Option<&Distribution>) -> String {
    let intervals = distribution.map(|distribution| distribution.intervals.as_slice()).unwrap_or_default();
    let texts = intervals.iter().map(|interval| format!("[{}, {}]", interval.low, interval.high));
    texts.collect::<Vec<_>>().join(" ∪ ")
}

fn document(catalogue: &ListEnvironmentsResponse) -> Value {
    json!({
        "server_version": catalogue.server_version,
        "max_batch_size": catalogue.max_batch_size,
        "environments": catalogue.environments.iter().map(environment).collect::<Vec<_>>(),
    })
}

fn environment(environment: &Environment) -> Value {
    let intervals = |distribution: Option<&Distribution>| {
        let intervals = distribution.map(|distribution| distribution.intervals.as_slice()).unwrap_or_default();
        intervals.iter().map(|interval| json!([interval.low, interval.high])).collect::<Vec<_>>()
    };
    let action = match environment.action.as_ref().and_then(|action| action.kind.as_ref()) {
        Some(Kind::Discrete(discrete)) => json!({ "discrete": discrete.names }),
        Some(Kind::Continuous(continuous)) => json!({ "continuous": channels(&continuous.channels) }),
        None => Value::Null,
    };
    let parameters: Vec<Value> = environment
        .parameters
        .iter()
        .map(|parameter| {
            json!({
                "name": parameter.name,
                "unit": parameter.unit,
                "description": parameter.description,
                "low": parameter.low,
                "high": parameter.high,
                "D": parameter.default_value,
                "R": intervals(parameter.random.as_ref()),
                "E": intervals(parameter.extreme.as_ref()),
            })
        })
        .collect();
    json!({
        "name": environment.name,
        "revision": environment.revision,
        "description": environment.description,
        "step_limit": environment.step_limit,
        "control_timestep": environment.control_timestep,
        "observation": channels(&environment.observation),
        "action": action,
        "success": environment.success.as_ref().map(|success| &success.description),
        "parameters": parameters,
        "model_hash": environment.model_hash,
    })
}

/// JSON has no infinity: an open end is null.
fn channels(channels: &[Channel]) -> Vec<Value> {
    channels
        .iter()
        .map(|channel| json!({ "name": channel.name, "unit": channel.unit, "low": channel.low, "high": channel.high }))
        .collect()
}
