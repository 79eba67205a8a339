//! `perturb envs`: lists the environments with their parameters.

use std::io::Write;

use perturb_files::interrupt::StopFlag;
use perturb_learner::proto::{Channel, Distribution, Environment, Parameter, action_space::Kind};
use perturb_protocol::catalogue;
use perturb_text::Table;

use super::args::EnvsArgs;
use super::display::output;
use super::error::Result;
use super::servers;

pub(super) fn run(args: &EnvsArgs) -> Result<()> {
    args.json.check()?;
    let catalogue = servers(&args.server, &StopFlag::default())?.catalogue()?;
    args.json.write(catalogue::to_json(&catalogue))?;
    if args.json.is_printed() {
        return Ok(());
    }
    let mut out = output();
    for environment in &catalogue.environments {
        print(&mut out, environment)?;
    }
    Ok(())
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
        if let Some(code) = environment.code_success.as_ref().filter(|code| *code != success) {
            writeln!(out, "   (code)      {}", code.description)?;
        }
    }
    let parameters = Table::builder("", &environment.parameters)
        .text("parameter", |parameter| &parameter.name)
        .text("unit", |parameter| &parameter.unit)
        .number("D", |parameter| parameter.default_value)
        .text("R", |parameter| show(parameter.random.as_ref()))
        .text("E", |parameter| show(parameter.extreme.as_ref()));
    writeln!(out, "{}", parameters.build().to_text())?;
    if !environment.disturbances.is_empty() {
        let range = |parameter: &Parameter| format!("{} {}..{}", parameter.name, parameter.low, parameter.high);
        let ranges: Vec<String> = environment.disturbances.iter().map(range).collect();
        writeln!(out, "  disturbances {}", ranges.join(", "))?;
    }
    writeln!(out)
}

/// Formats intervals as in `[0.3, 0.4] ∪ [0.8, 0.9]`.
fn show(distribution: Option<&Distribution>) -> String {
    let intervals = distribution.map(|distribution| distribution.intervals.as_slice()).unwrap_or_default();
    let texts = intervals.iter().map(|interval| format!("[{}, {}]", interval.low, interval.high));
    texts.collect::<Vec<_>>().join(" ∪ ")
}
