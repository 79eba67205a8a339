//! Contents of the pages, and changes of the contents.

use perturb_experiment::{ExperimentFolder, Plan};
use perturb_files::Lock;
use perturb_protocol::Version;

use crate::client::{Place, lines, write, write_training};

/// Returns the training's curve in an event.
fn curve(event: &serde_json::Value) -> &serde_json::Value {
    &event["charts"]["curve"]
}

fn part(event: &serde_json::Value, name: &str) -> String {
    event["parts"][name].as_str().unwrap_or_else(|| panic!("no part {name} in {event:#}")).to_owned()
}

#[test]
fn the_index_lists_runs_with_their_state_and_pictures() {
    let page = Place::new().get("/");
    assert_eq!(page.status, 200);
    assert!(page.head.contains("content-type: text/html"), "{}", page.head);
    for words in [
        "href=\"./run/one\"",
        "training: CartPole D a2c ff",
        "without a checkpoint",
        "href=\"./run/study\"",
        "experiment: CartPole",
        "1 of 2 cells",
        "92.0 %",
        "broken off",
        "/file/pictures/over%20%3Cb%3E.svg",
        "over &lt;b&gt;.svg",
    ] {
        assert!(page.body.contains(words), "{words} is not in {}", page.body);
    }
    assert!(!page.body.contains("<b>."), "names are escaped");
}

#[test]
fn a_training_page_has_curve_figures_and_settings() {
    let place = Place::new();
    let page = place.get("/run/one");
    assert_eq!(page.status, 200);
    for words in ["14.50", "50.0 %", "1 234", "waiting for servers", "20.0 %", "learning_rate", "data-chart=\"return\""]
    {
        assert!(page.body.contains(words), "{words} is not in {}", page.body);
    }
    let event = place.events("/events/one").until("an event", |_| true);
    assert_eq!(curve(&event)["episodes"], serde_json::json!([5.0, 15.0, 25.0]));
    assert_eq!(curve(&event)["return"], serde_json::json!([4.5, 14.5, 24.5]));
    assert_eq!(curve(&event)["success"], serde_json::json!([50.0, 50.0, 50.0]));
    assert_eq!(curve(&event)["steps"], serde_json::json!([20.0, 60.0, 100.0]));
    assert_eq!(curve(&event)["speed"], serde_json::json!([4.0, 4.0, 4.0]));
}

#[test]
fn several_trainings_are_drawn_in_one_chart() {
    let place = Place::new();
    write_training(&place.path("more/two, or <b>"), 60);
    let index =
        place.until("/", |page| page.body.contains("training: CartPole D a2c ff") && page.body.contains("more/two"));
    let two = "more/two%2C%20or%20%3Cb%3E";
    for words in ["value=\"one\"", &format!("value=\"{two}\""), "id=\"charted\" href=\"./curves\""] {
        assert!(index.body.contains(words), "{words} is not in {}", index.body);
    }
    assert!(!index.body.contains("value=\"study\""), "an experiment has no curve of its own");
    let page = place.get(&format!("/curves?runs=one,{two}"));
    assert_eq!(page.status, 200);
    for words in [&format!("data-events=\"./events?runs=one,{two}\""), "data-chart=\"return\"", "value=\"steps\""] {
        assert!(page.body.contains(words), "{words} is not in {}", page.body);
    }
    let mut events = place.events(&format!("/events?runs=one,{two},study"));
    let event =
        events.until("both curves", |event| event["charts"]["runs"].as_array().is_some_and(|runs| runs.len() == 2));
    let runs = &event["charts"]["runs"];
    assert_eq!((&runs[0]["id"], &runs[1]["kind"]), (&"one".into(), &"more/two, or <b>".into()));
    assert_eq!(runs[0]["return"], serde_json::json!([4.5, 14.5, 24.5]));
    assert_eq!((runs[0]["steps"][2].as_f64(), runs[1]["success"].as_array().unwrap().len()), (Some(100.0), 6));
    let head = part(&event, "head");
    for words in ["href=\"./run/one\"", "two, or &lt;b&gt;</a>: CartPole D a2c ff", "There is no training study."] {
        assert!(head.contains(words), "{words} is not in {head}");
    }
    write_training(&place.path("one"), 50);
    events.until("a curve that grew", |event| event["charts"]["runs"][0]["return"].as_array().unwrap().len() == 5);
    let gone = place.events("/events?runs=none,study").until("an answer", |_| true);
    assert!(gone["gone"].as_str().unwrap().contains("no run here"), "{gone}");
    for path in ["/curves", "/curves?runs=../one", "/events?runs=..", "/events?other"] {
        assert_eq!(place.get(path).status, 404, "{path}");
    }
}

