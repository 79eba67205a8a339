//! Draws each environment and writes it as PNG, for the documents:
//! `cargo run --release --example pictures -- docs/pictures`.

use perturb::{
    env::{Action, EpisodeSettings, Episodes, Version},
    render::{Renderer, Size},
    tasks,
};
use std::{env, error::Error, fs::File, io::BufWriter, path::Path};

/// The state in which each environment is drawn. A state has the entries of `EnvironmentSpec::state`, and shows the
/// typical situation of the environment, e.g. a tilted pole.
const SCENES: &[(&str, &[f64])] = &[
    ("CartPole", &[0.7, 0.0, 0.12, 0.0]),
    ("MountainCar", &[0.15, 0.0]),
    ("Acrobot", &[1.9, 0.9, 0.0, 0.0]),
    ("Pendulum", &[0.9, 0.0]),
    ("HalfCheetah", &[3.3, 0.02, -0.05, 0.5, -0.3, 0.2, -0.7, 0.5, -0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
    ("Hopper", &[4.3, -0.1, 0.1, -0.3, -0.7, 0.7, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
];
const SIZE: Size = Size { width: 280, height: 280 };

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let folder = env::args().nth(1).ok_or("give a folder to write the pictures to")?;
    let renderer = Renderer::new();
    for &(name, state) in SCENES {
        let Ok(spec) = tasks::catalogue().find(name) else { continue }; // built without MuJoCo
        let distributions = spec.distributions(Version::D).into();
        let settings = EpisodeSettings { seed: 1, environment_index: 0, distributions, episodes_per_trial: 1 };
        let mut episodes = Episodes::new((spec.make)()?, settings);
        episodes.begin(Some(state));
        if name == "Pendulum" {
            episodes.step(Action::Continuous(&[-1.6]), &mut [0.0; 3]); // its torque is shown
        }
        let pixels = renderer.draw(episodes.scene().ok_or("its physics diverged")?, SIZE).await?;
        let path = Path::new(&folder).join(format!("{name}.png"));
        let file = BufWriter::new(File::create(&path)?);
        let mut encoder = png::Encoder::new(file, SIZE.width.into(), SIZE.height.into());
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_compression(png::Compression::High);
        encoder.write_header()?.write_image_data(&pixels)?;
        println!("{}: {} bytes", path.display(), std::fs::metadata(&path)?.len());
    }
    Ok(())
}
