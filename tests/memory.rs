//! Memory as promised: what `plan` predicts is what the real program takes, and less than that is refused instead of dying of it.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, reason = "a test")]

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

/// Full size, as the promise says; frames come as fast as they are processed.
const SIZE: usize = 250;

fn board(dir: &Path) -> String {
    let text = "inherit = \"x86-sim\"\n[cameras.raw]\npaced = false\n[cameras.guide]\npaced = false\n";
    let file = dir.join("own.toml");
    std::fs::write(&file, text).unwrap();
    file.display().to_string()
}

fn stokescope() -> Command {
    Command::new(env!("CARGO_BIN_EXE_stokescope"))
}

fn run(program: &mut Command, board: &str, out: &Path) -> Output {
    let options = ["--json", "run", "--frames", "20", "--iterations", "4", "--no-preview", "--board", board, "--out"];
    program.args(options).arg(out).output().unwrap()
}

fn plan(board: &str) -> Value {
    let output = stokescope().args(["--json", "plan", "--board", board]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn the_process_takes_what_was_planned() {
    let dir = tempfile::tempdir().unwrap();
    let board = board(dir.path());
    let output = run(&mut stokescope(), &board, &dir.path().join("out"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
    let plan = plan(&board);
    assert_eq!(plan["size"], serde_json::json!([SIZE, SIZE]));
    // the preview's share is planned and not used here
    let unused: f64 = ["preview", "clients"].iter().map(|stage| plan["stages"][stage].as_f64().unwrap()).sum();
    let planned = plan["peak_rss_bytes"].as_f64().unwrap() - unused;
    let measured = summary["peak_rss_bytes"].as_f64().unwrap();
    let error = planned / measured - 1.0;
    println!("planned {:.1} MB, measured {:.1} MB: {:+.1} %", planned / 1e6, measured / 1e6, 100.0 * error);
    assert!(error.abs() <= 0.15, "planned {planned}, measured {measured}");
}

/// The program under a limit on its data.
fn limited(bytes: u64) -> Command {
    let mut command = Command::new("sh");
    let kibibytes = bytes / 1024;
    command.args(["-c", &format!("ulimit -d {kibibytes} && exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_stokescope")]);
    command
}

#[test]
fn it_runs_inside_its_plan_and_refuses_less() {
    let dir = tempfile::tempdir().unwrap();
    let board = board(dir.path());
    let plan = plan(&board);
    let peak = plan["peak_rss_bytes"].as_u64().unwrap();
    // stacks are counted whole by this limit
    let enough = run(&mut limited(peak + (10 << 20)), &board, &dir.path().join("enough"));
    assert!(enough.status.success(), "{}", String::from_utf8_lossy(&enough.stderr));
    for share in [2, 3, 4] {
        let less = run(&mut limited(peak / share), &board, &dir.path().join("less"));
        let said = String::from_utf8_lossy(&less.stderr).into_owned();
        assert_eq!(less.status.code(), Some(78), "{share}: {said}");
        assert!(said.contains("memory:") && said.contains(" need ") && said.contains("the limit is"), "{said}");
    }
}