#[test]
fn an_experiment_page_has_cells_rates_and_report() {
    let place = Place::new();
    let page = place.get("/run/study");
    assert_eq!(page.status, 200);
    for words in
        ["1 of 2 cells done, 1 to do", "CartPole ppo ff, trained on D", "91.0", "93.0", "src=\"../report/study\""]
    {
        assert!(page.body.contains(words), "{words} is not in {}", page.body);
    }
    let report = place.get("/report/study");
    assert!(report.body.contains("1 of 2 cells are done"), "{}", report.body);
    assert!(
        report.head.contains("style-src 'unsafe-inline'") && !report.head.contains("script-src"),
        "{}",
        report.head
    );
    let plan = Plan::load(&place.path("study/plan.toml")).unwrap();
    let cell = place.path("study/cells").join(&plan.cells[0].id).join("training");
    write_training(&cell, 20);
    let page = place.get(&format!("/run/study/cells/{}/training", plan.cells[0].id));
    assert!(page.body.contains("90.0 … 92.0") && page.body.contains("href=\"../../../../run/study\""), "{}", page.body);
}

#[test]
fn an_assessment_page_has_the_report_of_its_agent() {
    let place = Place::new();
    let agent = crate::fixture::assessed("mine <b>", "CartPole", &[Some(Version::R)], [200, 190, 100]);
    agent.write(&place.path("saved"), false).unwrap();
    let page = place.get("/run/saved");
    assert_eq!(page.status, 200);
    for words in ["mine &lt;b&gt;", "CartPole", "src=\"../report/saved\""] {
        assert!(page.body.contains(words), "{words} is not in {}", page.body);
    }
    let report = place.get("/report/saved");
    assert!(report.status == 200 && report.body.contains("mine &lt;b&gt; (trained elsewhere)"), "{}", report.body);
    let mut events = place.events("/events/saved");
    let before = events.until("the page", |event| event["parts"]["head"].is_string())["report"].clone();
    write(&place.path("saved/assessment.json"), "{");
    events.until("the fault", |event| part(event, "head").contains("not understood"));
    events.until("another report", |event| event["report"] != before);
    place.until("/report/saved", |page| page.body.contains("this assessment is not understood"));
}

#[test]
fn events_follow_the_file_and_stop_without_changes() {
    let place = Place::new();
    let mut events = place.events("/events/one");
    events.until("the curve", |event| curve(event)["success"].as_array().unwrap().len() == 3);
    let add = |text: &str| {
        use std::io::Write;
        let mut file = std::fs::File::options().append(true).open(place.path("one/monitor.csv")).unwrap();
        file.write_all(text.as_bytes()).unwrap();
    };
    add(&(lines(30, 50) + "7,7"));
    let event = events.until("more", |event| curve(event)["success"].as_array().unwrap().len() == 5);
    assert_eq!(curve(&event)["return"][4], 44.5);
    assert!(part(&event, "troubles").is_empty(), "half a line is no fault: {event:#}");
    // No event is sent before the next change.
    std::thread::sleep(std::time::Duration::from_secs(3));
    add(",8,1,1\n");
    let event = events.until("the next event", |_| true);
    assert_eq!(curve(&event)["episodes"], serde_json::json!([5.5, 16.5, 27.5, 38.5, 47.5]), "of 51 episodes");
}

