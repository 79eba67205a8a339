//! Generates the shell script that all jobs of an array run.

use std::path::Path;

use super::options::{JobCommand, OptionError, text_of};

/// Returns the script for the submission in the folder `submission`, which belongs to the experiment in `folder`.
///
/// The script ends with `exec`, so that Slurm's signals reach `perturb` itself: it then finishes its current iterations
/// and writes checkpoints.
pub(super) fn script(task: &JobCommand, folder: &Path, submission: &Path) -> Result<String, OptionError> {
    let cells = quoted(text_of(&submission.join("cells.txt"))?);
    let plan = quoted(text_of(&submission.join("plan.toml"))?);
    let (folder, program) = (quoted(text_of(folder)?), quoted(text_of(&task.program)?));
    let servers = if task.servers.is_empty() {
        let mut words = format!("--workers {}", task.workers);
        for folder in &task.tasks {
            words += &format!(" --task {}", quoted(text_of(folder)?));
        }
        words
    } else {
        format!("--server {}", quoted(&task.servers.join(",")))
    };
    let (jobs, group, wait) = (task.jobs, task.group, task.server_wait);
    Ok(format!(
        r#"#!/bin/sh
# One job of an array that `perturb run --engine slurm` submitted: it does the cells of its line in cells.txt.
cells_file={cells}
program={program}
echo "job ${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}} on ${{SLURMD_NODENAME}}, restarted ${{SLURM_RESTART_COUNT:-0}} times" >&2
cells=$(sed -n "$((SLURM_ARRAY_TASK_ID + 1))p" "$cells_file")
if [ -z "$cells" ]; then
    echo "perturb: $SLURMD_NODENAME finds no cells in $cells_file: can it read this file?" >&2
    exit 1
fi
if [ ! -x "$program" ]; then
    echo "perturb: $SLURMD_NODENAME finds no program $program: put it in a folder that all nodes can read" >&2
    exit 1
fi
exec "$program" run {plan} --json --out {folder} --cell "$cells" --jobs {jobs} --group {group} --server-wait {wait} {servers}
"#
    ))
}

/// Quotes a text as a single word for the shell.
fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    /// Runs the script of `task` as job `index`. Returns whether it succeeded, and its output.
    fn run(task: &JobCommand, directory: &Path, index: &str) -> (bool, String) {
        let text = script(task, &directory.join("it's $HOME"), directory).unwrap();
        let path = directory.join("job.sh");
        std::fs::write(&path, text).unwrap();
        let mut command = Command::new("sh");
        command.arg(path).env("SLURM_ARRAY_TASK_ID", index).env("SLURM_ARRAY_JOB_ID", "7").env("SLURMD_NODENAME", "n1");
        let output = command.output().unwrap();
        (output.status.success(), String::from_utf8([output.stdout, output.stderr].concat()).unwrap())
    }

    #[test]
    fn a_job_does_the_cells_of_its_line() {
        let directory = tempfile::tempdir().unwrap();
        std::fs::write(directory.path().join("cells.txt"), "a,b\nc\n").unwrap();
        let program = directory.path().join("a program");
        let mut task = JobCommand {
            program: program.clone(),
            jobs: 2,
            group: 9,
            workers: 3,
            tasks: vec![directory.path().join("it's a task")],
            servers: Vec::new(),
            server_wait: 60,
        };
        let (succeeded, said) = run(&task, directory.path(), "0");
        assert!(!succeeded && said.contains("n1 finds no program") && said.contains("a program"), "{said}");

        super::super::tests::install(&program, "#!/bin/sh\nprintf '[%s]' \"$@\"");
        let (succeeded, said) = run(&task, directory.path(), "0");
        let shown = directory.path().display();
        let expected = format!(
            "[run][{shown}/plan.toml][--json][--out][{shown}/it's $HOME][--cell][a,b][--jobs][2][--group][9][--server-wait][60][--workers][3][--task][{shown}/it's a task]"
        );
        assert!(succeeded && said.starts_with(&expected), "{said}");
        assert!(said.contains("job 7_0 on n1, restarted 0 times"), "{said}");

        task.servers = vec!["one:1".into(), "two:2".into()];
        let (_, said) = run(&task, directory.path(), "1");
        assert!(
            said.contains("[--cell][c][--jobs][2][--group][9][--server-wait][60][--server][one:1,two:2]"),
            "{said}"
        );
        let (succeeded, said) = run(&task, directory.path(), "2");
        assert!(!succeeded && said.contains("n1 finds no cells in"), "{said}");
    }
}
