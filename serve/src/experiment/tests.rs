use perturb_experiment::{ExperimentFolder, Plan};

use super::*;

const PLAN: &str = "environments = ['CartPole']\nversions = ['D']\ntest_versions = ['D']\ntest_episodes = 10
    settings = { episodes = 100 }\nruns = 60\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

/// A folder with an experiment of 60 cells.
struct ExperimentFixture {
    directory: tempfile::TempDir,
    plan: Plan,
}

impl ExperimentFixture {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let fixture = Self { directory, plan };
        fixture.folder().store_plan(&fixture.plan).unwrap();
        fixture
    }

    fn root(&self) -> PathBuf {
        self.directory.path().canonicalize().unwrap()
    }

    fn folder(&self) -> ExperimentFolder {
        ExperimentFolder::new(&self.root().join("study"))
    }

    fn write(&self, cell: usize, name: &str, text: &str) {
        let path = self.folder().cell(&self.plan.cells[cell].id).path().join(name);
        super::files::write_atomically(&path, text.as_bytes()).unwrap();
    }
}

#[test]
fn all_cells_in_work_have_progress_and_some_have_curves() {
    let fixture = ExperimentFixture::new();
    let cells = &fixture.plan.cells;
    let _locks: Vec<_> =
        cells.iter().map(|cell| fixture.folder().cell(&cell.id).try_lock().unwrap().unwrap()).collect();
    for cell in 0..cells.len() {
        fixture.write(cell, "training/progress.csv", "rollout/episodes\n50\n");
    }
    let mut experiment = LiveExperiment::new(&fixture.root(), fixture.folder().path());
    experiment.refresh_details();
    assert_eq!(experiment.state(), "in work");
    let shares = experiment.shares(experiment.status().unwrap());
    // 100 episodes of training, and ten test episodes that count as a quarter each.
    assert_eq!(shares, vec![(50.0 / 102.5) as f32; 60]);
    assert_eq!((experiment.trainings.len(), experiment.training(&cells[48].id).is_some()), (MAX_CURVES, false));

    fixture.write(59, "training/progress.csv", "rollout/episodes\n100\n");
    experiment.refresh_details();
    assert_eq!(experiment.shares(experiment.status().unwrap())[59], (100.0 / 102.5) as f32);
    assert!(experiment.changed() >= Stamp::read(&fixture.folder().plan_path()).unwrap().seconds());
}

#[test]
fn cells_with_a_configuration_have_a_page() {
    let fixture = ExperimentFixture::new();
    fixture.write(0, "failure.json", "{\"id\": \"x\", \"reason\": \"no server\", \"commit\": \"x\"}");
    fixture.write(1, "training/config.toml", "");
    let mut experiment = LiveExperiment::new(&fixture.root(), fixture.folder().path());
    experiment.refresh_details();
    let with_page = [0, 1, 2].map(|cell: usize| experiment.has_page(&fixture.plan.cells[cell].id));
    assert_eq!(with_page, [false, true, false]);
}

#[test]
fn the_fingerprint_covers_all_files_of_a_report() {
    let fixture = ExperimentFixture::new();
    let record = perturb_experiment::FailureRecord {
        id: fixture.plan.cells[0].id.clone(),
        reason: "NaN".into(),
        commit: "x".into(),
        requires_restart: true,
    };
    fixture.folder().cell(&record.id).write_failure(&record).unwrap();
    let status = || ExperimentStatus::read_within(fixture.folder().path(), &fixture.root()).unwrap();
    let files = || ReportFiles::list(&status(), (1, 0), &fixture.root());
    let mut last = files().fingerprint;
    assert_eq!(last, files().fingerprint);
    let heatmap = fixture.folder().path().join("heatmaps/a.json");
    for text in ["1", "22"] {
        super::files::write_atomically(&heatmap, text.as_bytes()).unwrap();
        let fingerprint = files().fingerprint;
        assert!(fingerprint != last && files().outside.is_none());
        last = fingerprint;
    }
    let secret =
        fixture.root().parent().unwrap().join(format!("{}-secret", fixture.root().file_name().unwrap().display()));
    std::fs::write(&secret, "secret").unwrap();
    std::fs::remove_file(&heatmap).unwrap();
    std::os::unix::fs::symlink(&secret, &heatmap).unwrap();
    assert_eq!(files().outside.as_deref(), Some("heatmaps/a.json"));
    let mut experiment = LiveExperiment::new(&fixture.root(), fixture.folder().path());
    experiment.refresh_details();
    let reason = experiment.report_folder().unwrap_err();
    std::fs::remove_file(&secret).unwrap();
    assert_eq!(reason, "heatmaps/a.json is a link that leads out of the folder");
}
