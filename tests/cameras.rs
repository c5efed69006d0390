//! Cameras that fail, as the user of `stokescope run` meets them.
#![allow(clippy::unwrap_used, reason = "a helper that fails is a test that fails")]

use std::path::Path;
use std::process::Command;

fn stokescope(args: &[&str]) -> (i32, String, String) {
    let output =
        Command::new(env!("CARGO_BIN_EXE_stokescope")).args(args).env_remove("STOKESCOPE_LOG").output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

/// The simulated board with other cameras; `raw` and `guide` are the lines of their tables.
fn board(dir: &Path, calibration: &str, raw: &str, guide: &str) -> String {
    let shipped = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("boards/x86-sim.toml")).unwrap();
    let camera = "backend = \"sim\"\nsource = \"wedges,size=250\"\nframe_rate = 10.0\n";
    assert_eq!(shipped.matches(camera).count(), 2);
    let text = shipped.replacen(camera, raw, 1).replacen(camera, guide, 1);
    let text = text.replace("\"simulated\"", &format!("{calibration:?}")).replace("iterations = 20", "iterations = 2");
    let path = dir.join("board.toml");
    std::fs::write(&path, text).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn a_stuck_camera_is_named_and_opened_again_and_the_run_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let text = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    assert_eq!(stokescope(&["simulate", "--size", "48", "--out", &text("session")]).0, 0);
    // one file shown again and again is what a stuck sensor looks like
    let replay =
        |more: &str| format!("backend = \"replay\"\nsource = {:?}\nframe_rate = 20.0\n{more}\n", text("session"));
    let board = board(dir.path(), &text("session"), &replay("max_identical = 3"), &replay(""));
    let (code, summary, log) = stokescope(&[
        "--json",
        "run",
        "--board",
        &board,
        "--frames",
        "5",
        "--no-preview",
        "--fusion",
        "off",
        "--out",
        &text("out"),
    ]);
    assert_eq!(code, 0, "{log}");
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["frames"], 5);
    let stuck = "raw camera offline: replayed raw camera";
    assert!(log.contains(stuck) && log.contains("stuck, 3 frames of exactly the same content"), "{log}");
    assert!(log.contains("raw camera: frames again") && !log.contains("guide camera offline"), "{log}");
}

#[test]
fn a_camera_that_cannot_be_had_ends_the_run_with_the_reason() {
    let dir = tempfile::tempdir().unwrap();
    let text = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let sim = "backend = \"sim\"\nsource = \"plastic,size=48\"\n";
    let run = |raw: &str| {
        let board = board(dir.path(), "simulated", raw, sim);
        let (code, _, log) =
            stokescope(&["run", "--board", &board, "--frames", "1", "--no-preview", "--out", &text("out")]);
        (code, log)
    };
    let (code, log) = run("backend = \"usb\"\nsource = \"\"\n");
    assert!(code == 69 && log.contains("camera backend `usb` is not available: allowed: sim, replay"), "{code}: {log}");
    let (code, log) = run("backend = \"sim\"\nsource = \"plastic,size=48\"\nbits = 12\n");
    assert!(code == 69 && log.contains("takes no width, height, format, bits, sync, trigger"), "{code}: {log}");
    if !cfg!(feature = "v4l2") {
        let (code, log) = run("backend = \"v4l2\"\nsource = \"/dev/video0\"\n");
        assert!(code == 69 && log.contains("cargo build --features v4l2"), "{code}: {log}");
    }
}
