//! What is made of a run: its report, heatmaps, curves.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Output;

use super::{Experiment, PLAN, kill_all, succeeded};
use crate::common::{perturb, stderr, wait_for};
use perturb_study::Folder;

#[test]
fn a_report_is_the_same_however_often_the_run_was_broken_off() {
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
    let (whole, killed) = (report("whole"), report("killed"));
    assert_eq!(whole.keys().collect::<Vec<_>>(), killed.keys().collect::<Vec<_>>());
    for (name, content) in &whole {
        assert!(*content == killed[name], "{name} differs");
    }

    let page = String::from_utf8_lossy(&whole["page"]).into_owned();
    assert!(page.matches("<svg").count() == 15 && page.matches("<table").count() == 14, "every picture and table");
    let pictures = ["profiles.png", "Pendulum-E-parameters.svg", "CartPole-thresholds.svg"];
    assert!(pictures.iter().all(|name| whole.contains_key(*name)), "{:?}", whole.keys());
    assert!(!page.contains("<script") && !page.contains("src=") && !page.contains("@import"), "it needs nothing else");
    let links: Vec<&str> = page.split("href=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    let inside = |link: &&str| link.strip_prefix('#').is_some_and(|id| page.contains(&format!(" id=\"{id}\"")));
    assert!(links.len() > 10 && links[0] == "data:," && links[1..].iter().all(inside), "{links:?}");
    let metrics = String::from_utf8_lossy(&whole["metrics.csv"]).into_owned();
    // Nothing was trained on R: Interpolation and Extrapolation are empty, not 0.
    assert!(metrics.lines().any(|line| line == "CartPole,a2c,ff,,Interpolation,0,,,100,0,"), "{metrics}");
}

#[test]
fn a_run_writes_its_report_when_nothing_is_left_to_do() {
    let experiment = Experiment::new(&PLAN.replace("7e-3, 7e-4", "1e38, 7e-4"));
    let (page, again) = (experiment.out("pages/page.html"), experiment.out("again.html"));
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

/// A heatmap of the episodes that an earlier one left.
fn draw_again(training: &Path, directory: &Path, records: &str) -> Output {
    let mut command = perturb(&["heatmap", "--x", "force", "--y", "length", "--out", "again", "--checkpoint"]);
    command.arg(training).args(["--records", records]).current_dir(directory).output().expect("ended")
}

#[test]
fn a_heatmap_is_drawn_of_two_parameters_and_others_are_refused() {
    let experiment = Experiment::new(PLAN);
    succeeded(&experiment.run("out", &["--cell", "0"]));
    let training = Folder::new(&experiment.out("out")).cell(&experiment.plan.cells[0].id).training();
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
    // E's force is 1 … 20: three parts, whose middles are 4.17, 10.5 and 16.83.
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
        assert_eq!(output.status.code(), Some(1));
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

/// Every file of a run's heatmaps.
fn heatmap_files(out: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let entries = std::fs::read_dir(out.join("heatmaps")).expect("a folder");
    let paths = entries.map(|entry| entry.expect("an entry").path());
    paths.map(|path| (path.clone(), std::fs::read(path).expect("read"))).collect()
}

/// How many pictures are in a page.
fn embedded(page: &str) -> usize {
    page.matches("<img ").count()
}

#[test]
fn heatmaps_of_an_experiment_are_made_once_and_are_in_its_report() {
    let experiment = Experiment::new(&PLAN.replace("['D', 'R']", "['D', 'E']"));
    succeeded(&experiment.run("out", &["--jobs", "2"]));
    let out = experiment.out("out");
    // How many are made, and how many were there already.
    let heatmaps = |arguments: &[&str]| {
        let output = experiment.heatmap("out", arguments);
        succeeded(&output);
        (String::from_utf8_lossy(&output.stdout).lines().count(), stderr(&output).matches("is there already").count())
    };
    let without = experiment.page("out");
    assert_eq!(embedded(&without), 0);
    assert!(without.contains("not there: 4 of 4. <code>perturb heatmap DIR</code> makes them"));

    // Two environments, trained on D and on E; the better of two configurations.
    assert_eq!(heatmaps(&[]), (4, 0));
    assert_eq!(heatmaps(&[]), (0, 4), "made once");
    let with = experiment.page("out");
    assert_eq!(embedded(&with), 4);
    assert!(!with.contains("not there") && !with.contains("src=\"http") && !with.contains("<script"));
    assert_eq!(with, experiment.page("out"), "the same folder, the same bytes");
    let first = heatmap_files(&out);
    assert_eq!(first.len(), 20, "four files and a record of each");

    // Half a picture does not count, nor one of a result that has been replaced.
    let is_picture = |path: &&PathBuf| path.extension().is_some_and(|ending| ending == "png");
    let damaged = first.keys().find(is_picture).expect("one");
    std::fs::write(damaged, b"\x89PNG").expect("written");
    assert_eq!(embedded(&experiment.page("out")), 3);
    assert_eq!(heatmaps(&[]), (1, 3));
    assert_eq!(heatmap_files(&out), first, "the same bytes again");
    let id = damaged.file_stem().expect("a name").to_string_lossy().into_owned();
    let result = Folder::new(&out).cell(&id).path().join("result.json");
    let text = std::fs::read_to_string(&result).expect("a result");
    std::fs::write(&result, text.replace("\"command\": \"perturb", "\"command\": \"/bin/perturb")).expect("written");
    let outdated = experiment.page("out");
    assert!(embedded(&outdated) == 3 && outdated.contains("the heatmap is of an earlier result"));
    assert_eq!(heatmaps(&["--seed", "2"]), (4, 0), "other settings, other heatmaps");
    without_its_checkpoint(&experiment, &id);
}

/// Without the checkpoint that a result came from there is no heatmap of it, and the others are made.
fn without_its_checkpoint(experiment: &Experiment, id: &str) {
    std::fs::remove_dir_all(Folder::new(&experiment.out("out")).cell(id).training()).expect("deleted");
    let output = experiment.heatmap("out", &[]);
    assert_eq!(output.status.code(), Some(1));
    let said = stderr(&output);
    assert!(said.contains("holds no checkpoint") && said.contains("1 of 4 heatmaps"), "{said}");
    assert_eq!(String::from_utf8_lossy(&output.stdout).lines().count(), 3);
}

#[test]
fn an_experiment_has_its_environments_usual_parameters() {
    let experiment = Experiment::new(PLAN);
    assert_eq!(experiment.heatmap(".", &["--x", "force", "--y", "mass"]).status.code(), Some(2));
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
}
