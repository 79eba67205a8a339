//! Routes and responses: pages, events, reports and files. No request changes anything.

use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{Html, IntoResponse, Redirect, Response};
use axum::routing::get;
use axum::{Extension, Router};
use futures_util::{StreamExt, future};
use perturb_protocol::Address;
use tokio_stream::wrappers::WatchStream;

use crate::connections::ClientAddress;
use crate::error::ViewError;
use crate::links::RelativeRoot;
use crate::paths::{RelativePath, Root};
use crate::publisher::{EventData, Publisher, Topic};
use crate::report::ReportCache;
use crate::server_status::ServerMonitor;
use crate::stream_places::StreamPlaces;
use crate::{files, pages};
use pages::{MessagePage, error_page};

/// Time between two comment lines that are sent on an event stream without events. A failed send shows that the client
/// is no longer connected.
const KEEP_ALIVE_INTERVAL: Duration = Duration::from_secs(15);
/// Content security policy of pages. It permits scripts, styles, pictures, films and frames only from this server.
const PAGE_POLICY: &str =
    "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'";
/// Content security policy of reports and files. It permits inline styles and embedded pictures, but no scripts.
const STATIC_POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; img-src 'self' data:; base-uri 'none'; \
                     form-action 'none'; frame-ancestors 'self'";

/// The state that all requests share.
#[derive(Debug)]
pub(crate) struct AppState {
    root: Root,
    stream_places: StreamPlaces,
    /// Whether the server listens on the loopback address.
    is_loopback: bool,
    /// Host names that requests may state in addition to localhost.
    hosts: Vec<String>,
    reports: Arc<ReportCache>,
    pub(crate) publisher: Arc<Publisher>,
}

impl AppState {
    pub(crate) fn new(root: Root, address: SocketAddr, hosts: Vec<String>, server: Option<Address>) -> Self {
        let reports = Arc::new(ReportCache::default());
        let server = server.map(|address| Arc::new(ServerMonitor::new(address)));
        let publisher = Arc::new(Publisher::new(root.clone(), Arc::clone(&reports), server));
        let stream_places = StreamPlaces::default();
        Self { root, stream_places, is_loopback: address.ip().is_loopback(), hosts, reports, publisher }
    }
}

/// Returns the routes of all pages.
pub(crate) fn router(state: Arc<AppState>) -> Router {
    Router::new()
        .route("/", get(index))
        .route("/run/", get(run))
        .route("/run/{*path}", get(run))
        .route("/curves", get(curves))
        .route("/report/", get(report))
        .route("/report/{*path}", get(report))
        .route("/file/{*path}", get(file))
        .route("/events", get(index_events))
        .route("/events/", get(run_events))
        .route("/events/{*path}", get(run_events))
        .route("/assets/{name}", get(asset))
        .fallback(|| async { pages::message_page(StatusCode::NOT_FOUND, "There is no such page.") })
        .layer(from_fn_with_state(Arc::clone(&state), guard))
        .with_state(state)
}

/// Refuses methods other than GET and HEAD, and requests by which a page of another site embeds something. If the
/// server listens on the loopback address, also refuses unknown host names. Makes the links of message pages relative,
/// and adds the security headers to each response.
async fn guard(State(state): State<Arc<AppState>>, request: Request, next: Next) -> Response {
    let relative_root = RelativeRoot::from_path(request.uri().path());
    let mut response = if !matches!(*request.method(), Method::GET | Method::HEAD) {
        let mut response =
            pages::message_page(StatusCode::METHOD_NOT_ALLOWED, "This server is read-only; use GET or HEAD.");
        response.headers_mut().insert(header::ALLOW, HeaderValue::from_static("GET, HEAD"));
        response
    } else if state.is_loopback && !is_known_host(request.headers(), request.uri(), &state.hosts) {
        let message = "This server answers to localhost, 127.0.0.1 and [::1] only. Use one of these names in the \
                       address, or start it with --host NAME.";
        pages::message_page(StatusCode::MISDIRECTED_REQUEST, message)
    } else if is_embedded_by_another_site(request.headers()) {
        let message = "A page of another site has requested this. Open it by its address or by a link.";
        pages::message_page(StatusCode::FORBIDDEN, message)
    } else {
        next.run(request).await
    };
    if let Some(MessagePage(text)) = response.extensions_mut().remove() {
        response =
            (response.status(), response.headers().clone(), Html(relative_root.relative_links(&text))).into_response();
    }
    let security_headers = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-cache"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ];
    let headers = response.headers_mut();
    headers.extend(security_headers.map(|(name, value)| (name, HeaderValue::from_static(value))));
    headers.entry(header::CONTENT_SECURITY_POLICY).or_insert(HeaderValue::from_static(PAGE_POLICY));
    response
}

