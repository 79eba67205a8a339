//! Safe uses of the operating system, for all programs:
//!
//! - [`plain`]: opens and reads plain files. Pipes and devices are refused without waiting.
//! - [`signals`]: makes a write beyond the limit of file sizes fail, instead of ending the program.
//! - [`support`]: skips operations that a file system does not support, and logs the consequence.
//! - [`threads`]: explains why a thread cannot be started.
//! - [`terminal`]: removes control characters from untrusted text.
#![forbid(unsafe_code)]

pub mod plain;
pub mod signals;
pub mod support;
pub mod terminal;
pub mod threads;

pub use plain::{open_plain, read_plain};
pub use signals::ignore_sigxfsz;
pub use terminal::escape_terminal;
pub use threads::explain_no_thread;
