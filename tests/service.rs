//! The live service as its users meet it: the real program, its signals, its files and its HTTP.
#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a helper that fails is a test that fails")]

mod emulated;
mod running;

use std::io::{Read, Write};
use std::time::{Duration, Instant};

use emulated::slowness;
use running::{Running, command, parts};

#[test]
fn some_frames_then_an_end_with_every_frame_kept() {
    let dir = tempfile::tempdir().unwrap();
    let output = command(dir.path(), &[]).args(["--frames", "3", "--no-preview"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&summary["frames"], &summary["preview"]), (&3.into(), &serde_json::Value::Null));
    assert!(summary["latency_ms"]["p95"].as_f64().unwrap() >= summary["latency_ms"]["p50"].as_f64().unwrap());
    let out = dir.path().join("out");
    for folder in [out.clone(), out.join("frame-000000"), out.join("frame-000002")] {
        for file in [
            "angles.npy",
            "stokes.npy",
            "stokes_error.npy",
            "intensity.png",
            "dolp.png",
            "aolp.png",
            "composite.png",
            "report.json",
        ] {
            assert!(folder.join(file).is_file(), "{} {file}", folder.display());
        }
    }
    assert_eq!(
        std::fs::read(out.join("stokes.npy")).unwrap(),
        std::fs::read(out.join("frame-000002/stokes.npy")).unwrap(),
        "the newest result stands in the folder itself"
    );
    stokescope::bundle::Bundle::load(&out.join("calibration")).unwrap();
}

