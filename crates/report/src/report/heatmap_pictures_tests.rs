use perturb_experiment::{Cell, Plan, add_assessed, store_heatmap};
use perturb_files::write_atomically;
use perturb_protocol::Version;
use perturb_records::{ExternalEvaluation, ExternalPolicy, HeatmapOptions, RecordedTest};
use perturb_settings::sets::{Context, Contexts, TestSet};

use super::*;
use crate::fixture;
use crate::plot::svg;

const PLAN: &str = "environments = ['Pendulum', 'Elsewhere']\nruns = 2
    [[algorithm]]\nname = 'a2c'\narchitectures = ['ff']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";

/// Returns a folder in which every cell has a result. A cell also has the heatmap that `heatmap` returns for it, if
/// any.
fn folder(plan: &Plan, heatmap: impl Fn(&Cell) -> Option<Heatmap>) -> tempfile::TempDir {
    let directory = tempfile::tempdir().unwrap();
    let folder = ExperimentFolder::new(directory.path());
    for cell in &plan.cells {
        write_atomically(&folder.cell(&cell.id).path().join("result.json"), b"{}").unwrap();
        if let Some(heatmap) = heatmap(cell) {
            store(&folder, cell, &heatmap);
        }
    }
    directory
}

fn store(folder: &ExperimentFolder, cell: &Cell, heatmap: &Heatmap) {
    let Heatmap { axes, base, grid, episodes, fixed, .. } = heatmap.clone();
    let (parameters, seed) = (axes.map(|axis| axis.name), cell.config.common.seed);
    let options = HeatmapOptions { parameters, base, grid, episodes, seed, fixed };
    store_heatmap(folder, cell, "1".into(), options, heatmap).unwrap();
}

fn panels(picture: &Picture) -> &HeatmapPanels {
    let PictureDrawing::Heatmaps(panels) = &picture.drawing else { unreachable!("heatmaps") };
    panels
}

fn pictures(plan: &Plan, folder: &ExperimentFolder) -> HeatmapPictures {
    let results = fixture::results(plan, |_| Some(([0.0; 3], 0.0)));
    heatmap_pictures(&results.select(), Some(folder)).unwrap()
}

fn is_of(cell: &Cell, environment: &str, algorithm: &str) -> bool {
    (cell.config.common.environment.as_str(), cell.method().algorithm.as_str()) == (environment, algorithm)
}

/// Returns a heatmap with higher success rates near the default. The region of success is larger for wider training
/// distributions. The success rate of the second run is 40 percentage points lower.
fn trained(cell: &Cell) -> Heatmap {
    let of_run = 20.0 * f64::from(cell.run * 2 - 1);
    let reach = [0.3, 0.5, 0.9][cell.config.common.version as usize];
    fixture::heatmap(6, |mass, length| {
        let far = (mass - 1.0).hypot(length - 1.0);
        let success = (100.0 - (far - reach).max(0.0) * 200.0 - of_run).clamp(0.0, 100.0);
        (-1600.0 + 14.0 * success - 90.0 * mass, success)
    })
}

