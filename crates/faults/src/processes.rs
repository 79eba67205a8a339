//! Runs commands with a limit of processes and threads.

use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};

use crate::disk::in_shell;

/// Returns a command that runs `command` as another user, who may have `limit` processes and threads. 256 successive
/// calls choose different users, because the limit holds for all processes of a user together. Returns `None` if this user may not
/// become another one, as only root may, or if the other one may not run the program.
pub fn with_process_limit(command: &Command, limit: u32) -> Option<Command> {
    static CALLS: AtomicU32 = AtomicU32::new(0);
    // Process ids have at most 22 bits. Users with such high numbers do not exist.
    let user = (1 << 30) | (std::process::id() << 8) | (CALLS.fetch_add(1, Ordering::Relaxed) % 256);
    let user = ["--reuid", &user.to_string(), "--regid", &user.to_string(), "--clear-groups"];
    let can_run = Command::new("setpriv").args(user).args(["test", "-x"]).arg(command.get_program()).status();
    can_run.ok().filter(|status| status.success())?;
    Some(in_shell(command, Command::new("setpriv").args(user).args(["prlimit", &format!("--nproc={limit}")])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_user_has_no_more_processes_than_the_limit() {
        let mut two = Command::new("/bin/sh");
        two.args(["-c", "true; sleep 0 & wait"]);
        let Some(mut limited) = with_process_limit(&two, 1) else {
            return eprintln!("skipped: this user may not become another one");
        };
        assert!(!limited.output().expect("ended").status.success());
        assert!(with_process_limit(&two, 2).expect("as before").output().expect("ended").status.success());
    }
}
