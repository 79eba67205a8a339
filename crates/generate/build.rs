//! Generates the Rust code of the protocols from `proto`, and the bindings of MuJoCo from its headers. Writes them
//! below `OUT_DIR`, with the same paths as in the repository.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::{env, fs, panic};

/// The .proto files from which code is generated, with paths relative to `proto`: files with services, and a file with
/// messages that are sent inside `google.protobuf.Any`.
const PROTOCOLS: [&str; 3] =
    ["perturb/v1/perturb.proto", "dm_env_rpc/v1/dm_env_rpc.proto", "dm_env_rpc/v1/extensions/properties.proto"];
/// Messages of `perturb.v1` that need a JSON serialiser, because the JSON catalogue contains them.
const SERIALIZED: [&str; 3] = ["Channel", "RewardTerm", "Quantity"];

fn main() -> Result<(), Box<dyn Error>> {
    let root = Path::new("../..");
    let out = PathBuf::from(env::var("OUT_DIR")?);
    if out.join("crates").exists() {
        fs::remove_dir_all(out.join("crates"))?; // also deletes files that are no longer generated
    }
    let protocols = out.join("crates/protocol/src/generated");
    fs::create_dir_all(&protocols)?;
    generate_protocols(&root.join("proto"), &protocols)?;
    let mujoco = out.join("crates/mujoco/src");
    fs::create_dir_all(&mujoco)?;
    generate_bindings(root, &mujoco.join("bindings.rs"))
}

/// Generates messages, clients and servers, with one file for each package, and the descriptors for server reflection.
fn generate_protocols(proto: &Path, out: &Path) -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed={}", proto.display());
    let mut compiler = protox::Compiler::new([proto])?;
    compiler.include_source_info(true).include_imports(true).open_files(PROTOCOLS)?;
    fs::write(out.join("descriptors.bin"), compiler.encode_file_descriptor_set())?;
    // Ordered maps make the encoding of messages deterministic.
    let mut builder = tonic_prost_build::configure().bytes(".").btree_map(".dm_env_rpc");
    for message in SERIALIZED {
        builder = builder.type_attribute(format!(".perturb.v1.{message}"), "#[derive(serde::Serialize)]");
    }
    Ok(builder.out_dir(out).compile_fds(compiler.file_descriptor_set())?)
}

/// Generates declarations of the MuJoCo functions and types that `crates/mujoco` uses.
fn generate_bindings(root: &Path, out: &Path) -> Result<(), Box<dyn Error>> {
    let shim = root.join("crates/mujoco/src/shim.h");
    let prefix = PathBuf::from(env::var_os("MUJOCO_PREFIX").unwrap_or_else(|| "/usr".into()));
    println!("cargo:rerun-if-changed={}", shim.display());
    println!("cargo:rerun-if-env-changed=MUJOCO_PREFIX");
    let builder = bindgen::Builder::default()
        .header(shim.display().to_string())
        .clang_arg(format!("-I{}", prefix.join("include").display()))
        .allowlist_function(
            "perturb_mj[rv]?_.*|mj_version|mj_deleteModel|mj_deleteData|mj_name2id|mj_id2name|mj_objectVelocity",
        )
        .allowlist_function("mjv_defaultOption|mjv_defaultScene|mjv_freeScene|mjr_defaultContext")
        .allowlist_type("mjtWarning|mjtObj|mjtCamera")
        .allowlist_var("mjVERSION_HEADER|mjNGAIN|mjNBIAS")
        .generate_comments(false)
        .rustfmt_configuration_file(Some(root.join("rustfmt.toml").canonicalize()?));
    // bindgen panics if libclang is missing. This hook suppresses the panic's message and backtrace.
    panic::set_hook(Box::new(|_| {}));
    let generated = panic::catch_unwind(panic::AssertUnwindSafe(|| builder.generate()));
    drop(panic::take_hook());
    let bindings = generated.map_err(|_| "libclang is missing: run `apt-get install libclang-dev`")?;
    let bindings = bindings.map_err(|error| format!("MuJoCo's headers cannot be read ({error}): run `make deps`"))?;
    Ok(bindings.write_to_file(out)?)
}
