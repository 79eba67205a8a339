//! Videos of trained policies.

use std::collections::HashSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use perturb_cli::video::{Footage, VideoFile, VideoOptions, film};
use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::{PrivateServer, Servers};
use perturb_learner::evaluation::test;
use perturb_protocol::Version;

use crate::common::{addresses, child_server, ended, kill, perturb, refusal, run, server, stderr, wait_for};
use gif::{ColorOutput, DecodeOptions};
use insta::assert_snapshot;
use tempfile::TempDir;

/// Trains a policy for a few episodes.
fn trained(server: &PrivateServer, text: &str) -> (TempDir, Checkpoint) {
    let servers = Servers::connect(std::slice::from_ref(server.address())).expect("a connection");
    let (out, outcome) = run(&servers, text);
    (out, outcome.checkpoint)
}

const CART_POLE: &str = "environment = 'CartPole'\nepisodes = 5\nnum_envs = 2\nn_steps = 32";
const PENDULUM: &str = "environment = 'Pendulum'\nepisodes = 2\nnum_envs = 2\nn_steps = 64";

/// Returns the command for a small video of the checkpoint in `out`.
fn video(out: &TempDir, file: &Path, more: &[&str]) -> Command {
    let [out, file] = [out.path(), file].map(|path| path.to_str().expect("UTF-8"));
    let mut command = perturb(&["video", "--checkpoint", out, "--out", file, "--width", "240", "--height", "240"]);
    command.args(more);
    command
}

