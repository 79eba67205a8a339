//! Reports, heatmaps and curves of a run.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Output;

use perturb_experiment::{CellState, ExperimentFolder};
use perturb_records::Records;

use super::{Experiment, PLAN, kill_all, succeeded};
use crate::common::{perturb, stderr, wait_for};

#[test]
fn reports_do_not_depend_on_interruptions() {
    let experiment = Experiment::new(&PLAN.replace("test_versions = ['D', 'R']", "test_versions = ['D', 'E']"));
    let report = |name: &str| {
        let page = experiment.out("page.html");
        let mut command = perturb(&["report"]);
        command.arg(experiment.out(name)).arg("--html").arg(&page);
        let output = command.output().expect("ended");
        succeeded(&output);
        let mut files = BTreeMap::from([("text".to_owned(), output.stdout)]);
        for entry in std::fs::read_dir(experiment.out(name).join("report")).expect("a folder") {
            let entry = entry.expect("an entry");
            files.insert(entry.file_name().to_string_lossy().into_owned(), std::fs::read(entry.path()).expect("read"));
        }
        files.insert("page".into(), std::fs::read(page).expect("a page"));
        files
    };
    succeeded(&experiment.run("whole", &["--jobs", "1"]));
    let child = experiment.command("killed", &["--jobs", "2"]).spawn().expect("started");
    wait_for("a result", || !experiment.results("killed").is_empty());
    kill_all(child);
    let partial = report("killed");
    let text = String::from_utf8_lossy(&partial["text"]).into_owned();
    assert!(text.contains("are missing.") && text.matches("missing").count() > 5, "{text}");
    succeeded(&experiment.run("killed", &["--jobs", "2"]));
    let whole = report("whole");
    let killed = report("killed");
    assert_eq!(whole.keys().collect::<Vec<_>>(), killed.keys().collect::<Vec<_>>());
    for (name, content) in &whole {
        assert!(*content == killed[name], "{name} differs");
    }

    let page = String::from_utf8_lossy(&whole["page"]).into_owned();
    let whole_page = (page.matches("<svg").count(), page.matches("<table").count());
    // Pictures: three findings, a profile, eight curves, and four of success over parameters. Tables: three of metrics,
    // two of scenarios, and one of interquartile means.
    assert_eq!(whole_page, (3 + 1 + 8 + 4, 3 + 2 + 1), "every picture and table");
    let pictures = ["profiles.png", "Pendulum-E-parameters.svg"];
    assert!(pictures.iter().all(|name| whole.contains_key(*name)), "{:?}", whole.keys());
    assert!(!page.contains("<script") && !page.contains("src=") && !page.contains("@import"), "it needs nothing else");
    let links: Vec<&str> = page.split("href=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    let inside = |link: &&str| {
        link.starts_with("data:") || link.strip_prefix('#').is_some_and(|id| page.contains(&format!(" id=\"{id}\"")))
    };
    assert!(links.len() > 10 && links[0] == "data:," && links.iter().all(inside), "{links:?}");
    assert_eq!(page.matches(".svg\" href=\"data:image/svg+xml").count(), 16, "each picture as a file");
    assert_eq!(page.matches(".csv\" href=\"data:text/csv").count(), 16, "and its numbers");
    let metrics = String::from_utf8_lossy(&whole["metrics.csv"]).into_owned();
    // No policy was trained on R, so Interpolation and Extrapolation are empty, and not 0.
    assert!(metrics.lines().any(|line| line == "CartPole,a2c,ff,,Interpolation,0,,,,,1,,,100,0,"), "{metrics}");
}

