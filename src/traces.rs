//! Traces for OpenTelemetry. The span of each request, with its log lines, is sent to a collector. Requires a build
//! with the feature `otel`, and the address of the collector in the environment variable `OTEL_EXPORTER_OTLP_ENDPOINT`.

use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::SpanExporter;
use opentelemetry_sdk::{Resource, trace::SdkTracerProvider};
use std::{
    error::Error,
    io::{self, IsTerminal},
    thread,
};
use tokio::{runtime::Builder, sync::oneshot};
use tracing::{Level, Subscriber};
use tracing_subscriber::{
    Layer, filter::Targets, fmt, layer::SubscriberExt, registry::LookupSpan, util::SubscriberInitExt,
};

/// The environment variable that contains the address of the collector.
pub const ENDPOINT: &str = "OTEL_EXPORTER_OTLP_ENDPOINT";
/// The name of this service at the collector, unless `OTEL_SERVICE_NAME` is set.
const SERVICE: &str = "perturb-server";
const SERVICE_VARIABLE: &str = "OTEL_SERVICE_NAME";

/// The sender of spans to the collector. When it is dropped, it sends all spans that are left.
pub struct Traces {
    provider: SdkTracerProvider,
    _end: oneshot::Sender<()>,
}

impl Drop for Traces {
    fn drop(&mut self) {
        if let Err(error) = self.provider.shutdown() {
            tracing::debug!(%error, "the last traces were not sent");
        }
    }
}

/// Starts the log on standard error, filtered by `filter`. If a collector is configured, also starts a thread that
/// sends spans, and returns its handle.
///
/// # Errors
/// If OpenTelemetry's environment variables are invalid, or the operating system cannot start a thread.
pub fn init(filter: Targets) -> Result<Option<Traces>, Box<dyn Error>> {
    let (traces, spans) = start()?.unzip();
    let lines = fmt::layer().with_writer(io::stderr).with_ansi(io::stderr().is_terminal()).with_filter(filter);
    tracing_subscriber::registry().with(lines).with(spans).try_init()?;
    Ok(traces)
}

/// Makes a tracing layer that sends spans to the collector. Returns `None` if no collector is configured.
fn start<S>() -> Result<Option<(Traces, impl Layer<S>)>, Box<dyn Error>>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
{
    if std::env::var_os(ENDPOINT).is_none() {
        return Ok(None);
    }
    // Spans are sent on a thread of their own, not on the transport thread.
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let exporter = runtime.block_on(async { SpanExporter::builder().with_tonic().build() })?;
    let (end, ended) = oneshot::channel::<()>();
    thread::Builder::new().name("traces".into()).spawn(move || runtime.block_on(ended))?;
    let name = std::env::var(SERVICE_VARIABLE).unwrap_or_else(|_| SERVICE.into());
    let resource = Resource::builder().with_service_name(name).build();
    let provider = SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource).build();
    let spans = Targets::new().with_target("perturb", Level::DEBUG);
    let layer = tracing_opentelemetry::layer().with_tracer(provider.tracer(SERVICE)).with_filter(spans);
    Ok(Some((Traces { provider, _end: end }, layer)))
}
