//! Decompression of messages that a client has compressed with gRPC's message compression.

use flate2::bufread::{GzDecoder, ZlibDecoder};
use std::{
    fmt,
    io::{self, BufRead, ErrorKind, Read},
};
use tonic::codegen::http::HeaderMap;

/// The HTTP header that names the compression of a call's messages.
const ENCODING_HEADER: &str = "grpc-encoding";
/// The maximum number of compressed bytes that one call of `append_part` reads. The limit bounds the call's time even
/// for input that decompresses to nothing.
const COMPRESSED_PART_BYTES: usize = 4 << 10;
/// The maximum number of bytes that one call of `append_part` appends.
const DECOMPRESSED_PART_BYTES: usize = 64 << 10;

/// A compression that the server accepts in requests. Replies are never compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Compression {
    /// `gzip`.
    Gzip,
    /// `deflate`, which in gRPC means the zlib format.
    Deflate,
}

impl Compression {
    /// Returns the compression that a call's headers announce. Returns `None` if they announce none; the call's
    /// messages must then be uncompressed. tonic refuses calls with other compressions.
    pub(super) fn from_headers(headers: &HeaderMap) -> Option<Self> {
        match headers.get(ENCODING_HEADER)?.as_bytes() {
            b"gzip" => Some(Self::Gzip),
            b"deflate" => Some(Self::Deflate),
            _ => None,
        }
    }

    /// Returns a decompressor for a compressed message.
    pub(super) fn decompressor(self, compressed: &[u8]) -> Decompressor<'_> {
        let input = PartialInput { bytes: compressed, left: 0 };
        match self {
            Self::Gzip => Decompressor::Gzip(GzDecoder::new(input)),
            Self::Deflate => Decompressor::Deflate(ZlibDecoder::new(input)),
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

/// A decompressor of one message, in small parts so that the caller can let other tasks run in between.
pub(super) enum Decompressor<'a> {
    Gzip(GzDecoder<PartialInput<'a>>),
    Deflate(ZlibDecoder<PartialInput<'a>>),
}

impl Decompressor<'_> {
    /// Decompresses the next part and appends it to `bytes`. Returns whether there may be more.
    ///
    /// # Errors
    /// If the message is not valid in this compression.
    pub(super) fn append_part(&mut self, bytes: &mut Vec<u8>) -> io::Result<bool> {
        let limit = DECOMPRESSED_PART_BYTES as u64;
        let read = match self {
            Self::Gzip(decoder) => {
                decoder.get_mut().left = COMPRESSED_PART_BYTES;
                decoder.take(limit).read_to_end(bytes)
            }
            Self::Deflate(decoder) => {
                decoder.get_mut().left = COMPRESSED_PART_BYTES;
                decoder.take(limit).read_to_end(bytes)
            }
        };
        match read {
            Ok(read) => Ok(read == DECOMPRESSED_PART_BYTES),
            Err(error) if error.kind() == ErrorKind::WouldBlock => Ok(true),
            Err(error) => Err(error),
        }
    }
}

/// A reader of `bytes` that stops with `WouldBlock` after the next `left` bytes.
pub(super) struct PartialInput<'a> {
    bytes: &'a [u8],
    left: usize,
}

impl Read for PartialInput<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let read = self.fill_buf()?.read(out)?;
        self.consume(read);
        Ok(read)
    }
}

impl BufRead for PartialInput<'_> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        if self.left == 0 && !self.bytes.is_empty() {
            return Err(ErrorKind::WouldBlock.into());
        }
        Ok(&self.bytes[..self.left.min(self.bytes.len())])
    }

    fn consume(&mut self, amount: usize) {
        self.bytes = &self.bytes[amount..];
        self.left -= amount;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::{Compression as Level, write::GzEncoder};
    use std::io::Write;

    /// Decompresses a message. Returns it with the number of calls of `append_part`.
    fn parts(compression: Compression, compressed: &[u8]) -> io::Result<(Vec<u8>, usize)> {
        let (mut decoder, mut bytes, mut n) = (compression.decompressor(compressed), Vec::new(), 1);
        while decoder.append_part(&mut bytes)? {
            n += 1;
        }
        Ok((bytes, n))
    }

    #[test]
    fn parts_together_are_the_message() {
        let message: Vec<u8> = (0..300_000_u32).flat_map(|i| i.wrapping_mul(2_654_435_761).to_le_bytes()).collect();
        let mut encoder = GzEncoder::new(Vec::new(), Level::fast());
        encoder.write_all(&message).unwrap();
        let (bytes, n) = parts(Compression::Gzip, &encoder.finish().unwrap()).unwrap();
        assert_eq!(bytes, message);
        assert!(n > message.len() / DECOMPRESSED_PART_BYTES, "{n}");
    }

    #[test]
    fn input_without_output_is_cut_into_parts() {
        let empty_block = [0, 0, 0, 0xff, 0xff];
        let compressed = [&[0x78, 0x9c], empty_block.repeat(100_000).as_slice()].concat();
        let mut decoder = Compression::Deflate.decompressor(&compressed);
        let mut bytes = Vec::new();
        let n = (0..).take_while(|_| decoder.append_part(&mut bytes).is_ok_and(|more| more)).count();
        assert!(n >= compressed.len() / COMPRESSED_PART_BYTES, "{n}");
        assert!(bytes.is_empty());
    }
}