fn done(mut command: Command) -> String {
    let output = command.output().expect("perturb");
    assert!(output.status.success(), "{}", stderr(&output));
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// Returns the number of steps of each episode, from the printed table.
fn lengths(stdout: &str) -> Vec<u64> {
    let rows = stdout.lines().skip(1).take_while(|line| line.starts_with(' '));
    rows.map(|row| row.split_whitespace().nth(2).and_then(|steps| steps.parse().ok()).expect("a number")).collect()
}

/// Returns the size of a GIF, its delays in hundredths of a second, and the visible picture at each frame.
fn decoded(path: &Path) -> ((u16, u16), Vec<u16>, Vec<Vec<u8>>) {
    let mut options = DecodeOptions::new();
    options.set_color_output(ColorOutput::RGBA);
    let mut decoder = options.read_info(File::open(path).expect("a file")).expect("a GIF");
    let size = (decoder.width(), decoder.height());
    let mut delays = Vec::new();
    let mut frames = Vec::new();
    let mut seen = vec![0; usize::from(size.0) * usize::from(size.1) * 4];
    while let Some(frame) = decoder.read_next_frame().expect("a whole GIF") {
        for (row, pixels) in frame.buffer.chunks(4 * usize::from(frame.width)).enumerate() {
            let start = (usize::from(frame.top) + row) * usize::from(size.0) + usize::from(frame.left);
            for (seen, pixel) in seen[4 * start..].chunks_mut(4).zip(pixels.chunks(4)) {
                if pixel[3] > 0 {
                    seen.copy_from_slice(pixel);
                }
            }
        }
        delays.push(frame.delay);
        frames.push(seen.clone());
    }
    (size, delays, frames)
}

fn names(folder: &TempDir) -> Vec<PathBuf> {
    std::fs::read_dir(folder.path()).expect("a folder").map(|entry| entry.expect("an entry").path()).collect()
}

#[test]
fn a_gif_has_a_frame_for_each_start_and_each_step() {
    let server = server(1);
    let address = server.address().to_string();
    for (text, delay) in [(CART_POLE, 2), (PENDULUM, 5)] {
        let (out, _) = trained(&server, text);
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("a.gif");
        let more = ["--server", &address, "--version", "E", "--episodes", "2"];
        let stdout = done(video(&out, &file, &more));
        assert_eq!(names(&folder), std::slice::from_ref(&file));
        assert!(file.metadata().expect("a file").len() <= 2_000_000);

        let lengths = lengths(&stdout);
        assert_eq!(lengths.len(), 2, "{stdout}");
        let (size, delays, frames) = decoded(&file);
        let expected: Vec<u16> = lengths
            .iter()
            .flat_map(|&steps| (0..=steps).map(move |step| if step == steps { 200 } else { delay }))
            .collect();
        assert_eq!(delays, expected, "real time, and two seconds at the end of each episode");
        assert!(stdout.contains(&format!("{} frames of {} × {} pixels at 1.00 ×", frames.len(), size.0, size.1)));
        assert!(size.0 == 240 && size.1 > 240 && size.1 % 2 == 0, "{size:?}");

        let pixels = |frames: &[Vec<u8>], rows: std::ops::Range<usize>| {
            let bytes = rows.start * 240 * 4..rows.end * 240 * 4;
            frames.iter().map(|frame| frame[bytes.clone()].to_vec()).collect::<HashSet<_>>().len()
        };
        let distinct = pixels(&frames, 0..240) as u64;
        // Some frames may be equal, because a pendulum at rest looks the same.
        assert!(distinct * 10 >= frames.len() as u64 * 9, "{distinct} of {} pictures differ", frames.len());
        assert_eq!(pixels(&frames, 240..usize::from(size.1)), frames.len(), "the text below differs in every frame");

        let again = folder.path().join("b.gif");
        done(video(&out, &again, &more));
        let other = folder.path().join("c.gif");
        done(video(&out, &other, &[&more[..], &["--seed", "2"]].concat()));
        let bytes = |path: &Path| std::fs::read(path).expect("a file");
        assert!(bytes(&again) == bytes(&file), "the same seed gives the same bytes");
        assert!(bytes(&other) != bytes(&file), "another seed another video");
    }
}

#[test]
fn a_gif_is_shown_as_fast_as_was_asked_for() {
    let server = server(1);
    let (out, _) = trained(&server, CART_POLE);
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("a.gif");
    let stdout = done(video(&out, &file, &["--episodes", "1", "--fps", "12.5", "--workers", "1"]));
    assert!(stdout.contains("at 0.25 × real time"), "{stdout}");
    let (_, delays, _) = decoded(&file);
    assert_eq!((delays[0], delays.last()), (8, Some(&200)));
}

#[test]
fn large_gifs_show_fewer_frames_in_the_same_time() {
    let server = server(1);
    let (out, _) = trained(&server, PENDULUM);
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("a.gif");
    let more = ["--server", &server.address().to_string(), "--episodes", "20", "--fps", "50"];
    let output = video(&out, &file, &more).output().expect("perturb");
    assert!(output.status.success(), "{}", stderr(&output));
    let words = stderr(&output);
    assert!(words.contains("is shown, so that the GIF has at most 2 MB"), "{words}");
    assert!((1_000_000..=2_000_000).contains(&file.metadata().expect("a file").len()));
    let mut decoder = DecodeOptions::new().read_info(File::open(&file).expect("a file")).expect("a GIF");
    let mut delays = Vec::new();
    while let Some(frame) = decoder.next_frame_info().expect("a whole GIF") {
        delays.push(u32::from(frame.delay));
    }
    assert_eq!(delays.iter().sum::<u32>(), 20 * (200 * 2 + 200), "as long as with all frames");
    assert!(delays.len() < 20 * 201);
    assert_eq!(delays.iter().filter(|&&delay| delay >= 200).count(), 20, "the end of each episode");
}

/// Makes a film with the library, deletes the file, and returns the film's figures.
fn filmed(servers: &Servers, checkpoint: &Checkpoint, version: Version, episodes: u64) -> Footage {
    filmed_every(1, servers, checkpoint, version, episodes)
}

fn filmed_every(every: u32, servers: &Servers, checkpoint: &Checkpoint, version: Version, episodes: u64) -> Footage {
    let folder = tempfile::tempdir().expect("a folder");
    let file = VideoFile::create(&folder.path().join("a.gif")).expect("a file");
    let options = VideoOptions { sets: vec![version.into()], episodes, seed: 5, size: (240, 240), fps: None, every };
    film(servers, checkpoint, &options, file, &StopFlag::default(), &mut |_| {})
        .unwrap_or_else(|error| panic!("{error}"))
}

#[test]
fn what_is_filmed_is_what_is_tested() {
    let server = [server(1)];
    let servers = Servers::connect(&addresses(&server)).expect("a connection");
    for (policy, episodes) in [
        ("algorithm = 'ppo'\narchitecture = 'ff'", 1),
        ("algorithm = 'a2c'\narchitecture = 'rc'", 1),
        ("algorithm = 'rl2-ppo'\nepisodes_per_trial = 3", 3),
    ] {
        let text =
            format!("environment = 'CartPole'\nversion = 'R'\nepisodes = 6\nnum_envs = 2\nn_steps = 32\n{policy}");
        let (_out, checkpoint) = trained(&server[0], &text);
        for version in [Version::R, Version::E] {
            let result = test(&servers, &checkpoint, version, 1, 5, &StopFlag::default(), |_| {}).expect("a test");
            let summary = filmed(&servers, &checkpoint, version, episodes);
            let last = summary.episodes.last().expect("an episode");
            assert_eq!(summary.episodes.len() as u64, episodes);
            assert_eq!(last.episode_return, result.mean_return, "{policy}");
            assert_eq!(f64::from(last.length), result.mean_length, "{policy}");
            assert_eq!(last.success, result.success_percent == 100.0);
            let parameters: HashSet<String> =
                summary.episodes.iter().map(|episode| format!("{:?}", episode.parameters)).collect();
            assert_eq!(parameters.len(), 1, "the parameters of a trial stay");
        }
    }
}

#[test]
fn each_episode_has_its_own_parameters() {
    let server = [server(1)];
    let servers = Servers::connect(&addresses(&server)).expect("a connection");
    let (_out, checkpoint) = trained(&server[0], CART_POLE);
    let summary = filmed(&servers, &checkpoint, Version::E, 3);
    let steps: u64 = summary.episodes.iter().map(|episode| u64::from(episode.length)).sum();
    assert_eq!(summary.frames, steps + 3);
    let thinned = filmed_every(6, &servers, &checkpoint, Version::E, 3);
    assert_eq!(thinned.episodes, summary.episodes, "what is played does not depend on what is shown");
    let shown = |steps: u32| 1 + u64::from(steps.div_ceil(6)); // the start, every sixth state, the last one
    assert_eq!(thinned.frames, thinned.episodes.iter().map(|episode| shown(episode.length)).sum::<u64>());
    let forces: Vec<f64> = summary.episodes.iter().map(|episode| episode.parameters[0].1).collect();
    assert!(forces[0] != forces[1] && forces[1] != forces[2], "{forces:?}");
    let extreme = |force: &f64| (1.0..=5.0).contains(force) || (15.0..=20.0).contains(force);
    assert!(forces.iter().all(extreme), "{forces:?}");
    assert_eq!(summary.episodes[0].parameters[0].0, "force");
}

#[test]
fn a_contact_sheet_has_the_versions_side_by_side() {
    let server = server(1);
    let (out, _) = trained(&server, CART_POLE);
    let folder = tempfile::tempdir().expect("a folder");
    let address = server.address().to_string();
    let sheet = |name: &str, versions: &str| {
        let file = folder.path().join(name);
        let more = ["--server", &address, "--version", versions, "--episodes", "2", "--seed", "4"];
        let stdout = done(video(&out, &file, &more));
        let file = std::io::BufReader::new(File::open(file).expect("a file"));
        let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
        reader.next_frame(&mut pixels).expect("a whole PNG");
        let width = reader.info().width as usize;
        let height = reader.info().height as usize;
        assert!(stdout.contains(&format!(" frames, on {width} × {height} pixels")), "{stdout}");
        (stdout, pixels.chunks(3 * width).map(<[u8]>::to_vec).collect::<Vec<_>>())
    };
    let (stdout, both) = sheet("a.png", "D,E");
    assert_eq!(lengths(&stdout).len(), 4, "{stdout}");
    let column = |name: &str| stdout.lines().skip(1).filter(|row| row.split_whitespace().nth(4) == Some(name)).count();
    assert_eq!((column("D"), column("E")), (2, 2), "{stdout}");
    let set = 3 * 240 + 2 * 2;
    let across = 2 * set + 8;
    assert!(both.iter().all(|row| row.len() == 3 * across));
    // Each half of the sheet equals the sheet of one version, with the same episodes in the same rows.
    for (version, start) in [("D", 0), ("E", set + 8)] {
        let (_, alone) = sheet("b.png", version);
        assert_eq!(alone.len(), both.len());
        let first = |row: &Vec<u8>, x: usize| row[3 * x..3 * (x + 240)].to_vec();
        assert!(alone.iter().zip(&both).all(|(alone, both)| first(alone, 0) == first(both, start)), "{version}");
        let last = (first, 5 * (240 + 2), start + 2 * (240 + 2));
        assert!(alone.iter().zip(&both).all(|(alone, both)| last.0(alone, last.1) == last.0(both, last.2)));
        assert!(alone.iter().any(|row| first(row, 0) != first(row, 5 * (240 + 2))), "time passes");
    }
    let refused = video(&out, &folder.path().join("c.png"), &["--fps", "5"]).output().expect("perturb");
    assert_eq!(refused.status.code(), Some(2));
    assert!(stderr(&refused).contains("--fps is the speed of a film"), "{}", stderr(&refused));
    let refused = video(&out, &folder.path().join("c.png"), &["--server", &address, "--episodes", "100000"]);
    let refused = { refused }.output().expect("perturb");
    assert!(stderr(&refused).contains("give fewer episodes or smaller pictures"), "{}", stderr(&refused));
    assert!(!folder.path().join("c.png").exists());
}

/// Returns ffprobe's description of a video's stream.
fn probed(path: &Path) -> String {
    let entries = "stream=codec_name,pix_fmt,width,height,r_frame_rate,color_space,nb_read_frames";
    let output = Command::new("ffprobe")
        .args(["-v", "error", "-count_frames", "-show_entries", entries, "-of", "default=noprint_wrappers=1"])
        .arg(path)
        .output()
        .expect("ffprobe");
    assert!(output.status.success(), "{}", stderr(&output));
    String::from_utf8(output.stdout).expect("UTF-8")
}

#[test]
fn an_mp4_is_what_every_player_shows() {
    if Command::new("ffmpeg").arg("-version").output().is_err() {
        eprintln!("skipped: ffmpeg is not installed");
        return;
    }
    let server = server(1);
    let (out, _) = trained(&server, PENDULUM);
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("a.mp4");
    let address = server.address().to_string();
    let more = ["--server", &address, "--version", "R", "--episodes", "1", "--width", "301"];
    let mut command = perturb(&["video", "--out", file.to_str().expect("UTF-8"), "--height", "255", "--checkpoint"]);
    command.arg(out.path()).args(more);
    let stdout = done(command);
    assert_eq!(names(&folder), std::slice::from_ref(&file));
    assert!(stdout.contains("at 1.00 × real time"), "{stdout}");

    let probed = probed(&file);
    // 201 frames at 20 frames per second, the last one for two seconds.
    for expected in [
        "codec_name=h264",
        "pix_fmt=yuv420p",
        "width=302",
        "r_frame_rate=20/1",
        "color_space=bt709",
        "nb_read_frames=240",
    ] {
        assert!(probed.lines().any(|line| line == expected), "{expected}: {probed}");
    }
    let bytes = std::fs::read(&file).expect("a file");
    let place = |name: &[u8]| bytes.windows(4).position(|window| window == name).expect("an atom");
    assert!(place(b"moov") < place(b"mdat"), "the index comes first");
}

#[test]
fn an_mp4_without_ffmpeg_is_refused_at_the_start() {
    let server = server(1);
    let (out, _) = trained(&server, CART_POLE);
    let folder = tempfile::tempdir().expect("a folder");
    let mut command = video(&out, &folder.path().join("a.mp4"), &["--server", &server.address().to_string()]);
    let output = command.env("PATH", "/nowhere").output().expect("perturb");
    assert_eq!(output.status.code(), Some(2));
    let words = stderr(&output);
    assert!(words.contains("apt-get install ffmpeg") && words.contains("a .gif, which needs no other"), "{words}");
    assert!(names(&folder).is_empty());
    let gif = folder.path().join("a.gif");
    let mut command = video(&out, &gif, &["--server", &server.address().to_string(), "--episodes", "1"]);
    command.env("PATH", "/nowhere");
    done(command);
    assert!(gif.is_file());
}

#[test]
fn what_cannot_be_filmed_is_refused_in_words() {
    let server = server(1);
    let (out, _) = trained(&server, CART_POLE);
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("file"), "").expect("a file");
    let empty = tempfile::tempdir().expect("a folder");
    let [run, directory, nothing] = [&out, &folder, &empty].map(|path| path.path().to_str().expect("UTF-8"));
    let address = server.address().to_string();
    let in_folder = |name: &str| format!("{directory}/{name}");
    let film = |name: &str, more: &[&str]| {
        let file = in_folder(name);
        let arguments = [&["video", "--checkpoint", run, "--out", &file][..], more].concat();
        refusal(&arguments, &[(run, "RUN"), (directory, "DIR"), (&address, "SERVER")])
    };
    let mut said = String::new();
    said += &film("a.avi", &[]);
    said += &film("a", &[]);
    said += &film("file/a.gif", &[]);
    for wrong in [
        &["--episodes", "0"][..],
        &["--version", "X"],
        &["--fps", "0"],
        &["--seed=-1"],
        &["--server", "unix:/nowhere.sock"],
        &["--server", &address, "--workers", "2"],
        &["--width", "239"],
        &["--height", "2049"],
    ] {
        said += &film("a.gif", wrong);
    }
    said += &refusal(
        &["video", "--checkpoint", nothing, "--out", &in_folder("a.gif")],
        &[(nothing, "EMPTY"), (directory, "DIR")],
    );
    assert_snapshot!(said);
    assert_eq!(names(&folder), [folder.path().join("file")], "nothing was written");
}