#[test]
fn a_run_writes_its_report_at_the_end() {
    let experiment = Experiment::new(&PLAN.replace("7e-3, 7e-4", "1e38, 7e-4"));
    let page = experiment.out("pages/page.html");
    let again = experiment.out("again.html");
    std::fs::create_dir(experiment.out("pages")).expect("a folder");
    let output = experiment.run("out", &["--html", page.to_str().expect("a path")]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    assert!(stderr(&output).contains("4 of 8 cells failed") && stderr(&output).contains("the report is in"));
    let table = experiment.out("out/report/metrics.csv");
    let written = [&page, &table].map(|path| std::fs::read(path).expect("a file"));
    assert!(String::from_utf8_lossy(&written[0]).contains("</html>"));
    let mut command = perturb(&["report"]);
    succeeded(&command.arg(experiment.out("out")).arg("--html").arg(&again).output().expect("ended"));
    assert!([&again, &table].map(|path| std::fs::read(path).expect("a file")) == written, "the same report");
    let names = std::fs::read_dir(experiment.out("pages")).expect("a folder").count();
    assert_eq!(names, 1, "nothing temporary stays");
}

/// Draws a heatmap from the recorded episodes of an earlier one.
fn draw_again(training: &Path, directory: &Path, records: &str) -> Output {
    let mut command = perturb(&["heatmap", "--x", "force", "--y", "length", "--out", "again", "--checkpoint"]);
    command.arg(training).args(["--records", records]).current_dir(directory).output().expect("ended")
}

#[test]
fn a_heatmap_needs_two_known_parameters() {
    let experiment = Experiment::new(PLAN);
    succeeded(&experiment.run("out", &["--cell", "0"]));
    let training = ExperimentFolder::new(&experiment.out("out")).cell(&experiment.plan.cells[0].id).training();
    let elsewhere = tempfile::tempdir().expect("a directory");
    let draw = |arguments: &[&str]| {
        let mut command = perturb(&["heatmap", "--grid", "3", "--episodes", "2", "--checkpoint"]);
        command.arg(&training).args(arguments);
        command.current_dir(elsewhere.path()).output().expect("ended")
    };
    let names = |directory: &Path| -> BTreeSet<String> {
        let entries = std::fs::read_dir(directory).expect("a folder");
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect()
    };
    let before = names(&training);
    let output = draw(&["--x", "force", "--y", "length"]);
    succeeded(&output);
    let files = ["csv", "parquet", "png", "svg"].map(|ending| format!("CartPole-a2c-ff-D-s1-force-length.{ending}"));
    assert_eq!(names(elsewhere.path()), BTreeSet::from(files), "in the working directory");
    assert_eq!(names(&training), before, "and nothing in the training's folder");
    let read = |ending: &str| {
        std::fs::read(elsewhere.path().join(format!("CartPole-a2c-ff-D-s1-force-length{ending}"))).expect("a file")
    };
    let table = String::from_utf8(read(".csv")).expect("text");
    let rows: Vec<Vec<f64>> = table
        .lines()
        .skip(1)
        .map(|line| line.split(',').map(|field| field.parse().expect("a number")).collect())
        .collect();
    assert_eq!(table.lines().next(), Some("force,length,mean_return,success_percent"));
    assert_eq!(rows.len(), 9);
    // R and E together have forces of 1 … 20. The centres of three equal bins are 4.17, 10.5 and 16.83.
    assert!((rows[0][0] - (1.0 + 19.0 / 6.0)).abs() < 1e-12 && rows[1][0] == 10.5 && rows[3][0] == rows[0][0]);
    assert!(rows.iter().all(|row| row[2] >= 1.0), "a step pays 1");
    assert!(String::from_utf8(read(".svg")).expect("text").starts_with("<svg") && read(".png").starts_with(b"\x89PNG"));
    assert_eq!(draw(&["--x", "force", "--y", "length"]).status.code(), Some(0));
    assert_eq!(String::from_utf8(read(".csv")).expect("text"), table, "the same again");
    let records = elsewhere.path().join("CartPole-a2c-ff-D-s1-force-length.parquet").display().to_string();
    succeeded(&draw_again(&training, elsewhere.path(), &records));
    assert_eq!(std::fs::read_to_string(elsewhere.path().join("again.csv")).expect("text"), table, "without playing");

    for (x, y) in [("force", "force"), ("force", "colour")] {
        let output = draw(&["--x", x, "--y", y]);
        assert_eq!(output.status.code(), Some(2));
        let message = stderr(&output);
        assert!(
            message.contains(&format!("`{y}` cannot be an axis")) && message.contains("force, length, mass"),
            "{message}"
        );
    }
    succeeded(&draw(&["--out", "usual"]));
    let table = std::fs::read_to_string(elsewhere.path().join("usual.csv")).expect("a table");
    assert!(table.starts_with("length,mass,"), "CartPole's usual parameters: {table}");
    assert_eq!(draw(&["--x", "force"]).status.code(), Some(2), "one parameter is not enough");
}

/// Returns a file's content as text.
fn text(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Returns the rows of a heatmap's CSV without the header.
fn figures(path: &Path) -> Vec<Vec<f64>> {
    let numbers = |line: &str| line.split(',').map(|field| field.parse().expect("a number")).collect();
    text(path).lines().skip(1).map(numbers).collect()
}

#[test]
fn a_heatmap_of_several_policies_is_their_mean() {
    let experiment = Experiment::new(
        "environments = ['CartPole', 'Pendulum']\nversions = ['D']\nruns = 2
        test_episodes = 4\nsettings = { episodes = 40, num_envs = 4 }
        [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']",
    );
    succeeded(&experiment.run("out", &["--jobs", "2"]));
    let folder = ExperimentFolder::new(&experiment.out("out"));
    let trainings: Vec<PathBuf> = experiment.plan.cells.iter().map(|cell| folder.cell(&cell.id).training()).collect();
    let elsewhere = tempfile::tempdir().expect("a directory");
    let draw = |trainings: &[&PathBuf], arguments: &[&str]| {
        let mut command = perturb(&["heatmap"]);
        command.args(arguments).arg("--checkpoint").args(trainings).current_dir(elsewhere.path());
        command.output().expect("ended")
    };
    let small = |more: &[&'static str]| [&["--grid", "2", "--episodes", "2"], more].concat();
    let [a, b, pendulum] = [&trainings[0], &trainings[1], &trainings[2]];
    succeeded(&draw(&[a], &small(&["--out", "a"])));
    succeeded(&draw(&[b], &small(&["--out", "b"])));
    succeeded(&draw(&[a, b], &small(&[])));
    let at = |name: &str| elsewhere.path().join(name);
    let both = figures(&at("CartPole-2-policies-length-mass.csv"));
    let alone = [figures(&at("a.csv")), figures(&at("b.csv"))];
    let mean = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(a, b)| (a + b) / 2.0).collect::<Vec<f64>>();
    assert_eq!(both, alone[0].iter().zip(&alone[1]).map(mean).collect::<Vec<_>>());
    assert_ne!(alone[0], alone[1]);
    assert!(words(&text(&at("CartPole-2-policies-length-mass.svg"))).contains("trained on D, 2 policies"));
    let records = ["1", "2"].map(|number| format!("CartPole-2-policies-length-mass.{number}.parquet"));
    succeeded(&draw(&[a, b], &["--out", "again", "--records", &records[0], &records[1]]));
    assert_eq!(figures(&at("again.csv")), both, "without playing");

    let output = draw(&[a, pendulum], &small(&[]));
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(
        said.contains("was trained in CartPole") && said.contains("in Pendulum: give policies of one environment"),
        "{said}"
    );
    let output = draw(&[a, b, a], &small(&[]));
    assert!(output.status.code() == Some(2) && stderr(&output).contains("twice: give different policies"));
    let output = draw(&[a, b], &["--records", &records[0]]);
    let said = stderr(&output);
    assert!(
        output.status.code() == Some(2) && said.contains("1 files for 2 policies; give one file for each"),
        "{said}"
    );

    // The third parameter is force: the default on D, drawn for each episode on E.
    succeeded(&draw(&[a], &small(&["--base-version", "E"])));
    let forces = |name: &str| -> Vec<f64> {
        let records = Records::read(&at(name)).expect("records");
        let place = records.about.parameters.iter().position(|parameter| parameter.name == "force").expect("there");
        records.episodes.iter().map(|episode| episode.requested[place]).collect()
    };
    assert_eq!(forces("a.parquet"), [10.0; 8]);
    let of_e = "CartPole-a2c-ff-D-s1-length-mass-E.parquet";
    let drawn = forces(of_e);
    assert!(drawn.iter().all(|force| (1.0..=5.0).contains(force) || (15.0..=20.0).contains(force)), "{drawn:?}");
    let different: BTreeSet<u64> = drawn.iter().map(|force| force.to_bits()).collect();
    assert_eq!(different.len(), 8);
    let picture = text(&at("CartPole-a2c-ff-D-s1-length-mass-E.svg"));
    assert!(words(&picture).contains("other parameters drawn from E"));
    succeeded(&draw(&[a], &["--out", "again-e", "--records", of_e]));
    assert_eq!(text(&at("again-e.svg")), picture, "the file knows what was drawn");

    succeeded(&draw(&[a], &small(&["--base-version", "R+E"])));
    assert!(words(&text(&at("CartPole-a2c-ff-D-s1-length-mass-R-or-E.svg"))).contains("drawn from R+E"));
}

/// Returns the texts of a picture with their line breaks removed.
fn words(svg: &str) -> String {
    let texts = svg.split("<text").skip(1).filter_map(|text| text.split_once('>')?.1.split_once('<'));
    texts.map(|(text, _)| text.trim()).collect::<Vec<_>>().join(" ")
}

/// Returns every file of a run's heatmaps.
fn heatmap_files(out: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let entries = std::fs::read_dir(out.join("heatmaps")).expect("a folder");
    let paths = entries.map(|entry| entry.expect("an entry").path());
    paths.map(|path| (path.clone(), std::fs::read(path).expect("read"))).collect()
}

/// Returns the titles of the heatmaps on a page.
fn embedded(page: &str) -> Vec<&str> {
    let names = page.split("aria-label=\"").skip(1).filter_map(|rest| rest.split('"').next());
    names.filter(|name| name.contains("mean return and success over ")).collect()
}

/// Makes heatmaps. Returns the number of new heatmaps and the number of existing heatmaps.
fn made(experiment: &Experiment, arguments: &[&str]) -> (usize, usize) {
    let output = experiment.heatmap("out", arguments);
    succeeded(&output);
    let made = String::from_utf8_lossy(&output.stdout).lines().filter(|line| line.ends_with(" and .parquet")).count();
    (made, stderr(&output).matches("exists already").count())
}

#[test]
fn heatmaps_of_an_experiment_are_made_once() {
    let experiment = Experiment::new(&PLAN.replace("['D', 'R']", "['D', 'E']\nruns = 2"));
    succeeded(&experiment.run("out", &["--jobs", "2"]));
    let out = experiment.out("out");
    let without = experiment.page("out");
    assert!(embedded(&without).is_empty());
    assert!(without.contains("Missing heatmaps: 8 of 8. <code>perturb heatmap DIR</code> makes them"));

    // There are eight heatmaps, of policies that were trained in two environments on D and on E, in two runs. The
    // better of two configurations is selected.
    assert_eq!(made(&experiment, &["--runs", "1"]), (4, 0));
    let partial = experiment.page("out");
    assert_eq!(embedded(&partial).len(), 2, "one of each environment");
    assert!(partial.contains("Missing heatmaps: 4 of 8.") && partial.contains("1 of 2 runs trained on E"));
    assert_eq!(made(&experiment, &[]), (4, 4));
    assert_eq!(made(&experiment, &[]), (0, 8), "made once");
    let with = experiment.page("out");
    assert!(embedded(&with).len() == 2 && with.matches("; 2 runs trained on E").count() == 2);
    assert!(!with.contains("Missing heatmaps") && !with.contains("src=") && !with.contains("<script"));
    assert_eq!(with, experiment.page("out"), "the same folder, the same bytes");
    let first = heatmap_files(&out);
    assert_eq!(first.len(), 24, "two files and a record of each");
    let pictures = ["CartPole", "Pendulum"].map(|environment| {
        let (x, y) = if environment == "CartPole" { ("length", "mass") } else { ("mass", "length") };
        out.join(format!("report/{environment}-a2c-ff-heatmap-{x}-{y}"))
    });
    for picture in &pictures {
        assert!(with.contains(&text(&picture.with_extension("svg"))), "the page has the same picture");
        assert_eq!(text(&picture.with_extension("csv")).lines().count(), 9, "two columns of four points");
    }

    // A heatmap is made again if its file is damaged. It is outdated if the result of its cell was replaced.
    let damaged = first.keys().find(|path| path.extension().is_some_and(|ending| ending == "csv")).expect("one");
    std::fs::write(damaged, b"mass,").expect("written");
    assert!(experiment.page("out").contains("Missing heatmaps: 1 of 8."));
    assert_eq!(made(&experiment, &[]), (1, 7));
    assert_eq!(heatmap_files(&out), first, "the same bytes again");
    let name = damaged.file_stem().expect("a name").to_string_lossy().into_owned();
    let id = experiment.plan.cells.iter().map(|cell| &cell.id).find(|id| name.starts_with(*id)).expect("a cell");
    let place = ExperimentFolder::new(&out).cell(id);
    let Ok(CellState::Done(mut result)) = place.state() else { panic!("{id} has no result") };
    result.command = format!("/bin/{}", result.command);
    place.write_result(&result).expect("written");
    let outdated = experiment.page("out");
    assert!(embedded(&outdated).len() == 2 && outdated.contains("1: the heatmap is of an earlier result"));
    assert_eq!(made(&experiment, &["--seed", "3"]), (8, 0), "other settings, other heatmaps");
    without_its_checkpoint(&experiment, id);
}

/// A result without its checkpoint has no heatmap. The other heatmaps are made.
fn without_its_checkpoint(experiment: &Experiment, id: &str) {
    std::fs::remove_dir_all(ExperimentFolder::new(&experiment.out("out")).cell(id).training()).expect("deleted");
    let output = experiment.heatmap("out", &[]);
    assert_eq!(output.status.code(), Some(1));
    let said = stderr(&output);
    assert!(said.contains("holds no checkpoint") && said.contains("1 of 8 heatmaps"), "{said}");
    assert_eq!(String::from_utf8_lossy(&output.stdout).lines().count(), 7 + 2, "and two pictures");
}

#[test]
fn heatmaps_of_an_experiment_have_any_two_parameters() {
    let plan = PLAN.replace("versions = ['D', 'E']", "versions = ['D']").replace("7e-3, 7e-4", "7e-4");
    let experiment = Experiment::new(&plan);
    succeeded(&experiment.run("out", &["--jobs", "2"]));
    let output = experiment.heatmap("out", &["--x", "force", "--y", "mass"]);
    succeeded(&output);
    assert!(
        stderr(&output).contains("Pendulum has no parameter `force`, only length, mass: left out"),
        "{}",
        stderr(&output)
    );
    assert_eq!(made(&experiment, &["--base-version", "R"]), (2, 0));
    assert_eq!(made(&experiment, &[]), (2, 0));
    let page = experiment.page("out");
    let [cart_pole, pendulum] =
        ["CartPole, a2c ff", "Pendulum, a2c ff"].map(|of| format!("{of}: mean return and success over"));
    let expected = [
        format!("{cart_pole} force and mass"),
        format!("{cart_pole} length and mass"),
        format!("{cart_pole} length and mass, the others drawn from R"),
        format!("{pendulum} mass and length"),
        format!("{pendulum} mass and length, the others drawn from R"),
    ];
    assert_eq!(embedded(&page), expected, "every pair that is there");
    assert!(!page.contains("Missing heatmaps"));

    let none = experiment.heatmap("out", &["--x", "force", "--y", "colour"]);
    assert_eq!(none.status.code(), Some(1));
    assert!(stderr(&none).contains("no environment of this experiment has both parameters"), "{}", stderr(&none));
    let same = experiment.heatmap("out", &["--x", "mass", "--y", "mass"]);
    assert!(same.status.code() == Some(1) && stderr(&same).contains("`mass` cannot be an axis"), "{}", stderr(&same));
    for wrong in [&["--x", "mass"][..], &["--parameters", "force=7"], &["--runs", "0"]] {
        assert_eq!(experiment.heatmap("out", wrong).status.code(), Some(2), "{wrong:?}");
    }
}

#[test]
fn curves_of_two_learners_are_drawn_and_written() {
    let plan = "environments = ['CartPole']\nversions = ['D']\ntest_versions = ['D']\ntest_episodes = 4
        settings = { episodes = 40, num_envs = 4 }
        [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
    let experiment = Experiment::new(plan);
    succeeded(&experiment.run("out", &["--jobs", "2"]));
    let mut command = perturb(&["curves"]);
    let output = command.arg(experiment.out("out")).output().expect("ended");
    succeeded(&output);
    let report = experiment.out("out").join("report");
    for picture in ["return", "success", "return-steps", "success-steps"] {
        let read = |ending: &str| {
            let name = format!("CartPole-{picture}.{ending}");
            std::fs::read(report.join(&name)).unwrap_or_else(|error| panic!("{name}: {error}"))
        };
        let picture = String::from_utf8(read("svg")).expect("text");
        assert!(picture.starts_with("<svg") && picture.contains("a2c") && picture.contains("ppo"));
        assert!(read("png").starts_with(b"\x89PNG"));
    }
    let table = std::fs::read_to_string(report.join("curves.csv")).expect("a table");
    let lines_of = |name: &str| table.lines().filter(|line| line.contains(name)).count();
    assert!(lines_of("a2c") >= 2 && lines_of("a2c") == lines_of("ppo"), "{table}");
    // Replace the report's folder by a link to a folder in which not even root can write, as in an experiment of
    // another user.
    std::fs::remove_dir_all(&report).expect("removed");
    std::os::unix::fs::symlink("/proc", &report).expect("a link");
    for name in ["report", "curves"] {
        let look = |more: &[&str]| perturb(&[name]).arg(experiment.out("out")).args(more).output().expect("ended");
        let refused = look(&[]);
        assert_eq!(refused.status.code(), Some(2), "{name}: {}", stderr(&refused));
        assert!(stderr(&refused).contains("give another folder with --out"), "{name}: {}", stderr(&refused));
        succeeded(&look(&["--out", experiment.out("own").to_str().expect("a path")]));
    }
}
