//! Faults of docs/faults.md that need the running program: each test provokes the fault of its number and checks the reaction.
#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a helper that fails is a test that fails")]

mod emulated;
mod running;

use std::fs;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use emulated::slowness;
use rand::{Rng, SeedableRng, rngs::StdRng};
use running::{LONG, Running, board, command, parts};
use stokescope::files::{read_image, read_npy};

/// A number from the environment, for long runs by script.
fn count(variable: &str, usual: usize) -> usize {
    std::env::var(variable).ok().and_then(|v| v.parse().ok()).unwrap_or(usual)
}

/// Small frames, as fast as they come.
const QUICK: [(&str, &str); 3] = [
    ("wedges,size=48", "wedges,size=32"),
    ("iterations = 2", "iterations = 1"),
    ("frame_rate = 10.0", "frame_rate = 1000.0"),
];

/// Every visible file under `dir` is whole, and every sidecar's files are there; gives the number of complete frames.
fn whole(dir: &Path) -> usize {
    let mut frames = 0;
    for entry in fs::read_dir(dir).into_iter().flatten().flatten() {
        let (path, name) = (entry.path(), entry.file_name().into_string().unwrap());
        if name.starts_with('.') {
            continue;
        }
        match path.extension().and_then(|e| e.to_str()) {
            _ if path.is_dir() => frames += whole(&path),
            Some("npy") => drop(read_npy(&path).unwrap()),
            Some("tif" | "png") => drop(read_image(&path).unwrap()),
            Some("json") => {
                let json: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
                if let Some(files) = json["files"].as_array() {
                    frames += 1;
                    let session = dir.parent().unwrap();
                    files.iter().for_each(|file| assert!(session.join(file.as_str().unwrap()).is_file(), "{file}"));
                }
            }
            _ => assert!(fs::metadata(&path).unwrap().len() > 0, "{} is empty", path.display()),
        }
    }
    frames
}

/// Names of the sessions in a folder.
fn names(sessions: &Path) -> Vec<std::ffi::OsString> {
    let names = fs::read_dir(sessions).into_iter().flatten().flatten().map(|entry| entry.file_name());
    let mut names: Vec<_> = names.filter(|name| name.to_string_lossy().starts_with("session-")).collect();
    names.sort();
    names
}

