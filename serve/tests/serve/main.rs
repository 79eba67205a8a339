//! Tests of the pages over HTTP, without a browser.
#![allow(clippy::unwrap_used)]

mod client;
#[path = "../../../crates/records/src/fixture.rs"]
mod fixture;
mod pages;
mod safety;
