//! The pages over HTTP, without a browser.

mod client;
mod pages;
mod safety;
