//! `perturb compare`, of trainings and of recorded episodes.

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

    // What was recorded is not played again.
    let records = path("records.parquet");
    let evaluate = ["evaluate", "--checkpoint", &format!("{plain}/1"), "--seed", "1", "--records", &records];
    let by_length = printed(&[&evaluate[..], &episodes, &["--by", "length"]].concat());
    assert!(by_length.contains("length"), "{by_length}");
    let recorded = printed(&["compare", &format!("a={records}"), &format!("b={records}"), "--score", "return"]);
    assert!(recorded.contains("+0.0 [+0.0, +0.0] over episodes: one seed of each says nothing"), "{recorded}");
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
