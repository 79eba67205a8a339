//! Files within the page, so that its links lead somewhere wherever it is.

use std::fmt::Write;

/// Characters that are not encoded in an address. All others are written in hexadecimal digits.
const PLAIN: &[u8] = b"-_.~!*'();:@=+$,/?";

/// An address that has `content` in it.
pub(super) fn data_uri(media_type: &str, content: &[u8]) -> String {
    let mut uri = format!("data:{media_type};charset=utf-8,");
    for &byte in content {
        if byte.is_ascii_alphanumeric() || PLAIN.contains(&byte) {
            uri.push(char::from(byte));
        } else {
            write!(uri, "%{byte:02X}").unwrap_or_default(); // memory takes it
        }
    }
    uri
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_an_address_cannot_have_is_written_in_digits() {
        let uri = data_uri("text/csv", "a,\"b\"\n1 %,<é>#\n".as_bytes());
        assert_eq!(uri, "data:text/csv;charset=utf-8,a,%22b%22%0A1%20%25,%3C%C3%A9%3E%23%0A");
    }
}
