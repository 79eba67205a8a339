//! Writes TensorBoard event files, without TensorFlow.
//!
//! A file is a sequence of TFRecords. A TFRecord consists of the length of its data as u64, a checksum of the length,
//! the data, and a checksum of the data, all little-endian. The data is a protobuf message `Event`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use prost::Message;

use super::disk::sync;

/// The message `Event` of tensorflow/core/util/event.proto, with only the fields that scalars need.
#[derive(Clone, PartialEq, Message)]
struct EventMessage {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<SummaryMessage>,
}

/// The message `Summary` of tensorflow/core/framework/summary.proto, with only the fields that scalars need.
#[derive(Clone, PartialEq, Message)]
struct SummaryMessage {
    #[prost(message, repeated, tag = "1")]
    value: Vec<ValueMessage>,
}

/// A scalar with its name.
#[derive(Clone, PartialEq, Message)]
struct ValueMessage {
    #[prost(string, tag = "1")]
    tag: String,
    // The field is part of a oneof, so it is sent even if it is 0.
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

/// Writes scalars to an events file for TensorBoard.
#[derive(Debug)]
pub struct EventWriter {
    file: BufWriter<File>,
    file_name: String,
    t_start: f64,
}

impl EventWriter {
    /// Creates an events file in `directory`. `t_start` is the start of the training in seconds since 1970.
    ///
    /// # Errors
    /// Errors of the operating system.
    pub fn create(directory: &Path, t_start: f64) -> std::io::Result<Self> {
        let file_name = format!("events.out.tfevents.{}.perturb", t_start as u64);
        let file = File::create(directory.join(&file_name))?;
        let mut writer = Self { file: BufWriter::new(file), file_name, t_start };
        let first =
            EventMessage { wall_time: t_start, file_version: Some("brain.Event:2".into()), ..EventMessage::default() };
        writer.record(&first)?;
        Ok(writer)
    }

    /// Returns a writer that continues at the end of `file`, whose name is `file_name`.
    pub(super) fn resume(file: File, file_name: String, t_start: f64) -> Self {
        Self { file: BufWriter::new(file), file_name, t_start }
    }

    /// Returns the name of the file.
    pub(super) fn file_name(&self) -> &str {
        &self.file_name
    }

    /// Flushes the file to the disk and returns its length.
    pub(super) fn sync(&mut self) -> std::io::Result<u64> {
        self.file.flush()?;
        sync(self.file.get_ref(), "events.out.tfevents")
    }

    /// Writes an event with the values of `scalars` at `step`, `elapsed` seconds after the start of the training.
    ///
    /// # Errors
    /// Errors of the operating system.
    pub fn write<'a>(
        &mut self,
        step: u64,
        elapsed: f64,
        scalars: impl Iterator<Item = (&'a str, f64)>,
    ) -> std::io::Result<()> {
        let value = scalars
            .map(|(tag, value)| ValueMessage { tag: tag.to_owned(), simple_value: Some(value as f32) })
            .collect();
        self.record(&EventMessage {
            wall_time: self.t_start + elapsed,
            step: i64::try_from(step).unwrap_or(i64::MAX),
            file_version: None,
            summary: Some(SummaryMessage { value }),
        })
    }

    fn record(&mut self, event: &EventMessage) -> std::io::Result<()> {
        self.file.write_all(&frame(&event.encode_to_vec()))?;
        self.file.flush()
    }
}

/// Returns a TFRecord with this data.
fn frame(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut record = Vec::with_capacity(data.len() + 16);
    record.extend(length);
    record.extend(masked_crc(&length).to_le_bytes());
    record.extend(data);
    record.extend(masked_crc(data).to_le_bytes());
    record
}

/// Returns the masked CRC-32C that TFRecords use. The plain checksum would be weak for data that itself contains
/// checksums.
fn masked_crc(data: &[u8]) -> u32 {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Parses the events of a file and verifies their checksums.
    fn read(mut bytes: &[u8]) -> Vec<EventMessage> {
        let mut events = Vec::new();
        while !bytes.is_empty() {
            let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
            let data = &bytes[12..12 + length];
            let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
            assert_eq!(number(8), masked_crc(&bytes[..8]));
            assert_eq!(number(12 + length), masked_crc(data));
            events.push(EventMessage::decode(data).unwrap());
            bytes = &bytes[16 + length..];
        }
        events
    }

    #[test]
    fn scalars_read_back() {
        let directory = tempfile::tempdir().unwrap();
        let mut writer = EventWriter::create(directory.path(), 100.0).unwrap();
        writer.write(128, 2.5, [("rollout/ep_rew_mean", 0.0), ("train/loss", -1.5)].into_iter()).unwrap();
        let path = directory.path().join("events.out.tfevents.100.perturb");
        let events = read(&std::fs::read(path).unwrap());
        assert_eq!(events[0].file_version.as_deref(), Some("brain.Event:2"));
        assert_eq!((events[1].step, events[1].wall_time), (128, 102.5));
        let values = &events[1].summary.as_ref().unwrap().value;
        let values: Vec<(&str, Option<f32>)> = values.iter().map(|v| (v.tag.as_str(), v.simple_value)).collect();
        assert_eq!(values, [("rollout/ep_rew_mean", Some(0.0)), ("train/loss", Some(-1.5))]);
    }

    #[test]
    fn record_equals_that_of_tensorboard() {
        // The output of tensorboard 2.21's RecordWriter for b"abc".
        let expected = "0300000000000000b099490e6162636e57f121";
        let hexadecimal: String = frame(b"abc").iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(hexadecimal, expected);
    }
}
