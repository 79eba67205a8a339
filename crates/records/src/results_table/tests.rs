use super::*;
use crate::parquet_file::ColumnValues;

fn row(study: &str, cell: &str, tested_on: &str) -> TableRow {
    TableRow {
        schema_version: SCHEMA_VERSION,
        study: study.into(),
        cell: cell.into(),
        environment: "CartPole".into(),
        revision: Some(1),
        model_hash: None,
        algorithm: "ppo".into(),
        architecture: "ff".into(),
        preset: "paper".into(),
        observe: "state".into(),
        trained_on: "R".into(),
        tested_on: Some(tested_on.into()),
        run: 2,
        seed: u64::MAX,
        after_episodes: Some(15_000),
        episodes: Some(1000),
        successes: Some(333),
        mean_return: Some(-1.0 / 3.0),
        mean_length: Some(82.1),
        cvar_10: Some(1e-300),
        timesteps: Some(u64::MAX),
        seconds: Some(0.1),
        commit: "0.1.0 (a); 0.1.0 (b)".into(),
        settings: r#"{"learning_rate":0.0003}"#.into(),
        checksum: Some("aa".into()),
        failure: None,
    }
}

fn table() -> ResultsTable {
    let mut table = ResultsTable::default();
    let plan = |text: &str| StudyPlan { plan: text.into(), csv_files: BTreeMap::new() };
    table.merge("one", plan("runs = 1"), vec![row("one", "a", "D"), row("one", "a", "E"), row("one", "b", "D")]);
    table.merge("two", plan("runs = 2"), vec![row("two", "a", "D")]);
    table
}

#[test]
fn table_reads_back_bit_for_bit_with_the_same_bytes() {
    let directory = tempfile::tempdir().unwrap();
    let [one, other] = ["one.parquet", "other.parquet"].map(|name| directory.path().join(name));
    let mut table = table();
    let failed = TableRow {
        tested_on: None,
        episodes: None,
        successes: None,
        mean_return: None,
        checksum: None,
        failure: Some("not finite".into()),
        ..row("two", "failed", "")
    };
    let plan = table.studies["two"].clone();
    table.merge("two", plan, vec![failed]);
    table.write(&one).unwrap();
    table.write(&other).unwrap();
    assert_eq!(std::fs::read(&one).unwrap(), std::fs::read(&other).unwrap());
    let read = ResultsTable::read(&one).unwrap();
    assert_eq!(read, table);
    assert_eq!(read.of_study("two").len(), 2);
    assert_eq!(read.rows().last().unwrap().result(), None);
    let csv = String::from_utf8(table.to_csv().unwrap()).unwrap();
    assert!(csv.starts_with("study,cell,environment,revision,model_hash,"), "{csv}");
    assert!(csv.contains("\ntwo,failed,CartPole,1,,ppo,ff,paper,state,R,,2,"), "{csv}");
    let result = read.rows()[0].result().unwrap();
    assert_eq!((result.success_percent, result.mean_return), (33.3, -1.0 / 3.0));
}

#[test]
fn merging_is_idempotent_and_by_cell() {
    let mut table = table();
    let before = table.clone();
    let plan = table.studies["one"].clone();
    let same = vec![row("one", "a", "D"), row("one", "a", "E")];
    let counts = table.merge("one", plan.clone(), same);
    assert_eq!((counts, &table), (MergeCounts { unchanged: 1, ..MergeCounts::default() }, &before));
    let changed = vec![TableRow { successes: Some(1), ..row("one", "a", "D") }, row("one", "c", "D")];
    let counts = table.merge("one", plan, changed);
    assert_eq!(counts, MergeCounts { added: 1, replaced: 1, unchanged: 0 });
    let cells: Vec<_> = table.rows().iter().map(|row| (&*row.study, &*row.cell, row.successes)).collect();
    let expected = [("one", "a", Some(1)), ("one", "b", Some(333)), ("one", "c", Some(333)), ("two", "a", Some(333))];
    assert_eq!(cells, expected, "the other study has a cell of the same name");
}

