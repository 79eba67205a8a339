//! The two text formats of metrics: OpenMetrics 1.0, and Prometheus' older format 0.0.4.

/// A text format of the metrics page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextFormat {
    /// OpenMetrics 1.0.
    OpenMetrics,
    /// Prometheus' text format 0.0.4, for scrapers that do not know OpenMetrics.
    Prometheus,
}

impl TextFormat {
    /// Chooses the format according to a request's `Accept` header: OpenMetrics, unless the client prefers plain text
    /// or accepts neither of the two. A client that accepts neither more likely understands the older format.
    pub fn negotiated(accept: Option<&str>) -> Self {
        let Some(accept) = accept else { return Self::OpenMetrics };
        let open_metrics = quality(accept, "application", "openmetrics-text");
        let is_preferred = open_metrics > 0.0 && open_metrics >= quality(accept, "text", "plain");
        if is_preferred { Self::OpenMetrics } else { Self::Prometheus }
    }

    /// Returns the value of the `Content-Type` header.
    pub fn content_type(self) -> &'static str {
        match self {
            Self::OpenMetrics => "application/openmetrics-text; version=1.0.0; charset=utf-8",
            Self::Prometheus => "text/plain; version=0.0.4; charset=utf-8",
        }
    }

    /// Converts a page from OpenMetrics to this format.
    pub fn convert(self, page: String) -> String {
        match self {
            Self::OpenMetrics => page,
            Self::Prometheus => to_prometheus(&page),
        }
    }
}

/// Returns the quality, 0 … 1, that an `Accept` header gives to a media type. The most specific matching range decides.
fn quality(accept: &str, kind: &str, subtype: &str) -> f32 {
    let mut best = (0, 0.0);
    for range in accept.split(',') {
        let mut parts = range.split(';').map(str::trim);
        let Some((own_kind, own_subtype)) = parts.next().and_then(|name| name.split_once('/')) else { continue };
        let specificity = match (own_kind.eq_ignore_ascii_case(kind), own_subtype.eq_ignore_ascii_case(subtype)) {
            (true, true) => 3,
            (true, false) if own_subtype == "*" => 2,
            _ if (own_kind, own_subtype) == ("*", "*") => 1,
            _ => continue,
        };
        let given = parts.find_map(|part| part.strip_prefix("q=").or_else(|| part.strip_prefix("Q=")));
        let quality = given.map_or(1.0, |text| text.trim().parse::<f32>().unwrap_or(0.0).clamp(0.0, 1.0));
        // If two ranges are equally specific, e.g. two versions of a format, the higher quality counts.
        if specificity > best.0 || (specificity == best.0 && quality > best.1) {
            best = (specificity, quality);
        }
    }
    best.1
}

/// Converts OpenMetrics to Prometheus' older format. There the name of a counter's family also ends in `_total`, and no
/// `# EOF` line marks the end.
fn to_prometheus(page: &str) -> String {
    let mut text = String::with_capacity(page.len());
    let mut help = "";
    for line in page.lines() {
        if let Some(rest) = line.strip_prefix("# HELP ") {
            help = rest;
        } else if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, kind) = rest.split_once(' ').unwrap_or((rest, "untyped"));
            let suffix = if kind == "counter" { "_total" } else { "" };
            let sentence = help.strip_prefix(name).unwrap_or_default();
            text.push_str(&format!("# HELP {name}{suffix}{sentence}\n# TYPE {name}{suffix} {kind}\n"));
        } else if !line.starts_with('#') {
            text.push_str(line);
            text.push('\n');
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case::nothing(None, TextFormat::OpenMetrics)]
    #[case::anything(Some("*/*"), TextFormat::OpenMetrics)]
    #[case::prometheus(
        Some("application/openmetrics-text;version=1.0.0;q=0.6,text/plain;version=0.0.4;q=0.3,*/*;q=0.1"),
        TextFormat::OpenMetrics
    )]
    #[case::telegraf(Some("text/plain;version=0.0.4;q=1,*/*;q=0.1"), TextFormat::Prometheus)]
    #[case::text(Some("text/plain"), TextFormat::Prometheus)]
    #[case::any_text(Some("text/*;q=0.5"), TextFormat::Prometheus)]
    #[case::protobuf(
        Some("application/vnd.google.protobuf;encoding=delimited;q=0.7,text/plain;version=0.0.4;q=0.3"),
        TextFormat::Prometheus
    )]
    #[case::refused(Some("application/openmetrics-text;q=0, */*"), TextFormat::Prometheus)]
    #[case::unknown(Some("image/png"), TextFormat::Prometheus)]
    #[case::letters(Some("Application/OpenMetrics-Text; Q=0.9, TEXT/plain; q=0.1"), TextFormat::OpenMetrics)]
    #[case::broken(Some(";;q=,/,text"), TextFormat::Prometheus)]
    fn scrapers_get_what_they_ask_for(#[case] accept: Option<&str>, #[case] expected: TextFormat) {
        assert_eq!(TextFormat::negotiated(accept), expected);
    }

    #[test]
    fn the_older_format_names_counters_as_their_series() {
        let page =
            "# HELP a Steps.\n# TYPE a counter\na_total{x=\"# 1\"} 1\n# HELP b Now.\n# TYPE b gauge\nb 2.5\n# EOF\n";
        let expected = "# HELP a_total Steps.\n# TYPE a_total counter\na_total{x=\"# 1\"} 1\n# HELP b Now.\n# TYPE b gauge\nb 2.5\n";
        assert_eq!(TextFormat::Prometheus.convert(page.into()), expected);
        assert_eq!(TextFormat::OpenMetrics.convert(page.into()), page);
    }
}