#[test]
fn frames_of_the_camera_are_cropped_and_binned_as_the_bundle_says() {
    let dir = tempfile::tempdir().unwrap();
    let device = dir.path().join("device");
    stokescope::bundle::write_simulated(&"plastic,size=96,surround=0,guide_margin=0".parse().unwrap(), &device)
        .unwrap();
    let path = device.join("calibration.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let text = text.replace("channels = 1\n", "channels = 1\ncrop = [16, 0, 64, 96]\nbin = 2\n");
    std::fs::write(&path, text + "[guide]\nhomography = [1, 0, 0, 0, 1, 0, 0, 0, 1]\n").unwrap();
    let more = [
        ("wedges,size=48", "plastic,size=96,surround=0,guide_margin=0"),
        ("calibration = \"simulated\"", "calibration = \"device\""),
    ];
    let output = command(dir.path(), &more).args(["--frames", "2", "--no-preview"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let out = dir.path().join("out");
    assert_eq!(stokescope::files::read_npy(&out.join("stokes.npy")).unwrap().shape, [3, 48, 32]);
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    // The scene goes on to both sides of the crop.
    assert_eq!(report["method"], "guided");
    assert!(report["field"]["light_from_beyond"].as_f64().unwrap() > 0.01, "{report}");
}

#[test]
fn a_wrong_device_is_said_live_with_the_likeliest_fault() {
    let dir = tempfile::tempdir().unwrap();
    let device = dir.path().join("device");
    stokescope::bundle::write_simulated(&"plastic,size=128,surround=0,guide_margin=0".parse().unwrap(), &device)
        .unwrap();
    let path = device.join("psf.npy");
    let psf = stokescope::files::read_npy(&path).unwrap();
    let (n, samples) = (psf.shape[0], psf.into_f32());
    let transposed: Vec<_> = (0..n * n).map(|i| samples[i % n * n + i / n]).collect();
    stokescope::files::write_npy(&path, &[n, n], &transposed).unwrap();
    let more = [
        ("wedges,size=48", "plastic,size=128,surround=0,guide_margin=0"),
        ("calibration = \"simulated\"", "calibration = \"device\""),
        ("iterations = 2", "iterations = 20"),
    ];
    let output = command(dir.path(), &more).args(["--frames", "3", "--no-preview", "--fps", "off"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: serde_json::Value =
        serde_json::from_slice(&std::fs::read(dir.path().join("out/report.json")).unwrap()).unwrap();
    assert_ne!(report["verdict"], "credible", "{report}");
    assert!(report["suspects"].to_string().contains("transpose"), "{report}");
    assert!(report["warnings"].to_string().contains("transpose"), "{report}");
}

#[test]
fn the_preview_answers_and_ends_with_the_signal() {
    let service = Running::start(&[], &[]);
    assert_eq!(service.text("/healthz"), (200, "ok\n".to_owned()));
    let state = service.state();
    assert_eq!(state["cameras"]["guide"]["online"], true);
    assert_eq!(state["size"], serde_json::json!([48, 48]));
    let (status, page) = service.text("/");
    assert!(status == 200 && page.contains("stokescope") && !page.contains("http://") | page.contains("www.w3.org"));
    for view in state["views"].as_array().unwrap() {
        let name = view["name"].as_str().unwrap();
        let (status, jpeg) = service.get(&format!("/snapshot?view={name}"));
        assert!(status == 200 && jpeg.starts_with(&[0xff, 0xd8]) && jpeg.ends_with(&[0xff, 0xd9]), "{name}");
    }
    let (_, png) = service.get("/snapshot?view=dolp&format=png");
    assert!(png.starts_with(b"\x89PNG") && png.ends_with(b"IEND\xaeB`\x82"));
    let pixel: serde_json::Value = serde_json::from_slice(&service.get("/pixel?x=47&y=0").1).unwrap();
    assert!(pixel["s0"].is_f64() && pixel["aolp_degrees"].is_f64(), "{pixel}");
    assert!(pixel["dolp_error"].as_f64().unwrap() > 0.0, "{pixel}");
    let histogram: serde_json::Value = serde_json::from_slice(&service.get("/histogram").1).unwrap();
    let sum: f64 = histogram["dolp"].as_array().unwrap().iter().filter_map(serde_json::Value::as_f64).sum();
    assert!((sum - 1.0).abs() < 1e-3);
    let (_, metrics) = service.text("/metrics");
    assert!(metrics.contains("stokescope_camera_online{camera=\"raw\"} 1"), "{metrics}");

    let mut stream = service.connect();
    write!(stream, "GET /stream?view=i45 HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let pictures = parts(stream, 3);
    assert!(pictures[0] != pictures[1] && pictures[1] != pictures[2], "each frame once");

    let out = service.dir.path().join("out");
    let summary = service.stop();
    assert!(summary["frames"].as_u64().unwrap() >= 3);
    assert!(summary["out"].as_str().unwrap() == out.to_str().unwrap());
}

#[test]
fn what_may_not_be_asked_is_refused() {
    let service = Running::start(&[], &[]);
    let (status, text) = service.text("/stream?view=thermal");
    assert!(status == 404 && text.contains("intensity, dolp, aolp"), "{status} {text}");
    for path in ["/../Cargo.toml", "/%2e%2e/Cargo.toml", "/out/stokes.npy", "//etc/passwd"] {
        assert_eq!(service.get(path).0, 404, "{path}");
    }
    assert_eq!(service.get("/pixel?x=48&y=0").0, 400);
    assert_eq!(service.get_with("/state", "Host: evil.example\r\n").0, 403);
    assert_eq!(service.get_with("/state", "Host: localhost\r\nOrigin: http://evil.example\r\n").0, 403);
    assert_eq!(service.get_with("/state", "").0, 400);
    let post = service.raw("POST /state HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
    assert!(post.starts_with("HTTP/1.1 405") && post.to_lowercase().contains("allow: get, head"), "{post}");
    let huge = service.raw(&format!("GET / HTTP/1.1\r\nHost: localhost\r\nX: {}\r\n\r\n", "x".repeat(17 << 10)));
    assert!(huge.starts_with("HTTP/1.1 431") || huge.is_empty(), "{huge}");
    let garbage = service.raw("\x16\x03\x01 what is this\r\n\r\n");
    assert!(garbage.starts_with("HTTP/1.1 400") || garbage.is_empty(), "{garbage}");
    assert_eq!(service.text("/healthz").0, 200);
}

#[test]
fn too_many_clients_are_told_so_and_slow_ones_are_let_go() {
    let service = Running::start(&[("max_clients = 32", "max_clients = 3")], &[]);
    // those that ask for nothing make room
    let idle: Vec<_> = (0..20).map(|_| service.connect()).collect();
    assert_eq!(service.text("/healthz").0, 200);
    let watchers: Vec<_> = (0..3).map(|_| service.connect()).collect();
    for mut stream in &watchers {
        write!(stream, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
        assert!(stream.read(&mut [0; 64]).unwrap() > 0);
    }
    let answer = service.raw("GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n");
    assert!(answer.starts_with("HTTP/1.1 503") && answer.ends_with("too many clients\n"), "{answer}");
    drop((idle, watchers));
    // headers that do not come free their places
    let begin = Instant::now();
    let mut slow = service.connect();
    write!(slow, "GET / HT").unwrap();
    let _ = slow.read_to_end(&mut Vec::new());
    assert!(begin.elapsed() < Duration::from_secs(20) * slowness(), "{:?}", begin.elapsed());
    service.until("an answer", || service.get("/healthz").0 == 200);
}

/// Reads at a rate in bytes per second, for a time; gives the bytes read and whether the service is still there.
fn read_slowly(stream: &mut std::net::TcpStream, rate: f64, time: Duration) -> (usize, bool) {
    let (begin, mut read, mut buffer) = (Instant::now(), 0, [0; 1000]);
    while begin.elapsed() < time {
        let due = (rate * begin.elapsed().as_secs_f64()) as usize - read;
        if due == 0 {
            std::thread::sleep(Duration::from_millis(2));
            continue;
        }
        match stream.read(&mut buffer[..due.min(1000)]) {
            Ok(n) if n > 0 => read += n,
            _ => return (read, false),
        }
    }
    (read, true)
}

#[test]
fn however_slowly_a_watcher_reads_no_more_than_three_pictures_wait_for_it() {
    let service = Running::start(&[("size=48", "size=128")], &["--fps", "off"]);
    let picture = service.get("/snapshot?view=raw").1.len();
    for share in [0.5, 0.1] {
        let mut stream = service.connect();
        write!(stream, "GET /stream?view=raw HTTP/1.0\r\nHost: localhost\r\n\r\n").unwrap();
        let rate = share * 10.0 * picture as f64;
        let (read, there) = read_slowly(&mut stream, rate, Duration::from_secs(6));
        assert!(there && read as f64 > 3.0 * rate, "{read} bytes at {rate} per second");
        // everything that waits for it
        stream.set_nonblocking(true).unwrap();
        let mut waiting = vec![0; 64 * picture];
        let waiting = stream.read(&mut waiting).unwrap_or(0) as f64 / picture as f64;
        println!("{waiting:.1} pictures wait for a watcher that reads {share} of them");
        assert!(waiting <= 3.0, "{waiting} pictures wait for a watcher that reads {share} of them");
    }
    service.stop();
}

#[test]
fn a_frame_rate_that_does_not_reach_a_watcher_is_not_held() {
    // a rate that any machine reaches
    let service = Running::start(&[("size=48", "size=128")], &["--fps", "2"]);
    let held = |value: u8| service.text("/metrics").1.contains(&format!("stokescope_frame_rate_held {value}\n"));
    service.until("a rate that is held", || held(1));
    let mut stream = service.connect();
    write!(stream, "GET /stream?view=raw HTTP/1.0\r\nHost: localhost\r\n\r\n").unwrap();
    let picture = service.get("/snapshot?view=raw").1.len() as f64;
    service.until("a rate that is not held", || {
        assert!(read_slowly(&mut stream, 0.7 * picture, Duration::from_secs(1)).1);
        held(0)
    });
    let quality = service.state()["quality"].clone();
    assert_eq!((&quality["held"], &quality["missed"]), (&false.into(), &"a watcher takes fewer pictures".into()));
    let (reached, shown) = (quality["reached_fps"].as_f64().unwrap(), quality["shown_fps"].as_f64().unwrap());
    assert!(shown < 1.9 && reached >= 1.9, "{quality}");
    drop(stream);
    service.until("a rate that is held again", || held(1));
    service.stop();
}

#[test]
fn a_watcher_that_reads_a_byte_a_second_is_let_go() {
    let service = Running::start(&[("size=48", "size=128")], &[]);
    let mut stream = service.connect();
    write!(stream, "GET /stream?view=raw HTTP/1.0\r\nHost: localhost\r\n\r\n").unwrap();
    let begin = Instant::now();
    stream.set_read_timeout(Some(Duration::from_secs(1))).unwrap();
    while service.state()["clients"].as_u64().unwrap() > 1 {
        assert!(begin.elapsed() < Duration::from_secs(30) * slowness(), "it is still served");
        let _ = stream.read(&mut [0; 1]);
        std::thread::sleep(Duration::from_secs(1));
    }
    assert!(begin.elapsed() > Duration::from_secs(15), "{:?}", begin.elapsed());
    service.stop();
}

#[test]
fn a_watcher_that_takes_nothing_holds_nobody_up() {
    let service = Running::start(&[("frame_rate = 10.0", "frame_rate = 50.0")], &[]);
    let mut stalled = service.connect();
    write!(stalled, "GET /stream?view=raw HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let mut stream = service.connect();
    write!(stream, "GET /stream?view=raw HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    parts(stream, 20);
    service.stop();
}

/// A service that asks for the token `secret-1`.
fn guarded(more: &[(&str, &str)], arguments: &[&str]) -> Running {
    let dir = tempfile::tempdir().unwrap();
    let mut command = command(dir.path(), more);
    command.args(["--listen", "127.0.0.1:0"]).args(arguments).env("STOKESCOPE_TOKEN", "secret-1");
    let mut child = command.spawn().unwrap();
    let mut lines = std::io::BufRead::lines(std::io::BufReader::new(child.stderr.take().unwrap()));
    let line = lines.find_map(|l| l.ok().filter(|l| l.contains("http://"))).unwrap();
    let address = line.split("http://").nth(1).unwrap().trim_end_matches('/').parse().unwrap();
    std::thread::spawn(move || lines.map_while(Result::ok).for_each(|line| eprintln!("{line}")));
    Running { child, address, dir }
}

const TOKEN: &str = "Host: localhost\r\nAuthorization: bearer secret-1\r\n";

#[test]
fn clients_without_the_token_lock_nobody_out_and_cannot_guess_quickly() {
    let service = guarded(&[("max_clients = 32", "max_clients = 8")], &[]);
    let crowd: Vec<_> = (0..40)
        .map(|_| {
            let mut stream = service.connect();
            // an earlier one may have been let go while it talks
            let _ = write!(stream, "GET /state HTTP/1.1\r\nHost: localhost\r\n\r\n");
            stream
        })
        .collect();
    for path in ["/state", "/healthz", "/metrics"] {
        service.until("an answer", || service.get_with("/healthz", TOKEN).0 == 200);
        assert_eq!(service.get_with(path, TOKEN).0, 200, "{path}");
    }
    drop(crowd);
    // three wrong tokens, each answered late, end a connection
    let (begin, mut stream) = (Instant::now(), service.connect());
    for _ in 0..10 {
        let _ = write!(stream, "GET /state HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer guess-12\r\n\r\n");
    }
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    let answers = String::from_utf8_lossy(&answer).matches("HTTP/1.1 401").count();
    assert!(answers <= 3 && begin.elapsed() > Duration::from_millis(400), "{answers} in {:?}", begin.elapsed());
    // however many come, the log says it once
    for path in ["/state?token=guess-13", "/healthz?token=guess-14"] {
        assert_eq!(service.get(path).0, 401, "{path}");
    }
    let log = String::from_utf8(service.get_with("/log", TOKEN).1).unwrap();
    assert_eq!(log.matches("with a wrong token").count(), 1, "{log}");
}

#[test]
fn behind_a_proxy_its_name_and_https_are_taken_and_a_broken_change_is_not() {
    let service = guarded(&[], &["--allow-host", "cam.example.org"]);
    service.until("a frame", || service.get_with("/healthz", TOKEN).0 == 200);
    for host in ["cam.example.org", "other.example.org"] {
        let headers = TOKEN.replace("localhost", host);
        assert_eq!(service.get_with("/state", &headers).0, 200, "the token opens under any name");
    }
    assert_eq!(service.get_with("/state?token=secret-1", "Host: cam.example.org\r\n").0, 200);
    let state = || -> serde_json::Value { serde_json::from_slice(&service.get_with("/state", TOKEN).1).unwrap() };
    let change = |headers: &str, body: &str, length: usize| {
        let request = format!(
            "POST /control HTTP/1.1\r\n{headers}Content-Type: application/json\r\nContent-Length: {length}\r\n\r\n{body}"
        );
        let mut stream = service.connect();
        stream.write_all(request.as_bytes()).unwrap();
        stream.shutdown(std::net::Shutdown::Write).unwrap();
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    };
    let asked = || state()["quality"]["asked_iterations"].as_u64().unwrap();
    let before = asked();
    let body = "{\"iterations\": 9}";
    for (headers, body, length) in [
        (TOKEN.to_owned(), body, body.len() + 5),
        (TOKEN.to_owned(), "{\"iterations\": 9}}", body.len() + 1),
        (TOKEN.to_owned(), "{\"iterations\": 9, \"jpeg_quality\": 0}", 36),
        (TOKEN.replace("bearer secret-1", "junk"), body, body.len()),
    ] {
        let answer = change(&headers, body, length);
        assert!(!answer.starts_with("HTTP/1.1 200") && asked() == before, "{answer}");
    }
    let proxied = TOKEN.replace("localhost", "cam.example.org") + "Origin: https://cam.example.org\r\n";
    assert!(change(&proxied, body, body.len()).starts_with("HTTP/1.1 200"));
    service.until("the change", || asked() == 9);
}

#[test]
fn names_of_the_board_file_are_names_of_this_machine() {
    let dir = tempfile::tempdir().unwrap();
    let hosts = |list: &str| format!("max_clients = 32\nallowed_hosts = [{list}]");
    let wrong = hosts("\"microscope.lab\", \"https://microscope.lab:443\"");
    let output = command(dir.path(), &[("max_clients = 32", &wrong)]).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(78), "{said}");
    for part in ["preview.allowed_hosts", "https://microscope.lab:443", "without scheme and port"] {
        assert!(said.contains(part), "{part} in {said}");
    }
    let output = command(dir.path(), &[]).args(["--allow-host", "microscope.lab:443"]).output().unwrap();
    assert!(
        output.status.code() == Some(2) && String::from_utf8_lossy(&output.stderr).contains("without scheme and port")
    );

    let service = Running::start(&[("max_clients = 32", &hosts("\"microscope.lab\""))], &["--allow-host", "bench.lab"]);
    for host in ["microscope.lab", "Microscope.lab:8443", "bench.lab", "localhost"] {
        let headers = format!("Host: {host}\r\nOrigin: https://{host}\r\n");
        assert_eq!(service.get_with("/state", &headers).0, 200, "{host}");
    }
    let (status, text) = service.get_with("/state", "Host: other.lab\r\n");
    let text = String::from_utf8(text).unwrap();
    assert!(status == 403 && text.contains("--allow-host or by allowed_hosts in [preview]"), "{status} {text}");
    service.stop();
}

#[test]
fn the_cameras_are_closed_and_opened_again_when_asked_for_and_the_service_goes_on() {
    const PROOF: &str = "Origin: http://localhost\r\nContent-Type: application/json\r\n";
    let service = Running::start(&[], &["--control"]);
    let reopened = |state: &serde_json::Value| {
        ["raw", "guide"].map(|camera| state["cameras"][camera]["reopened"].as_u64().unwrap())
    };
    assert_eq!(service.post("/cameras/restart", "Content-Type: application/json\r\n", "{}"), 403, "proof is needed");
    assert_eq!(reopened(&service.state()), [0, 0]);
    assert_eq!(service.post("/cameras/restart", PROOF, "{}"), 202);
    service.until("both cameras", || reopened(&service.state()) == [1, 1]);
    let frames = || service.state()["frames"].as_u64().unwrap();
    let before = frames();
    service.until("further pairs", || frames() > before + 5);
    let state = service.state();
    assert!(["raw", "guide"].iter().all(|camera| state["cameras"][camera]["online"] == true), "{state}");
    assert_eq!(reopened(&state), [1, 1], "once");
    let mut events = service.connect();
    write!(events, "GET /events HTTP/1.0\r\nHost: localhost\r\n\r\n").unwrap();
    let lines = std::io::BufRead::lines(std::io::BufReader::new(events)).map_while(Result::ok);
    let restarted: Vec<_> = lines.filter(|line| line.contains("camera-restarted")).take(2).collect();
    assert!(
        ["raw", "guide"].iter().all(|role| restarted.concat().contains(&format!("\"camera\":\"{role}\""))),
        "{restarted:?}"
    );
    assert!(service.text("/log").1.contains("raw camera: closed, to be opened again by request"));
    service.stop();
    let closed = Running::start(&[], &[]);
    assert_eq!(closed.post("/cameras/restart", PROOF, "{}"), 403, "nothing can be changed");
}

#[test]
fn neither_the_event_command_nor_a_viewer_sees_the_token() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("environment");
    let command = format!("env > '{}'", file.display());
    let service = guarded(&[], &["--on-event", &command]);
    service.until("the command to run", || std::fs::read_to_string(&file).is_ok_and(|text| text.contains("PATH=")));
    assert!(!std::fs::read_to_string(&file).unwrap().contains("secret-1"));
    service.until("a frame", || service.get_with("/healthz", TOKEN).0 == 200);
    for path in ["/", "/state", "/log", "/version", "/metrics"] {
        let (status, text) = service.get_with(path, TOKEN);
        assert!(status == 200 && !String::from_utf8(text).unwrap().contains("secret-1"), "{path}");
    }
}

#[test]
fn a_token_opens_what_is_closed_without() {
    let dir = tempfile::tempdir().unwrap();
    for none in [["--listen", "0.0.0.0:0"].as_slice(), &["--listen", "127.0.0.1:0", "--token", ""]] {
        let open = command(dir.path(), &[]).args(none).env("STOKESCOPE_TOKEN", "").output().unwrap();
        assert_eq!(open.status.code(), Some(2));
        assert!(String::from_utf8_lossy(&open.stderr).contains("needs --token"));
    }
    // a variable that is empty is one that is not set
    let mut closed = command(dir.path(), &[]);
    closed.args(["--listen", "127.0.0.1:0", "--frames", "1"]).env("STOKESCOPE_TOKEN", "");
    assert!(closed.output().unwrap().status.success());
    let service = guarded(&[], &[]);
    assert_eq!(service.get("/state").0, 401);
    assert_eq!(service.get("/stream?token=wrong").0, 401);
    assert_eq!(service.get("/state?token=secret-1").0, 200);
    assert_eq!(service.get_with("/state", "Host: localhost\r\nAuthorization: Bearer secret-1\r\n").0, 200);
}

#[test]
fn a_lost_camera_is_reported_and_the_other_goes_on() {
    // the guide's recording changes its size at the second frame: that camera fails whenever it gets there
    let dir = tempfile::tempdir().unwrap();
    let guide = dir.path().join("guide");
    std::fs::create_dir(&guide).unwrap();
    stokescope::files::write_npy(&guide.join("0.npy"), &[48, 48], &[0.5; 48 * 48]).unwrap();
    // one frame that cannot be used is left out, several in a row are a lost camera
    for n in 1..=4 {
        stokescope::files::write_npy(&guide.join(format!("{n}.npy")), &[8, 8], &[0.5; 64]).unwrap();
    }
    let table = format!("[cameras.guide]\nbackend = \"replay\"\nsource = {:?}\n#", dir.path());
    let service = Running::start(&[("[cameras.guide]\nbackend = \"sim\"\n", &table)], &[]);
    service.until("an unguided frame", || {
        let state = service.state();
        let warned = state["report"]["warnings"].to_string().contains("unguided");
        // the models of `auto` are trained with a guide
        let refined = state["report"]["fusion"].is_object();
        state["cameras"]["guide"]["fault"].to_string().contains("8×8") && warned && !refined
    });
    let before = service.state()["frames"].as_u64().unwrap();
    service.until("further frames and attempts", || {
        let state = service.state();
        state["frames"].as_u64().unwrap() > before + 3 && state["cameras"]["guide"]["reopened"].as_u64().unwrap() > 0
    });
    assert_eq!(service.state()["cameras"]["raw"]["online"], true);
    assert_eq!(service.text("/healthz").0, 200);
    assert_eq!(service.get("/snapshot?view=guide").0, 200);
    service.stop();
}

#[test]
fn when_results_cannot_be_written_the_live_view_goes_on_and_saving_resumes() {
    let service = Running::start(&[], &[]);
    let (out, away) = (service.dir.path().join("out"), service.dir.path().join("away"));
    // a file where the folder was: nothing can be made in it, for any user
    std::fs::rename(&out, &away).unwrap();
    std::fs::write(&out, "").unwrap();
    service.until("an alarm", || service.state()["saving"]["fault"].is_string());
    let before = service.state()["frames"].as_u64().unwrap();
    service.until("frames all the same", || service.state()["frames"].as_u64().unwrap() > before + 2);
    std::fs::remove_file(&out).unwrap();
    std::fs::rename(&away, &out).unwrap();
    let written = service.state()["saving"]["written"].as_u64().unwrap();
    service.until("saving again", || {
        let saving = service.state()["saving"].clone();
        saving["fault"].is_null() && saving["written"].as_u64().unwrap() > written
    });
    assert!(service.stop()["results"]["failed"].as_u64().unwrap() > 0);
}

#[test]
fn what_cannot_run_is_refused_at_the_start() {
    let refused = |more: &[(&str, &str)], arguments: &[&str]| {
        let dir = tempfile::tempdir().unwrap();
        let output = command(dir.path(), more).args(arguments).output().unwrap();
        (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
    };
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let (code, text) = refused(&[], &["--listen", &taken.local_addr().unwrap().to_string()]);
    assert!(code == 69 && text.contains("another instance"), "{code} {text}");
    let small = [("limit_bytes = 102760448", "limit_bytes = 23068672"), ("size=48", "size=160")];
    let (code, text) = refused(&small, &["--no-preview"]);
    assert!(code == 78 && text.contains("recon") && text.contains("the limit is 23068672"), "{code} {text}");
    let (code, text) = refused(&[("backend = \"sim\"", "backend = \"usb\"")], &["--no-preview"]);
    assert!(code == 69 && text.contains("allowed: sim"), "{code} {text}");
    let (code, text) = refused(&[], &["--no-preview", "--fusion", "small"]);
    assert!(code == 66 && text.contains("fusion model small: neither shipped nor in"), "{code} {text}");
}

#[test]
fn single_shots_are_taken_by_request_and_by_signal_alone() {
    const PROOF: &str = "Origin: http://localhost\r\nContent-Type: application/json\r\n";
    let shots = ("max_skew_us = 5000", "single_shots = true\nmax_skew_us = 5000");
    let service = Running::begin(&[shots], &["--control"]);
    let frames = || service.state()["frames"].as_u64().unwrap();
    let seen = || service.state()["cameras"]["raw"]["frames"].as_u64().unwrap();
    service.until("frames of the cameras", || seen() > 5);
    assert_eq!((frames(), service.get("/healthz").0), (0, 200), "no frame is asked for");
    assert_eq!(service.post("/trigger", "Content-Type: application/json\r\n", ""), 403, "without proof");
    assert_eq!(service.post("/trigger", PROOF, ""), 200);
    service.until("the frame that was asked for", || frames() == 1);
    let signal = format!("kill -USR1 {}", service.child.id());
    assert!(std::process::Command::new("sh").args(["-c", &signal]).status().unwrap().success());
    service.until("the frame of the signal", || frames() == 2);
    let before = seen();
    service.until("more frames of the cameras", || seen() > before + 5);
    assert_eq!(frames(), 2);
    assert_eq!(service.stop()["frames"], 2);
    let service = Running::start(&[], &["--control"]);
    assert_eq!(service.post("/trigger", PROOF, ""), 400, "every pair is processed");
    service.stop();
}

#[test]
fn settings_change_at_run_time_with_leave_and_proof_alone() {
    const PROOF: &str = "Origin: http://localhost\r\nContent-Type: application/json\r\n";
    let service = Running::start(&[], &[]);
    assert_eq!(service.control(PROOF, "{\"iterations\": 3}"), 403, "read-only by default");
    service.stop();
    // a machine too slow for the frame rate would choose fewer iterations
    let service = Running::start(&[], &["--control", "--fps", "off", "--fusion", "off"]);
    assert_eq!(service.control(PROOF, "{\"iterations\": 3, \"jpeg_quality\": 30}"), 200);
    service.until("three iterations", || service.state()["report"]["iterations"] == 3);
    assert_eq!(service.state()["controls"]["jpeg_quality"], 30);
    for (headers, body, status) in [
        ("Content-Type: application/json\r\n", "{}", 403),
        ("Origin: http://evil.example\r\nContent-Type: application/json\r\n", "{}", 403),
        ("Origin: http://localhost\r\n", "{}", 415),
        (PROOF, "{\"iteration\": 3}", 400),
        (PROOF, "{\"iterations\": 0, \"jpeg_quality\": 99}", 400),
        (PROOF, "{\"fusion\": true}", 400),
        (PROOF, "no json", 400),
    ] {
        assert_eq!(service.control(headers, body), status, "{headers} {body}");
    }
    assert_eq!(service.control(PROOF, &" ".repeat(5000)), 413);
    assert_eq!(service.state()["controls"]["jpeg_quality"], 30, "all of a change or nothing");
    assert_eq!(service.control(PROOF, "{\"background\": \"store\"}"), 200);
    assert_eq!(service.state()["controls"]["background"], true);
    assert_eq!(service.get("/snapshot?view=difference").0, 200);
    let region: serde_json::Value = serde_json::from_slice(&service.get("/histogram?x=4&y=4&w=8&h=8").1).unwrap();
    assert!(region["pixels"].as_u64().unwrap() <= 64 && region["stokes"].as_array().unwrap().len() == 3, "{region}");
}

#[cfg(feature = "fusion")]
#[test]
fn results_are_fused_until_physics_alone_is_asked_for() {
    const PROOF: &str = "Origin: http://localhost\r\nContent-Type: application/json\r\n";
    let service = Running::start(&[], &["--control", "--fusion", "preview"]);
    let fusion = |service: &Running| service.state()["controls"]["fusion"].clone();
    let expected = serde_json::json!({
        "on": true, "available": true, "model": "preview", "precision": "int8", "reason": "asked for",
    });
    assert_eq!(fusion(&service), expected);
    service.until("a fused result", || service.state()["report"]["fusion"].is_object());
    assert!(service.state()["stages_ms"]["fusion"]["p50"].as_f64().unwrap() > 0.0);
    assert_eq!(service.control(PROOF, "{\"fusion\": false}"), 200);
    assert_eq!(fusion(&service)["on"], false);
    service.until("physics alone", || service.state()["report"]["fusion"].is_null());
    assert_eq!(service.control(PROOF, "{\"fusion\": true}"), 200);
    service.until("a fused result again", || service.state()["report"]["fusion"].is_object());
    service.stop();
}

#[test]
fn what_happens_is_told_to_readers_and_to_a_command() {
    let dir = tempfile::tempdir().unwrap();
    let heard = dir.path().join("heard");
    let command = format!("cat > '{}'", heard.display());
    let service = Running::start(&[], &["--on-event", &command]);
    let mut stream = service.connect();
    write!(stream, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let mut text = Vec::new();
    let begin = Instant::now();
    while !String::from_utf8_lossy(&text).contains("\"event\":\"first-frame\"") {
        let mut part = [0; 1024];
        let n = stream.read(&mut part).unwrap();
        text.extend_from_slice(&part[..n]);
        assert!(n > 0 && begin.elapsed() < Duration::from_secs(30) * slowness(), "{}", String::from_utf8_lossy(&text));
    }
    service.until("the command to hear of it", || {
        std::fs::read_to_string(&heard).unwrap_or_default().contains("\"event\":\"started\"")
    });
    service.stop();
}

#[test]
fn a_session_is_recorded_and_replayed_to_the_same_results() {
    let dir = tempfile::tempdir().unwrap();
    let (sessions, replayed) = (dir.path().join("sessions"), dir.path().join("replayed"));
    for format in ["npy", "tiff", "ome-tiff", "png16"] {
        let output = command(dir.path(), &[])
            .args([
                "--frames",
                "4",
                "--no-preview",
                "--record-reserve-bytes",
                "0",
                "--record-format",
                format,
                "--record",
            ])
            .arg(&sessions)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(summary["recording"]["written"], 4, "{summary}");
        let session = summary["recording"]["session"].as_str().unwrap();
        let output = std::process::Command::new(env!("CARGO_BIN_EXE_stokescope"))
            .args(["--json", "replay", session, "--out"])
            .arg(&replayed)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let again: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!((&again["frames"], &again["dropped"]["raw"]), (&4.into(), &0.into()), "{again}");
        for frame in 0..4 {
            let file = format!("frame-{frame:06}/stokes.npy");
            let read = |path: &std::path::Path| stokescope::files::read_npy(&path.join(&file)).unwrap().into_f32();
            let (now, then) = (read(&replayed), read(&dir.path().join("out")));
            let error = now.iter().zip(&then).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            // A guide is kept in 16 bits. What that rounds goes on from frame to frame, and into the corrections of the fusion model.
            assert!(error < 1e-2, "{format}, frame {frame}: {error}");
        }
    }
    let output =
        std::process::Command::new(env!("CARGO_BIN_EXE_stokescope")).arg("replay").arg(&replayed).output().unwrap();
    assert_eq!(output.status.code(), Some(65), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn the_service_manager_is_told_of_results_and_of_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("notify");
    let socket = std::os::unix::net::UnixDatagram::bind(&path).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(1))).unwrap();
    let listening = std::thread::spawn(move || {
        let (mut heard, mut buffer) = (Vec::new(), [0; 512]);
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_secs(30) * slowness()
            && !heard.last().is_some_and(|t: &String| t.contains("STOPPING=1"))
        {
            if let Ok(n) = socket.recv(&mut buffer) {
                heard.push(String::from_utf8_lossy(&buffer[..n]).into_owned());
            }
        }
        heard
    });
    let output = command(dir.path(), &[]).args(["--frames", "3", "--no-preview"]).env("NOTIFY_SOCKET", &path).output();
    assert!(output.unwrap().status.success());
    let heard = listening.join().unwrap();
    let count = |word: &str| heard.iter().filter(|text| text.contains(word)).count();
    assert_eq!((count("READY=1"), count("STOPPING=1")), (1, 1), "{heard:?}");
    assert!((1..=3).contains(&count("WATCHDOG=1")), "fed by frames alone: {heard:?}");
}

/// Records eight frames into a session; gives its folder.
fn recorded(dir: &std::path::Path) -> std::path::PathBuf {
    let output = command(dir, &[])
        .args(["--frames", "8", "--no-preview", "--record-reserve-bytes", "0", "--record"])
        .arg(dir.join("sessions"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    summary["recording"]["session"].as_str().unwrap().into()
}

/// Replays a session; gives exit code, log, and the number of frames.
fn replay(session: &std::path::Path, out: &std::path::Path) -> (Option<i32>, String, u64) {
    let begin = Instant::now();
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_stokescope"))
        .args(["--json", "replay"])
        .arg(session)
        .arg("--out")
        .arg(out)
        .output()
        .unwrap();
    assert!(begin.elapsed() < Duration::from_secs(30) * slowness(), "{:?}", begin.elapsed());
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
    (output.status.code(), String::from_utf8(output.stderr).unwrap(), summary["frames"].as_u64().unwrap_or(0))
}

#[test]
fn replay_names_and_counts_missing_and_damaged_frames_and_ends() {
    let dir = tempfile::tempdir().unwrap();
    let session = recorded(dir.path());
    let out = dir.path().join("replayed");
    assert_eq!((replay(&session, &out).0, replay(&session, &out).2), (Some(0), 8));
    // the first frame as well, from which cameras learn the format
    let bad = [
        ("raw/00000000.npy", Some("short")),
        ("raw/00000002.npy", None),
        ("guide/00000003.npy", None),
        ("guide/00000005.npy", Some("")),
        ("frames/00000006.json", Some("{")),
    ];
    for (file, text) in bad {
        match text {
            Some(text) => std::fs::write(session.join(file), text).unwrap(),
            None => std::fs::remove_file(session.join(file)).unwrap(),
        }
    }
    let (code, log, frames) = replay(&session, &out);
    assert_eq!((code, frames), (Some(65), 3), "{log}");
    for (file, _) in bad {
        assert_eq!(log.matches(file).count(), 1, "{file} in {log}");
    }
    assert!(log.contains("5 of 8 frames are missing or damaged and were left out"), "{log}");
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    assert_eq!(report["method"], "guided", "{report}");
    // nothing is left
    std::fs::remove_dir_all(session.join("guide")).unwrap();
    let (code, log, frames) = replay(&session, &out);
    assert!(code == Some(65) && frames == 0 && log.contains("no complete frame"), "{code:?} {log}");
}

#[test]
fn a_calibrated_device_s_recording_is_replayed() {
    let dir = tempfile::tempdir().unwrap();
    let session = recorded(dir.path());
    let path = session.join("calibration/calibration.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(!text.contains("[camera]"));
    let camera = "\n[camera]\nname = \"imx296\"\nformat = \"mono 10-bit\"\nwidth = 48\nheight = 48\n";
    std::fs::write(&path, text + camera).unwrap();
    let (code, log, frames) = replay(&session, &dir.path().join("replayed"));
    assert_eq!((code, frames), (Some(0), 8), "{log}");
    // a board of replayed cameras runs with that bundle, and calibrates it
    let table = |role: &str| format!("[cameras.{role}]\nbackend = \"replay\"\nsource = {session:?}\n#");
    let (raw, guide) = (table("raw"), table("guide"));
    let calibration = format!("calibration = {:?}", session.join("calibration"));
    let board = [
        ("[cameras.raw]\nbackend = \"sim\"\n", raw.as_str()),
        ("[cameras.guide]\nbackend = \"sim\"\n", guide.as_str()),
        ("calibration = \"simulated\"", calibration.as_str()),
    ];
    let output = command(dir.path(), &board).args(["--frames", "2", "--no-preview"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_stokescope"))
        .args(["calibrate", "white", "--frames", "2", "--board"])
        .arg(dir.path().join("small.toml"))
        .arg("--bundle")
        .arg(session.join("calibration"))
        .output()
        .unwrap();
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(!log.contains("belongs to camera"), "{log}");
    let kept = std::fs::read_to_string(&path).unwrap();
    assert!(kept.contains("imx296") && !kept.contains("replayed"), "{kept}");
}
