//! One function for each parser: whatever the bytes, it returns, soon and without taking much memory.
#![allow(clippy::unwrap_used, reason = "the surroundings of a parser are not what is tested")]
#![allow(unreachable_pub, reason = "it is a library, and a module of a test")]

use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Arc, LazyLock, Mutex};
use std::time::Duration;

use sha2::{Digest, Sha256};
use stokescope::board::Board;
use stokescope::bundle::Bundle;
use stokescope::files::{read_image, read_npy, write_npy};
use stokescope::live::{Options, Service};
use stokescope::model::Model;
use stokescope::session::Playback;

/// A folder of this process in memory where there is one.
fn folder() -> &'static Path {
    static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| {
        let memory = Path::new("/dev/shm");
        let within = if memory.is_dir() { memory.to_path_buf() } else { std::env::temp_dir() };
        tempfile::Builder::new().prefix("stokescope-fuzz-").tempdir_in(within).unwrap().keep()
    });
    &FOLDER
}

/// A board file.
pub fn board(bytes: &[u8]) {
    if let Ok(text) = std::str::from_utf8(bytes) {
        let _ = Board::parse(Path::new("board.toml"), text);
    }
}

/// The description of a bundle, beside a PSF of 8×8 pixels.
pub fn bundle(bytes: &[u8]) {
    let dir = folder().join("bundle");
    if !dir.exists() {
        fs::create_dir(&dir).unwrap();
        write_npy(&dir.join("psf.npy"), &[8, 8], &std::array::from_fn::<f32, 64, _>(|i| (i % 7) as f32)).unwrap();
    }
    fs::write(dir.join("calibration.toml"), bytes).unwrap();
    let _ = Bundle::load(&dir);
}

/// The manifest of a fusion model.
pub fn manifest(bytes: &[u8]) {
    if let Ok(text) = std::str::from_utf8(bytes) {
        let _ = Model::parse(Path::new("manifest.toml"), text);
    }
}

/// An NPY file.
pub fn npy(bytes: &[u8]) {
    let path = folder().join("array.npy");
    fs::write(&path, bytes).unwrap();
    let _ = read_npy(&path);
}

/// A PNG, TIFF or NPY image.
pub fn image(bytes: &[u8]) {
    let path = folder().join("image");
    fs::write(&path, bytes).unwrap();
    let _ = read_image(&path);
}

/// A request of a client to a running service, which answers others afterwards as before.
pub fn request(bytes: &[u8]) {
    // it ends with the process
    static SERVICE: LazyLock<(SocketAddr, Mutex<Service>)> = LazyLock::new(|| {
        // a program of Rust's own is not ended by a client that leaves, a fuzzer's main is not one
        signal_hook::flag::register(signal_hook::consts::SIGPIPE, Arc::default()).unwrap();
        let mut board = Board::load("x86-sim").unwrap();
        board.raw.source = "wedges,size=16,stripes=4".into();
        board.guide = None;
        board.iterations = 1;
        let service = Service::start(&Options::new(board, folder().join("out"))).unwrap();
        (service.address().unwrap(), Mutex::new(service))
    });
    let ask = |bytes: &[u8]| {
        let mut stream = TcpStream::connect(SERVICE.0).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let mut answer = [0; 64];
        // it may be cut off while it talks
        let _ = stream.write_all(bytes);
        let _ = stream.shutdown(std::net::Shutdown::Write);
        let n = stream.read(&mut answer).unwrap_or(0);
        answer[..n].to_vec()
    };
    ask(bytes);
    // connections that are not yet known to be gone may take all places for a moment
    let mut answers = (0..200).map(|n| {
        std::thread::sleep(Duration::from_millis(10 * n.min(10)));
        ask(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    });
    let well = answers.any(|answer| answer.starts_with(b"HTTP/1.1 200"));
    assert!(well, "the service does not answer after {}", String::from_utf8_lossy(bytes));
}

/// Description and sidecar of a session: the bytes before and after the first NUL.
pub fn session(bytes: &[u8]) {
    let dir = folder().join("session");
    fs::create_dir_all(dir.join("frames")).unwrap();
    let cut = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    fs::write(dir.join("session.json"), &bytes[..cut]).unwrap();
    fs::write(dir.join("frames/00000000.json"), bytes.get(cut + 1..).unwrap_or_default()).unwrap();
    let _ = Playback::open(&dir);
}

/// The network of a model that is not shipped. `program` opens it, in a process of its own within bounds, and goes on without trouble.
pub fn model(program: &Path, bytes: &[u8]) {
    let dir = folder().join("model");
    let run = |args: &[&str]| {
        // what the process takes beside the trial of the network is far below this limit
        let mut command = Command::new("sh");
        command.args(["-c", "ulimit -v 2097152 && exec \"$@\"", "sh"]).arg(program).args(args).current_dir(&dir);
        command.stdout(Stdio::null()).stderr(Stdio::null()).status().unwrap()
    };
    if !dir.exists() {
        fs::create_dir(&dir).unwrap();
        assert!(run(&["simulate", "--size", "16", "--out", "bundle"]).success());
    }
    let digest: String = Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect();
    let text = include_str!("../../tests/golden/fusion/mixes/manifest.toml");
    let own = |line: &str| {
        line.split_once("sha256 = ").filter(|_| line.starts_with("f32")).map(|(start, _)| start.to_owned())
    };
    let lines = text.lines().filter(|line| !line.starts_with("int8"));
    let manifest: Vec<_> = lines
        .map(|line| own(line).map_or(line.to_owned(), |start| format!("{start}sha256 = \"{digest}\" }}")))
        .collect();
    fs::write(dir.join("manifest.toml"), manifest.join("\n")).unwrap();
    fs::write(dir.join("model.onnx"), bytes).unwrap();
    let common = ["reconstruct", "--calibration", "bundle", "--raw", "bundle/raw.npy", "--guide", "bundle/guide.npy"];
    let status = run(&[&common[..], &["--iterations", "1", "--force", "--fusion", ".", "--out", "out"]].concat());
    let allowed = [0, 65, 66, 78];
    assert!(status.code().is_some_and(|code| allowed.contains(&code)), "{status}");
}
