//! Requests that the web server must refuse, the security headers of responses, and requests for parts of files.

use std::os::unix::fs::symlink;

use rstest::rstest;

use crate::client::{Place, write};

#[rstest]
#[case("/file/../outside.csv")]
#[case("/file/one/../../outside.csv")]
#[case("/file/%2e%2e/outside.csv")]
#[case("/file/%2E%2E%2Foutside.csv")]
#[case("/file/..%2foutside.csv")]
#[case("/file/one/%2e%2e/%2e%2e/outside.csv")]
#[case("/file/%252e%252e/outside.csv")]
#[case("/file/..%5coutside.csv")]
#[case("/file//etc/passwd")]
#[case("/file/%2fetc%2fpasswd")]
#[case("/file/one/monitor.csv%00")]
#[case("/file/one/monitor.csv%00.svg")]
#[case("/file/link.csv")]
#[case("/file/up/outside.csv")]
#[case("/file/.secret.csv")]
#[case("/file/hidden/secret.csv")]
#[case("/file/one/checkpoint.json")]
#[case("/file/notes.txt")]
#[case("/file/page.html")]
#[case("/file/folder.csv")]
#[case("/file/pipe.csv")]
#[case("/file/")]
#[case("/run/../")]
#[case("/run/up")]
#[case("/run/one/..")]
#[case("/run/missing")]
#[case("/events/%2e%2e/runs")]
#[case("/report/one")]
#[case("/report/../study")]
#[case("/assets/../Cargo.toml")]
#[case("/assets/%2e%2e")]
#[case("/nothing")]
fn paths_outside_and_unknown_kinds_are_not_found(#[case] path: &str) {
    let place = Place::new();
    symlink(place.path("../outside.csv"), place.path("link.csv")).unwrap();
    symlink(place.path(".."), place.path("up")).unwrap();
    for name in [".secret.csv", ".git/secret.csv", "one/checkpoint.json", "notes.txt", "page.html", "folder.csv/a"] {
        write(&place.path(name), "secret");
    }
    symlink(place.path(".git"), place.path("hidden")).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(place.path("pipe.csv")).status().unwrap().success());
    let answer = place.get(path);
    assert!(!answer.body.contains("secret") && !answer.body.contains("root:"), "{path}: {}", answer.body);
    assert_eq!(answer.status, 404, "{path}: {}", answer.body);
}

#[rstest]
#[case("POST", "/")]
#[case("PUT", "/file/one/monitor.csv")]
#[case("DELETE", "/run/one")]
#[case("PATCH", "/run/one")]
#[case("OPTIONS", "/")]
#[case("TRACE", "/")]
fn methods_other_than_get_and_head_are_refused(#[case] method: &str, #[case] path: &str) {
    let place = Place::new();
    let answer = place.ask(method, path, "localhost");
    assert!(answer.status == 405 && answer.head.contains("allow: get, head"), "{}", answer.head);
    assert!(place.path("one/monitor.csv").exists());
}

#[test]
fn foreign_host_names_are_refused() {
    let place = Place::new();
    for (host, status) in [("localhost:1234", 200), ("127.0.0.1", 200), ("[::1]:8420", 200), ("evil.example:8420", 421)]
    {
        for path in ["/", "/run/one", "/file/one/monitor.csv", "/assets/app.js"] {
            assert_eq!(place.ask("HEAD", path, host).status, status, "{host} {path}");
        }
    }
    assert_eq!(place.ask("GET", "/events", "evil.example").status, 421);
    let nobody = place.send("GET / HTTP/1.0\r\n\r\n");
    assert_eq!(nobody.status, 421);
}

