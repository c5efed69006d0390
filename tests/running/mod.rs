//! A running service, and how to talk to it.
#![allow(dead_code, reason = "every test binary uses its part of these helpers")]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::emulated::slowness;

/// Far longer than anything takes, so that only what hangs fails.
pub(crate) const LONG: Duration = Duration::from_secs(60);

/// A small board, quick on any machine; `more` replaces lines of it.
pub(crate) fn board(dir: &Path, more: &[(&str, &str)]) -> std::path::PathBuf {
    let shipped = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("boards/x86-sim.toml")).unwrap();
    let mut text = shipped.replace("wedges,size=250", "wedges,size=48").replace("iterations = 20", "iterations = 2");
    for (from, to) in more {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    let path = dir.join("small.toml");
    std::fs::write(&path, text).unwrap();
    path
}

pub(crate) fn command(dir: &Path, more: &[(&str, &str)]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_stokescope"));
    command.args(["--json", "run", "--board"]).arg(board(dir, more)).arg("--out").arg(dir.join("out"));
    command.env_remove("STOKESCOPE_TOKEN").stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// A running service with a preview on a free port. Killed when dropped.
pub(crate) struct Running {
    pub(crate) child: Child,
    pub(crate) address: SocketAddr,
    pub(crate) dir: tempfile::TempDir,
}

impl Running {
    /// Starts a service and waits for its first result.
    pub(crate) fn start(more: &[(&str, &str)], arguments: &[&str]) -> Self {
        let running = Self::begin(more, arguments);
        running.until("a first result", || running.state()["frames"].as_u64().is_some_and(|n| n > 0));
        running
    }

    /// Starts a service and waits for its address alone.
    pub(crate) fn begin(more: &[(&str, &str)], arguments: &[&str]) -> Self {
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
        Self { child, address: address.parse().unwrap(), dir }
    }

    pub(crate) fn until(&self, what: &str, mut done: impl FnMut() -> bool) {
        let begin = Instant::now();
        while !done() {
            assert!(begin.elapsed() < LONG * slowness(), "{what} in vain: {}", self.state());
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    pub(crate) fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(LONG * slowness())).unwrap();
        stream
    }

    /// Sends these bytes and reads until the service closes.
    pub(crate) fn raw_bytes(&self, request: &str) -> Vec<u8> {
        let mut stream = self.connect();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        answer
    }

    /// As [`Self::raw_bytes`], as text.
    pub(crate) fn raw(&self, request: &str) -> String {
        String::from_utf8_lossy(&self.raw_bytes(request)).into_owned()
    }

    pub(crate) fn get_with(&self, path: &str, headers: &str) -> (u16, Vec<u8>) {
        let mut stream = self.connect();
        write!(stream, "GET {path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n").unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n").expect("headers") + 4;
        let status = std::str::from_utf8(&answer[9..12]).unwrap().parse().unwrap();
        (status, answer.split_off(end))
    }

    pub(crate) fn get(&self, path: &str) -> (u16, Vec<u8>) {
        self.get_with(path, "Host: localhost\r\n")
    }

    pub(crate) fn text(&self, path: &str) -> (u16, String) {
        let (status, body) = self.get(path);
        (status, String::from_utf8(body).unwrap())
    }

    pub(crate) fn state(&self) -> serde_json::Value {
        serde_json::from_slice(&self.get("/state").1).unwrap()
    }

    /// A figure of the process: VmRSS in kB, Threads, or with another name none.
    pub(crate) fn process(&self, figure: &str) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix(figure)?.strip_prefix(':')).unwrap();
        line.trim().trim_end_matches(" kB").parse().unwrap()
    }

    /// Files that the process holds open.
    pub(crate) fn descriptors(&self) -> usize {
        std::fs::read_dir(format!("/proc/{}/fd", self.child.id())).unwrap().count()
    }

    /// Posts a change; gives the status.
    pub(crate) fn control(&self, headers: &str, body: &str) -> u16 {
        self.post("/control", headers, body)
    }

    /// Posts to `path`; gives the status.
    pub(crate) fn post(&self, path: &str, headers: &str, body: &str) -> u16 {
        let answer = self.raw(&format!(
            "POST {path} HTTP/1.1\r\nHost: localhost\r\n{headers}Content-Length: {}\r\nConnection: close\r\n\r\n{body}",
            body.len()
        ));
        answer[9..12].parse().unwrap()
    }

    /// Sends SIGTERM; gives the summary.
    pub(crate) fn stop(mut self) -> serde_json::Value {
        let begin = Instant::now();
        // the shell has a kill of its own where no other is installed
        let signal = format!("kill {}", self.child.id());
        assert!(Command::new("sh").args(["-c", &signal]).status().unwrap().success());
        let mut summary = String::new();
        self.child.stdout.take().unwrap().read_to_string(&mut summary).unwrap();
        let status = self.child.wait().unwrap();
        assert!(begin.elapsed() < Duration::from_secs(5) * slowness(), "{:?}", begin.elapsed());
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
pub(crate) fn parts(stream: TcpStream, count: usize) -> Vec<Vec<u8>> {
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