#[test]
fn a_locked_run_is_in_work() {
    let place = Place::new();
    let mut events = place.events("/events");
    events.until("the list", |event| part(event, "runs").contains("without a checkpoint"));
    let lock = Lock::try_take(&place.path("one")).unwrap().unwrap();
    let event = events.until("work", |event| part(event, "runs").contains("in work"));
    assert_eq!(event["title"], "1 in work · perturb");
    drop(lock);
    events.until("the end of work", |event| !part(event, "runs").contains("in work"));
}

#[test]
fn a_cell_in_work_has_a_curve_until_it_is_done() {
    let place = Place::new();
    let folder = ExperimentFolder::new(&place.path("study"));
    let plan = Plan::load(&folder.plan_path()).unwrap();
    let cell = folder.cell(&plan.cells[1].id);
    let mut events = place.events("/events/study");
    let lock = cell.try_lock().unwrap().unwrap();
    write_training(&cell.training(), 60);
    let training = Lock::try_take(&cell.training()).unwrap().unwrap();
    let event = events.until("the cell in work", |event| {
        event["charts"]["cells"].as_array().is_some_and(|cells| cells.len() == 1)
            && part(event, "working").contains("30 of 100")
    });
    assert_eq!(event["charts"]["cells"][0]["kind"], "CartPole ppo ff, R");
    let report = event["report"].clone();
    cell.write_result(&crate::client::result(&plan.cells[1])).unwrap();
    drop((lock, training));
    let event = events.until("the result", |event| part(event, "head").contains("2 of 2 cells done"));
    assert_ne!(event["report"], report, "the report is another one");
    assert!(event["charts"]["cells"].as_array().unwrap().is_empty() && part(&event, "head").contains("finished"));
}

#[test]
fn an_old_report_says_so_until_it_is_built_again() {
    let place = Place::new();
    let folder = ExperimentFolder::new(&place.path("study"));
    let plan = Plan::load(&folder.plan_path()).unwrap();
    assert!(place.get("/report/study").body.contains("1 of 2 cells are done"));
    assert!(!place.get("/run/study").body.contains("newer than this report"));
    folder.cell(&plan.cells[1].id).write_result(&crate::client::result(&plan.cells[1])).unwrap();
    let older = place.until("/run/study", |page| page.body.contains("2 of 2 cells done"));
    assert!(older.body.contains("Some results are newer than this report"), "{}", older.body);
    assert!(place.get("/report/study").body.contains("1 of 2 cells are done"), "it is too recent to be built again");
    place.until("/run/study", |page| !page.body.contains("newer than this report"));
    assert!(!place.get("/report/study").body.contains("1 of 2 cells are done"));
}

#[test]
fn broken_files_are_named_on_the_page() {
    let place = Place::new();
    write(&place.path("one/config.toml"), "no = TOML =");
    write(&place.path("bad/plan.toml"), "environments = 7");
    let plan = Plan::load(&place.path("study/plan.toml")).unwrap();
    let result = place.path("study/cells").join(&plan.cells[1].id).join("result.json");
    write(&result, "{\"format_version\": 1, \"id");
    let index = place.get("/");
    assert_eq!((index.status, index.body.matches("not understood").count()), (200, 2), "{}", index.body);
    for (run, words) in [("one", "This training is not understood"), ("bad", "This experiment is not understood")] {
        let page = place.get(&format!("/run/{run}"));
        assert!(page.status == 200 && page.body.contains(words), "{}", page.body);
    }
    let page = place.get("/run/study");
    assert!(page.body.contains("result.json is not understood"), "{}", page.body);
    let report = place.get("/report/study");
    assert!(report.status == 200 && report.body.contains("There is no report now"), "{}", report.body);
    write_training(&place.path("one"), 3);
    write(&place.path("one/monitor.csv"), "r,l,t,success\n1,2,3,1\nx,2,4,1\n\u{0}\u{1}\n5,2,5,1\n");
    write(&place.path("one/checkpoint/checkpoint.json"), "{");
    write(&place.path("one/progress.csv"), "\u{fffd}\n\n,,,");
    let page = place.until("/run/one", |page| page.body.contains("monitor.csv: line 3: `x` is not a number"));
    assert!(page.body.contains("checkpoint.json is not a usable checkpoint"), "{}", page.body);
}