#[test]
fn a_picture_is_of_the_mean_over_runs_and_says_how_many() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    // A2C has heatmaps of both runs on D, of the first run on R, and none on E.
    let version = |cell: &Cell| cell.config.common.version;
    let is_there = |cell: &Cell| version(cell) == Version::D || (version(cell) == Version::R && cell.run == 1);
    let made = |cell: &Cell| (is_of(cell, "Pendulum", "a2c") && is_there(cell)).then(|| trained(cell));
    let directory = folder(&plan, made);
    let pictures = pictures(&plan, &ExperimentFolder::new(directory.path()));
    assert_eq!(pictures.pictures.len(), 1, "nothing of PPO and in the other environment");
    let picture = &pictures.pictures[0];
    let panels = panels(picture);
    let captions: Vec<&str> = panels.columns.iter().map(|column| column.caption.as_str()).collect();
    assert_eq!(captions, ["trained on D, 2 runs", "trained on R, 1 of 2 runs", "trained on E, 0 of 2 runs"]);
    let runs: Vec<Heatmap> = plan.cells.iter().filter_map(made).collect();
    assert_eq!(
        panels.columns[0].content.as_ref().unwrap(),
        &Heatmap::mean(&[runs[0].clone(), runs[1].clone()]).unwrap()
    );
    assert_eq!(panels.columns[1].content.as_ref().unwrap(), &runs[2]);
    assert_eq!(panels.columns[2].content, Err("no complete heatmap was found".into()));
    assert_eq!(
        picture.caption.replace(perturb_experiment::VERSION, "VERSION"),
        "Pendulum, a2c ff: mean return and success over mass and length. Means over runs: 2 runs trained on D; 1 of 2 runs \
         trained on R (run 2: no complete heatmap was found); 0 of 2 runs trained on E (run 1: no complete heatmap was \
         found, run 2: no complete heatmap was found). 6 × 6 points of 20 episodes of each policy, test seeds 1, 2. \
         perturb VERSION."
    );
    assert_eq!((pictures.total, pictures.missing.len()), (24, 3 + 18));
    let csv = String::from_utf8(picture.data.to_csv()).unwrap();
    assert!(csv.starts_with("train,runs,mass,length,mean_return,success_percent\nD,2,0.5833333333333334,"), "{csv}");
    assert_eq!((csv.lines().count(), csv.lines().filter(|line| line.starts_with("R,1,")).count()), (73, 36));

    let out = tempfile::tempdir().unwrap();
    let others = ["iqm.csv", "Pendulum-a2c-ff-heatmap-mass-length-R.svg"];
    for name in others {
        write_atomically(&out.path().join(name), b"").unwrap();
    }
    assert_eq!(save_heatmaps(&pictures, out.path()).unwrap(), ["Pendulum-a2c-ff-heatmap-mass-length"]);
    let names = ["svg", "png", "csv"].map(|ending| format!("Pendulum-a2c-ff-heatmap-mass-length.{ending}"));
    assert!(names.iter().all(|name| out.path().join(name).exists()));
    assert!(out.path().join(others[0]).exists(), "not a heatmap's");
    assert_eq!(std::fs::read_dir(out.path()).unwrap().count(), 4, "the picture of a heatmap that is gone is gone, too");
    insta::with_settings!({ prepend_module_to_snapshot => false }, {
        insta::assert_snapshot!("heatmap", svg(panels).unwrap());
    });
}

#[test]
fn returns_use_the_environments_scale() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let of = |cell: &Cell| match cell.config.common.environment.as_str() {
        "Pendulum" if cell.method().algorithm == "a2c" => -1600.0,
        "Pendulum" => -200.0,
        _ => 5.0,
    };
    let directory = folder(&plan, |cell| Some(fixture::heatmap(2, |mass, _| (of(cell) + mass, 0.0))));
    let folder = ExperimentFolder::new(directory.path());
    // One cell also has a heatmap of another kind: its other parameters are drawn from R.
    let cell = plan.cells.iter().find(|cell| is_of(cell, "Pendulum", "ppo")).unwrap();
    store(&folder, cell, &Heatmap { base: Version::R, ..fixture::heatmap(3, |_, _| (-9000.0, 0.0)) });
    let pictures = pictures(&plan, &folder);
    let pictures = pictures.pictures;
    let scales: Vec<_> =
        pictures.iter().map(|picture| (picture.file.as_str(), panels(picture).returns.clone())).collect();
    let (pendulum, elsewhere) = (-1600.0..-200.0, 5.7..6.3);
    assert_eq!(
        scales,
        [
            ("Pendulum-a2c-ff-heatmap-mass-length", pendulum.clone()),
            ("Pendulum-ppo-ff-heatmap-mass-length", pendulum.clone()),
            ("Pendulum-ppo-ff-heatmap-mass-length-R", pendulum),
            ("Elsewhere-a2c-ff-heatmap-mass-length", elsewhere.clone()),
            ("Elsewhere-ppo-ff-heatmap-mass-length", elsewhere),
        ]
    );
    let drawn = pictures.iter().find(|picture| picture.file == "Pendulum-ppo-ff-heatmap-mass-length-R").unwrap();
    assert!(drawn.caption.contains("over mass and length, the others drawn from R."), "{}", drawn.caption);
    assert!(panels(drawn).title[1].ends_with("other parameters drawn from R"));
}

#[test]
fn mean_needs_equal_points_and_episodes() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let first = fixture::heatmap(2, |_, _| (0.0, 0.0));
    for other in [fixture::heatmap(3, |_, _| (9.0, 9.0)), Heatmap { episodes: 5, ..first.clone() }] {
        let directory = folder(&plan, |cell| Some(if cell.run == 1 { first.clone() } else { other.clone() }));
        let pictures = pictures(&plan, &ExperimentFolder::new(directory.path()));
        assert!(panels(&pictures.pictures[0]).columns.iter().all(|column| column.content.as_ref() == Ok(&first)));
        assert_eq!(pictures.missing, [NoHeatmap::NotAlike; 12]);
        assert!(pictures.pictures[0].caption.contains("1 of 2 runs trained on E (run 2: the heatmap's grid"));
    }
}

