//! Compiles the protocols: Rust types, clients, servers, and the descriptors for reflection.

use std::{env, error::Error, fs, path::PathBuf};

const FOLDER: &str = "../../proto";
/// Those with services, and what is sent inside `google.protobuf.Any`.
const PROTOCOLS: [&str; 3] =
    ["perturb/v1/perturb.proto", "dm_env_rpc/v1/dm_env_rpc.proto", "dm_env_rpc/v1/extensions/properties.proto"];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed={FOLDER}");
    let mut compiler = protox::Compiler::new([FOLDER])?;
    compiler.include_source_info(true).include_imports(true).open_files(PROTOCOLS)?;
    let descriptors = PathBuf::from(env::var("OUT_DIR")?).join("descriptors.bin");
    fs::write(descriptors, compiler.encode_file_descriptor_set())?;
    // Of two equal messages with maps, only ordered ones have equal bytes.
    let mut builder = tonic_prost_build::configure().bytes(".").btree_map(".dm_env_rpc");
    for message in ["Channel", "RewardTerm", "Quantity"] {
        // As the catalogue in JSON has them.
        builder = builder.type_attribute(format!(".perturb.v1.{message}"), "#[derive(serde::Serialize)]");
    }
    builder.compile_fds(compiler.file_descriptor_set())?;
    Ok(())
}
