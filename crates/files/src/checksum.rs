//! Checksums of files. With a checksum, a changed byte causes an error and not an unnoticed wrong result.
//!
//! In a JSON document, the entry `crc32c` is the CRC-32C of the rest of the document, as compact JSON with sorted keys.
//! This makes the checksum independent of spaces and of the order of entries. Any other file contains `perturb.crc32c=`
//! followed by eight hexadecimal digits: the CRC-32C of all bytes before and after this text. Files of earlier programs
//! have no checksum, and are read without a check.

use serde::Serialize;
use serde_json::Value;

/// The key of the checksum in a JSON document.
const ENTRY: &str = "crc32c";
/// The text before the checksum in a file that is not JSON.
const MARK: &[u8] = b"perturb.crc32c=";
/// The number of hexadecimal digits of the checksum in a file that is not JSON.
const DIGITS: usize = 8;
/// The error message for a wrong checksum.
pub const CHECKSUM_MISMATCH: &str = "the checksum does not match, because the file was changed or damaged";

/// A JSON document together with its checksum, for serialisation as one object.
#[derive(Serialize)]
pub struct WithChecksum<'a, T> {
    #[serde(flatten)]
    document: &'a T,
    crc32c: u32,
}

impl<'a, T: Serialize> WithChecksum<'a, T> {
    /// Computes the checksum of `document`, which must serialise to a JSON object.
    ///
    /// # Errors
    /// The serialiser's error if `document` cannot be written as JSON.
    pub fn new(document: &'a T) -> serde_json::Result<Self> {
        Ok(Self { document, crc32c: checksum(&serde_json::to_value(document)?) })
    }
}

/// Removes the checksum from a JSON document and compares it with the rest of the document. Returns whether the
/// document had a checksum.
///
/// # Errors
/// [`CHECKSUM_MISMATCH`] if the checksum is wrong.
pub fn open(document: &mut Value) -> Result<bool, &'static str> {
    match document.as_object_mut().and_then(|entries| entries.remove(ENTRY)) {
        None => Ok(false),
        Some(sum) if sum == checksum(document) => Ok(true),
        Some(_) => Err(CHECKSUM_MISMATCH),
    }
}

/// Computes the checksum of a document from which the checksum entry was removed.
fn checksum(document: &Value) -> u32 {
    crc32c::crc32c(document.to_string().as_bytes())
}

/// Inserts the checksum of `file` at the byte offset `place`. Readers of the file's format must ignore additional bytes
/// at this offset.
pub fn insert(file: &mut Vec<u8>, place: usize) {
    let digits = format!("{:0DIGITS$x}", crc32c::crc32c(file));
    file.splice(place..place, [MARK, digits.as_bytes()].concat());
}

/// Compares the checksum in `file` with its content. Accepts a file without a checksum.
///
/// # Errors
/// [`CHECKSUM_MISMATCH`] if the checksum is wrong or incomplete.
pub fn check(file: &[u8]) -> Result<(), &'static str> {
    let Some(place) = file.windows(MARK.len()).rposition(|piece| piece == MARK) else { return Ok(()) };
    let (before, rest) = (&file[..place], &file[place + MARK.len()..]);
    let (digits, behind) = rest.split_at_checked(DIGITS).ok_or(CHECKSUM_MISMATCH)?;
    let sum = crc32c::crc32c_append(crc32c::crc32c(before), behind);
    if format!("{sum:0DIGITS$x}").as_bytes() == digits { Ok(()) } else { Err(CHECKSUM_MISMATCH) }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_document_is_what_was_written_or_refused() {
        let document = json!({ "b": [1, 0.1, null], "a": { "d": "e", "c": u64::MAX } });
        let mut sealed = serde_json::to_value(WithChecksum::new(&document).unwrap()).unwrap();
        assert_eq!(open(&mut sealed.clone()), Ok(true));
        let text = serde_json::to_string_pretty(&sealed).unwrap();
        let mut read: Value = serde_json::from_str(&text.replace("0.1", "0.2")).unwrap();
        assert_eq!(open(&mut read), Err(CHECKSUM_MISMATCH));
        sealed.as_object_mut().unwrap().remove(ENTRY);
        assert_eq!(open(&mut sealed), Ok(false), "of an earlier program");
        assert_eq!(sealed, document);
    }

    #[test]
    fn a_file_is_what_was_written_or_refused() {
        let mut file = b"before, behind".to_vec();
        assert_eq!(check(&file), Ok(()), "of an earlier program");
        insert(&mut file, 7);
        assert_eq!(check(&file), Ok(()));
        for place in (0..7).chain(22..file.len()) {
            let mut changed = file.clone();
            changed[place] ^= 1;
            assert_eq!(check(&changed), Err(CHECKSUM_MISMATCH), "byte {place}");
            assert_eq!(check(&file[..place]).is_err(), place >= 22, "cut at byte {place}");
        }
    }
}
