//! Batches on the command line: every frame once, by its own guide, in the order that people count, and what is wrong by name.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::path::Path;
use std::process::Command;

use stokescope::files::{read_npy, write_npy};
use tempfile::TempDir;

/// Runs the program; returns its exit code, stdout and stderr.
fn stokescope(args: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_stokescope")).args(args).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

const FRAMES: usize = 11;

/// A bundle of a device with a field stop, with `FRAMES` raw frames and guides, named r/frame_1.npy … and g/frame_01.npy ….
fn captures() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("s").display().to_string();
    let count = FRAMES.to_string();
    let field_stop = ["--surround", "0", "--guide-margin", "0"];
    let args = ["simulate", "--scene", "wedges", "--size", "48", "--frames", &count, "--out", &out];
    let (code, _, e) = stokescope(&[&args[..], &field_stop].concat());
    assert_eq!(code, 0, "{e}");
    for (from, to) in [("raw", "r"), ("guide", "g")] {
        std::fs::create_dir(dir.path().join(to)).unwrap();
        for index in 0..FRAMES {
            let number = if to == "r" { format!("{}", index + 1) } else { format!("{:02}", index + 1) };
            let source = dir.path().join(format!("s/{from}/{index:06}.npy"));
            std::fs::copy(source, dir.path().join(format!("{to}/frame_{number}.npy"))).unwrap();
        }
    }
    dir
}

/// Runs a batch of a few iterations in `dir`.
fn batch(dir: &Path, raw: &str, guide: &str, more: &[&str]) -> (i32, String, String) {
    let path = |name: &str| dir.join(name).display().to_string();
    let [bundle, raw, guide, out] = ["s", raw, guide, "out"].map(path);
    let args = ["reconstruct", "--calibration", &bundle, "--raw", &raw, "--guide", &guide, "--out", &out];
    stokescope(&[&args[..], &["--iterations", "3", "--threads", "1"], more].concat())
}

/// The result of one frame by itself.
fn alone(dir: &Path, raw: &str, guide: &str) -> Vec<f32> {
    let path = |name: &str| dir.join(name).display().to_string();
    let [bundle, raw, guide, out] = ["s", raw, guide, "one"].map(path);
    let args = ["reconstruct", "--calibration", &bundle, "--raw", &raw, "--guide", &guide, "--out", &out];
    let (code, _, e) = stokescope(&[&args[..], &["--iterations", "3", "--threads", "1"]].concat());
    assert_eq!(code, 0, "{e}");
    read_npy(&dir.join("one/stokes.npy")).unwrap().into_f32()
}

fn table(dir: &Path) -> Vec<String> {
    std::fs::read_to_string(dir.join("out/report.csv")).unwrap().lines().map(str::to_owned).collect()
}

#[test]
fn a_folder_is_solved_frame_by_frame_as_each_by_itself() {
    let dir = captures();
    std::fs::write(dir.path().join("r/._frame_1.npy"), "not an image").unwrap();
    let (code, stdout, e) = batch(dir.path(), "r", "g", &[]);
    assert_eq!((code, stdout.contains("11 frames"), stdout.contains("0 failed")), (0, true, true), "{stdout}{e}");
    let table = table(dir.path());
    assert_eq!(table.len(), FRAMES + 1);
    for (number, row) in table.iter().enumerate().skip(1) {
        let (raw, guide) = (format!("r/frame_{number}.npy"), format!("g/frame_{number:02}.npy"));
        assert!(row.contains(&raw) && row.contains(&guide), "{row}");
        let found = read_npy(&dir.path().join(format!("out/frame_{number}.npy"))).unwrap();
        assert_eq!(found.shape, [3, 48, 48]);
        assert!(found.into_f32() == alone(dir.path(), &raw, &guide), "{raw}");
    }
}

#[test]
fn patterns_take_what_they_match_and_tiff_has_all_planes() {
    let dir = captures();
    for (format, ending) in [("tiff", "tif"), ("ome-tiff", "ome.tif")] {
        let (code, stdout, e) =
            batch(dir.path(), "r/frame_[79].npy", "g/frame_0[79].npy", &["--format", format, "--json"]);
        assert_eq!(code, 0, "{e}");
        assert!(stdout.contains("\"frames\":2"), "{stdout}");
        let file = std::fs::File::open(dir.path().join(format!("out/frame_9.{ending}"))).unwrap();
        let mut tiff = tiff::decoder::Decoder::new(file).unwrap();
        let mut planes = Vec::new();
        loop {
            let tiff::decoder::DecodingResult::F32(plane) = tiff.read_image().unwrap() else { panic!("depth") };
            planes.push(plane);
            if !tiff.more_images() {
                break;
            }
            tiff.next_image().unwrap();
        }
        assert_eq!(planes.len(), 6, "S0, S1, S2, DoLP, AoLP, valid");
        assert!(planes[..3].concat() == alone(dir.path(), "r/frame_9.npy", "g/frame_09.npy"));
        assert!(planes[4].iter().all(|v| (0.0..180.0).contains(v)) && planes[5].iter().all(|v| *v == 0.0 || *v == 1.0));
    }
}

