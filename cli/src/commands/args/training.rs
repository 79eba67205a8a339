//! Arguments of the commands that list, serve and train.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::Args;
use perturb_learner::client::Address;
use perturb_protocol::Version;
use perturb_settings::sets::Assignment;
use perturb_settings::{Architecture, Observe, Preset, Settings};

use super::{JsonArgs, OneOf, PlayArgs, ServerArgs, WaitArgs, at_least_one, natural, within};

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb envs
  perturb envs --server 127.0.0.1:7447               # of a running perturb-server
  perturb envs --json envs.json")]
pub struct EnvsArgs {
    #[command(flatten)]
    pub server: ServerArgs,
    #[command(flatten)]
    pub json: JsonArgs,
}

/// Options take precedence over --config, and --config over the algorithm's defaults. Options and --set must not
/// contradict each other.
#[derive(Args, Debug)]
#[command(after_help = "Required: --env, or --config with an environment, or --resume.
Examples:
  perturb train --env Hopper --version R --episodes 5000
  perturb train --env CartPole --algorithm a2c --set learning_rate=1e-3 --out runs/mine
  perturb train --env Pendulum --parameters length=0.8..1.2 mass=1
  perturb train --resume runs/mine                   # after Ctrl-C, or kill -9
  perturb train --resume runs/mine --extend 5000     # train on")]
pub struct TrainArgs {
    /// Name of the environment; `perturb envs` lists them.
    #[arg(long, value_name = "NAME")]
    pub env: Option<String>,
    /// Version of the environment's parameters: D (the defaults), R (random), E (extreme) or R+E [default: D].
    #[arg(long)]
    pub version: Option<Version>,
    /// Parameters that replace those of the version: a value, or intervals to draw from, e.g.
    /// length=0.3..0.4,0.8..0.9 mass=0.1.
    #[arg(long, value_name = "PARAMETER=VALUES", num_args = 1..)]
    pub parameters: Vec<Assignment>,
    /// A list of parameters to train on: a CSV file whose header names parameters, with a row for each of 1 to 1024
    /// contexts. Each trial has the values of one row; all rows are equally likely.
    #[arg(long, value_name = "FILE", conflicts_with = "parameters")]
    pub contexts: Option<PathBuf>,
    /// Defaults of the settings: perturb's recommended ones, or those of the paper's authors [default: perturb].
    #[arg(long, value_parser = OneOf::new(&Preset::NAMES))]
    pub preset: Option<String>,
    /// Learning algorithm [default: ppo].
    #[arg(long, value_parser = OneOf::new(&Settings::names()))]
    pub algorithm: Option<String>,
    /// Network architecture: feed-forward (ff) or recurrent (rc) [default: ff; with RL², rc].
    #[arg(long, value_parser = OneOf::new(&Architecture::NAMES))]
    pub architecture: Option<String>,
    /// Input of the policy: the environment's observation (state), or also the parameters of the episode (parameters)
    /// [default: state].
    #[arg(long, value_parser = OneOf::new(&Observe::NAMES))]
    pub observe: Option<String>,
    /// Number of episodes in a trial; RL² only [default: 2].
    #[arg(long, value_name = "N", value_parser = at_least_one::<u64>)]
    pub episodes_per_trial: Option<u64>,
    /// Number of training episodes. EPOpt counts only the episodes that it learns from [default: 15000].
    #[arg(long, value_name = "N", value_parser = at_least_one::<u64>)]
    pub episodes: Option<u64>,
    /// Random seed of the training [default: 1].
    #[arg(long, value_name = "N", value_parser = natural::<u64>)]
    pub seed: Option<u64>,
    /// Directory for the checkpoint and the logs [default: runs/<environment>-<algorithm>-<time>].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Delete an existing run in --out first.
    #[arg(long)]
    pub overwrite: bool,
    /// Number of threads for policy updates. Results do not depend on it [default: one for each core].
    #[arg(long, value_name = "N", value_parser = |text: &str| within(text, 1..=64u16))]
    pub threads: Option<u16>,
    /// A TOML file of settings, e.g. the config.toml of an earlier run.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// A setting, e.g. learning_rate=3e-4. Can be given several times.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Resume the run in this directory from its last checkpoint, with its own settings. The result is the same as
    /// without the interruption.
    #[arg(
        long,
        value_name = "DIR",
        conflicts_with_all = [
            "env", "version", "parameters", "contexts", "preset", "algorithm", "architecture", "observe",
            "episodes_per_trial", "episodes", "seed", "out", "overwrite", "config", "set"
        ]
    )]
    pub resume: Option<PathBuf>,
    /// Extend a resumed run by this number of episodes. They are added to the run's budget, or to the number of
    /// finished episodes if that is larger. With learning_rate_schedule = "constant" the result equals that of one
    /// training with the larger budget. Another schedule continues as it would in a training with the larger budget.
    #[arg(long, value_name = "EPISODES", value_parser = at_least_one::<u64>)]
    pub extend: Option<u64>,
    #[command(flatten)]
    pub json: JsonArgs,
    #[command(flatten)]
    pub play: PlayArgs,
}