#[test]
fn embedding_by_another_site_is_refused() {
    let place = Place::new();
    let ask = |site: &str, mode: &str, dest: &str, path: &str| {
        let said = format!("Sec-Fetch-Site: {site}\r\nSec-Fetch-Mode: {mode}\r\nSec-Fetch-Dest: {dest}");
        place.send(&format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n{said}\r\nConnection: close\r\n\r\n")).status
    };
    for path in ["/", "/run/one", "/report/study", "/file/one/monitor.csv", "/events"] {
        assert_eq!(ask("cross-site", "no-cors", "image", path), 403, "{path}");
    }
    assert_eq!(ask("cross-site", "navigate", "document", "/run/one"), 200, "a link");
    assert_eq!(ask("same-origin", "no-cors", "image", "/file/one/monitor.csv"), 200);
}

#[test]
fn every_response_has_security_headers() {
    let place = Place::new();
    for path in ["/", "/run/one", "/run/study", "/report/study", "/file/pictures/over%20%3Cb%3E.svg", "/nothing"] {
        let answer = place.get(path);
        let policy = answer.head.lines().find_map(|line| line.strip_prefix("content-security-policy: ")).unwrap();
        assert!(policy.starts_with("default-src 'self';") || policy.starts_with("default-src 'none';"), "{policy}");
        assert!(policy.contains("frame-ancestors 'self'") && !policy.contains("http"), "{policy}");
        let scripts = policy.starts_with("default-src 'self'");
        assert_eq!(scripts, !path.starts_with("/report") && !path.starts_with("/file"), "{path}: {policy}");
        for header in ["x-content-type-options: nosniff", "cross-origin-resource-policy: same-origin"] {
            assert!(answer.head.contains(header), "{path}: {}", answer.head);
        }
        // Pages have no inline scripts and load nothing from other hosts.
        let elsewhere = ["<script>", "onclick", "src=\"http", "href=\"http"];
        assert!(!elsewhere.iter().any(|words| answer.body.contains(words)), "{path}: {}", answer.body);
    }
}

#[test]
fn files_support_ranges_and_entity_tags() {
    let place = Place::new();
    write(&place.path("film.mp4"), "0123456789");
    let answer = place.get("/file/film.mp4");
    assert_eq!((answer.status, answer.body.as_str()), (200, "0123456789"));
    assert!(answer.head.contains("content-type: video/mp4") && answer.head.contains("accept-ranges: bytes"));
    let part = |range: &str| {
        let head = format!(
            "GET /file/film.mp4 HTTP/1.1\r\nHost: localhost\r\nRange: bytes={range}\r\nConnection: close\r\n\r\n"
        );
        place.send(&head)
    };
    let answer = part("2-4");
    assert_eq!((answer.status, answer.body.as_str()), (206, "234"));
    assert!(answer.head.contains("content-range: bytes 2-4/10") && answer.head.contains("content-length: 3"));
    assert_eq!((part("-2").body.as_str(), part("8-").body.as_str(), part("10-").status), ("89", "89", 416));
    let tag = answer_tag(&place.get("/file/film.mp4").head);
    let with = |said: &str| {
        place
            .send(&format!("GET /file/film.mp4?v=1 HTTP/1.1\r\nHost: localhost\r\n{said}\r\nConnection: close\r\n\r\n"))
    };
    assert_eq!(with(&format!("If-None-Match: \"x\", {tag}")).status, 304);
    assert_eq!(with(&format!("Range: bytes=2-4\r\nIf-Range: {tag}")).body, "234");
    write(&place.path("film.mp4"), "another film");
    assert_eq!(with(&format!("If-None-Match: {tag}")).body, "another film");
    assert_eq!(with(&format!("Range: bytes=2-4\r\nIf-Range: {tag}")).status, 200, "the tag is of another file");
    let head = place.ask("HEAD", "/file/film.mp4", "localhost");
    assert_eq!((head.status, head.body.as_str()), (200, ""));
}

fn answer_tag(head: &str) -> String {
    head.lines().find_map(|line| line.strip_prefix("etag: ")).expect("a tag").to_owned()
}

#[test]
fn at_most_32_event_streams_of_a_client_are_open() {
    let place = Place::new();
    let mut all: Vec<_> = (0..32).map(|_| place.events("/events/one")).collect();
    for events in &mut all {
        events.until("an event", |event| event["title"].is_string());
    }
    assert_eq!(place.get("/events").status, 503);
    assert_eq!(place.get("/run/one").status, 200, "pages can be loaded");
    all.truncate(16);
    let start = std::time::Instant::now();
    // The server notices closed connections when it sends the next event.
    while place.events("/events").status() != "200" {
        write(&place.path("one/monitor.csv"), &format!("r,l,t,success\n{},1,1,1\n", start.elapsed().as_nanos()));
        assert!(start.elapsed() < crate::client::LIMIT, "closed streams still count");
        std::thread::sleep(std::time::Duration::from_millis(200));
    }
}
