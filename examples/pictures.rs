//! Draws each environment after some steps and writes it as PNG, for the documents:
//! `cargo run --release --example pictures -- docs/pictures`.

use perturb::{
    env::{self, Action, ActionSpace, Episodes, Settings},
    physics::Version,
    render::{Renderer, Size},
};
use std::{env as process, error::Error, fs::File, io::BufWriter, path::Path};

/// Steps before the picture, short enough that nothing has fallen, and the action: left or right, or a control.
const SCENES: &[(&str, usize, f32)] = &[
    ("CartPole", 8, 1.0),
    ("MountainCar", 30, 0.0),
    ("Acrobot", 12, 1.0),
    ("Pendulum", 30, 1.2),
    ("HalfCheetah", 8, 0.6),
    ("Hopper", 20, -0.4),
];
const SIZE: Size = Size { width: 320, height: 320 };

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let folder = process::args().nth(1).ok_or("give a folder to write the pictures to")?;
    let renderer = Renderer::new();
    for &(name, steps, action) in SCENES {
        let Ok(spec) = env::find(name) else { continue };
        let distributions = spec.parameters.iter().map(|p| p.distribution(Version::Default)).collect();
        let settings = Settings { seed: 1, environment_index: 0, distributions, episodes_per_trial: 1 };
        let mut episodes = Episodes::new(env::make(name)?, settings);
        let mut terms = vec![0.0; spec.reward_terms.len()];
        for _ in 0..steps {
            match spec.action {
                ActionSpace::Discrete(_) => episodes.step(Action::Discrete(action as u32), &mut terms),
                ActionSpace::Continuous(a) => episodes.step(Action::Continuous(&vec![action; a.len()]), &mut terms),
            };
        }
        let pose = episodes.pose().ok_or("its physics diverged")?;
        let pixels = renderer.draw(pose, SIZE).await?;
        let path = Path::new(&folder).join(format!("{name}.png"));
        let mut encoder =
            png::Encoder::new(BufWriter::new(File::create(&path)?), SIZE.width.into(), SIZE.height.into());
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_compression(png::Compression::High);
        encoder.write_header()?.write_image_data(&pixels)?;
        println!("{}: {} bytes", path.display(), std::fs::metadata(&path)?.len());
    }
    Ok(())
}