#[test]
fn a_server_that_cannot_draw_says_why() {
    let server = server(1);
    let (out, _) = trained(&server, "environment = 'Hopper'\nepisodes = 2\nnum_envs = 2\nn_steps = 32");
    let folder = tempfile::tempdir().expect("a folder");
    let mut command = video(&out, &folder.path().join("a.gif"), &["--workers", "1"]);
    // The private server inherits this variable and finds no driver.
    let output = command.env("__EGL_VENDOR_LIBRARY_FILENAMES", "/nowhere.json").output().expect("perturb");
    assert_eq!(output.status.code(), Some(1));
    let words = stderr(&output);
    assert!(words.contains("refused a picture: this server cannot draw Hopper"), "{words}");
    assert!(names(&folder).is_empty());
}

/// Returns the processor time of a process, in seconds.
fn processor_seconds(id: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).expect("a process");
    let (_, fields) = stat.rsplit_once(')').expect("a name in brackets");
    let ticks = fields.split_whitespace().skip(11).take(2).map(|ticks| ticks.parse::<f64>().expect("a number"));
    ticks.sum::<f64>() / 100.0
}

/// Starts a long video, calls `end` when a part of the video is done, and returns the output of `perturb` and the
/// remaining files.
fn broken_off(ending: &str, server: Option<&str>, end: impl FnOnce(u32)) -> (Output, Vec<PathBuf>) {
    let training = crate::common::server(1);
    let (out, _) = trained(&training, PENDULUM);
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join(format!("a.{ending}"));
    let mut command = video(&out, &file, &["--episodes", "10000"]);
    if let Some(address) = server {
        command.args(["--server", address]);
    }
    let child = command.spawn().expect("perturb");
    // A GIF is written only at its end, so processor time shows that frames are made. Starting `perturb` takes less
    // than this half second.
    wait_for("the first frames", || processor_seconds(child.id()) > 0.5);
    end(child.id());
    (ended(child), names(&folder))
}

#[test]
fn a_film_whose_server_is_killed_leaves_no_file() {
    let server = server(1);
    let address = server.address().to_string();
    let (output, names) = broken_off("gif", Some(&address), |_| kill("-KILL", server.process_id()));
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("lost the server at"), "{}", stderr(&output));
    assert!(names.is_empty(), "{names:?}");

    let private = |parent| kill("-KILL", child_server(parent).expect("a private server"));
    let (output, names) = broken_off("gif", None, private);
    assert!(stderr(&output).contains("the private server ended with signal: 9"), "{}", stderr(&output));
    assert!(names.is_empty(), "{names:?}");
}

#[test]
fn a_signal_ends_a_video_and_leaves_no_file() {
    let mut endings = vec!["gif"];
    if Command::new("ffmpeg").arg("-version").output().is_ok() {
        endings.push("mp4");
    } else {
        eprintln!("skipped for .mp4: ffmpeg is not installed");
    }
    for ending in endings {
        let (output, names) = broken_off(ending, None, |id| kill("-TERM", id));
        assert_eq!(output.status.code(), Some(128 + 15), "{}", stderr(&output));
        assert!(names.is_empty(), "{names:?}");
    }
}
