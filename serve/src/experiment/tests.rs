use perturb_study::{Folder, Plan};

use super::*;

const PLAN: &str = "environments = ['CartPole']\nversions = ['D']\ntest_versions = ['D']\ntest_episodes = 10
    settings = { episodes = 100 }\nruns = 60\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";

struct Place {
    directory: tempfile::TempDir,
    plan: Plan,
}

impl Place {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let place = Self { directory, plan };
        place.folder().keep_plan(&place.plan).unwrap();
        place
    }

    fn root(&self) -> PathBuf {
        self.directory.path().canonicalize().unwrap()
    }

    fn folder(&self) -> Folder {
        Folder::new(&self.root().join("study"))
    }

    fn write(&self, cell: usize, name: &str, text: &str) {
        let path = self.folder().cell(&self.plan.cells[cell].id).path().join(name);
        files::write_atomically(&path, text.as_bytes()).unwrap();
    }
}

#[test]
fn how_far_cells_are_is_known_of_all_in_work_and_curves_are_followed_of_some() {
    let place = Place::new();
    let cells = &place.plan.cells;
    let _locks: Vec<_> = cells.iter().map(|cell| place.folder().cell(&cell.id).try_lock().unwrap().unwrap()).collect();
    for cell in 0..cells.len() {
        place.write(cell, "training/progress.csv", "rollout/episodes\n50\n");
    }
    let mut experiment = Experiment::of(&place.root(), place.folder().path());
    experiment.follow();
    assert_eq!(experiment.state(), "in work");
    let shares = experiment.shares(experiment.status().unwrap());
    // 100 episodes of training, and ten of a test that count as a quarter each.
    assert_eq!(shares, vec![(50.0 / 102.5) as f32; 60]);
    assert_eq!((experiment.followed.len(), experiment.training(&cells[48].id).is_some()), (MOST_FOLLOWED, false));

    place.write(59, "training/progress.csv", "rollout/episodes\n100\n");
    experiment.follow();
    assert_eq!(experiment.shares(experiment.status().unwrap())[59], (100.0 / 102.5) as f32);
    assert!(experiment.changed() >= Stamp::of(&place.folder().plan_path()).unwrap().seconds());
}

#[test]
fn who_has_a_page_of_its_own_is_known() {
    let place = Place::new();
    place.write(0, "failure.json", "{\"id\": \"x\", \"reason\": \"no server\", \"commit\": \"x\"}");
    place.write(1, "training/config.toml", "");
    let mut experiment = Experiment::of(&place.root(), place.folder().path());
    experiment.follow();
    let with_page = [0, 1, 2].map(|cell: usize| experiment.has_page(&place.plan.cells[cell].id));
    assert_eq!(with_page, [false, true, false]);
}

#[test]
fn all_that_a_report_is_made_from_is_in_its_state_and_nothing_from_outside() {
    let place = Place::new();
    let record = perturb_study::Failure {
        id: place.plan.cells[0].id.clone(),
        reason: "NaN".into(),
        commit: "x".into(),
        begins_anew: true,
    };
    place.folder().cell(&record.id).write_failure(&record).unwrap();
    let status = || ExperimentStatus::read_within(place.folder().path(), &place.root()).unwrap();
    let sources = || Sources::of(&status(), (1, 0), &place.root());
    let mut last = sources().state;
    assert_eq!(last, sources().state);
    let heatmap = place.folder().path().join("heatmaps/a.json");
    for text in ["1", "22"] {
        files::write_atomically(&heatmap, text.as_bytes()).unwrap();
        let state = sources().state;
        assert!(state != last && sources().out.is_none());
        last = state;
    }
    let secret = place.root().parent().unwrap().join(format!("{}-secret", place.root().file_name().unwrap().display()));
    std::fs::write(&secret, "secret").unwrap();
    std::fs::remove_file(&heatmap).unwrap();
    std::os::unix::fs::symlink(&secret, &heatmap).unwrap();
    assert_eq!(sources().out.as_deref(), Some("heatmaps/a.json"));
    let mut experiment = Experiment::of(&place.root(), place.folder().path());
    experiment.follow();
    let reason = experiment.reported().unwrap_err();
    std::fs::remove_file(&secret).unwrap();
    assert_eq!(reason, "heatmaps/a.json is a link that leads out of the folder");
}
