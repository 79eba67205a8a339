//! Tests of the pages over HTTP, without a browser.
#![allow(clippy::unwrap_used)]

mod client;
mod pages;
mod safety;
