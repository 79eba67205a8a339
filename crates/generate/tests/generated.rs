//! Test that the generated files in the repository are up to date.

#[test]
fn generated_files_are_up_to_date() {
    let files = perturb_generate::generated().expect("the build script's files");
    assert!(files.len() >= 6, "only {} files are generated", files.len());
    for file in files {
        assert!(file.is_up_to_date(), "{} is out of date: run `make generate`", file.path.display());
    }
}
