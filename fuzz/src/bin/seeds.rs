//! The program `seeds DIR`: writes the valid inputs of each fuzz target to a folder in DIR that has the target's name.

use std::path::Path;

use perturb_fuzz::{TARGETS, seeds};

fn main() -> std::io::Result<()> {
    let directory = std::env::args().nth(1).ok_or_else(|| std::io::Error::other("expected a folder"))?;
    for target in TARGETS {
        let folder = Path::new(&directory).join(target.name);
        std::fs::create_dir_all(&folder)?;
        for (number, seed) in seeds(target.name).iter().enumerate() {
            std::fs::write(folder.join(format!("seed-{number}")), seed)?;
        }
    }
    Ok(())
}
