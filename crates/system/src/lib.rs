//! Services of the operating system for all programs, each with a safe default:
//!
//! - [`plain`]: opens and reads plain files. A pipe or a device is refused without waiting for it.
//! - [`signals`]: a write beyond the limit of file sizes fails instead of ending the program.
//! - [`threads`]: the reason why no thread can be started.
//! - [`terminal`]: text of other parties, without what a terminal would obey.
#![forbid(unsafe_code)]

pub mod plain;
pub mod signals;
pub mod terminal;
pub mod threads;

pub use plain::{open_plain, read_plain};
pub use signals::ignore_sigxfsz;
pub use terminal::escape_terminal;
pub use threads::explain_no_thread;
