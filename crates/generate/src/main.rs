//! The program `perturb-generate`: copies the generated files into the repository. `make generate` runs it.
#![forbid(unsafe_code)]

use std::fs;
use std::io::{Error, Result};

fn main() -> Result<()> {
    for file in perturb_generate::generated()?.iter().filter(|file| !file.is_up_to_date()) {
        let path = file.path.display();
        fs::write(file.copy(), &file.content)
            .map_err(|error| Error::new(error.kind(), format!("cannot write {path}: {error}")))?;
        println!("{path} is written");
    }
    Ok(())
}
