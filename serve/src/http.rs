//! Requests and answers: pages, events, reports, files; nothing is ever changed.

use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use futures_util::{StreamExt, future};
use perturb_protocol::Address;
use tokio_stream::wrappers::WatchStream;

use crate::load::Asked;
use crate::paths::{Relative, Root};
use crate::report::Reports;
use crate::watch::{Missing, Seen, Topic, Watch};
use crate::{files, pages};
use pages::not_there;

/// How often a stream says something although there is nothing to say: so it is known whether anybody listens.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
/// Pages are made of this program's own files alone, and of pictures of the folder.
const POLICY: &str =
    "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'";
/// A report has its style inside, and no script. A picture may have styles, too.
const INERT: &str = "default-src 'none'; style-src 'unsafe-inline'; img-src 'self' data:; base-uri 'none'; \
                     form-action 'none'; frame-ancestors 'self'";

/// What all requests share.
#[derive(Debug)]
pub(crate) struct Shared {
    root: Root,
    /// Whether only this machine can ask.
    loopback: bool,
    reports: Arc<Reports>,
    pub(crate) watch: Arc<Watch>,
}

impl Shared {
    pub(crate) fn new(root: Root, address: SocketAddr, server: Option<Address>) -> Self {
        let (reports, server) = (Arc::new(Reports::default()), server.map(|address| Arc::new(Asked::at(address))));
        let watch = Arc::new(Watch::new(root.clone(), Arc::clone(&reports), server));
        Self { root, loopback: address.ip().is_loopback(), reports, watch }
    }
}

/// All that can be asked for.
pub(crate) fn router(shared: Arc<Shared>) -> Router {
    Router::new()
        .route("/", get(index))
        .route("/run/", get(run))
        .route("/run/{*path}", get(run))
        .route("/report/", get(report))
        .route("/report/{*path}", get(report))
        .route("/file/{*path}", get(file))
        .route("/events", get(index_events))
        .route("/events/", get(run_events))
        .route("/events/{*path}", get(run_events))
        .route("/assets/{name}", get(asset))
        .fallback(|| async { pages::refusal(StatusCode::NOT_FOUND, "There is no such page.") })
        .layer(from_fn_with_state(Arc::clone(&shared), guard))
        .with_state(shared)
}

/// Refuses what is no question, and what another site may have had a browser ask; says with each answer what browsers may
/// do with it.
async fn guard(State(shared): State<Arc<Shared>>, request: Request, next: Next) -> Response {
    let mut response = if !matches!(*request.method(), Method::GET | Method::HEAD) {
        let mut refusal = pages::refusal(StatusCode::METHOD_NOT_ALLOWED, "This server only shows; it changes nothing.");
        refusal.headers_mut().insert(header::ALLOW, HeaderValue::from_static("GET, HEAD"));
        refusal
    } else if shared.loopback && !is_local(request.headers(), request.uri()) {
        let words = "This server answers to localhost, 127.0.0.1 and [::1] alone: ask for it by one of these names.";
        pages::refusal(StatusCode::MISDIRECTED_REQUEST, words)
    } else if is_of_another_site(request.headers()) {
        let words = "A page of another site has asked for this; open it by its address, or by a link.";
        pages::refusal(StatusCode::FORBIDDEN, words)
    } else {
        next.run(request).await
    };
    let always = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-cache"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ];
    let headers = response.headers_mut();
    headers.extend(always.map(|(name, value)| (name, HeaderValue::from_static(value))));
    headers.entry(header::CONTENT_SECURITY_POLICY).or_insert(HeaderValue::from_static(POLICY));
    response
}

/// Whether a browser asks because a page of another site has a picture, a frame or a script from here: that page would see
/// nothing, but have files read all the time. A link is followed, whoever has it.
fn is_of_another_site(headers: &HeaderMap) -> bool {
    let said = |name: &str| headers.get(name).and_then(|value| value.to_str().ok());
    let link = said("sec-fetch-mode") == Some("navigate") && said("sec-fetch-dest") == Some("document");
    matches!(said("sec-fetch-site"), Some("cross-site" | "same-site")) && !link
}

/// Whether a browser asked for a name of this machine. Another name may lead here, too, whoever has it: so a page of
/// theirs would be of the same origin.
fn is_local(headers: &HeaderMap, uri: &Uri) -> bool {
    let host =
        headers.get(header::HOST).and_then(|host| host.to_str().ok()).or(uri.authority().map(|host| host.as_str()));
    let Some(host) = host else { return false };
    let name = match host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((name, port)) if port.is_empty() || port.starts_with(':') => name,
        Some(_) => return false,
        None => host.split_once(':').map_or(host, |(name, _)| name),
    };
    name.eq_ignore_ascii_case("localhost") || name.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

