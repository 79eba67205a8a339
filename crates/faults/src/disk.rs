//! Disks without room.

use std::path::Path;
use std::process::{Command, Stdio};

/// `command` where no file may get larger than so many blocks of 512 bytes: writing more is an error, "File too large".
pub fn small_files(command: &Command, blocks: u32) -> Command {
    // By default it would be a signal.
    let script = "trap '' XFSZ; ulimit -f \"$1\"; shift; exec \"$@\"";
    scripted(command, Command::new("sh").args(["-c", script, "sh", &blocks.to_string()]))
}

/// `command`, run twice, first where `folder` is a disk of so many kB and then with all the room it wants; what is in the
/// folder at the end is put into `kept`. Standard error has the first run's status in a line between the two. None where
/// the system lets nobody mount such a disk.
pub fn full_at_first(command: &Command, folder: &Path, kilobytes: u32, kept: &Path) -> Option<Command> {
    const NAMESPACE: [&str; 2] = ["--map-root-user", "--mount"];
    let tried = Command::new("unshare").args(NAMESPACE).args(["mount", "-t", "tmpfs", "tmpfs"]).arg(folder).status();
    tried.ok().filter(|status| status.success())?;
    let script = "folder=$1 size=$2 kept=$3; shift 3
        mount -t tmpfs -o size=${size}k tmpfs \"$folder\" || exit 99
        \"$@\"; echo \"first status $?\" >&2
        mount -o remount,size=1g \"$folder\" || exit 99
        \"$@\"; status=$?
        cp -a \"$folder/.\" \"$kept\" || exit 99
        exit $status";
    let mut shell = Command::new("unshare");
    shell.args(NAMESPACE).args(["sh", "-c", script, "sh"]).arg(folder).arg(kilobytes.to_string()).arg(kept);
    Some(scripted(command, &mut shell))
}

/// `shell` with all of `command` behind it.
fn scripted(command: &Command, shell: &mut Command) -> Command {
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
    fn files_stay_small() {
        let folder = tempfile::tempdir().expect("a folder");
        let output = small_files(&writing(folder.path()), 32).output().expect("ended");
        let words = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && words.contains("File too large"), "{words}");
        assert_eq!(std::fs::metadata(folder.path().join("file")).expect("a file").len(), 16 << 10);
    }

    #[test]
    fn a_disk_is_full_at_first_and_what_is_written_then_is_kept() {
        let [disk, kept] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
        let (disk, kept) = (disk.path(), kept.path());
        let Some(mut twice) = full_at_first(&writing(disk), disk, 100, kept) else {
            return eprintln!("skipped: nobody may mount a disk here");
        };
        let output = twice.output().expect("ended");
        let words = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && words.contains("No space left on device"), "{words}");
        assert!(words.contains("first status 1"), "{words}");
        assert_eq!(std::fs::metadata(kept.join("file")).expect("a file").len(), 200 << 10);
    }
}
