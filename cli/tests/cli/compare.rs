//! `perturb compare` with trainings and with recorded episodes.

use super::common::{perturb, stderr};

fn printed(arguments: &[&str]) -> String {
    let output = perturb(arguments).output().expect("perturb runs");
    assert!(output.status.success(), "{}", stderr(&output));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn conditions_are_compared_over_seeds_and_episodes() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = |name: &str| directory.path().join(name).display().to_string();
    for (condition, version) in [("plain", "D"), ("random", "R")] {
        for seed in ["1", "2"] {
            let out = path(&format!("{condition}/{seed}"));
            let train = ["train", "--env", "CartPole", "--version", version, "--episodes", "20", "--seed", seed];
            printed(&[&train[..], &["--out", &out]].concat());
        }
    }
    let episodes = ["--versions", "D,E", "--episodes", "10"];
    let [plain, random] = ["plain", "random"].map(path);
    let text = printed(&[&["compare", &plain, &random], &episodes[..]].concat());
    assert!(text.contains("random − plain") && text.contains("two seeds decide nothing."), "{text}");
    let page = path("compared.html");
    printed(&[&["compare", &plain, &random, "--html", &page], &episodes[..]].concat());
    let page = std::fs::read_to_string(page).expect("a page");
    assert!(page.contains("random − plain") && page.contains("two seeds decide nothing."), "{page}");
    let named = [format!("a={plain}/1,{plain}/2"), format!("b={random}/2")];
    let json = printed(&[&["compare", &named[0], &named[1], "--json"], &episodes[..]].concat());
    let told: serde_json::Value = serde_json::from_str(&json).expect("JSON and nothing else");
    let it = &told["differences"][0];
    assert_eq!(
        (&it["x"], &it["y"], &it["paired"], &it["seeds_95"]),
        (&"b".into(), &"a".into(), &false.into(), &().into())
    );
    assert_eq!((&it["same_episodes"], told["means"].as_array().map(Vec::len)), (&true.into(), Some(4)));

    // Recorded episodes are not played again.
    let records = path("records.parquet");
    let evaluate = ["evaluate", "--checkpoint", &format!("{plain}/1"), "--seed", "1", "--records", &records];
    let by_length = printed(&[&evaluate[..], &episodes, &["--by", "length"]].concat());
    assert!(by_length.contains("length"), "{by_length}");
    let recorded = printed(&["compare", &format!("a={records}"), &format!("b={records}"), "--score", "return"]);
    assert!(recorded.contains("+0.0 [+0.0, +0.0] over episodes: one seed each supports no conclusion"), "{recorded}");
    let rescored = printed(&["rescore", &records, "--by", "length"]);
    let rates: Vec<f64> = rescored
        .lines()
        .skip_while(|line| !line.starts_with("success: "))
        .map(str::trim_start)
        .filter(|line| line.starts_with("E ") && line.contains('…'))
        .filter_map(|line| line.split_whitespace().nth(5)?.parse().ok())
        .collect();
    assert!(rates.len() > 1 && rates.is_sorted(), "the worst first: {rescored}");

    for (arguments, part) in [
        (vec!["compare", "nowhere"], "nowhere"),
        (vec!["compare", &records, &records], "`records` twice"),
        (vec!["rescore", &records, "--by", "size"], "give context or one of force, length, mass"),
        (vec!["rescore", &records, "--by", "context"], "name a parameter"),
    ] {
        let output = perturb(&arguments).output().expect("perturb runs");
        assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
        assert!(stderr(&output).contains(part), "{}", stderr(&output));
    }
}

#[test]
fn rows_of_a_results_table_are_compared() {
    let table = concat!(env!("CARGO_MANIFEST_DIR"), "/../results/results.parquet");
    let study = format!("{table}/classic-ff");
    let chosen = ["--where", "environment=cart-pole", "trained_on=R", "seed=2..6", "algorithm=a2c,ppo"];
    let json = printed(&[&["compare", &study, "--by", "algorithm", "--json"], &chosen[..]].concat());
    let told: serde_json::Value = serde_json::from_str(&json).expect("JSON and nothing else");
    let rows = perturb_records::ResultsTable::read(table.as_ref()).expect("a table");
    let on_e: Vec<f64> = rows
        .rows()
        .iter()
        .filter(|row| (row.study.as_str(), row.environment.as_str()) == ("classic-ff", "CartPole"))
        .filter(|row| (row.trained_on.as_str(), row.algorithm.as_str()) == ("R", "ppo") && row.seed > 1)
        .filter(|row| row.tested_on.as_deref() == Some("E"))
        .filter_map(|row| Some(row.result()?.success_percent))
        .collect();
    let means = told["means"].as_array().expect("means");
    let it = means.iter().find(|it| it["condition"] == "ppo" && it["tested_on"] == "E").expect("a mean");
    assert_eq!((on_e.len(), &it["by_seed"]), (5, &serde_json::json!(on_e)));
    assert_eq!((&told["environment"], &told["from_counts"]), (&"CartPole".into(), &true.into()));
    let text = printed(
        &[
            &["compare", &format!("a={study}"), &format!("b={study}"), "--versions", "E"],
            &chosen[..4],
            &["algorithm=ppo"],
        ]
        .concat(),
    );
    assert!(text.contains("b − a") && text.contains("Rows of a results table have no episodes"), "{text}");
    for (arguments, part) in [
        (vec![&study[..]], "one environment; choose its rows"),
        (vec![&study, "--where", "environment=CartPole"], "several policies of seed"),
        (vec![&study, "--where", "colour=red"], "a setting, or one of study, cell"),
        (vec![&study, "--where", "seed=77"], "no row of classic-ff is chosen; the studies of the table are"),
        (vec![&study, "nowhere"], "results tables alone"),
        (vec!["nowhere", "--by", "algorithm"], "choose rows of results tables"),
        (vec![&study, "--success", "code"], "are not tested again"),
    ] {
        let output = perturb(&[&["compare"], &arguments[..]].concat()).output().expect("perturb runs");
        assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
        assert!(stderr(&output).contains(part), "{}", stderr(&output));
    }
}
