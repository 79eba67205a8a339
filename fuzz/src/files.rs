//! What the learner reads back: checkpoints, recorded episodes, experiment files.

use perturb_study::Plan;
use perturb_study::checkpoint::Checkpoint;
use perturb_study::records::Records;
use serde_json::{Value, json};

/// More cells than these would only take time.
const MOST_BYTES_OF_A_PLAN: usize = 4096;

/// A checkpoint: two bytes that say how long its `checkpoint.json` is, that, and its weights. Checksums are made good, as
/// by somebody who wrote the files on purpose. What is read is played.
pub fn checkpoints(data: &[u8]) {
    let Some((length, rest)) = data.split_first_chunk::<2>() else { return };
    let (document, weights) = rest.split_at(usize::from(u16::from_le_bytes(*length)).min(rest.len()));
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).expect("a file");
    match serde_json::from_slice::<Value>(document) {
        Ok(Value::Object(mut document)) => {
            document.remove("crc32c");
            let weights = json!({ "file": "weights", "bytes": weights.len(), "crc32c": crc32c::crc32c(weights) });
            document.insert("weights".into(), weights);
            write("checkpoint.json", Value::from(document).to_string().as_bytes());
        }
        _ => write("checkpoint.json", document),
    }
    write("weights", weights);
    if let Ok(checkpoint) = Checkpoint::load(folder.path()) {
        let _ = checkpoint.player(2, 1, 0);
    }
}

/// Recorded episodes, judged if they can be read.
pub fn records(data: &[u8]) {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("episodes.parquet");
    std::fs::write(&file, data).expect("a file");
    if let Ok(records) = Records::read(&file) {
        for test in &records.about.tests {
            let _ = records.result(&test.set.name, None);
        }
    }
}

/// An experiment file.
pub fn plans(data: &[u8]) {
    if let Some(text) = std::str::from_utf8(data).ok().filter(|text| text.len() <= MOST_BYTES_OF_A_PLAN) {
        let _ = Plan::parse("plan.toml", text.to_owned());
    }
}
