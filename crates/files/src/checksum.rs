//! Checksums of files. With them a changed byte is an error, and never leads to another result.
//!
//! A JSON document has the entry `crc32c`: CRC-32C of the rest of the document as compact JSON with sorted names, so that
//! spaces and order do not matter. Any other file holds `perturb.crc32c=` with eight hexadecimal digits: CRC-32C of the
//! bytes before and behind it. Files of earlier programs have neither, and are read without a check.

use serde::Serialize;
use serde_json::Value;

/// The entry that holds the checksum.
const ENTRY: &str = "crc32c";
/// Comes before a file's checksum.
const MARK: &[u8] = b"perturb.crc32c=";
/// Digits of a file's checksum.
const DIGITS: usize = 8;
/// The error for a document with a wrong checksum.
pub const CHECKSUM_MISMATCH: &str = "the checksum does not match, because the file was changed or damaged";

/// A document and its checksum, in one object.
#[derive(Serialize)]
pub struct WithChecksum<'a, T> {
    #[serde(flatten)]
    document: &'a T,
    crc32c: u32,
}

impl<'a, T: Serialize> WithChecksum<'a, T> {
    /// `document`, which must be an object.
    ///
    /// # Errors
    /// The serializer's error, if `document` cannot be written as JSON.
    pub fn new(document: &'a T) -> serde_json::Result<Self> {
        Ok(Self { document, crc32c: checksum(&serde_json::to_value(document)?) })
    }
}

/// Takes the checksum out of a document that was read; says whether it had one.
///
/// # Errors
/// [`CHECKSUM_MISMATCH`] if it does not match.
pub fn open(document: &mut Value) -> Result<bool, &'static str> {
    match document.as_object_mut().and_then(|entries| entries.remove(ENTRY)) {
        None => Ok(false),
        Some(sum) if sum == checksum(document) => Ok(true),
        Some(_) => Err(CHECKSUM_MISMATCH),
    }
}

/// Returns the checksum of a document without its checksum entry.
fn checksum(document: &Value) -> u32 {
    crc32c::crc32c(document.to_string().as_bytes())
}

/// Puts the checksum of `file` into it, at a `place` where no reader looks.
pub fn insert(file: &mut Vec<u8>, place: usize) {
    let digits = format!("{:0DIGITS$x}", crc32c::crc32c(file));
    file.splice(place..place, [MARK, digits.as_bytes()].concat());
}

/// Checks the checksum in `file`. A file without one is accepted.
///
/// # Errors
/// [`CHECKSUM_MISMATCH`] if the content was changed.
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
