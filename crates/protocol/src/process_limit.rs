//! Error text for a process or thread that cannot be started because of a process limit.

use std::io::{Error, ErrorKind};

/// Describes why a process or thread could not be started. If a process limit is the reason, the text names the limit.
pub fn spawn_failure(error: &Error) -> String {
    match error.kind() {
        ErrorKind::WouldBlock => format!("{error}: {}", limit()),
        _ => error.to_string(),
    }
}

fn limit() -> String {
    let limits = std::fs::read_to_string("/proc/self/limits").unwrap_or_default();
    match max_processes(&limits) {
        Some(number) => format!(
            "this user may have {number} processes and threads (`ulimit -u`), a container perhaps fewer; end others, or \
             have the limit raised"
        ),
        None => "the container or the machine may have no more processes and threads; have its limit raised".into(),
    }
}

/// Parses the soft limit of processes from the text of `/proc/self/limits`. `None` if it is unlimited.
fn max_processes(limits: &str) -> Option<u64> {
    limits.lines().find_map(|line| line.strip_prefix("Max processes")?.split_whitespace().next()?.parse().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_failures_by_the_limit_name_it() {
        let text = "Limit                     Soft Limit           Hard Limit           Units\n\
                    Max processes             4096                 63442                processes\n";
        assert_eq!(max_processes(text), Some(4096));
        assert_eq!(max_processes(&text.replace("4096 ", "unlimited ")), None);
        // Error 11 is EAGAIN, by which the system refuses processes above the limit; error 2 is ENOENT.
        assert!(spawn_failure(&Error::from_raw_os_error(11)).contains("processes and threads"));
        assert_eq!(spawn_failure(&Error::from_raw_os_error(2)), "No such file or directory (os error 2)");
    }
}