/// A session of a few frames, with its folder.
fn recorded(dir: &Path) -> PathBuf {
    let output = command(dir, &[])
        .args(["--frames", "3", "--no-preview", "--record-reserve-bytes", "0", "--record"])
        .arg(dir.join("sessions"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    PathBuf::from(summary["recording"]["session"].as_str().unwrap())
}

#[test]
fn fault_01_a_camera_lost_in_mid_stream_is_reported_in_two_seconds_and_comes_back() {
    let dir = tempfile::tempdir().unwrap();
    let session = recorded(dir.path());
    let table = |role: &str| format!("[cameras.{role}]\nbackend = \"replay\"\nsource = {session:?}\n#");
    let (raw, guide) = (table("raw"), table("guide"));
    let calibration = format!("calibration = {:?}", session.join("calibration"));
    let service = Running::start(
        &[
            ("[cameras.raw]\nbackend = \"sim\"\n", &raw),
            ("[cameras.guide]\nbackend = \"sim\"\n", &guide),
            ("calibration = \"simulated\"", &calibration),
        ],
        &[],
    );
    let before = service.get("/snapshot?view=intensity").1;
    let (here, away) = (session.join("raw"), session.join("unplugged"));
    let begin = Instant::now();
    fs::rename(&here, &away).unwrap();
    service.until("the loss to be known", || service.state()["cameras"]["raw"]["online"] == false);
    assert!(begin.elapsed() < Duration::from_secs(2) * slowness(), "{:?}", begin.elapsed());
    assert_eq!(service.get("/healthz").0, 503);
    let (status, notice) = service.get("/snapshot?view=intensity");
    assert!(status == 200 && notice != before, "a placeholder");
    assert_eq!(service.state()["cameras"]["guide"]["online"], true);
    let frames = service.state()["frames"].as_u64().unwrap();
    fs::rename(&away, &here).unwrap();
    service.until("frames again", || service.state()["frames"].as_u64().unwrap() > frames + 2);
    let state = service.state();
    assert!(state["cameras"]["raw"]["online"] == true && state["cameras"]["raw"]["reopened"].as_u64().unwrap() > 0);
    let events = state["events"].to_string();
    assert!(events.contains("camera-offline") && events.contains("camera-online"), "{events}");
    service.stop();
}

#[test]
fn fault_06_frames_too_far_apart_are_dropped_and_no_guide_is_used_for_another_instant() {
    // the guide's clock runs at another rate: only the first frames are of one instant
    let table = "[cameras.guide]\nbackend = \"sim\"\nsource = \"wedges,size=48\"\nframe_rate = ";
    let (from, to) = (format!("{table}10.0"), format!("{table}7.3"));
    let service = Running::start(&[(&from, &to)], &[]);
    service.until("unpaired frames", || service.state()["dropped"]["unpaired"].as_u64().unwrap() > 5);
    let state = service.state();
    assert!(state["frames"].as_u64().unwrap() <= 2, "{state}");
    assert_eq!(state["cameras"]["guide"]["online"], true);
}

/// A small file system of its own, where that is allowed.
struct Small(PathBuf);

impl Small {
    fn mount(dir: PathBuf, bytes: u64) -> Option<Self> {
        fs::create_dir(&dir).unwrap();
        let option = format!("size={bytes}");
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", &option, "tmpfs"]).arg(&dir).output();
        mounted.is_ok_and(|o| o.status.success()).then_some(Self(dir))
    }
}

impl Drop for Small {
    fn drop(&mut self) {
        // the folder goes with the test in any case
        let _ = Command::new("umount").arg("-l").arg(&self.0).output();
    }
}

#[test]
fn fault_13_a_full_disk_stops_recording_alone_and_it_resumes_by_itself() {
    let dir = tempfile::tempdir().unwrap();
    let Some(disk) = Small::mount(dir.path().join("disk"), 1 << 20) else {
        println!(
            "skipped: this user may not mount a file system; the failing disk of src/session/storage.rs is tested"
        );
        return;
    };
    let sessions = disk.0.join("sessions");
    let service = Running::start(
        &[("frame_rate = 10.0", "frame_rate = 100.0")],
        &["--record-reserve-bytes", "0", "--record", sessions.to_str().unwrap()],
    );
    service.until("a full disk", || service.state()["recording"]["fault"].is_string());
    let state = service.state();
    let (frames, written) = (state["frames"].as_u64().unwrap(), state["recording"]["written"].as_u64().unwrap());
    service.until("live frames all the same", || service.state()["frames"].as_u64().unwrap() > frames + 3);
    assert!(service.state()["saving"]["fault"].is_null(), "results go to another disk");
    assert_eq!(whole(&sessions) as u64, written);
    let session = PathBuf::from(state["recording"]["session"].as_str().unwrap());
    for frame in 0..written / 2 {
        for (folder, ending) in [("frames", "json"), ("raw", "npy"), ("guide", "npy"), ("stokes", "npy")] {
            fs::remove_file(session.join(format!("{folder}/{frame:08}.{ending}"))).unwrap();
        }
    }
    service.until("recording again", || service.state()["recording"]["written"].as_u64().unwrap() > written);
    let alarms = service.state()["events"].to_string().matches("recording-stopped").count();
    assert!(alarms >= 1, "an alarm when it stops, not with every frame");
    service.stop();
    whole(&sessions);
}

#[test]
fn fault_14_whenever_it_is_killed_every_visible_file_is_whole() {
    let kills = count("STOKESCOPE_KILLS", 200 / slowness() as usize);
    let (left, complete) = (AtomicUsize::new(kills), AtomicUsize::new(0));
    thread::scope(|scope| {
        for worker in 0..4 {
            let (left, complete) = (&left, &complete);
            scope.spawn(move || {
                let mut random = StdRng::seed_from_u64(14 + worker);
                let dir = tempfile::tempdir().unwrap();
                let sessions = dir.path().join("sessions");
                while left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1)).is_ok() {
                    let mut child = command(dir.path(), &QUICK)
                        .args(["--no-preview", "--record-reserve-bytes", "0", "--record-max-frames", "500", "--record"])
                        .arg(&sessions)
                        .stderr(Stdio::null())
                        .spawn()
                        .unwrap();
                    let known = names(&sessions);
                    let begin = Instant::now();
                    while names(&sessions) == known && begin.elapsed() < LONG / 4 * slowness() {
                        thread::sleep(Duration::from_millis(2));
                    }
                    thread::sleep(slowness() * Duration::from_millis(random.random_range(0..120)));
                    child.kill().unwrap();
                    child.wait().unwrap();
                    let newest = fs::read_dir(&sessions).unwrap().flatten().map(|e| e.path()).max().unwrap();
                    complete.fetch_add(whole(&newest), Ordering::Relaxed);
                    whole(&dir.path().join("out"));
                }
                whole(&sessions);
            });
        }
    });
    let complete = complete.into_inner();
    println!("{kills} kills, {complete} complete frames, none of them damaged");
    assert!(complete > kills / 4, "{complete} frames in {kills} recordings: the kills came too early to mean anything");
}

