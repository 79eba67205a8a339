//! Generated declarations of MuJoCo's functions and of those in `shim.h`. Run `make generate` after editing `shim.h`,
//! or to declare more of MuJoCo.
#![allow(
    missing_docs,
    non_camel_case_types,
    non_snake_case,
    non_upper_case_globals,
    dead_code,
    unused_imports,
    clippy::all
)]
// Generated code: its unsafe blocks, if any, come from bindgen.
#![allow(clippy::undocumented_unsafe_blocks)]

include!("bindings.rs");