#[test]
fn an_array_holds_every_frame_in_its_chunk_and_a_frame_that_failed_has_none() {
    let dir = captures();
    std::fs::write(dir.path().join("r/frame_3.npy"), "not an image").unwrap();
    let chunk = |index: usize| std::fs::read(dir.path().join(format!("out/results.ome.zarr/0/c/{index}/0/0/0")));
    for _ in 0..2 {
        let (code, _, e) = batch(dir.path(), "r", "g", &["--format", "ome-zarr"]);
        assert!(code == 65 && e.contains("1 of 11 frames failed"), "{e}");
        assert!(chunk(2).is_err() && (0..FRAMES).all(|index| index == 2 || chunk(index).is_ok()));
    }
    let values: Vec<f32> = chunk(9).unwrap().chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    assert_eq!(values.len(), 6 * 48 * 48, "S0, S1, S2, DoLP, AoLP, valid");
    assert!(values[..3 * 48 * 48] == alone(dir.path(), "r/frame_10.npy", "g/frame_10.npy")[..]);
    assert!(table(dir.path())[10].contains("results.ome.zarr[9]"), "{:?}", table(dir.path())[10]);
    let (code, _, e) = batch(dir.path(), "r/frame_[45].npy", "g/frame_0[45].npy", &["--format", "ome-zarr"]);
    assert!(code == 73 && e.contains("holds results of other frames or settings"), "{code}: {e}");
    assert!(chunk(9).is_ok());
}

#[test]
fn stacks_are_paired_by_position() {
    let dir = captures();
    for (folder, name, count) in [("r", "raws.npy", 5), ("g", "guides.npy", 5), ("g", "few.npy", 4)] {
        let values: Vec<f32> = (1..=count)
            .flat_map(|n| {
                let number = if folder == "r" { n.to_string() } else { format!("{n:02}") };
                read_npy(&dir.path().join(format!("{folder}/frame_{number}.npy"))).unwrap().into_f32()
            })
            .collect();
        let side = (values.len() / count).isqrt();
        write_npy(&dir.path().join(name), &[count, side, side], &values).unwrap();
    }
    let (code, _, e) = batch(dir.path(), "raws.npy", "guides.npy", &["--unit", "counts"]);
    assert_eq!(code, 0, "{e}");
    let found = read_npy(&dir.path().join("out/raws_000004.npy")).unwrap().into_f32();
    assert!(found == alone(dir.path(), "r/frame_5.npy", "g/frame_05.npy"));
    let (code, _, e) = batch(dir.path(), "raws.npy", "few.npy", &[]);
    assert!(code == 2 && e.contains("5 frames") && e.contains("4 frames; frames of a stack are paired"), "{e}");
    // floating-point counts of a sensor with a black level are not taken for fractions of full scale
    let (code, _, e) = batch(dir.path(), "raws.npy", "guides.npy", &[]);
    assert!(code == 65 && e.contains("floating-point readings up to") && e.contains("5 of 5 frames failed"), "{e}");
}

#[test]
fn bad_frames_are_named_and_do_not_stop_the_rest() {
    let dir = captures();
    std::fs::write(dir.path().join("r/frame_4.npy"), "not an image").unwrap();
    std::fs::remove_file(dir.path().join("g/frame_06.npy")).unwrap();
    std::fs::remove_file(dir.path().join("r/frame_10.npy")).unwrap();
    let (code, _, e) = batch(dir.path(), "r", "g", &[]);
    assert_eq!(code, 65, "{e}");
    for part in [
        "frame_4.npy: file type is",
        "r/frame_6.npy: no guide of this name or number",
        "g/frame_10.npy: no raw frame of this name or number",
        "3 of 10 frames failed",
    ] {
        assert!(e.contains(part), "{part} in {e}");
    }
    let results = std::fs::read_dir(dir.path().join("out")).unwrap().count();
    assert_eq!((results, table(dir.path()).len()), (8 + 1, 12));
    assert!(table(dir.path()).iter().all(|line| line.split(',').count() >= 16));
}

#[test]
fn what_is_no_batch_is_refused_before_anything_is_written() {
    let dir = captures();
    let refused = |raw: &str, guide: &str, more: &[&str], expected: &str| {
        let (code, _, e) = batch(dir.path(), raw, guide, more);
        assert!(code == 2 && e.contains(expected), "{code}: {e}");
        assert!(!dir.path().join("out/report.csv").exists());
    };
    refused("r", "g/frame_01.npy", &[], "--guide is one frame and --raw are many");
    refused("r/frame_1.npy", "g", &[], "--raw is one frame and --guide are many");
    refused("r/frame_1.npy", "g/frame_01.npy", &["--format", "tiff"], "--format: allowed for a batch");
    refused("r", "g", &["--format", "png16"], "allowed: npy, tiff, ome-tiff, ome-zarr");
    let r = dir.path().join("r").display().to_string();
    let s = dir.path().join("s").display().to_string();
    let (code, _, e) = stokescope(&["reconstruct", "--calibration", &s, "--raw", &r, "--out", &r]);
    assert!(code == 2 && e.contains("holds the frames, whose names the results have"), "{e}");
    let (code, _, e) = batch(dir.path(), "r/*.tif", "g", &[]);
    assert!(code == 65 && e.contains("number of frames is 0"), "{e}");
}

#[test]
fn a_reader_that_has_gone_is_no_error_and_a_full_disk_is_one() {
    let run = |out: std::process::Stdio| {
        let mut program = Command::new(env!("CARGO_BIN_EXE_stokescope"));
        let child = program.arg("boards").stdout(out).stderr(std::process::Stdio::piped()).spawn().unwrap();
        let done = child.wait_with_output().unwrap();
        (done.status.code().unwrap(), String::from_utf8(done.stderr).unwrap())
    };
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    assert_eq!(run(writer.into()), (0, String::new()));
    if let Ok(full) = std::fs::OpenOptions::new().write(true).open("/dev/full") {
        let (code, e) = run(full.into());
        assert!(code == 74 && e.contains("standard output: writing failed"), "{code}: {e}");
    }
}
