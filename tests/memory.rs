//! Memory as promised: what `plan` predicts is what the real program takes, and less than that is refused instead of dying of it.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, reason = "a test")]

mod emulated;

use std::path::Path;
use std::process::{Command, Output};

use emulated::slowness;
use serde_json::Value;

/// Boards whose promise is tried here, with simulated cameras in place of theirs: name, pixels a side, fusion model, whether frames come at
/// their rate, bytes of the whole process. Code as tests build it takes some 6 MiB more than as it is shipped.
const BOARDS: [(&str, usize, &str, bool, u64); 5] = [
    ("x86-sim", 250, "off", false, 72 << 20),
    ("x86-sim", 250, "off", true, 76 << 20),
    ("x86-sim", 250, "default", false, 100 << 20),
    ("rpi-zero-2w", 192, "off", false, 56 << 20),
    ("rpi4", 250, "off", false, 78 << 20),
];

/// Frames come as fast as they are processed, or with `paced` at their rate, from a clip.
fn board(dir: &Path, base: &str, size: usize, model: &str, paced: bool) -> String {
    let camera = format!("backend = \"sim\"\nsource = \"plastic,size={size}\"\npaced = {paced}\nsync = \"off\"\n");
    let cameras = format!("[cameras.raw]\n{camera}[cameras.guide]\n{camera}");
    let file = dir.join(format!("own-{base}.toml"));
    let own = format!(
        "inherit = \"{base}\"\n[fusion]\nmodel = \"{model}\"\n[cameras]\ncalibration = \"simulated\"\n{cameras}"
    );
    std::fs::write(&file, own).unwrap();
    file.display().to_string()
}

/// Whether the program runs under an emulator, whose own memory would be measured and limited. Says so: nothing is proven then.
fn emulated() -> bool {
    let emulated = slowness() > 1;
    if emulated {
        eprintln!("skipped, not passed: memory under an emulator is the emulator's");
    }
    emulated
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
    if emulated() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    for (base, size, model, paced, promised) in BOARDS.into_iter().filter(|b| b.2 == "off" || cfg!(feature = "fusion"))
    {
        let board = board(dir.path(), base, size, model, paced);
        let output = run(&mut stokescope(), &board, &dir.path().join("out"));
        assert!(output.status.success(), "{base}: {}", String::from_utf8_lossy(&output.stderr));
        let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
        let plan = plan(&board);
        assert_eq!(plan["size"], serde_json::json!([size, size]));
        // the preview's share is planned and not used here
        let unused: f64 = ["preview", "clients"].iter().map(|stage| plan["stages"][stage].as_f64().unwrap()).sum();
        let planned = plan["peak_rss_bytes"].as_f64().unwrap() - unused;
        let measured = summary["peak_rss_bytes"].as_f64().unwrap();
        let error = planned / measured - 1.0;
        println!(
            "{base}, model {model}: planned {:.1} MB, measured {:.1} MB: {:+.1} %",
            planned / 1e6,
            measured / 1e6,
            100.0 * error
        );
        assert!(error.abs() <= 0.15, "{base}: planned {planned}, measured {measured}");
        assert!(measured <= promised as f64, "{base}: measured {measured}, promised {promised}");
    }
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
    if emulated() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let board = board(dir.path(), "x86-sim", 250, "off", false);
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

#[test]
fn a_zero_2_w_runs_in_its_share_of_the_machine() {
    if emulated() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let board = board(dir.path(), "rpi-zero-2w", 192, "off", false);
    // what the unit gives it; stacks are counted whole
    let output = run(&mut limited(48 << 20), &board, &dir.path().join("out"));
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(summary["frames"], 20, "{said}");
    assert!(summary["peak_rss_bytes"].as_u64().unwrap() <= 48 << 20, "{summary}");
}
