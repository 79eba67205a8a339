//! What the system says of the process.

use procfs::{ProcResult, boot_time_secs, page_size, process::Process, ticks_per_second};

/// Resources of this process, as Prometheus' own libraries name them.
pub struct Resources {
    /// Processor time, s.
    pub cpu_seconds: f64,
    /// Memory in use, bytes.
    pub resident_bytes: u64,
    /// When it started, s since 1970.
    pub start_seconds: f64,
    /// Its threads.
    pub threads: i64,
    /// File descriptors in use.
    pub descriptors: usize,
    /// The most there may be; none: as many as there are.
    pub most_descriptors: Option<u64>,
}

/// Reads them.
///
/// # Errors
/// Where `/proc` is not there or does not tell.
pub fn resources() -> ProcResult<Resources> {
    let process = Process::myself()?;
    let stat = process.stat()?;
    let seconds = |ticks: u64| ticks as f64 / ticks_per_second() as f64;
    let limit = process.limits()?.max_open_files.soft_limit;
    Ok(Resources {
        cpu_seconds: seconds(stat.utime + stat.stime),
        resident_bytes: stat.rss * page_size(),
        start_seconds: boot_time_secs()? as f64 + seconds(stat.starttime),
        threads: stat.num_threads,
        descriptors: process.fd_count()?,
        most_descriptors: match limit {
            procfs::process::LimitValue::Value(limit) => Some(limit),
            procfs::process::LimitValue::Unlimited => None,
        },
    })
}
