//! Reads a metrics page and checks it against the OpenMetrics text format.

use std::{
    collections::BTreeMap,
    io::{Read, Write},
    net::TcpStream,
    os::unix::net::UnixStream,
    path::Path,
    time::Duration,
};

const PATIENCE: Duration = Duration::from_secs(60);

/// A metrics page, and its values. The key of a value is its name with labels, as written on the page.
#[derive(Debug)]
pub struct Page {
    pub text: String,
    numbers: BTreeMap<String, f64>,
}

/// Sends a request line. Returns the head and the body of the response.
pub fn asked(stream: impl Read + Write, line: &str) -> (String, String) {
    asked_for(stream, line, "")
}

/// Sends a request line and header lines. Returns the head and the body of the response.
pub fn asked_for(mut stream: impl Read + Write, line: &str, headers: &str) -> (String, String) {
    write!(stream, "{line} HTTP/1.1\r\nHost: localhost\r\n{headers}\r\n").unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").expect("a head and a body");
    (head.into(), body.into())
}

/// Connects to a metrics page on a Unix socket.
pub fn unix(socket: &Path) -> UnixStream {
    let stream = UnixStream::connect(socket).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

/// Connects to a metrics page on a TCP port.
pub fn tcp(port: &str) -> TcpStream {
    let stream = TcpStream::connect(port).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

impl Page {
    /// Reads the page on this Unix socket, and checks all its lines.
    pub fn scrape(socket: &Path) -> Self {
        let (head, text) = asked(unix(socket), "GET /metrics");
        assert!(
            head.starts_with("HTTP/1.1 200") && head.contains("application/openmetrics-text; version=1.0.0"),
            "{head}"
        );
        Self::read(text)
    }

    fn read(text: String) -> Self {
        let body = text.strip_suffix("# EOF\n").expect("the end is marked");
        let (mut numbers, mut family, mut help) = (BTreeMap::new(), (String::new(), ""), String::new());
        let mut families = Vec::new();
        for line in body.lines() {
            if let Some(rest) = line.strip_prefix("# HELP ") {
                help = rest.split_once(' ').expect("a sentence").0.into();
            } else if let Some(rest) = line.strip_prefix("# TYPE ") {
                let (name, kind) = rest.split_once(' ').expect("a kind");
                assert_eq!(name, help, "a sentence stands before each kind");
                assert!(!families.contains(&name.to_owned()), "{name} is there twice");
                families.push(name.into());
                family = (name.into(), kind);
            } else {
                let (series, number) = line.rsplit_once(' ').expect(line);
                let name = series.split('{').next().unwrap();
                let suffixes: &[&str] = match family.1 {
                    "counter" => &["_total"],
                    "gauge" => &[""],
                    "histogram" => &["_sum", "_count", "_bucket"],
                    other => panic!("kind {other}"),
                };
                assert!(
                    suffixes.iter().any(|suffix| name == format!("{}{suffix}", family.0)),
                    "{line} below {family:?}"
                );
                check_labels(&series[name.len()..]);
                let series = series.strip_suffix("{}").unwrap_or(series);
                let number = number.replace("+Inf", "inf").parse().expect(line);
                assert!(numbers.insert(series.to_owned(), number).is_none(), "{series} is there twice");
            }
        }
        let page = Self { numbers, text };
        page.check_histograms();
        page
    }

    /// Checks that the counts of each histogram grow with their bounds, up to the total count.
    fn check_histograms(&self) {
        let mut last: Option<(&str, f64)> = None;
        // The lines are in order of bounds.
        for line in self.text.lines().filter(|line| line.contains("_bucket{")) {
            let (series, number) = line.rsplit_once(' ').unwrap();
            let number: f64 = number.parse().unwrap();
            let (name, bound) = series.split_once("le=\"").unwrap();
            assert!(last.is_none_or(|(of, before)| of != name || number >= before), "{line}");
            last = (!bound.starts_with("+Inf")).then_some((name, number));
            if last.is_none() {
                let labels = bound.split_once('"').unwrap().1.trim_start_matches(',');
                let all = format!("{}_count{{{labels}", name.split("_bucket").next().unwrap());
                assert_eq!(self.number(all.strip_suffix("{}").unwrap_or(&all)), number, "{line}");
            }
        }
    }

    /// Returns the value of a series, or 0 if the page does not contain it.
    pub fn number(&self, series: &str) -> f64 {
        self.numbers.get(series).copied().unwrap_or_default()
    }

    /// Returns whether the page contains a series.
    pub fn tells(&self, series: &str) -> bool {
        self.numbers.contains_key(series)
    }
}

/// Checks that labels have the form `{name="value",…}` or are empty.
fn check_labels(labels: &str) {
    let Some(inside) = labels.strip_prefix('{') else { return assert_eq!(labels, "") };
    let mut rest = inside.strip_suffix('}').expect(labels);
    while !rest.is_empty() {
        let (name, value) = rest.split_once("=\"").expect(labels);
        assert!(name.bytes().all(|byte| byte.is_ascii_lowercase() || byte == b'_') && !name.is_empty(), "{labels}");
        let mut escaped = false;
        let end = value.find(|letter| {
            let ends = letter == '"' && !escaped;
            escaped = letter == '\\' && !escaped;
            ends
        });
        rest = &value[end.expect(labels) + 1..];
        rest = rest.strip_prefix(',').unwrap_or_else(|| {
            assert_eq!(rest, "", "{labels}");
            rest
        });
    }
}
