//! The metrics of the page. Labels contain only names that this program, its environments or the token file define,
//! never text from a client.

use super::{MetricsSources, process};
use crate::{meters::Histogram, server::audit::ledger::Ledger};
use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeLabelSet, MetricEncoder, NoLabelSet, text},
    metrics::MetricType,
    registry::Registry,
};
use std::{
    fmt,
    sync::{Arc, atomic::Ordering},
};
use tonic::Code;

type EncodeResult = Result<(), fmt::Error>;
type MetricLabels<'a, const N: usize> = [(&'static str, &'a str); N];
/// The label set of metrics without labels.
const NO_LABELS: MetricLabels<'static, 0> = [];

/// Renders the metrics page with the present values, in OpenMetrics format.
///
/// # Errors
/// Only if there is a defect, because writing to memory cannot fail.
pub fn page(sources: &Arc<MetricsSources>) -> Result<String, fmt::Error> {
    let mut registry = Registry::default();
    registry.register_collector(Box::new(MetricsCollector(Arc::clone(sources))));
    let mut text = String::new();
    text::encode(&mut text, &registry)?;
    Ok(text)
}

struct MetricsCollector(Arc<MetricsSources>);

impl fmt::Debug for MetricsCollector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("MetricsCollector")
    }
}

impl Collector for MetricsCollector {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> EncodeResult {
        let mut page = Page(encoder);
        let labels = [("version", env!("CARGO_PKG_VERSION")), ("commit", env!("PERTURB_COMMIT"))];
        page.gauges("perturb_build_info", "1, with the version and the commit that were built", [(labels, 1.0)])?;
        self.capacity(&mut page)?;
        self.requests(&mut page)?;
        self.environments(&mut page)?;
        self.transport(&mut page)?;
        self.tokens(&mut page)?;
        resources(&mut page)
    }
}

impl MetricsCollector {
    /// Writes the amounts of resources in use, and their limits.
    fn capacity(&self, page: &mut Page<'_>) -> EncodeResult {
        let MetricsSources { pool, sessions, leases, connections, budget, ledger, .. } = &*self.0;
        if let Some(status) = ledger.as_ref().map(Ledger::status) {
            let help = "1 if the ledger's file is intact; if 0, requests that draw parameters are refused";
            page.gauges("perturb_ledger_intact", help, [(NO_LABELS, f64::from(status.is_intact()))])?;
            page.gauges("perturb_ledger_bytes", "Length of the ledger", [(NO_LABELS, status.bytes() as f64)])?;
        }
        for (name, help, value) in [
            ("perturb_sessions", "Sessions now", sessions.in_use()),
            ("perturb_sessions_limit", "Maximum number of sessions", sessions.limit()),
            ("perturb_sessions_detached", "Sessions now that have a lease and no stream", leases.detached()),
            ("perturb_connections", "Connections now", connections.in_use()),
            ("perturb_environments", "Environments now", pool.environments()),
            ("perturb_environments_limit", "Maximum number of environments", pool.limit()),
            ("perturb_in_flight_bytes", "Bytes in flight now", budget.used()),
            ("perturb_in_flight_bytes_limit", "Maximum number of bytes in flight", budget.limit()),
        ] {
            page.gauges(name, help, [(NO_LABELS, value as f64)])?;
        }
        let resumed = [(NO_LABELS, leases.resumed() as f64)];
        page.counters("perturb_sessions_resumed", "Times that another stream resumed a session", resumed)
    }

    fn requests(&self, page: &mut Page<'_>) -> EncodeResult {
        let MetricsSources { requests, errors, access, .. } = &*self.0;
        let each = requests.iter().flat_map(|(protocol, counts)| {
            counts.iter().flat_map(move |(kind, count)| {
                let refused = count.refused.load(Ordering::Relaxed);
                let done = count.answered.load(Ordering::Relaxed).saturating_sub(refused);
                let labels = move |outcome| [("protocol", *protocol), ("kind", *kind), ("outcome", outcome)];
                [(labels("done"), done as f64), (labels("refused"), refused as f64)]
            })
        });
        page.counters("perturb_requests", "Answered requests of sessions", each)?;
        let named: Vec<_> = errors.counts().map(|(kind, n)| (code_name(kind.code()), kind.reason(), n)).collect();
        let each = named.iter().map(|(code, reason, n)| ([("code", code.as_str()), ("reason", reason)], *n as f64));
        page.counters("perturb_refusals", "Requests, calls and sessions that were refused or ended, by reason", each)?;
        let endings = access.endings();
        let each = endings.iter().map(|((of, how), count)| ([("protocol", *of), ("ending", *how)], *count as f64));
        page.counters("perturb_sessions_ended", "Sessions that ended", each)
    }

    fn environments(&self, page: &mut Page<'_>) -> EncodeResult {
        let meters = self.0.pool.meters();
        let name = |name: &'static str| [("environment", name)];
        let each = meters.iter().map(|(of, meter)| (name(of), meter.steps.load(Ordering::Relaxed) as f64));
        page.counters("perturb_steps", "Steps of an environment", each)?;
        let each = meters.iter().map(|(of, meter)| (name(of), meter.episodes.load(Ordering::Relaxed) as f64));
        page.counters("perturb_episodes", "Episodes that ended", each)?;
        let each = meters.iter().flat_map(|(name, meter)| {
            let used = meter.classes().filter(|(_, times)| times.counts().iter().any(|(_, count)| *count > 0));
            used.map(move |(class, times)| ([("environment", *name), ("batch", class)], times))
        });
        let help = "Time of a step request from its validation to its reply, by batch size";
        page.histograms("perturb_step_seconds", help, each)?;
        let MetricsSources { pool, pictures, .. } = &*self.0;
        let help = "Time that a batch waits in the queue until a worker takes a part of it";
        page.histograms("perturb_queue_wait_seconds", help, [(NO_LABELS, pool.waits())])?;
        page.histograms("perturb_picture_seconds", "Time to draw a picture", [(NO_LABELS, &**pictures)])
    }

