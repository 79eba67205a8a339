//! Finds MuJoCo 2.2.2, generates bindings from its headers and compiles the shim.

use std::{
    env, fs, panic,
    path::{Path, PathBuf},
    process,
};

const VERSION: &str = "222";
const INSTALL: &str = "apt-get install libmujoco-dev libclang-dev";

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
    generate_bindings(&include);
    let mut shim = cc::Build::new();
    shim.files(["src/shim.c", "src/kinematics.c"]).include(&include).std("c11").opt_level(2);
    // Debian's MuJoCo fuses no products and sums, and kinematics.c has to come to its bytes.
    shim.flag("-ffp-contract=off").compile("perturb_mujoco_shim");
    // After the shim, which needs it.
    println!("cargo:rustc-link-lib=dylib=mujoco");
}

/// Ends the build with one sentence.
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

fn generate_bindings(include: &Path) {
    // bindgen panics where libclang is missing; the hook keeps its trace out of the message.
    panic::set_hook(Box::new(|_| {}));
    let generated = panic::catch_unwind(|| {
        bindgen::Builder::default()
            .header("src/shim.h")
            .clang_arg(format!("-I{}", include.display()))
            .allowlist_function(
                "perturb_mj[rv]?_.*|mj_version|mj_deleteModel|mj_deleteData|mj_name2id|mj_objectVelocity",
            )
            .allowlist_function("mjv_defaultOption|mjv_defaultScene|mjv_freeScene|mjr_defaultContext")
            .allowlist_type("mjtWarning|mjtObj|mjtCamera")
            .allowlist_var("mjVERSION_HEADER")
            .generate_comments(false)
            .generate()
    });
    drop(panic::take_hook());
    let written = match generated {
        Ok(Ok(bindings)) => env::var("OUT_DIR")
            .map_err(|error| error.to_string())
            .and_then(|out| bindings.write_to_file(Path::new(&out).join("bindings.rs")).map_err(|e| e.to_string())),
        Ok(Err(error)) => Err(error.to_string()),
        Err(_) => Err("libclang is missing".into()),
    };
    if let Err(error) = written {
        fail(format!("The bindings of MuJoCo cannot be generated ({error}): run `{INSTALL}`."))
    }
}
