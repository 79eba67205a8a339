//! Tests of policies as arithmetic, in one test program.
#![allow(clippy::disallowed_methods)] // of references

mod acting;
mod gradient;
mod normaliser;
mod player;