async fn index(State(shared): State<Arc<Shared>>) -> Response {
    match shared.watch.see(&Topic::Index).await {
        Ok(shown) => page(pages::index::page(&shared.root, &shown.update)),
        Err(missing) => not_there(&missing),
    }
}

async fn run(State(shared): State<Arc<Shared>>, uri: Uri) -> Response {
    let Some(relative) = named(&uri, "/run/") else { return not_there(&Missing::NoRun) };
    match shared.watch.see(&Topic::Run(relative.clone())).await {
        Ok(shown) => page(pages::run_page(&shared.root, &relative, &shown.update)),
        Err(missing) => not_there(&missing),
    }
}

async fn index_events(State(shared): State<Arc<Shared>>) -> Response {
    events(&shared, Topic::Index)
}

async fn run_events(State(shared): State<Arc<Shared>>, uri: Uri) -> Response {
    match named(&uri, "/events/") {
        Some(relative) => events(&shared, Topic::Run(relative)),
        None => not_there(&Missing::NoRun),
    }
}

/// What is seen, whenever it is something else.
fn events(shared: &Shared, topic: Topic) -> Response {
    let Some(seen) = shared.watch.subscribe(topic) else {
        return pages::refusal(StatusCode::SERVICE_UNAVAILABLE, "Too many pages are open already; close some.");
    };
    let seen = WatchStream::new(seen).filter(|seen: &Seen| future::ready(!seen.is_empty()));
    let events = seen.map(|seen| Ok::<_, Infallible>(Event::default().data(seen)));
    Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)).into_response()
}

async fn report(State(shared): State<Arc<Shared>>, uri: Uri) -> Response {
    let Some(relative) = named(&uri, "/report/") else { return not_there(&Missing::NoRun) };
    // What the page says about the state is what the report is of.
    let reported = match shared.watch.see(&Topic::Run(relative)).await {
        Ok(shown) => shown.update.reported.clone(),
        Err(missing) => return not_there(&missing),
    };
    let Some(pages::Reported { folder, state }) = reported else { return not_there(&Missing::NoRun) };
    let page = match folder {
        Ok(folder) => shared.reports.page(&folder, state).await,
        Err(reason) => Err(reason),
    };
    let mut response = match page {
        Ok(page) => Html(page.to_string()).into_response(),
        Err(reason) => Html(pages::no_report(&reason)).into_response(),
    };
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(INERT));
    response
}

async fn file(State(shared): State<Arc<Shared>>, uri: Uri, headers: HeaderMap) -> Response {
    let sent = match named(&uri, "/file/") {
        Some(relative) => files::send(shared.root.clone(), relative, &headers).await,
        None => None,
    };
    let Some(mut response) = sent else { return pages::refusal(StatusCode::NOT_FOUND, "There is no such file.") };
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(INERT));
    response
}

async fn asset(uri: Uri) -> Response {
    match uri.path().strip_prefix("/assets/").and_then(pages::asset) {
        Some((kind, content)) => ([(header::CONTENT_TYPE, kind)], content).into_response(),
        None => pages::refusal(StatusCode::NOT_FOUND, "There is no such file."),
    }
}

/// What the address names behind `prefix`, as it was written.
fn named(uri: &Uri, prefix: &str) -> Option<Relative> {
    Relative::decode(uri.path().strip_prefix(prefix)?)
}

fn page(text: String) -> Response {
    Html(text).into_response()
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
    #[case("", false)]
    fn names_of_this_machine(#[case] host: &str, #[case] local: bool) {
        let headers = HeaderMap::from_iter([(header::HOST, host.parse().unwrap())]);
        assert_eq!(is_local(&headers, &Uri::from_static("/")), local);
    }

    #[rstest]
    #[case(&[], false)]
    #[case(&[("sec-fetch-site", "same-origin"), ("sec-fetch-mode", "no-cors"), ("sec-fetch-dest", "image")], false)]
    #[case(&[("sec-fetch-site", "none"), ("sec-fetch-mode", "navigate"), ("sec-fetch-dest", "document")], false)]
    #[case(&[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "navigate"), ("sec-fetch-dest", "document")], false)]
    #[case(&[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "no-cors"), ("sec-fetch-dest", "image")], true)]
    #[case(&[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "navigate"), ("sec-fetch-dest", "iframe")], true)]
    #[case(&[("sec-fetch-site", "same-site"), ("sec-fetch-mode", "cors"), ("sec-fetch-dest", "empty")], true)]
    fn pages_of_other_sites_have_links_and_nothing_else(#[case] said: &[(&'static str, &str)], #[case] refused: bool) {
        let said = said.iter().map(|(name, value)| (HeaderName::from_static(name), value.parse().unwrap()));
        assert_eq!(is_of_another_site(&HeaderMap::from_iter(said)), refused);
    }

    #[test]
    fn who_names_nobody_is_no_browser_of_this_machine() {
        assert!(!is_local(&HeaderMap::new(), &Uri::from_static("/")));
    }
}
