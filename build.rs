//! Compiles the protocol: Rust types, client, server, and the descriptors for reflection.

use std::{env, error::Error, fs, path::PathBuf};

const PROTO: &str = "proto/perturb/v1/perturb.proto";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed={PROTO}");
    let mut compiler = protox::Compiler::new(["proto"])?;
    compiler.include_source_info(true).include_imports(true).open_file(PROTO)?;
    let descriptors = PathBuf::from(env::var("OUT_DIR")?).join("perturb.bin");
    fs::write(descriptors, compiler.encode_file_descriptor_set())?;
    tonic_prost_build::configure().bytes(".").compile_fds(compiler.file_descriptor_set())?;
    Ok(())
}
