//! The tests of policies as arithmetic, one program.
#![allow(clippy::disallowed_methods)] // of references

mod acting;
mod gradient;
mod normaliser;
mod player;
