//! Traces for OpenTelemetry: each request's span, with its log lines, is sent to a collector. Needs a build with the
//! feature `otel`, and the variable `OTEL_EXPORTER_OTLP_ENDPOINT` with the collector's address.

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

/// OpenTelemetry's variable with the address of the collector.
pub const ENDPOINT: &str = "OTEL_EXPORTER_OTLP_ENDPOINT";
/// The server's name at the collector, if `OTEL_SERVICE_NAME` is not set.
const SERVICE: &str = "perturb-server";
const SERVICE_VARIABLE: &str = "OTEL_SERVICE_NAME";

/// Sends spans. When it is dropped, sends the remaining ones.
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

/// Starts the log on standard error with this filter, and if a collector is named, a thread that sends spans.
///
/// # Errors
/// If the variables are wrong, or the system starts no thread.
pub fn init(filter: Targets) -> Result<Option<Traces>, Box<dyn Error>> {
    let (traces, spans) = start()?.unzip();
    let lines = fmt::layer().with_writer(io::stderr).with_ansi(io::stderr().is_terminal()).with_filter(filter);
    tracing_subscriber::registry().with(lines).with(spans).try_init()?;
    Ok(traces)
}

/// Returns a layer whose spans are sent; `None` if no collector is named.
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
