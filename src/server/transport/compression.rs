//! Messages that a client compresses, as gRPC allows.

use flate2::bufread::{GzDecoder, ZlibDecoder};
use std::{fmt, io::Read};
use tonic::codegen::http::HeaderMap;

/// The header of a call that names the compression of its messages.
const ENCODING_HEADER: &str = "grpc-encoding";

/// A compression that the server reads. Its replies are never compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Compression {
    /// `gzip`.
    Gzip,
    /// `deflate`, which is zlib's format in gRPC.
    Deflate,
}

impl Compression {
    /// Returns the compression of a call's messages, or `None` if they may not be compressed. tonic refuses other names.
    pub(super) fn from_headers(headers: &HeaderMap) -> Option<Self> {
        match headers.get(ENCODING_HEADER)?.as_bytes() {
            b"gzip" => Some(Self::Gzip),
            b"deflate" => Some(Self::Deflate),
            _ => None,
        }
    }

    /// Returns a reader of the decompressed message.
    pub(super) fn reader<'a>(self, compressed: &'a [u8]) -> Box<dyn Read + Send + 'a> {
        match self {
            Self::Gzip => Box::new(GzDecoder::new(compressed)),
            Self::Deflate => Box::new(ZlibDecoder::new(compressed)),
        }
    }
}

impl fmt::Display for Compression {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::Gzip => "gzip",
            Self::Deflate => "deflate",
        })
    }
}
