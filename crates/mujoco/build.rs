//! Finds MuJoCo 2.2.2 and compiles the C code of this crate.

use std::{
    env, fs,
    path::{Path, PathBuf},
    process,
};

const VERSION: &str = "222";
const INSTALL: &str = "apt-get install libmujoco-dev";

fn main() {
    for file in ["shim.c", "shim.h", "kinematics.c", "kinematics.h"] {
        println!("cargo:rerun-if-changed=src/{file}");
    }
    println!("cargo:rerun-if-env-changed=MUJOCO_PREFIX");
    let prefix = PathBuf::from(env::var_os("MUJOCO_PREFIX").unwrap_or_else(|| "/usr".into()));
    let include = prefix.join("include");
    let header = include.join("mujoco/mujoco.h");
    println!("cargo:rerun-if-changed={}", header.display());
    check_version(&header);
    println!("cargo:rustc-link-search=native={}", library_folder(&prefix).display());
    let mut shim = cc::Build::new();
    shim.files(["src/shim.c", "src/kinematics.c"]).include(&include).std("c11").opt_level(2);
    // kinematics.c must give the same bytes as Debian's MuJoCo, which is built without fused multiply-add.
    shim.flag("-ffp-contract=off").compile("perturb_mujoco_shim");
    // The linker must see a library after the code that uses it, so MuJoCo is linked after the shim.
    println!("cargo:rustc-link-lib=dylib=mujoco");
}

/// Prints `sentence` as an error message and ends the build.
fn fail(sentence: String) -> ! {
    eprintln!("{sentence}");
    process::exit(1)
}

fn check_version(header: &Path) {
    let Ok(text) = fs::read_to_string(header) else {
        fail(format!("MuJoCo's header {} is missing: run `{INSTALL}`.", header.display()))
    };
    let found = text.lines().find_map(|line| line.strip_prefix("#define mjVERSION_HEADER ")).map(str::trim);
    if found != Some(VERSION) {
        let found = found.unwrap_or("unknown");
        fail(format!(
            "{} is of MuJoCo version {found}, but {VERSION} is needed: run `{INSTALL}` on Debian 12.",
            header.display()
        ))
    }
}

fn library_folder(prefix: &Path) -> PathBuf {
    let target = env::var("CARGO_CFG_TARGET_ARCH").unwrap_or_default();
    let folders = [prefix.join("lib").join(format!("{target}-linux-gnu")), prefix.join("lib")];
    match folders.iter().find(|folder| folder.join("libmujoco.so").exists()) {
        Some(folder) => folder.clone(),
        None => fail(format!("MuJoCo's library libmujoco.so is missing below {}: run `{INSTALL}`.", prefix.display())),
    }
}