#[test]
fn fault_15_two_sessions_of_the_same_second_have_names_of_their_own() {
    let dir = tempfile::tempdir().unwrap();
    let run = || {
        let mut command = command(dir.path(), &QUICK);
        command.args(["--frames", "1", "--no-preview", "--record-reserve-bytes", "0", "--record"]);
        let output = command.arg(dir.path().join("sessions")).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    (0..4).for_each(|_| run());
    assert_eq!(names(&dir.path().join("sessions")).len(), 4);
    assert_eq!(whole(&dir.path().join("sessions")), 4);
}

#[test]
fn fault_18_clients_of_every_bad_kind_cost_the_others_nothing() {
    let service = Running::start(
        &[
            ("max_clients = 32", "max_clients = 150"),
            ("frame_rate = 10.0", "frame_rate = 20.0"),
            ("size=48", "size=32"),
        ],
        &[],
    );
    let ask = |path: &str| {
        let mut stream = service.connect();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
        stream
    };
    let rate = || {
        let stream = ask("/stream?view=aolp");
        let begin = Instant::now();
        parts(stream, 40);
        40.0 / begin.elapsed().as_secs_f64()
    };
    let (alone, memory) = (rate(), service.process("VmRSS"));
    // watchers, watchers that take nothing, headers that do not come, headers without end, garbage
    let stop = Arc::new(AtomicBool::new(false));
    let watchers: Vec<_> = (0..78)
        .map(|n| {
            let (mut stream, stop) =
                (ask(["/stream?view=aolp", "/stream?view=raw", "/events"][n % 3]), Arc::clone(&stop));
            thread::spawn(move || {
                let mut buffer = [0; 4096];
                while !stop.load(Ordering::Relaxed) && stream.read(&mut buffer).is_ok_and(|n| n > 0) {}
            })
        })
        .collect();
    let stalled: Vec<_> = (0..10).map(|_| ask("/stream?view=dolp")).collect();
    let mut slow: Vec<_> = (0..5).map(|_| service.connect()).collect();
    for stream in &mut slow {
        stream.write_all(b"GET /state HTTP/1.1\r\nHo").unwrap();
    }
    for n in 0..40 {
        let bytes: Vec<u8> =
            (0..2048u32).map(|i| (i.wrapping_mul(2_654_435_761).wrapping_add(n) >> 13) as u8).collect();
        // it may be cut off while it talks
        let _ = service.connect().write_all(&bytes);
    }
    let crowded = rate();
    let grown = service.process("VmRSS").saturating_sub(memory);
    println!("{alone:.1} frames per second alone, {crowded:.1} in the crowd; {grown} kB more memory");
    // an emulator has no core to spare for the crowd's own arithmetic
    assert!(crowded * f64::from(slowness()) > 0.7 * alone, "{crowded} of {alone} frames per second");
    assert!(grown <= 16 << 10, "{grown} kB");
    stop.store(true, Ordering::Relaxed);
    drop((stalled, slow));
    watchers.into_iter().for_each(|w| w.join().unwrap());
    service.until("the clients to be gone", || service.state()["clients"].as_u64().unwrap() <= 2);
    assert_eq!(service.get("/healthz").0, 200);
    service.stop();
}

#[test]
fn fault_17_under_pressure_iterations_are_given_up_before_frames_and_it_is_said() {
    let dir = tempfile::tempdir().unwrap();
    let firmware = dir.path().join("devices/platform/soc/soc:firmware");
    fs::create_dir_all(&firmware).unwrap();
    let say = |bits: &str| fs::write(firmware.join("get_throttled"), bits).unwrap();
    say("0\n");
    let sysfs = dir.path().to_str().unwrap();
    let service = Running::start(&[], &["--sysfs", sysfs, "--iterations", "8", "--fps", "0.5"]);
    let iterations = || service.state()["quality"]["iterations"].as_u64().unwrap();
    service.until("all iterations", || iterations() == 8);
    say("5\n");
    service.until("half of them", || iterations() == 4);
    let state = service.state();
    assert!(state["quality"]["reduced"].as_str().unwrap().starts_with("undervoltage: 4 of 8"), "{}", state["quality"]);
    let (_, metrics) = service.text("/metrics");
    for line in [
        "stokescope_machine_undervoltage 1",
        "stokescope_machine_throttled 1",
        "stokescope_iterations{kind=\"allowed\"} 4",
    ] {
        assert!(metrics.contains(line), "{line} in {metrics}");
    }
    say("0\n");
    service.until("all of them again", || iterations() == 8);
    assert!(service.state()["quality"]["reduced"].is_null());
    service.stop();
}

#[test]
fn fault_19_nothing_is_given_away_or_changed_without_proof() {
    let service = Running::start(&[], &[]);
    for path in ["/../../etc/passwd", "/..%2f..%2fetc/passwd", "/stream?view=../raw", "/snapshot?view=/etc/passwd"] {
        assert_eq!(service.get(path).0, 404, "{path}");
    }
    for headers in ["Host: evil.example\r\n", "Host: localhost\r\nOrigin: https://evil.example\r\n"] {
        for path in ["/", "/state", "/events", "/stream", "/snapshot", "/metrics"] {
            assert_eq!(service.get_with(path, headers).0, 403, "{path} {headers}");
        }
    }
    let json = "Origin: http://localhost\r\nContent-Type: application/json\r\n";
    assert_eq!(service.control(json, "{\"iterations\": 9}"), 403);
}

#[test]
fn fault_21_a_second_instance_is_told_the_cause_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let sessions = dir.path().join("sessions");
    let service = Running::start(&[], &["--record-reserve-bytes", "0", "--record", sessions.to_str().unwrap()]);
    let output = command(dir.path(), &[]).args(["--no-preview", "--record"]).arg(&sessions).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), text.lines().count()), (Some(73), 1), "{text}");
    assert!(text.contains("another instance"), "{text}");
    let out = service.dir.path().join("out");
    let output = command(service.dir.path(), &[]).args(["--no-preview"]).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), text.lines().count()), (Some(73), 1), "{text}");
    assert!(text.contains("another instance") && text.contains(out.to_str().unwrap()), "{text}");
    let listen = service.address.to_string();
    let output = command(dir.path(), &[]).args(["--listen", &listen]).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(69) && text.contains("--no-preview") && text.lines().count() == 1, "{text}");
}

