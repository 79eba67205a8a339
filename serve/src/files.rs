//! Sending a file of a run, or a part of it.

use std::fs::{File, Metadata};
use std::io::SeekFrom;
use std::ops::RangeInclusive;
use std::os::fd::AsRawFd;
use std::path::Path;

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use perturb_study::files::{Stamp, open_plain};
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio_util::io::ReaderStream;

use crate::paths::{Relative, Root, media_type};

/// The end of what is asked of a file.
#[derive(Debug, PartialEq)]
enum Asked {
    Whole,
    Part(RangeInclusive<u64>),
    Beyond,
}

/// The file that `relative` names; `None` if it is not sent.
pub(crate) async fn send(root: Root, relative: Relative, headers: &HeaderMap) -> Option<Response> {
    let opened = tokio::task::spawn_blocking(move || {
        let path = root.resolve(&relative)?;
        let kind = media_type(&path)?;
        open(&path).ok().map(|opened| (kind, opened))
    });
    let (kind, (file, metadata)) = opened.await.ok()??;
    let (length, mut file) = (metadata.len(), tokio::fs::File::from_std(file));
    let tag = format!("\"{}\"", Stamp::of_metadata(&metadata).tag());
    let said = |name: header::HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
    let known = |tags: &str| tags.split(',').any(|known| known.trim().trim_start_matches("W/") == tag);
    if said(header::IF_NONE_MATCH).is_some_and(known) {
        return Some((StatusCode::NOT_MODIFIED, [(header::ETAG, tag)]).into_response());
    }
    // A part of what has become another file fits no other part.
    let range = said(header::RANGE).filter(|_| said(header::IF_RANGE).is_none_or(|of| of == tag));
    let asked = range.map_or(Asked::Whole, |range| part(range, length));
    let (status, from, count) = match &asked {
        Asked::Whole => (StatusCode::OK, 0, length),
        Asked::Part(range) => (StatusCode::PARTIAL_CONTENT, *range.start(), range.end() - range.start() + 1),
        Asked::Beyond => {
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
    if let Asked::Part(range) = asked {
        let range = format!("bytes {}-{}/{length}", range.start(), range.end());
        headers.insert(header::CONTENT_RANGE, HeaderValue::from_str(&range).ok()?);
    }
    Some(response)
}

/// Opens the plain file at a `path` without links. Had a part of it become a link meanwhile, another one would be open.
fn open(path: &Path) -> std::io::Result<(File, Metadata)> {
    let opened = open_plain(path)?;
    match std::fs::read_link(format!("/proc/self/fd/{}", opened.0.as_raw_fd()))? == path {
        true => Ok(opened),
        false => Err(std::io::ErrorKind::InvalidInput.into()),
    }
}

/// What a Range header asks of a file: one part, from somewhere, or so much of the end. What is not understood asks for
/// all.
fn part(header: &str, length: u64) -> Asked {
    let Some((from, to)) = header.strip_prefix("bytes=").and_then(|range| range.split_once('-')) else {
        return Asked::Whole;
    };
    let last = length.saturating_sub(1);
    let (from, to) = match (from.parse::<u64>(), to.parse::<u64>()) {
        (Ok(from), Ok(to)) if from <= to => (from, to.min(last)),
        (Ok(from), Err(_)) if to.is_empty() => (from, last),
        (Err(_), Ok(count)) if from.is_empty() => (length.saturating_sub(count), last),
        _ => return Asked::Whole,
    };
    if from > to || length == 0 { Asked::Beyond } else { Asked::Part(from..=to) }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case("bytes=0-", Asked::Part(0..=9))]
    #[case("bytes=2-3", Asked::Part(2..=3))]
    #[case("bytes=2-99", Asked::Part(2..=9))]
    #[case("bytes=-4", Asked::Part(6..=9))]
    #[case("bytes=-99", Asked::Part(0..=9))]
    #[case("bytes=10-", Asked::Beyond)]
    #[case("bytes=3-2", Asked::Whole)]
    #[case("bytes=0-1,4-5", Asked::Whole)]
    #[case("lines=1-2", Asked::Whole)]
    fn a_part_of_ten_bytes(#[case] header: &str, #[case] expected: Asked) {
        assert_eq!(part(header, 10), expected);
    }

    #[test]
    fn what_has_become_a_link_meanwhile_is_not_opened() {
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