/// Tells whether a page of another site embeds or fetches something from this server, e.g. a picture, frame or script.
/// Such a page could not read the response, but could make the server read files all the time. Links from other sites
/// are permitted.
fn is_embedded_by_another_site(headers: &HeaderMap) -> bool {
    let header_text = |name: &str| headers.get(name).and_then(|value| value.to_str().ok());
    let is_link =
        header_text("sec-fetch-mode") == Some("navigate") && header_text("sec-fetch-dest") == Some("document");
    matches!(header_text("sec-fetch-site"), Some("cross-site" | "same-site")) && !is_link
}

/// Tells whether a request states `localhost`, a loopback address, or one of `hosts` as its host. All other names are
/// refused, because another site could make its own host name resolve to this server (DNS rebinding). Pages of that
/// site would then have the same origin as this server's pages.
fn is_known_host(headers: &HeaderMap, uri: &Uri, hosts: &[String]) -> bool {
    let host =
        headers.get(header::HOST).and_then(|host| host.to_str().ok()).or(uri.authority().map(|host| host.as_str()));
    let Some(host) = host else { return false };
    let name = match host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((name, port)) if port.is_empty() || port.starts_with(':') => name,
        Some(_) => return false,
        None => host.split_once(':').map_or(host, |(name, _)| name),
    };
    let is_named = hosts.iter().any(|host| name.eq_ignore_ascii_case(host));
    is_named
        || name.eq_ignore_ascii_case("localhost")
        || name.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

async fn index(State(state): State<Arc<AppState>>) -> Response {
    match state.publisher.view(&Topic::Index).await {
        Ok(view) => page(&pages::index::page(&state.root, &view.update), &RelativeRoot::from_index()),
        Err(error) => error_page(&error),
    }
}

async fn run(State(state): State<Arc<AppState>>, uri: Uri) -> Response {
    let Some(relative) = relative_path(&uri, "/run/") else { return error_page(&ViewError::RunNotFound) };
    if let Some(name) = relative.path().file_name().filter(|_| uri.path().ends_with('/')) {
        // Each page has only one address, without a slash at its end, because relative links depend on the slashes.
        return Redirect::permanent(&format!("../{}", RelativePath::default().join(name).encode())).into_response();
    }
    match state.publisher.view(&Topic::Run(relative.clone())).await {
        Ok(view) => page(&pages::run_page(&state.root, &relative, &view.update), &RelativeRoot::from_run(&relative)),
        Err(error) => error_page(&error),
    }
}

async fn curves(State(state): State<Arc<AppState>>, uri: Uri) -> Response {
    let Some(chosen) = chosen_trainings(&uri) else { return error_page(&ViewError::RunNotFound) };
    page(&pages::curves::page(&state.root, &chosen), &RelativeRoot::from_index())
}

/// Streams the events of the list of all runs. If the query names trainings, streams the events of their curves
/// instead.
async fn index_events(
    State(state): State<Arc<AppState>>,
    Extension(peer): Extension<ClientAddress>,
    uri: Uri,
) -> Response {
    match (uri.query(), chosen_trainings(&uri)) {
        (None, _) => events(&state, Topic::Index, peer),
        (_, Some(chosen)) => events(&state, Topic::Curves(chosen), peer),
        (_, None) => error_page(&ViewError::RunNotFound),
    }
}

async fn run_events(
    State(state): State<Arc<AppState>>,
    Extension(peer): Extension<ClientAddress>,
    uri: Uri,
) -> Response {
    match relative_path(&uri, "/events/") {
        Some(relative) => events(&state, Topic::Run(relative), peer),
        None => error_page(&ViewError::RunNotFound),
    }
}

/// Returns a stream of server-sent events with the changes of a page.
fn events(state: &AppState, topic: Topic, ClientAddress(peer): ClientAddress) -> Response {
    let Some(place) = state.stream_places.take(peer) else {
        let message = "Too many pages are open already; close some.";
        let mut response = pages::message_page(StatusCode::SERVICE_UNAVAILABLE, message);
        // Closes the connection. The client will try again later, and must not occupy a connection until then.
        response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
        return response;
    };
    let events = WatchStream::new(state.publisher.subscribe(topic));
    let events = events.filter(|event: &EventData| future::ready(!event.is_empty()));
    let events = events.map(move |event| {
        let _place = &place; // keeps the place until the stream ends
        Ok::<_, Infallible>(Event::default().data(event))
    });
    Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE_INTERVAL)).into_response()
}