/// Takes about a minute on two cores with the default options.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb demo
  perturb demo --episodes 200 --test-episodes 50     # a quick check that it runs
  perturb demo --env CartPole")]
pub struct DemoArgs {
    /// Name of the environment.
    #[arg(long, value_name = "NAME", default_value = "Hopper")]
    pub env: String,
    /// Number of episodes of each training [default: 5000; Hopper and CartPole 1500].
    #[arg(long, value_name = "N", value_parser = at_least_one::<u64>)]
    pub episodes: Option<u64>,
    /// Number of episodes of each test.
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = at_least_one::<u64>)]
    pub test_episodes: u64,
    /// Random seed.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = natural::<u64>)]
    pub seed: u64,
    /// Folder for the runs, the heatmap and the films [default: runs/demo-<time>].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub server: ServerArgs,
    #[command(flatten)]
    pub wait: WaitArgs,
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb ls                                         # what is in runs/
  perturb ls results --json results.json")]
pub struct LsArgs {
    /// Folder to search, with all folders below it.
    #[arg(value_name = "DIR", default_value = "runs")]
    pub dir: PathBuf,
    #[command(flatten)]
    pub json: JsonArgs,
}

/// The page changes no files. It has no authentication, so by default it can be opened only on this machine. On another
/// machine, use a tunnel: ssh -L 8420:localhost:8420 MACHINE.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb serve                                      # then open http://127.0.0.1:8420
  perturb serve runs/quick --address 9000
  perturb serve --server 127.0.0.1:7447              # with the status of a perturb-server")]
pub struct ServeArgs {
    /// Folder of the runs, at any depth, or a single run.
    #[arg(value_name = "DIR", default_value = "runs")]
    pub dir: PathBuf,
    /// Address to listen at: ADDRESS:PORT, or a port of the loopback address. Port 0 takes a free port and prints it.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8420", value_parser = listen_address)]
    pub address: SocketAddr,
    /// Host names, separated by commas, at which browsers may open the page in addition to localhost, e.g. the name of
    /// a reverse proxy. Links are relative, so the proxy may serve the page below any path.
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    pub host: Vec<String>,
    /// A running perturb-server whose status the page shows: unix:/path, host:port, http://host:port or
    /// tcp://host:port, with TLS https://host:port.
    #[arg(long, value_name = "ADDRESS")]
    pub server: Option<Address>,
}

/// Parses an address to listen at.
fn listen_address(text: &str) -> Result<SocketAddr, String> {
    let local = |port| SocketAddr::from(([127, 0, 0, 1], port));
    let port = text.strip_prefix("localhost:").unwrap_or(text).parse().map(local);
    port.or_else(|_| text.parse()).map_err(|_| "expected ADDRESS:PORT, e.g. 127.0.0.1:8420, or a port".to_owned())
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb completions bash > ~/.local/share/bash-completion/completions/perturb
  perturb completions zsh > ~/.zfunc/_perturb")]
pub struct CompletionsArgs {
    /// Name of the shell.
    pub shell: clap_complete::Shell,
}

#[derive(Args, Debug)]
#[command(after_help = "Example:
  perturb man ~/.local/share/man/man1 && man perturb-train")]
pub struct ManArgs {
    /// Existing folder for perturb.1 and a page for each command.
    #[arg(value_name = "DIR")]
    pub dir: PathBuf,
}
