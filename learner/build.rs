//! Compiles the protocol's Rust types and client.

use std::error::Error;

const PROTO: &str = "../proto/perturb/v1/perturb.proto";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed={PROTO}");
    let descriptors = protox::compile(["perturb/v1/perturb.proto"], ["../proto"])?;
    tonic_prost_build::configure().bytes(".").build_server(false).compile_fds(descriptors)?;
    Ok(())
}