#[test]
fn merging_keeps_what_deleted_files_had_said() {
    let mut table = table();
    let before = table.clone();
    let plan = table.studies["two"].clone();
    let bare = TableRow { cvar_10: None, seconds: None, checksum: None, ..row("two", "a", "D") };
    assert_eq!(table.merge("two", plan.clone(), vec![bare.clone()]).unchanged, 1);
    assert_eq!(table, before);
    let other = TableRow { successes: Some(5), ..bare };
    assert_eq!(table.merge("two", plan, vec![other.clone()]).replaced, 1);
    assert_eq!(table.rows().last(), Some(&other), "the old checksum was of other episodes");
}

#[test]
fn columns_are_found_by_name_and_missing_ones_are_named() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("results.parquet");
    let table = table();
    let about = r#"{"schema_version":1,"studies":{}}"#;
    let write = |columns: &[(String, ColumnValues<'_>)], about: &str| {
        write_atomically(&path, &encode(MESSAGE, columns, about.into(), &one_group(columns)).unwrap()).unwrap();
        ResultsTable::read(&path)
    };
    let mut columns = table.columns();
    columns.reverse();
    columns.push(("note".into(), ColumnValues::Number(vec![0.5; 4])));
    assert_eq!(write(&columns, about).unwrap().rows(), table.rows(), "another order, and a column of a later program");
    columns.retain(|(name, _)| name != "seed");
    let message = write(&columns, about).unwrap_err().to_string();
    assert!(message.contains("results.parquet is not a results table: it has no column seed"), "{message}");
    let message = write(&table.columns(), r#"{"schema_version":2,"studies":{}}"#).unwrap_err().to_string();
    assert!(message.contains("has schema version 2, this program reads 1 to 1"), "{message}");
    std::fs::write(&path, "text").unwrap();
    let message = ResultsTable::read(&path).unwrap_err().to_string();
    assert!(message.contains("it is not a Parquet file"), "{message}");
    let message = ResultsTable::read(&directory.path().join("none")).unwrap_err().to_string();
    assert!(message.starts_with("there is no results table"), "{message}");
}

#[test]
fn rows_are_chosen_by_their_values_and_grouped() {
    let table = table();
    let chosen = |study: Option<&str>, filters: &[&str], by: &[&str]| -> Result<Vec<(String, usize)>, String> {
        let filters: Vec<RowFilter> = filters.iter().map(|text| text.parse().unwrap()).collect();
        let by: Vec<String> = by.iter().map(|&column| column.to_owned()).collect();
        let groups = table.choose(study, &filters, &by).map_err(|error| error.to_string())?;
        Ok(groups.into_iter().map(|(name, rows)| (name, rows.len())).collect())
    };
    assert_eq!(chosen(None, &[], &[]), Ok(vec![(String::new(), 4)]));
    assert_eq!(chosen(Some("one"), &["tested_on=d"], &["cell"]), Ok(vec![("a".into(), 1), ("b".into(), 1)]));
    let by_rate =
        chosen(None, &["environment=cart-pole", "run=1..2", "learning_rate=3e-4"], &["study", "learning_rate"]);
    assert_eq!(by_rate, Ok(vec![("one learning_rate=0.0003".into(), 3), ("two learning_rate=0.0003".into(), 1)]));
    assert_eq!(chosen(None, &["run=3..9"], &[]), Ok(vec![]));
    assert_eq!(chosen(None, &["cell=b,c"], &[]), Ok(vec![(String::new(), 1)]));
    assert!(chosen(None, &["colour=red"], &[]).unwrap_err().contains("a setting, or one of study, cell, environment"));
    assert!("algorithm".parse::<RowFilter>().unwrap_err().to_string().contains("COLUMN=VALUES"));
    assert!("seed=a..b".parse::<RowFilter>().is_err());
}

#[test]
fn groups_with_different_texts_have_different_names() {
    let mut table = ResultsTable::default();
    let plan = StudyPlan { plan: "runs = 1".into(), csv_files: BTreeMap::new() };
    let spaced = [("a b", "c"), ("a", "b c")];
    table.merge("one", plan, spaced.map(|(cell, tested_on)| row("one", cell, tested_on)).into());
    let groups = table.choose(None, &[], &["cell".to_owned(), "tested_on".to_owned()]).unwrap();
    let names: Vec<&str> = groups.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, [r#""a b" c"#, r#"a "b c""#]);
}