#[test]
fn fault_24_after_thousands_of_frames_memory_files_and_threads_are_what_they_were() {
    let frames = count("STOKESCOPE_SOAK", 3000 / slowness() as usize) as u64;
    let service = Running::start(&QUICK, &["--fps", "off"]);
    let mut stream = service.connect();
    write!(stream, "GET /stream?view=aolp HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let watcher = thread::spawn(move || {
        let mut buffer = [0; 4096];
        while stream.read(&mut buffer).is_ok_and(|n| n > 0) {}
    });
    let patience = Duration::from_secs(60) + slowness() * Duration::from_millis(100 * frames);
    let begin = Instant::now();
    let reach = |wanted: u64| {
        while service.state()["frames"].as_u64().unwrap() < wanted {
            assert!(begin.elapsed() < patience, "{}", service.state());
            thread::sleep(Duration::from_millis(100));
        }
        (service.process("VmRSS"), service.descriptors(), service.process("Threads"))
    };
    let (memory, files, threads) = reach(frames / 3);
    let (memory_now, files_now, threads_now) = reach(frames);
    println!(
        "{frames} frames: {memory} → {memory_now} kB, {files} → {files_now} files, {threads} → {threads_now} threads"
    );
    // an emulator goes on translating
    assert!(memory_now <= memory + 1024 || slowness() > 1, "{memory} → {memory_now} kB");
    // a thread that had nothing to do for a while ends
    assert!(files_now <= files + 2 && threads_now <= threads, "{files} → {files_now}, {threads} → {threads_now}");
    service.stop();
    watcher.join().unwrap();
}

#[test]
fn the_board_of_these_tests_is_a_valid_one() {
    let dir = tempfile::tempdir().unwrap();
    stokescope::board::Board::load(board(dir.path(), &QUICK).to_str().unwrap()).unwrap();
}
