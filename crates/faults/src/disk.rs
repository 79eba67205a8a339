//! Runs commands with a full disk or a limit of file sizes.

use std::path::Path;
use std::process::{Command, Stdio};

/// Returns a command that runs `command` with a limit of file sizes, in blocks of 512 bytes. A write beyond the limit
/// fails with "File too large", if the program ignores the signal SIGXFSZ, as all of perturb's programs do.
pub fn with_file_limit(command: &Command, blocks: u32) -> Command {
    let script = "ulimit -f \"$1\"; shift; exec \"$@\"";
    in_shell(command, Command::new("sh").args(["-c", script, "sh", &blocks.to_string()]))
}

/// Returns a command that runs `command` twice with a disk mounted at `folder`. In the first run the disk has
/// `kilobytes` of space, in the second run 1 GiB. Between the runs the returned command writes the first exit status to
/// standard error. At the end it copies the contents of the folder to `copy`. Returns `None` if this user may not mount
/// disks.
pub fn on_full_then_free_disk(command: &Command, folder: &Path, kilobytes: u32, copy: &Path) -> Option<Command> {
    const NAMESPACE: [&str; 2] = ["--map-root-user", "--mount"];
    let mount = Command::new("unshare").args(NAMESPACE).args(["mount", "-t", "tmpfs", "tmpfs"]).arg(folder).status();
    mount.ok().filter(|status| status.success())?;
    let script = "folder=$1 size=$2 kept=$3; shift 3
        mount -t tmpfs -o size=${size}k tmpfs \"$folder\" || exit 99
        \"$@\"; echo \"first status $?\" >&2
        mount -o remount,size=1g \"$folder\" || exit 99
        \"$@\"; status=$?
        cp -a \"$folder/.\" \"$kept\" || exit 99
        exit $status";
    let mut shell = Command::new("unshare");
    shell.args(NAMESPACE).args(["sh", "-c", script, "sh"]).arg(folder).arg(kilobytes.to_string()).arg(copy);
    Some(in_shell(command, &mut shell))
}

/// Returns a command that runs `shell`, with the program and the arguments of `command` appended to its arguments.
pub(crate) fn in_shell(command: &Command, shell: &mut Command) -> Command {
    let mut whole = Command::new(shell.get_program());
    whole.args(shell.get_args()).arg(command.get_program()).args(command.get_args());
    whole.stdout(Stdio::piped()).stderr(Stdio::piped());
    whole.envs(command.get_envs().filter_map(|(name, value)| Some((name, value?))));
    whole
}

#[cfg(test)]
mod tests {
    use super::*;

    fn writing(folder: &Path) -> Command {
        let mut command = Command::new("dd");
        command.args(["if=/dev/zero", "bs=1k", "count=200", "status=none"]);
        command.arg(format!("of={}", folder.join("file").display()));
        command
    }

    #[test]
    fn files_do_not_exceed_the_limit() {
        let folder = tempfile::tempdir().expect("a folder");
        // Unlike perturb's programs, dd does not ignore the signal SIGXFSZ by itself.
        let mut ignoring = Command::new("sh");
        let dd = writing(folder.path());
        ignoring.args(["-c", "trap '' XFSZ; exec \"$@\"", "sh"]).arg(dd.get_program()).args(dd.get_args());
        let output = with_file_limit(&ignoring, 32).output().expect("ended");
        let words = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && words.contains("File too large"), "{words}");
        assert_eq!(std::fs::metadata(folder.path().join("file")).expect("a file").len(), 16 << 10);
    }

    #[test]
    fn a_disk_is_full_at_first_and_free_later() {
        let [disk, kept] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
        let disk = disk.path();
        let kept = kept.path();
        let Some(mut twice) = on_full_then_free_disk(&writing(disk), disk, 100, kept) else {
            return eprintln!("skipped: this user may not mount disks");
        };
        let output = twice.output().expect("ended");
        let words = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && words.contains("No space left on device"), "{words}");
        assert!(words.contains("first status 1"), "{words}");
        assert_eq!(std::fs::metadata(kept.join("file")).expect("a file").len(), 200 << 10);
    }
}
