//! The live service as its users meet it: the real program, its signals, its files and its HTTP.
#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a helper that fails is a test that fails")]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Far longer than anything takes, so that only what hangs fails.
const LONG: Duration = Duration::from_secs(60);

/// A small board, quick on any machine; `more` replaces lines of it.
fn board(dir: &Path, more: &[(&str, &str)]) -> std::path::PathBuf {
    let shipped = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("boards/x86-sim.toml")).unwrap();
    let mut text = shipped.replace("plastic,size=250", "plastic,size=48").replace("iterations = 20", "iterations = 2");
    for (from, to) in more {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    let path = dir.join("small.toml");
    std::fs::write(&path, text).unwrap();
    path
}

fn command(dir: &Path, more: &[(&str, &str)]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_stokescope"));
    command.args(["--json", "run", "--board"]).arg(board(dir, more)).arg("--out").arg(dir.join("out"));
    command.env_remove("STOKESCOPE_TOKEN").stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// A running service with a preview on a free port. Killed when dropped.
struct Running {
    child: Child,
    address: SocketAddr,
    dir: tempfile::TempDir,
}

impl Running {
    fn start(more: &[(&str, &str)], arguments: &[&str]) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut child = command(dir.path(), more).args(["--listen", "127.0.0.1:0"]).args(arguments).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let address = lines
            .by_ref()
            .map_while(Result::ok)
            .find_map(|line| line.split_once("preview: http://").map(|(_, rest)| rest.trim_end_matches('/').to_owned()))
            .expect("the address of the preview");
        // what the service says later must not block it
        std::thread::spawn(move || lines.map_while(Result::ok).for_each(|line| eprintln!("{line}")));
        let running = Self { child, address: address.parse().unwrap(), dir };
        running.until("a first result", || running.state()["frames"].as_u64().is_some_and(|n| n > 0));
        running
    }

    fn until(&self, what: &str, mut done: impl FnMut() -> bool) {
        let begin = Instant::now();
        while !done() {
            assert!(begin.elapsed() < LONG, "{what} in vain: {}", self.state());
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(LONG)).unwrap();
        stream
    }

    /// Sends these bytes and reads until the service closes.
    fn raw(&self, request: &str) -> String {
        let mut stream = self.connect();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        String::from_utf8_lossy(&answer).into_owned()
    }

    fn get_with(&self, path: &str, headers: &str) -> (u16, Vec<u8>) {
        let mut stream = self.connect();
        write!(stream, "GET {path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n").unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n").expect("headers") + 4;
        let status = std::str::from_utf8(&answer[9..12]).unwrap().parse().unwrap();
        (status, answer.split_off(end))
    }

    fn get(&self, path: &str) -> (u16, Vec<u8>) {
        self.get_with(path, "Host: localhost\r\n")
    }

    fn text(&self, path: &str) -> (u16, String) {
        let (status, body) = self.get(path);
        (status, String::from_utf8(body).unwrap())
    }

    fn state(&self) -> serde_json::Value {
        serde_json::from_slice(&self.get("/state").1).unwrap()
    }

    /// Sends SIGTERM; gives the summary.
    fn stop(mut self) -> serde_json::Value {
        let begin = Instant::now();
        // the shell has a kill of its own where no other is installed
        let signal = format!("kill {}", self.child.id());
        assert!(Command::new("sh").args(["-c", &signal]).status().unwrap().success());
        let mut summary = String::new();
        self.child.stdout.take().unwrap().read_to_string(&mut summary).unwrap();
        let status = self.child.wait().unwrap();
        assert!(begin.elapsed() < Duration::from_secs(5), "{:?}", begin.elapsed());
        assert_eq!(status.code(), Some(0));
        serde_json::from_str(&summary).unwrap()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // it ended already when the test went well
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Reads `count` parts of a stream: each a whole JPEG.
fn parts(stream: TcpStream, count: usize) -> Vec<Vec<u8>> {
    let mut reader = BufReader::new(stream);
    let mut line = || -> String {
        let mut line = String::new();
        reader.read_line(&mut line).unwrap();
        line.trim_end().to_owned()
    };
    while !line().is_empty() {}
    // chunks of the transfer coding stand between the lines; pictures come whole in one of them
    let mut found = Vec::new();
    let mut length = 0;
    while found.len() < count {
        let mut text = String::new();
        assert!(reader.read_line(&mut text).unwrap() > 0, "the stream ended");
        if let Some(n) = text.strip_prefix("Content-Length: ") {
            length = n.trim().parse().unwrap();
        }
        if text == "\r\n" && length > 0 {
            let mut image = vec![0; length];
            reader.read_exact(&mut image).unwrap();
            assert!(image.starts_with(&[0xff, 0xd8]) && image.ends_with(&[0xff, 0xd9]));
            let mut boundary = String::new();
            reader.read_line(&mut boundary).unwrap();
            reader.read_line(&mut boundary).unwrap();
            assert_eq!(boundary, "\r\n--stokescope-frame\r\n");
            found.push(image);
            length = 0;
        }
    }
    found
}

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
        for file in
            ["angles.npy", "stokes.npy", "intensity.png", "dolp.png", "aolp.png", "composite.png", "report.json"]
        {
            assert!(folder.join(file).is_file(), "{} {file}", folder.display());
        }
    }
    assert_eq!(
        std::fs::read(out.join("stokes.npy")).unwrap(),
        std::fs::read(out.join("frame-000002/stokes.npy")).unwrap(),
        "the newest result stands in the folder itself"
    );
    stokescope::calibration::Calibration::load(&out.join("calibration")).unwrap();
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
    let held: Vec<_> = (0..3).map(|_| service.connect()).collect();
    let mut slow = &held[0];
    write!(slow, "GET / HT").unwrap();
    let begin = Instant::now();
    let answer = service.raw("GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n");
    assert!(answer.starts_with("HTTP/1.1 503") && answer.ends_with("too many clients\n"), "{answer}");
    // headers that do not come free their places
    for mut stream in held {
        let mut rest = Vec::new();
        let _ = stream.read_to_end(&mut rest);
    }
    assert!(begin.elapsed() < Duration::from_secs(20), "{:?}", begin.elapsed());
    assert_eq!(service.text("/healthz").0, 200);
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

#[test]
fn a_token_opens_what_is_closed_without() {
    let service = {
        let dir = tempfile::tempdir().unwrap();
        let open = command(dir.path(), &[]).args(["--listen", "0.0.0.0:0"]).output().unwrap();
        assert_eq!(open.status.code(), Some(2));
        assert!(String::from_utf8_lossy(&open.stderr).contains("needs --token"));
        let mut child =
            command(dir.path(), &[]).args(["--listen", "127.0.0.1:0", "--token", "secret-1"]).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let line = lines.find_map(|l| l.ok().filter(|l| l.contains("http://"))).unwrap();
        let address = line.split("http://").nth(1).unwrap().trim_end_matches('/').parse().unwrap();
        Running { child, address, dir }
    };
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
    stokescope::array::write_npy(&guide.join("0.npy"), &[48, 48], &[0.5; 48 * 48]).unwrap();
    stokescope::array::write_npy(&guide.join("1.npy"), &[8, 8], &[0.5; 64]).unwrap();
    let table = format!("[cameras.guide]\nbackend = \"replay\"\nsource = {:?}\n#", dir.path());
    let service = Running::start(&[("[cameras.guide]\nbackend = \"sim\"\n", &table)], &[]);
    service.until("an unguided frame", || {
        let state = service.state();
        let warned = state["report"]["warnings"].to_string().contains("unguided");
        state["cameras"]["guide"]["fault"].to_string().contains("8×8") && warned
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
    let small = [("limit_bytes = 67108864", "limit_bytes = 8388608"), ("size=48", "size=160")];
    let (code, text) = refused(&small, &["--no-preview"]);
    assert!(code == 78 && text.contains("recon") && text.contains("the limit is 8388608"), "{code} {text}");
    let (code, text) = refused(&[("backend = \"sim\"", "backend = \"usb\"")], &["--no-preview"]);
    assert!(code == 69 && text.contains("allowed: sim"), "{code} {text}");
    let (code, text) = refused(&[], &["--no-preview", "--fusion", "small"]);
    assert!(code == 66 && text.contains("no models are shipped"), "{code} {text}");
}
