//! Compiles the protocol: Rust types, client, server, and the descriptors for reflection.

use std::{env, error::Error, path::PathBuf};

const PROTO: &str = "proto/perturb/v1/perturb.proto";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed={PROTO}");
    let descriptors = protox::Compiler::new(["proto"])?
        .include_source_info(true)
        .include_imports(true)
        .open_file(PROTO)?
        .file_descriptor_set();
    tonic_prost_build::configure()
        .bytes(".")
        .file_descriptor_set_path(PathBuf::from(env::var("OUT_DIR")?).join("perturb.bin"))
        .skip_protoc_run()
        .compile_fds(descriptors)?;
    Ok(())
}
