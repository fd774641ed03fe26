//! The README is true: every path that it names in code marks exists, and its test command is the one CI runs.

use std::path::Path;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn every_path_the_readme_names_exists() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let folders = ["shared/", "services/", "config/", "tests/", "src/", "docs/", ".ci/", "benches/"];
    let named: Vec<&str> = readme
        .split('`')
        .skip(1)
        .step_by(2)
        .filter(|text| folders.iter().any(|f| text.starts_with(f)) && !text.contains([' ', '\n', '*', '…', '<']))
        .collect();
    assert!(named.len() > 20, "the code map names the folders: found {named:?}");
    let missing: Vec<&&str> = named.iter().filter(|path| !root().join(path).exists()).collect();
    assert!(missing.is_empty(), "the README names what is not there: {missing:?}");
}

#[test]
fn ci_runs_the_readmes_test_command() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let ci = std::fs::read_to_string(root().join(".ci/run")).unwrap();
    let command = "cargo test --locked --workspace";
    assert!(readme.contains(command) && ci.contains(command));
}
