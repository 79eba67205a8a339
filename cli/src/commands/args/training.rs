//! What can be typed to look around and to train.

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
  perturb envs --server 127.0.0.1:7447               # those of a running perturb-server
  perturb envs --json envs.json")]
pub struct EnvsArgs {
    #[command(flatten)]
    pub server: ServerArgs,
    #[command(flatten)]
    pub json: JsonArgs,
}

/// What is typed beats --config, which beats the algorithm's defaults; flags and --set may not contradict each other.
#[derive(Args, Debug)]
#[command(after_help = "Required: --env, or --config with an environment, or --resume.
Examples:
  perturb train --env Hopper --version R --episodes 5000
  perturb train --env CartPole --algorithm a2c --set learning_rate=1e-3 --out runs/mine
  perturb train --env Pendulum --parameters length=0.8..1.2 mass=1
  perturb train --resume runs/mine                   # after Ctrl-C, or kill -9
  perturb train --resume runs/mine --extend 5000     # train on")]
pub struct TrainArgs {
    /// The environment's name; `perturb envs` lists them.
    #[arg(long, value_name = "NAME")]
    pub env: Option<String>,
    /// Where its parameters come from [default: D].
    #[arg(long)]
    pub version: Option<Version>,
    /// Parameters in place of the version's: a value, or intervals to draw from, e.g. length=0.3..0.4,0.8..0.9 mass=0.1.
    #[arg(long, value_name = "PARAMETER=VALUES", num_args = 1..)]
    pub parameters: Vec<Assignment>,
    /// Whose defaults settings have: those that we recommend, or those of the paper's authors [default: perturb].
    #[arg(long, value_parser = OneOf::new(&Preset::NAMES))]
    pub preset: Option<String>,
    /// What learns [default: ppo].
    #[arg(long, value_parser = OneOf::new(&Settings::names()))]
    pub algorithm: Option<String>,
    /// What acts [default: ff; with RL², which has no other, rc].
    #[arg(long, value_parser = OneOf::new(&Architecture::NAMES))]
    pub architecture: Option<String>,
    /// What the policy sees: the environment's observation, or the parameters that the episode runs with, too [default:
    /// state].
    #[arg(long, value_parser = OneOf::new(&Observe::NAMES))]
    pub observe: Option<String>,
    /// RL² only: episodes in a trial [default: 2].
    #[arg(long, value_name = "N", value_parser = at_least_one::<u64>)]
    pub episodes_per_trial: Option<u64>,
    /// Episodes to train for; EPOpt counts those that it learns from [default: 15000].
    #[arg(long, value_name = "N", value_parser = at_least_one::<u64>)]
    pub episodes: Option<u64>,
    /// Fixes all randomness [default: 1].
    #[arg(long, value_name = "N", value_parser = natural::<u64>)]
    pub seed: Option<u64>,
    /// Directory for the checkpoint and the logs [default: runs/<environment>-<algorithm>-<time>].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Delete the run that is in --out already.
    #[arg(long)]
    pub overwrite: bool,
    /// Threads of an update; their number changes no byte [default: one a core].
    #[arg(long, value_name = "N", value_parser = |text: &str| within(text, 1..=64u16))]
    pub threads: Option<u16>,
    /// A TOML file of settings, e.g. the config.toml of an earlier run.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// A setting, e.g. learning_rate=3e-4; repeatable.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Go on with the run in this directory from its last checkpoint, exactly as if it had not been broken off. Its
    /// settings are those that it began with.
    #[arg(
        long,
        value_name = "DIR",
        conflicts_with_all = [
            "env", "version", "parameters", "preset", "algorithm", "architecture", "observe", "episodes_per_trial",
            "episodes", "seed", "out", "overwrite", "config", "set"
        ]
    )]
    pub resume: Option<PathBuf>,
    /// Go on past the budget of the run, or past what it has if that is more, for so many more episodes. With learning_rate_schedule = "constant" it comes to
    /// what a training with the larger budget comes to; another schedule goes on from where that one would be.
    #[arg(long, value_name = "EPISODES", value_parser = at_least_one::<u64>)]
    pub extend: Option<u64>,
    #[command(flatten)]
    pub json: JsonArgs,
    #[command(flatten)]
    pub play: PlayArgs,
}

/// Five minutes on two cores, unless told otherwise.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb demo
  perturb demo --episodes 200 --test-episodes 50     # only to see that it runs
  perturb demo --env CartPole --episodes 2000")]
pub struct DemoArgs {
    /// The environment.
    #[arg(long, value_name = "NAME", default_value = "Hopper")]
    pub env: String,
    /// Episodes of each training.
    #[arg(long, value_name = "N", default_value_t = 5000, value_parser = at_least_one::<u64>)]
    pub episodes: u64,
    /// Episodes of each test.
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = at_least_one::<u64>)]
    pub test_episodes: u64,
    /// Fixes all randomness.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = natural::<u64>)]
    pub seed: u64,
    /// Where the runs, the heatmap and the film go [default: runs/demo-<time>].
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
    /// Where to look, however deep.
    #[arg(value_name = "DIR", default_value = "runs")]
    pub dir: PathBuf,
    #[command(flatten)]
    pub json: JsonArgs,
}

/// The page changes nothing: it only shows what is in the folder. There is no authentication, so it listens on this machine's
/// own address alone, unless another one is given; from elsewhere: ssh -L 8420:localhost:8420 MACHINE.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb serve                                      # then open http://127.0.0.1:8420
  perturb serve runs/quick --address 9000
  perturb serve --server 127.0.0.1:7447              # also what a perturb-server says")]
pub struct ServeArgs {
    /// Where the runs are, however deep; or one of them.
    #[arg(value_name = "DIR", default_value = "runs")]
    pub dir: PathBuf,
    /// Where to listen: ADDRESS:PORT, or a port of this machine's own address; port 0 takes a free one, which is printed.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8420", value_parser = listening)]
    pub address: SocketAddr,
    /// A running server of environments, of which the page shows what it says of itself: unix:/path, host:port,
    /// http://host:port or tcp://host:port, with TLS https://host:port.
    #[arg(long, value_name = "ADDRESS")]
    pub server: Option<Address>,
}

/// Where to listen.
fn listening(text: &str) -> Result<SocketAddr, String> {
    let local = |port| SocketAddr::from(([127, 0, 0, 1], port));
    let port = text.strip_prefix("localhost:").unwrap_or(text).parse().map(local);
    port.or_else(|_| text.parse()).map_err(|_| "expected ADDRESS:PORT, e.g. 127.0.0.1:8420, or a port".to_owned())
}

#[derive(Args, Debug)]
#[command(after_help = "Examples:
  perturb completions bash > ~/.local/share/bash-completion/completions/perturb
  perturb completions zsh > ~/.zfunc/_perturb")]
pub struct CompletionsArgs {
    /// The shell.
    pub shell: clap_complete::Shell,
}

#[derive(Args, Debug)]
#[command(after_help = "Example:
  perturb man ~/.local/share/man/man1 && man perturb-train")]
pub struct ManArgs {
    /// The folder, which must be there: perturb.1 and a page for each command.
    #[arg(value_name = "DIR")]
    pub dir: PathBuf,
}
