//! Sends a file of a run, or a part of the file.
//!
//! The file server of tower-http is not used. It follows symbolic links, and it detects changes of a file only by its
//! time in whole seconds.

use std::fs::{File, Metadata};
use std::io::SeekFrom;
use std::ops::RangeInclusive;
use std::os::fd::AsRawFd;
use std::path::Path;

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use perturb_files::{Stamp, open_plain};
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio_util::io::ReaderStream;

use crate::paths::{RelativePath, Root, media_type};

/// The bytes of a file that a request asks for.
#[derive(Debug, PartialEq)]
enum RequestedRange {
    /// The whole file.
    WholeFile,
    /// The bytes at these positions.
    Part(RangeInclusive<u64>),
    /// Bytes beyond the end of the file.
    NotSatisfiable,
}

/// Returns the response with the file at `relative`. Returns `None` if there is no such file, or if files of this kind
/// are not sent.
pub(crate) async fn send(root: Root, relative: RelativePath, headers: &HeaderMap) -> Option<Response> {
    let opened = tokio::task::spawn_blocking(move || {
        let path = root.resolve(&relative)?;
        let kind = media_type(&path)?;
        open(&path).ok().map(|opened| (kind, opened))
    });
    let (kind, (file, metadata)) = opened.await.ok()??;
    // If the client already has this version of the file, it is not sent again.
    let length = metadata.len();
    let mut file = tokio::fs::File::from_std(file);
    let tag = format!("\"{}\"", Stamp::from_metadata(&metadata).tag());
    let header_text = |name: header::HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
    let has_tag = |tags: &str| tags.split(',').any(|known| known.trim().trim_start_matches("W/") == tag);
    if header_text(header::IF_NONE_MATCH).is_some_and(has_tag) {
        return Some((StatusCode::NOT_MODIFIED, [(header::ETAG, tag)]).into_response());
    }
    // If the tag differs, the client has parts of an earlier version of the file, so it gets the whole new file.
    let range = header_text(header::RANGE).filter(|_| header_text(header::IF_RANGE).is_none_or(|known| known == tag));
    let requested = range.map_or(RequestedRange::WholeFile, |range| parse_range(range, length));
    let (status, from, count) = match &requested {
        RequestedRange::WholeFile => (StatusCode::OK, 0, length),
        RequestedRange::Part(range) => (StatusCode::PARTIAL_CONTENT, *range.start(), range.end() - range.start() + 1),
        RequestedRange::NotSatisfiable => {
            let range = [(header::CONTENT_RANGE, format!("bytes */{length}"))];
            return Some((StatusCode::RANGE_NOT_SATISFIABLE, range).into_response());
        }
    };
    file.seek(SeekFrom::Start(from)).await.ok()?;
    let mut response = Body::from_stream(ReaderStream::with_capacity(file.take(count), 64 << 10)).into_response();
    *response.status_mut() = status;
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    headers.insert(header::CONTENT_LENGTH, count.into());
    headers.insert(header::ETAG, HeaderValue::from_str(&tag).ok()?);
    headers.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    if let RequestedRange::Part(range) = requested {
        let range = format!("bytes {}-{}/{length}", range.start(), range.end());
        headers.insert(header::CONTENT_RANGE, HeaderValue::from_str(&range).ok()?);
    }
    Some(response)
}

/// Opens the plain file at `path`, which must not contain symbolic links. Fails if a part of the path was replaced by a
/// symbolic link.
fn open(path: &Path) -> std::io::Result<(File, Metadata)> {
    let opened = open_plain(path)?;
    match std::fs::read_link(format!("/proc/self/fd/{}", opened.0.as_raw_fd()))? == path {
        true => Ok(opened),
        false => Err(std::io::ErrorKind::InvalidInput.into()),
    }
}

/// Parses a `Range` header for a file of `length` bytes. Returns the whole file if the header is invalid or has several
/// ranges.
fn parse_range(header: &str, length: u64) -> RequestedRange {
    let Some((from, to)) = header.strip_prefix("bytes=").and_then(|range| range.split_once('-')) else {
        return RequestedRange::WholeFile;
    };
    let last = length.saturating_sub(1);
    let (from, to) = match (from.parse::<u64>(), to.parse::<u64>()) {
        (Ok(from), Ok(to)) if from <= to => (from, to.min(last)),
        (Ok(from), Err(_)) if to.is_empty() => (from, last),
        (Err(_), Ok(count)) if from.is_empty() => (length.saturating_sub(count), last),
        _ => return RequestedRange::WholeFile,
    };
    if from > to || length == 0 { RequestedRange::NotSatisfiable } else { RequestedRange::Part(from..=to) }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case("bytes=0-", RequestedRange::Part(0..=9))]
    #[case("bytes=2-3", RequestedRange::Part(2..=3))]
    #[case("bytes=2-99", RequestedRange::Part(2..=9))]
    #[case("bytes=-4", RequestedRange::Part(6..=9))]
    #[case("bytes=-99", RequestedRange::Part(0..=9))]
    #[case("bytes=10-", RequestedRange::NotSatisfiable)]
    #[case("bytes=3-2", RequestedRange::WholeFile)]
    #[case("bytes=0-1,4-5", RequestedRange::WholeFile)]
    #[case("lines=1-2", RequestedRange::WholeFile)]
    fn ranges_of_ten_bytes(#[case] header: &str, #[case] expected: RequestedRange) {
        assert_eq!(parse_range(header, 10), expected);
    }

    #[test]
    fn links_in_a_resolved_path_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().canonicalize().unwrap().join(name);
        std::fs::create_dir(path("folder")).unwrap();
        std::fs::write(path("folder/a.csv"), "x").unwrap();
        std::os::unix::fs::symlink("folder", path("link")).unwrap();
        std::os::unix::fs::symlink("a.csv", path("folder/b.csv")).unwrap();
        assert_eq!(
            ["folder/a.csv", "link/a.csv", "folder/b.csv"].map(|name| open(&path(name)).is_ok()),
            [true, false, false]
        );
    }
}