#[test]
fn experiment_without_heatmaps_has_advice_on_why() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let directory = tempfile::tempdir().unwrap();
    let folder = ExperimentFolder::new(directory.path());
    let results = fixture::results(&plan, |cell| is_of(cell, "Pendulum", "a2c").then_some(([0.0; 3], 0.0)));
    let pictures = heatmap_pictures(&results.select(), Some(&folder)).unwrap();
    assert_eq!((pictures.pictures.len(), pictures.total), (0, 24));
    let advice = pictures.advice();
    assert!(advice[0].starts_with("Missing heatmaps: 6 of 24."), "{advice:?}");
    assert_eq!(advice[1], "Heatmaps that wait for the results of their trainings: 18 of 24.");
}

/// Returns an agent whose policies were tested on a grid over mass and length, with four episodes per point. `policies`
/// has each policy's training version and its number of successes among the four episodes.
fn agent(policies: &[(Version, u32)]) -> ExternalEvaluation {
    let trained_on: Vec<_> = policies.iter().map(|(version, _)| Some(*version)).collect();
    let tested = fixture::assessed("pushes", "Pendulum", &trained_on, [1; 3]);
    let with_heatmap = |(policy, (_, successes)): (&ExternalPolicy, &(Version, u32))| {
        let axes = fixture::heatmap(2, |_, _| (0.0, 0.0)).axes;
        let contexts = Contexts::Listed(Heatmap::contexts(&axes, 2, &Context::new()));
        let set = TestSet { name: Heatmap::SET.into(), version: Version::D, contexts };
        let mut records = policy.records.clone();
        let episode = |index| fixture::episode(Heatmap::SET, index, 0.0, 1, index / 4 < *successes);
        records.add(RecordedTest { set, seed: 9, axes: Some(axes) }, (0..16).map(episode).collect());
        ExternalPolicy::new(policy.known.clone(), records)
    };
    let policies = tested.policies().iter().zip(policies).map(with_heatmap).collect();
    ExternalEvaluation::new(tested.name.clone(), tested.agent.clone(), policies).unwrap()
}

#[test]
fn external_agents_have_heatmap_pictures() {
    let plan = Plan::parse("test", PLAN.into()).unwrap();
    let directory = folder(&plan, |cell| is_of(cell, "Pendulum", "a2c").then(|| trained(cell)));
    let results = fixture::results(&plan, |_| Some(([0.0; 3], 0.0)));
    let assessed = [agent(&[(Version::D, 2), (Version::E, 3)]), agent(&[(Version::D, 4)])];
    let mut selections = results.select();
    let alone = heatmap_pictures(&selections, Some(&ExperimentFolder::new(directory.path()))).unwrap();
    add_assessed(&mut selections, &assessed);
    let pictures = heatmap_pictures(&selections, Some(&ExperimentFolder::new(directory.path()))).unwrap();
    let (here, elsewhere): (Vec<_>, Vec<_>) = pictures.pictures.into_iter().partition(|it| !it.name.contains("pushes"));
    assert_eq!(here, alone.pictures, "those of cells are the same");
    assert_eq!(elsewhere.len(), 1);
    let panels = panels(&elsewhere[0]);
    let captions: Vec<&str> = panels.columns.iter().map(|column| column.caption.as_str()).collect();
    assert_eq!(captions, ["trained on D, 2 runs", "trained on E, 1 run"]);
    let success = |column: usize| panels.columns[column].content.as_ref().unwrap().points[0].success_percent;
    assert_eq!((success(0), success(1)), (75.0, 75.0), "the mean over runs, and of one");
    assert!(elsewhere[0].caption.contains("2 × 2 points of 4 episodes of each policy, test seed 1."));
    assert!(!elsewhere[0].caption.contains("perturb"), "whose program it was is not known");

    // The pictures of an agent are the same without an experiment.
    let mut selections = Vec::new();
    add_assessed(&mut selections, &assessed);
    assert_eq!(heatmap_pictures(&selections, None).unwrap().pictures, elsewhere);
    // A policy that was not tested on a grid has no heatmap.
    let mut others = assessed[1].policies()[0].clone();
    others.records.about.tests.iter_mut().for_each(|test| test.axes = None);
    let others = [ExternalEvaluation::new(String::new(), "other".into(), vec![others]).unwrap()];
    let mut selections = Vec::new();
    add_assessed(&mut selections, &others);
    assert_eq!(heatmap_pictures(&selections, None).unwrap().pictures, []);
}
