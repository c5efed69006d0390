//! `stokescope bench`, as a user starts it.
#![allow(clippy::unwrap_used, reason = "a test")]

use assert_cmd::Command;
use serde_json::Value;

#[test]
fn bench_measures_and_writes_what_it_says() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("new");
    let bench = "bench --json --size 64 --iterations 1,3 --methods guided,fista-published-scaled --out";
    let done = Command::cargo_bin("stokescope").unwrap().args(bench.split(' ')).arg(&out).assert().success();
    let answer: Value = serde_json::from_slice(&done.get_output().stdout).unwrap();

    let mean = answer["mean"].as_array().unwrap();
    let kinds: Vec<_> =
        mean.iter().map(|r| (r["method"].as_str().unwrap(), r["iterations"].as_u64().unwrap())).collect();
    assert_eq!(
        kinds,
        [("guide-only", 0), ("guided", 1), ("guided", 3), ("fista-published-scaled", 1), ("fista-published-scaled", 3)]
    );
    let figure = |row: usize, key: &str| mean[row][key].as_f64().unwrap();
    // Two iterations of guided are 4 FFTs each, of FISTA over four angles 8.
    assert_eq!([figure(2, "ffts") - figure(1, "ffts"), figure(4, "ffts") - figure(3, "ffts")], [8.0, 16.0]);
    assert_eq!(figure(4, "time_ratio"), 1.0);
    // What the guide alone cannot know.
    assert!(figure(2, "aolp_mae_deg") < 0.7 * figure(0, "aolp_mae_deg"), "polarization is found: {answer}");
    assert!(figure(2, "seconds") > 0.0 && answer["machine"]["cores"].as_u64().unwrap() >= 1);

    let csv = std::fs::read_to_string(out.join("bench.csv")).unwrap();
    let scenes = answer["scenes"].as_array().unwrap().len();
    assert_eq!(csv.lines().count(), 1 + (scenes + 1) * mean.len());
    assert!(std::fs::read(out.join("bench.png")).unwrap().starts_with(b"\x89PNG"));
}

#[test]
fn a_suite_is_measured_with_its_guides_aligned_or_as_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let suite = dir.path().to_str().unwrap();
    let stokescope = |arguments: &str| {
        let done = Command::cargo_bin("stokescope").unwrap().args(arguments.split(' ')).assert().success();
        done.get_output().stdout.clone()
    };
    stokescope(&format!("simulate --scene spheres --size 96 --shift 3 -2 --out {suite}/spheres"));
    let s12_psnr = |register: &str| {
        let bench = format!("bench --json --suite {suite} --methods guided --iterations 5 {register}");
        let answer: Value = serde_json::from_slice(&stokescope(&bench)).unwrap();
        answer["mean"][1]["s12_psnr"].as_f64().unwrap()
    };
    let (as_it_is, aligned) = (s12_psnr("--register off"), s12_psnr("--register on"));
    assert!(
        aligned > as_it_is + 1.0,
        "{aligned:.2} dB beside an aligned guide, {as_it_is:.2} dB beside one that is off"
    );
}

#[test]
fn frames_of_a_video_go_on_from_the_last_and_are_held_against_frames_by_themselves() {
    let bench = "bench --json --video --size 32";
    let done = Command::cargo_bin("stokescope").unwrap().args(bench.split(' ')).assert().success();
    let rows: Value = serde_json::from_slice(&done.get_output().stdout).unwrap();
    let rows = rows.as_array().unwrap();
    assert_eq!(rows.len(), 60, "ten frames of six videos");
    for (k, row) in rows.iter().enumerate() {
        let (first, video) = (k % 10 == 0, row["video"].as_str().unwrap());
        assert_eq!(row["frame"], k % 10, "{row}");
        assert_eq!(row["course"] == "cold", first, "{row}");
        if video.starts_with("still") {
            assert_eq!(row["averaged"], k % 10 + 1, "{row}");
        }
        // The first has no other to go on from: it is a frame by itself.
        assert_eq!(row["s12_psnr"] == row["s12_psnr_cold"], first, "{row}");
    }
}

#[test]
fn alignment_is_asked_for_only_where_it_is_a_choice() {
    for other in ["--solver", "--video", "--models"] {
        let run = Command::cargo_bin("stokescope").unwrap().args(["bench", other, "--register", "on"]).assert().code(2);
        let said = String::from_utf8_lossy(&run.get_output().stderr).into_owned();
        assert!(said.contains("--register") && said.contains(other), "{said}");
    }
}