    fn transport(&self, page: &mut Page<'_>) -> EncodeResult {
        let names: Vec<String> = (0..self.0.threads.len()).map(|place| place.to_string()).collect();
        let threads = || names.iter().zip(&self.0.threads).map(|(name, thread)| ([("thread", name.as_str())], thread));
        let each = threads().map(|(name, thread)| (name, thread.load.connections() as f64));
        page.gauges("perturb_transport_connections", "Connections of a transport thread now", each)?;
        let help = "Delay with which a transport thread wakes up; 1 to 2 ms are caused by the timer";
        page.histograms("perturb_transport_lag_seconds", help, threads().map(|(name, thread)| (name, &thread.lag)))
    }

    fn tokens(&self, page: &mut Page<'_>) -> EncodeResult {
        let tokens = self.0.tokens.as_ref().map(|tokens| tokens.usage()).unwrap_or_default();
        let each = |number: fn(&crate::server::auth::TokenUsage) -> f64| {
            tokens.iter().map(move |used| ([("token", used.name.as_str())], number(used)))
        };
        page.gauges("perturb_token_sessions", "Sessions of a token now", each(|used| used.sessions as f64))?;
        page.gauges("perturb_token_environments", "Environments of a token now", each(|used| used.envs as f64))?;
        page.gauges("perturb_token_in_flight_bytes", "Bytes of a token in flight now", each(|used| used.bytes as f64))?;
        let help = "Time that requests of a token waited for its rate limit";
        page.counters("perturb_token_wait_seconds", help, each(|used| used.waited.as_secs_f64()))?;
        page.counters("perturb_token_steps", "Steps of a token's environments", each(|used| used.steps as f64))?;
        page.counters(
            "perturb_token_refusals",
            "Refused requests and sessions of a token",
            each(|used| used.refusals as f64),
        )
    }
}

/// Writes the resources of the process, if the operating system reports them.
fn resources(page: &mut Page<'_>) -> EncodeResult {
    let Ok(resources) = process::resources() else { return Ok(()) };
    page.counters("process_cpu_seconds", "Processor time", [(NO_LABELS, resources.cpu_seconds)])?;
    for (name, help, value) in [
        ("process_resident_memory_bytes", "Memory in use", resources.resident_bytes as f64),
        ("process_start_time_seconds", "Start time of the process, since 1970", resources.start_seconds),
        ("process_threads", "Threads", resources.threads as f64),
        ("process_open_fds", "File descriptors in use", resources.descriptors as f64),
        (
            "process_max_fds",
            "Maximum number of file descriptors",
            resources.max_descriptors.map_or(f64::INFINITY, |n| n as f64),
        ),
    ] {
        page.gauges(name, help, [(NO_LABELS, value)])?;
    }
    Ok(())
}

/// Returns the name of a gRPC code as in gRPC's documentation, e.g. `RESOURCE_EXHAUSTED`.
fn code_name(code: Code) -> String {
    let mut text = String::new();
    for letter in format!("{code:?}").chars() {
        if letter.is_uppercase() && !text.is_empty() {
            text.push('_');
        }
        text.push(letter.to_ascii_uppercase());
    }
    text
}

/// The page that is being written.
struct Page<'a>(DescriptorEncoder<'a>);

impl Page<'_> {
    fn gauges<S: EncodeLabelSet>(
        &mut self,
        name: &str,
        help: &str,
        each: impl IntoIterator<Item = (S, f64)>,
    ) -> EncodeResult {
        self.series(name, help, MetricType::Gauge, each, |mut encoder, value| encoder.encode_gauge(&value))
    }

    /// Writes counters. The encoder adds `_total` to `name`.
    fn counters<S: EncodeLabelSet>(
        &mut self,
        name: &str,
        help: &str,
        each: impl IntoIterator<Item = (S, f64)>,
    ) -> EncodeResult {
        let encode = |mut encoder: MetricEncoder<'_>, value| encoder.encode_counter::<NoLabelSet, _, f64>(&value, None);
        self.series(name, help, MetricType::Counter, each, encode)
    }

    fn histograms<'h, S: EncodeLabelSet>(
        &mut self,
        name: &str,
        help: &str,
        each: impl IntoIterator<Item = (S, &'h Histogram)>,
    ) -> EncodeResult {
        self.series(name, help, MetricType::Histogram, each, |mut encoder, times: &Histogram| {
            let counts = times.counts();
            let all = counts.iter().map(|(_, count)| count).sum();
            encoder.encode_histogram::<NoLabelSet>(times.seconds(), all, &counts, None)
        })
    }

    fn series<S: EncodeLabelSet, V>(
        &mut self,
        name: &str,
        help: &str,
        kind: MetricType,
        each: impl IntoIterator<Item = (S, V)>,
        encode: impl Fn(MetricEncoder<'_>, V) -> EncodeResult,
    ) -> EncodeResult {
        let mut metric = self.0.encode_descriptor(name, help, None, kind)?;
        each.into_iter().try_for_each(|(labels, value)| encode(metric.encode_family(&labels)?, value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_written_as_in_grpcs_documents() {
        assert_eq!(code_name(Code::ResourceExhausted), "RESOURCE_EXHAUSTED");
        assert_eq!(code_name(Code::Ok), "OK");
    }
}
