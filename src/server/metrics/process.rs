//! Reads the resources that the server's process uses.

use rustix::{
    param::{clock_ticks_per_second, page_size},
    process::{Resource, getrlimit},
};
use std::{fs, io};

/// The resources that this process uses. They are among the standard process metrics of Prometheus' client libraries.
pub struct Resources {
    /// The CPU time used so far, s.
    pub cpu_seconds: f64,
    /// The resident memory, bytes.
    pub resident_bytes: u64,
    /// The start time of the process, s since 1970.
    pub start_seconds: f64,
    /// The number of threads.
    pub threads: i64,
    /// The number of open file descriptors.
    pub descriptors: usize,
    /// The maximum number of file descriptors; `None` for no limit.
    pub max_descriptors: Option<u64>,
}

/// Reads the resources that this process uses from `/proc`.
///
/// # Errors
/// If `/proc` is missing or does not have the expected format.
pub fn resources() -> io::Result<Resources> {
    let stat = fs::read_to_string("/proc/self/stat")?;
    let system = fs::read_to_string("/proc/stat")?;
    // The descriptor through which this line reads the directory is not counted.
    let descriptors = fs::read_dir("/proc/self/fd")?.count().saturating_sub(1);
    parse(&stat, &system, descriptors)
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, "/proc/self/stat or /proc/stat has another format"))
}

/// Parses the contents of `/proc/self/stat` and `/proc/stat`. Field numbers start at 1, as in proc(5).
fn parse(stat: &str, system: &str, descriptors: usize) -> Option<Resources> {
    // Field 2 is the program's name in parentheses, which may contain spaces and parentheses.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let field = |number: usize| fields.get(number - 3)?.parse::<u64>().ok();
    let boot: u64 = system.lines().find_map(|line| line.strip_prefix("btime "))?.trim().parse().ok()?;
    let seconds = |ticks: u64| ticks as f64 / clock_ticks_per_second() as f64;
    Some(Resources {
        cpu_seconds: seconds(field(14)? + field(15)?),
        resident_bytes: field(24)? * page_size() as u64,
        start_seconds: boot as f64 + seconds(field(22)?),
        threads: i64::try_from(field(20)?).ok()?,
        descriptors,
        max_descriptors: getrlimit(Resource::Nofile).current,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_counted_after_the_program_name() {
        let after = "S 1 2 3 4 5 6 7 8 9 10 150 50 0 0 20 0 7 0 300 4096 11 18446744073709551615 1 1";
        let ticks = clock_ticks_per_second() as f64;
        for name in ["perturb-server", "a ) b (c"] {
            let read = parse(&format!("42 ({name}) {after}"), "cpu 1 2\nbtime 1000\nprocesses 3\n", 9).unwrap();
            assert_eq!((read.cpu_seconds, read.start_seconds), (200.0 / ticks, 1000.0 + 300.0 / ticks), "{name}");
            assert_eq!((read.threads, read.resident_bytes), (7, 11 * page_size() as u64), "{name}");
            assert_eq!(read.descriptors, 9);
        }
        assert!(parse("42 (perturb-server) S 1 2", "btime 1000\n", 9).is_none());
        assert!(parse(&format!("42 (perturb-server) {after}"), "cpu 1 2\n", 9).is_none());
    }

    #[test]
    fn this_process_has_resources() {
        let read = resources().unwrap();
        assert!(
            read.threads >= 1 && read.descriptors >= 3 && read.resident_bytes > 1 << 20 && read.start_seconds > 1e9
        );
    }
}