#[test]
fn folders_may_vanish_and_come_back() {
    let place = Place::new();
    let mut events = place.events("/events/one");
    let mut all = place.events("/events");
    events.until("the curve", |event| curve(event).is_object());
    std::fs::rename(place.path("one"), place.path(".hidden")).unwrap();
    events.until("the end", |event| event["gone"].is_string());
    assert_eq!(place.get("/run/one").status, 404);
    assert_eq!(place.get("/file/one/config.toml").status, 404);
    std::fs::rename(place.path(".hidden"), place.path("one")).unwrap();
    events.until("the run again", |event| curve(event).is_object());
    std::fs::rename(place.path(""), place.path("").with_file_name("elsewhere")).unwrap();
    let event = all.until("the end of all", |event| event["gone"].is_string());
    assert!(event["gone"].as_str().unwrap().contains("cannot list "), "{event}");
    assert_eq!(place.get("/").status, 404);
    std::fs::rename(place.path("").with_file_name("elsewhere"), place.path("")).unwrap();
    all.until("all again", |event| event["parts"].is_object());
    assert_eq!(place.get("/").status, 200);
}

#[test]
fn pipes_and_devices_do_not_block_pages() {
    let place = Place::new();
    let pipe = |name: &str| {
        let path = place.path(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let _ = std::fs::remove_file(&path);
        assert!(std::process::Command::new("mkfifo").arg(path).status().unwrap().success());
    };
    let plan = Plan::load(&place.path("study/plan.toml")).unwrap();
    let cell = |cell: usize, name: &str| format!("study/cells/{}/{name}", plan.cells[cell].id);
    pipe("one/monitor.csv");
    pipe("one/progress.csv");
    pipe("one/checkpoint/checkpoint.json");
    pipe(&cell(1, "result.json"));
    pipe(&cell(0, "training/monitor.csv"));
    pipe("study/heatmaps/a.json");
    write_training(&place.path("zeros"), 3);
    std::fs::remove_file(place.path("zeros/monitor.csv")).unwrap();
    std::os::unix::fs::symlink("/dev/zero", place.path("zeros/monitor.csv")).unwrap();
    for path in ["/", "/run/one", "/run/study", "/run/zeros", "/report/study"] {
        assert_eq!(place.get(path).status, 200, "{path}");
    }
    assert!(place.get("/run/one").body.contains("monitor.csv: it cannot be read: it is a pipe"));
    assert!(place.get("/run/study").body.contains("it is a pipe or a device"));
    assert_eq!(place.get("/file/one/monitor.csv").status, 404);
}

#[test]
fn files_behind_outside_links_are_not_quoted() {
    let place = Place::new();
    write(&place.folder.path().join("credentials.toml"), "[registry]\ntoken = \"secret-token");
    let link = |name: &str| {
        let _ = std::fs::remove_file(place.path(name));
        write(&place.path(name), "");
        std::fs::remove_file(place.path(name)).unwrap();
        std::os::unix::fs::symlink(place.folder.path().join("credentials.toml"), place.path(name)).unwrap();
    };
    let plan = Plan::load(&place.path("study/plan.toml")).unwrap();
    link("x/config.toml");
    link("y/plan.toml");
    link(&format!("study/cells/{}/result.json", plan.cells[1].id));
    for (path, words) in [
        ("/run/x", "config.toml is a link that leads out of the folder"),
        ("/run/y", "plan.toml is a link that leads out of the folder"),
        ("/run/study", "result.json is a link that leads out of the folder"),
        ("/report/y", "plan.toml is a link that leads out of the folder"),
        ("/report/study", "result.json is a link that leads out of the folder"),
        ("/", "not understood"),
    ] {
        let page = place.get(path);
        assert!(page.status == 200 && page.body.contains(words), "{path}: {}", page.body);
        assert!(!page.body.contains("token") && !page.body.contains("registry"), "{path}: {}", page.body);
    }
}

#[test]
fn pages_link_to_existing_files_only() {
    let place = Place::new();
    let plan = Plan::load(&place.path("study/plan.toml")).unwrap();
    let page = place.get("/run/study");
    assert!(
        page.body.contains(&format!("{}: done", plan.cells[0].id)) && !page.body.contains("href=\"../run/study/cells")
    );
    write_training(&place.path("study/cells").join(&plan.cells[0].id).join("training"), 20);
    let address = format!("href=\"../run/study/cells/{}/training\"", plan.cells[0].id);
    place.until("/run/study", |page| page.body.contains(&address));
    let sent = |page: &str| {
        ["config.toml", "monitor.csv", "progress.csv"].map(|name| page.contains(&format!("/one/{name}\"")))
    };
    assert_eq!(sent(&place.get("/run/one").body), [true; 3]);
    std::fs::remove_file(place.path("one/progress.csv")).unwrap();
    let page = place.until("/run/one", |page| !page.body.contains("/one/progress.csv\""));
    assert_eq!(sent(&page.body), [true, true, false]);
}

#[test]
fn files_are_read_at_most_once_a_second() {
    let place = Place::new();
    let begun = std::time::Instant::now();
    place.get("/run/one");
    write(&place.path("one/config.toml"), "no = TOML =");
    place.until("/run/one", |page| page.body.contains("not understood"));
    assert!(begun.elapsed() >= std::time::Duration::from_millis(900), "{:?}", begun.elapsed());
}

#[test]
fn a_single_run_can_be_served() {
    let place = Place::new();
    let address = crate::client::serve(&place.path("study"));
    let study = Place { address, ..place };
    assert!(study.get("/").body.contains("href=\"./run/\""));
    assert!(study.get("/run/").body.contains("1 of 2 cells done"));
    assert!(study.get("/report/").body.contains("1 of 2 cells are done"));
    study.events("/events/").until("an event", |event| event["parts"]["head"].is_string());
    assert_eq!(study.get("/file/plan.toml").status, 200);
}

#[test]
fn all_links_are_relative() {
    let place = Place::new();
    for path in ["/", "/run/one", "/run/study", "/run/missing", "/nothing/at/all"] {
        let page = place.get(path);
        for attribute in ["href=\"/", "src=\"/", "data-events=\"/"] {
            assert!(!page.body.contains(attribute), "{path}: {}", page.body);
        }
        let depth = path.matches('/').count() - 1;
        let style = format!("href=\"{}assets/style.css\"", if depth == 0 { "./".into() } else { "../".repeat(depth) });
        assert!(page.body.contains(&style), "{path}: {}", page.body);
    }
    let event = place.events("/events").until("the list", |event| part(event, "runs").contains("run/one"));
    assert!(part(&event, "runs").contains("href=\"./run/one\""), "{event}");
    let moved = place.get("/run/one/");
    assert!(moved.status == 308 && moved.head.contains("location: ../one\r\n"), "{}", moved.head);
}

#[test]
fn links_out_of_the_folder_are_named() {
    let place = Place::new();
    write_training(&place.folder.path().join("scratch/big"), 30);
    std::os::unix::fs::symlink("../scratch/big", place.path("linked")).unwrap();
    std::os::unix::fs::symlink("one", place.path("again")).unwrap();
    let page = place.until("/", |page| page.body.contains("are not followed"));
    assert!(page.body.contains("<code>linked</code>.") && !page.body.contains("run/again"), "{}", page.body);
    assert_eq!(place.get("/run/linked").status, 404);
}

#[test]
fn many_event_streams_leave_the_page_to_others() {
    let place = Place::new();
    let streams: Vec<_> = (0..500).map(|_| place.events("/events")).collect();
    let start = std::time::Instant::now();
    assert_eq!(place.get("/").status, 200);
    assert!(start.elapsed() < std::time::Duration::from_secs(8), "{:?}", start.elapsed());
    drop(streams);
}
