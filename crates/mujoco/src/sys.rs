//! Generated declarations of MuJoCo and of the shim. After an edit of `shim.h`, or to use more of MuJoCo, run `make generate`.
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