async fn report(State(state): State<Arc<AppState>>, uri: Uri) -> Response {
    let Some(relative) = relative_path(&uri, "/report/") else { return error_page(&ViewError::RunNotFound) };
    // The page of the run has the folder and the fingerprint of the report's files.
    let source = match state.publisher.view(&Topic::Run(relative)).await {
        Ok(view) => view.update.report_source.clone(),
        Err(error) => return error_page(&error),
    };
    let Some(pages::ReportSource { folder, fingerprint }) = source else { return error_page(&ViewError::RunNotFound) };
    let page = match folder {
        Ok(folder) => state.reports.page(&folder, fingerprint).await,
        Err(reason) => Err(reason),
    };
    let mut response = match page {
        Ok(page) => Html(page.to_string()).into_response(),
        Err(reason) => Html(pages::no_report(&reason)).into_response(),
    };
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(STATIC_POLICY));
    response
}

async fn file(State(state): State<Arc<AppState>>, uri: Uri, headers: HeaderMap) -> Response {
    let sent = match relative_path(&uri, "/file/") {
        Some(relative) => files::send(state.root.clone(), relative, &headers).await,
        None => None,
    };
    let Some(mut response) = sent else { return pages::message_page(StatusCode::NOT_FOUND, "There is no such file.") };
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(STATIC_POLICY));
    response
}

async fn asset(uri: Uri) -> Response {
    match uri.path().strip_prefix("/assets/").and_then(pages::asset) {
        Some((kind, content)) => ([(header::CONTENT_TYPE, kind)], content).into_response(),
        None => pages::message_page(StatusCode::NOT_FOUND, "There is no such file."),
    }
}

/// Returns the path of a run or file, which follows `prefix` in the address.
fn relative_path(uri: &Uri, prefix: &str) -> Option<RelativePath> {
    RelativePath::decode(uri.path().strip_prefix(prefix)?)
}

/// Returns the trainings that a query names, as in `runs=a,b/c`. Returns at most [`pages::curves::MAX_TRAININGS`] of
/// them.
fn chosen_trainings(uri: &Uri) -> Option<Vec<RelativePath>> {
    let names = uri.query()?.strip_prefix("runs=")?;
    names.split(',').take(pages::curves::MAX_TRAININGS).map(RelativePath::decode).collect()
}

fn page(text: &str, relative_root: &RelativeRoot) -> Response {
    Html(relative_root.relative_links(text)).into_response()
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case("localhost", true)]
    #[case("LOCALHOST:8420", true)]
    #[case("127.0.0.1:8420", true)]
    #[case("127.1.2.3", true)]
    #[case("[::1]:8420", true)]
    #[case("[::1]", true)]
    #[case("localhost.example.org", false)]
    #[case("127.0.0.1.example.org:8420", false)]
    #[case("192.168.0.1", false)]
    #[case("[::1].example.org", false)]
    #[case("example.org", false)]
    #[case("hub.example.org:443", true)]
    #[case("HUB.example.org", true)]
    #[case("other.hub.example.org", false)]
    #[case("", false)]
    fn names_of_this_machine(#[case] host: &str, #[case] local: bool) {
        let headers = HeaderMap::from_iter([(header::HOST, host.parse().unwrap())]);
        let hosts = ["hub.example.org".to_owned()];
        assert_eq!(is_known_host(&headers, &Uri::from_static("/"), &hosts), local);
    }

    #[rstest]
    #[case(&[], false)]
    #[case(&[("sec-fetch-site", "same-origin"), ("sec-fetch-mode", "no-cors"), ("sec-fetch-dest", "image")], false)]
    #[case(&[("sec-fetch-site", "none"), ("sec-fetch-mode", "navigate"), ("sec-fetch-dest", "document")], false)]
    #[case(&[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "navigate"), ("sec-fetch-dest", "document")], false)]
    #[case(&[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "no-cors"), ("sec-fetch-dest", "image")], true)]
    #[case(&[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "navigate"), ("sec-fetch-dest", "iframe")], true)]
    #[case(&[("sec-fetch-site", "same-site"), ("sec-fetch-mode", "cors"), ("sec-fetch-dest", "empty")], true)]
    fn pages_of_other_sites_may_only_link(#[case] headers: &[(&'static str, &str)], #[case] refused: bool) {
        let headers = headers.iter().map(|(name, value)| (HeaderName::from_static(name), value.parse().unwrap()));
        assert_eq!(is_embedded_by_another_site(&HeaderMap::from_iter(headers)), refused);
    }

    #[test]
    fn a_request_without_a_host_is_not_local() {
        assert!(!is_known_host(&HeaderMap::new(), &Uri::from_static("/"), &[]));
    }
}
