//! Command lines in messages, which users can copy to resume a run.

use std::path::Path;

use perturb_learner::training::{LastCheckpoint, TrainError};
use perturb_text::quoted;

use super::args::{PlayArgs, ServerArgs, WaitArgs};
use super::error::CommandError;

/// Returns the command line of this process.
pub(super) fn this_command() -> String {
    let words = std::env::args_os().skip(1).map(quoted);
    ["perturb".to_owned()].into_iter().chain(words).collect::<Vec<_>>().join(" ")
}

/// Returns the options `--task` for another command that needs the same environments. The text is empty without tasks.
pub(super) fn task_options(server: &ServerArgs) -> String {
    server.task.iter().map(|task| format!(" --task {}", quoted(task))).collect()
}

/// Returns the command that resumes the run in `path` with the same servers.
pub(super) fn resume_command(path: &Path, play: &PlayArgs) -> String {
    let mut command = format!("perturb train --resume {}", quoted(path));
    let servers: Vec<String> = play.server.server.iter().map(ToString::to_string).collect();
    if !servers.is_empty() {
        command += &format!(" --server {}", quoted(servers.join(",")));
    }
    command += &task_options(&play.server);
    if play.act == "client" {
        command += " --act client";
    }
    if play.wait.server_wait != WaitArgs::DEFAULT_SECONDS {
        command += &format!(" --server-wait {}", play.wait.server_wait);
    }
    command
}

/// Converts the error of a failed training. If the training can be resumed, adds the command that resumes it.
pub(super) fn with_resume_command(error: TrainError, play: &PlayArgs) -> CommandError {
    match &error {
        TrainError::Failed { last: Some(LastCheckpoint { run, .. }), source }
            if !matches!(**source, TrainError::Numbers(_)) =>
        {
            CommandError::Failed(format!("{error}; to go on with the training: {}", resume_command(run, play)))
        }
        _ => error.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_has_the_same_servers() {
        let play = |servers: &[&str], act: &str| PlayArgs {
            server: ServerArgs {
                server: servers.iter().map(|text| text.parse().unwrap()).collect(),
                workers: None,
                task: Vec::new(),
            },
            act: act.into(),
            wait: WaitArgs { server_wait: WaitArgs::DEFAULT_SECONDS },
        };
        assert_eq!(resume_command(Path::new("runs/a"), &play(&[], "server")), "perturb train --resume runs/a");
        assert_eq!(
            resume_command(Path::new("my runs/a"), &play(&["unix:/x", "h:7"], "client")),
            "perturb train --resume 'my runs/a' --server 'unix:/x,http://h:7' --act client"
        );
        let mut with_task = play(&[], "server");
        with_task.server.task = vec!["my robot".into()];
        let command = resume_command(Path::new("runs/a"), &with_task);
        assert_eq!(command, "perturb train --resume runs/a --task 'my robot'");
    }
}
