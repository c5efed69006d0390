//! `explain` makes a page from a result folder, through the real binary.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::path::Path;
use std::process::{Command, Output};

fn stokescope(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_stokescope")).args(args).output().unwrap()
}

fn explained(folder: &Path) -> (String, String) {
    let done = stokescope(&["explain", folder.to_str().unwrap()]);
    let stderr = String::from_utf8(done.stderr).unwrap();
    assert!(done.status.success(), "{stderr}");
    let printed = String::from_utf8(done.stdout).unwrap();
    (std::fs::read_to_string(printed.trim()).unwrap(), printed)
}

#[test]
fn a_result_is_explained_and_one_of_a_wrong_set_up_with_its_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (device, out) = (path("device"), path("out"));
    assert!(stokescope(&["simulate", "--size", "96", "--out", &device]).status.success());
    let reconstruct = || {
        let [raw, guide] = ["raw", "guide"].map(|name| format!("{device}/{name}.npy"));
        let files = ["--calibration", &device, "--raw", &raw, "--guide", &guide, "--out", &out];
        stokescope(&[&["reconstruct"][..], &files, &["--fusion", "off", "--force"]].concat())
    };
    assert!(reconstruct().status.success());
    let (html, printed) = explained(Path::new(&out));
    assert!(printed.trim().ends_with("explain.html"), "{printed}");
    for part in
        ["<b>Credible.</b>", "Method guided solved for S1, S2", "the model explains them", "Nothing needs to be done."]
    {
        assert!(html.contains(part), "{part}: {html}");
    }
    for picture in ["intensity.png", "dolp.png", "aolp.png", "composite.png", "dolp_error.png"] {
        assert!(html.contains(picture) && Path::new(&out).join(picture).is_file(), "{picture}");
    }

    let description = format!("{device}/calibration.toml");
    let text = std::fs::read_to_string(&description).unwrap();
    std::fs::write(&description, text.replace("[0, 45, 90, 135]", "[0, 90, 45, 135]")).unwrap();
    assert!(reconstruct().status.success());
    let (html, _) = explained(Path::new(&out));
    assert!(!html.contains("<b>Credible.</b>") && html.contains("in the order 1, 3, 2, 4"), "{html}");
}

#[test]
fn a_folder_without_a_report_is_refused_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let missing = stokescope(&["explain", folder.path().to_str().unwrap()]);
    assert_eq!(missing.status.code(), Some(66));
    assert!(String::from_utf8(missing.stderr).unwrap().contains("report.json: no such file"));
    std::fs::write(folder.path().join("report.json"), "{").unwrap();
    let broken = stokescope(&["explain", folder.path().to_str().unwrap()]);
    assert_eq!(broken.status.code(), Some(65));
    assert!(String::from_utf8(broken.stderr).unwrap().contains("report.json: report is EOF"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
