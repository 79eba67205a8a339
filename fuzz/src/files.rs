//! Fuzz targets for files: checkpoints, recorded episodes, ledgers and experiment files.

use std::sync::LazyLock;

use perturb::config::Config;
use perturb::tasks;
use perturb_checkpoint::Checkpoint;
use perturb_experiment::Plan;
use perturb_records::Records;
use perturb_records::ledger::Ledgers;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::seeds::{stored_policy, stored_records};

/// Maximum size of an experiment file, in bytes. Larger files would only take more time.
const MAX_PLAN_BYTES: usize = 4096;

/// Loads a checkpoint. The input consists of the length of `checkpoint.json` in two bytes, the text of
/// `checkpoint.json`, and the file of the weights.
///
/// Corrects the checksums in the input, as an attacker would do. If the checkpoint can be loaded, creates a player from
/// it.
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

/// Reads recorded episodes. If they are valid, computes the success rates.
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

/// Reads the lines of a ledger, after adding valid digests to them. If the ledger is valid, audits a stored policy with
/// it.
pub fn ledgers(data: &[u8]) {
    static POLICY_WITH_RECORDS: LazyLock<(Checkpoint, Records)> = LazyLock::new(|| (stored_policy(), stored_records()));
    let Ok(text) = std::str::from_utf8(data) else { return };
    let mut head = "0".repeat(64);
    let mut ledger = String::new();
    for line in text.lines() {
        head = format!("{:x}", Sha256::digest(format!("{head} {line}")));
        ledger += &format!("{head} {line}\n");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("ledger");
    std::fs::write(&file, ledger).expect("a file");
    if let Ok(ledgers) = Ledgers::read(&[file], &[]) {
        let (checkpoint, records) = &*POLICY_WITH_RECORDS;
        let training = &checkpoint.state.config.common;
        let environment = find_environment(&training.environment);
        let _ = ledgers.prove(training, checkpoint.state.counters.episodes, &environment, records);
    }
}

/// Returns the environment called `name` from the catalogue.
fn find_environment(name: &str) -> perturb::proto::Environment {
    let listing = perturb::server::listing(&tasks::catalogue(), &Config::default()).expect("models load");
    listing.environments.into_iter().find(|environment| environment.name == name).expect("it is there")
}

/// Parses an experiment file.
pub fn plans(data: &[u8]) {
    if let Some(text) = std::str::from_utf8(data).ok().filter(|text| text.len() <= MAX_PLAN_BYTES) {
        let _ = Plan::parse("plan.toml", text.to_owned());
    }
}
