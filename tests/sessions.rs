//! Sessions over HTTP, with the real program: recorded, listed, downloaded, replayed and removed; one frame with its numbers and pictures.
#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a helper that fails is a test that fails")]

mod emulated;
mod running;

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::Shutdown;
use std::path::Path;
use std::process::Command;

use running::Running;
use serde_json::{Value, json};
use stokescope::files::{ImageStack, Samples};

const JSON: &str = "Origin: http://localhost\r\nContent-Type: application/json\r\n";

/// Sends a change; gives the status and the answer.
fn send(service: &Running, method: &str, path: &str, body: &str) -> (u16, String) {
    let answer = service.raw(&format!(
        "{method} {path} HTTP/1.1\r\nHost: localhost\r\n{JSON}Content-Length: {}\r\nConnection: close\r\n\r\n{body}",
        body.len()
    ));
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (head[9..12].parse().unwrap(), body.to_owned())
}

fn list(service: &Running) -> Value {
    serde_json::from_slice(&service.get("/sessions").1).unwrap()
}

/// Body of an answer in chunks.
fn joined(mut chunks: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    loop {
        let end = chunks.windows(2).position(|w| w == b"\r\n").unwrap();
        let length = usize::from_str_radix(std::str::from_utf8(&chunks[..end]).unwrap(), 16).unwrap();
        if length == 0 {
            return out;
        }
        out.extend(&chunks[end + 2..end + 2 + length]);
        chunks = &chunks[end + 4 + length..];
    }
}

/// Files in a ZIP file without compression, by its directory.
fn unpacked(zip: &[u8]) -> BTreeMap<String, Vec<u8>> {
    let number = |at: usize, bytes: usize| (0..bytes).fold(0, |n, i| n | usize::from(zip[at + i]) << (8 * i));
    let end = zip.len() - 22;
    assert_eq!(&zip[end..end + 4], b"PK\x05\x06");
    let (count, mut at) = (number(end + 10, 2), number(end + 16, 4));
    let mut found = BTreeMap::new();
    for _ in 0..count {
        assert_eq!(&zip[at..at + 4], b"PK\x01\x02");
        let (size, name, header) = (number(at + 24, 4), number(at + 28, 2), number(at + 42, 4));
        let name = std::str::from_utf8(&zip[at + 46..at + 46 + name]).unwrap();
        assert_eq!(&zip[header..header + 4], b"PK\x03\x04");
        let start = header + 30 + name.len();
        found.insert(name.to_owned(), zip[start..start + size].to_vec());
        at += 46 + name.len();
    }
    assert_eq!(at, end);
    found
}

fn unpack(zip: &[u8], dir: &Path) {
    for (name, content) in unpacked(zip) {
        let path = dir.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, content).unwrap();
    }
}

#[test]
fn a_viewer_records_downloads_replays_and_removes_a_session() {
    let dir = tempfile::tempdir().unwrap();
    let sessions = dir.path().join("sessions");
    let service =
        Running::start(&[], &["--control", "--record-reserve-bytes", "0", "--sessions", sessions.to_str().unwrap()]);
    assert_eq!(service.state()["recording"]["on"], false);
    assert_eq!(list(&service)["sessions"], json!([]));
    assert_eq!(send(&service, "POST", "/recording", "{\"on\": true, \"name\": \"a\\nb\"}").0, 400);

    let (status, _) =
        send(&service, "POST", "/recording", "{\"on\": true, \"name\": \"leaf\", \"note\": \"from below\"}");
    assert_eq!(status, 200);
    assert_eq!(send(&service, "POST", "/recording", "{\"on\": true}").0, 400, "one is being recorded");
    service.until("frames", || service.state()["recording"]["frames"].as_u64() >= Some(3));
    let found = list(&service);
    let id = found["sessions"][0]["id"].as_str().unwrap().to_owned();
    assert_eq!((found["sessions"][0]["name"].as_str(), found["current"].as_str()), (Some("leaf"), Some(id.as_str())));
    let (status, text) = send(&service, "DELETE", &format!("/sessions/{id}"), "");
    assert!(status == 400 && text.contains("is being recorded"), "{status} {text}");
    assert_eq!(send(&service, "POST", "/recording", "{\"on\": false}").0, 200);
    // what waited for the disk is written
    service.until("the end", || {
        let frames = || list(&service)["sessions"][0]["frames"].as_u64();
        let before = frames();
        std::thread::sleep(std::time::Duration::from_millis(300));
        before == frames()
    });
    let (_, png) = service.get(&format!("/sessions/{id}/thumbnail"));
    assert!(png.starts_with(b"\x89PNG"));
    let (status, text) = send(&service, "POST", &format!("/sessions/{id}"), "{\"name\": \"oak\", \"note\": \"\"}");
    assert!(status == 200 && text.contains("\"name\":\"oak\"") && !text.contains("from below"), "{text}");

    let (status, zip) = service.get(&format!("/sessions/{id}/zip"));
    assert_eq!(status, 200);
    let away = dir.path().join("away");
    unpack(&zip, &away);
    let out = dir.path().join("replayed");
    let replay =
        Command::new(env!("CARGO_BIN_EXE_stokescope")).arg("replay").arg(&away).arg("--out").arg(&out).output();
    let replay = replay.unwrap();
    assert!(replay.status.success(), "{}", String::from_utf8_lossy(&replay.stderr));
    // the results as one file, the one that the command writes, with its length told
    let exported = dir.path().join("leaf.ome.tif");
    let export = ["export", "--format", "ome-tiff", "--out", exported.to_str().unwrap()];
    let export = Command::new(env!("CARGO_BIN_EXE_stokescope")).args(export).arg(&away).output().unwrap();
    assert!(export.status.success(), "{}", String::from_utf8_lossy(&export.stderr));
    let answer = service
        .raw_bytes(&format!("GET /sessions/{id}/ome-tiff HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"));
    let (head, stack) = answer.split_at(answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap() + 4);
    let head = String::from_utf8_lossy(head).to_lowercase();
    assert!(head.contains(&format!("content-length: {}\r\n", stack.len())), "{head}");
    assert!(
        head.contains("image/tiff") && head.contains(&format!("filename=\"{}.ome.tif\"", id.to_lowercase())),
        "{head}"
    );
    assert!(stack == std::fs::read(&exported).unwrap());
    let numbers = |folder: &Path| {
        let mut names: Vec<_> = std::fs::read_dir(folder).unwrap().flatten().map(|entry| entry.path()).collect();
        names.sort();
        names
    };
    let recorded = numbers(&away.join(&id).join("stokes"));
    assert!(recorded.len() >= 3);
    // the running pipeline had seen frames before the first one, so results are near, not equal
    let read = |path: &Path| stokescope::files::read_npy(path).unwrap().into_f32();
    let (again, first) = (read(&out.join("frame-000000/stokes.npy")), read(&recorded[0]));
    let energy = |values: &mut dyn Iterator<Item = f32>| values.map(|v| f64::from(v).powi(2)).sum::<f64>();
    let off = energy(&mut again.iter().zip(&first).map(|(a, b)| a - b)) / energy(&mut first.iter().copied());
    assert!(again.len() == first.len() && off < 0.1, "{off}");
    let mut pages = ImageStack::open(&exported).unwrap().unwrap();
    assert_eq!(pages.count(), 5 * recorded.len(), "S0, S1, S2, DoLP and AoLP of every frame");
    for (page, recorded) in first.chunks(first.len() / 3).enumerate() {
        let Samples::F32(plane) = pages.read(page).unwrap() else { panic!("depth") };
        assert_eq!(plane.as_slice(), recorded);
    }
    std::fs::remove_dir_all(sessions.join(&id).join("stokes")).unwrap();
    let (status, text) = service.text(&format!("/sessions/{id}/ome-tiff"));
    assert!(status == 404 && text.contains("no frame whose files are all there"), "{status} {text}");

    // a second session, which is not the first one
    assert_eq!(send(&service, "POST", "/recording", "{\"on\": true}").0, 200);
    service.until("a second session", || list(&service)["sessions"].as_array().unwrap().len() == 2);
    assert_eq!(send(&service, "DELETE", &format!("/sessions/{id}"), "").0, 200);
    assert_eq!(service.get(&format!("/sessions/{id}/zip")).0, 404);
    assert!(!sessions.join(&id).exists());
    assert_eq!(service.get("/sessions/..%2f..%2fetc/zip").0, 404);
    let (_, log) = service.text("/log");
    assert!(log.contains("preview: http://"), "{log}");
    assert!(service.text("/version").1.contains(env!("CARGO_PKG_VERSION")));
    service.stop();
}

#[test]
fn nobody_records_where_it_was_not_foreseen_or_changes_are_not_allowed() {
    let service = Running::start(&[], &["--control"]);
    assert_eq!(send(&service, "POST", "/recording", "{\"on\": true}").0, 404);
    assert_eq!(service.get("/sessions").0, 404);
    let dir = tempfile::tempdir().unwrap();
    let service = Running::start(&[], &["--sessions", dir.path().to_str().unwrap()]);
    assert_eq!(send(&service, "POST", "/recording", "{\"on\": true}").0, 403);
    assert_eq!(service.get("/sessions").0, 200);
    assert_eq!(send(&service, "DELETE", "/sessions/session-x", "").0, 403);
}

#[test]
fn one_frame_is_given_with_its_numbers_and_pictures() {
    let service = Running::start(&[], &[]);
    let (status, npy) = service.get("/frame?of=stokes&format=npy");
    assert_eq!(status, 200);
    let path = service.dir.path().join("frame.npy");
    std::fs::write(&path, &npy).unwrap();
    assert_eq!(stokescope::files::read_npy(&path).unwrap().shape, [3, 48, 48]);
    let (status, npy) = service.get("/frame?of=errors");
    std::fs::write(&path, &npy).unwrap();
    let errors = stokescope::files::read_npy(&path).unwrap();
    assert!(status == 200 && errors.shape == [3, 48, 48] && errors.into_f32().iter().all(|e| *e > 0.0));
    assert_eq!(service.get("/frame?of=thermal").0, 400);

    let (status, zip) = service.get("/still");
    assert_eq!(status, 200);
    let files = unpacked(&joined(&zip));
    let views = service.state()["views"].as_array().unwrap().len();
    assert_eq!(files.len(), views + 4, "{:?}", files.keys());
    assert!(files.iter().all(|(name, file)| !name.ends_with(".png") || file.starts_with(b"\x89PNG")));
    let report: Value = serde_json::from_slice(&files["report.json"]).unwrap();
    assert!(report["frame"].is_u64() && report["report"]["method"].is_string());
    std::fs::write(&path, &files["stokes.npy"]).unwrap();
    let stokes = stokescope::files::read_npy(&path).unwrap();
    std::fs::write(&path, &files["stokes_error.npy"]).unwrap();
    assert_eq!(stokescope::files::read_npy(&path).unwrap().shape, stokes.shape);
    let few = unpacked(&joined(&service.get("/still?views=aolp,raw").1));
    let names: Vec<_> = few.keys().map(String::as_str).collect();
    assert_eq!(names, ["aolp.png", "raw.png", "report.json", "stokes.npy", "stokes_error.npy", "valid.npy"]);
    assert_eq!(service.get("/still?views=no").0, 404);
}

#[test]
fn a_body_that_is_cut_short_or_broken_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let service =
        Running::start(&[], &["--control", "--record-reserve-bytes", "0", "--sessions", dir.path().to_str().unwrap()]);
    assert_eq!(send(&service, "POST", "/recording", "{\"on\": true, \"name\": \"leaf\"}").0, 200);
    service.until("frames", || service.state()["recording"]["frames"].as_u64() >= Some(1));
    assert_eq!(send(&service, "POST", "/recording", "{\"on\": false}").0, 200);
    let id = list(&service)["sessions"][0]["id"].as_str().unwrap().to_owned();
    let settings = || {
        let (state, sessions) = (service.state(), list(&service)["sessions"].clone());
        let names: Vec<_> = sessions.as_array().unwrap().iter().map(|session| session["name"].clone()).collect();
        json!([state["controls"], state["quality"]["asked_iterations"], state["recording"]["on"], names])
    };
    let changes = [
        ("/control".to_owned(), "{\"iterations\": 9, \"jpeg_quality\": 31}"),
        ("/recording".to_owned(), "{\"on\": true, \"name\": \"late\"}"),
        (format!("/sessions/{id}"), "{\"name\": \"oak\", \"note\": \"\"}"),
    ];
    let before = settings();
    for (path, body) in &changes {
        let (n, half) = (body.len(), &body[..body.len() / 2]);
        let broken = [
            ("shorter than its length", format!("Content-Length: {}\r\n\r\n{body}", n + 5)),
            ("half of the object", format!("Content-Length: {}\r\n\r\n{half}", n / 2)),
            ("more than the object", format!("Content-Length: {}\r\n\r\n{body}}}", n + 1)),
            ("a chunk that is cut", format!("Transfer-Encoding: chunked\r\n\r\n{:x}\r\n{body}", n + 5)),
            ("no last chunk", format!("Transfer-Encoding: chunked\r\n\r\n{n:x}\r\n{body}\r\n")),
            ("a chunk without its length", format!("Transfer-Encoding: chunked\r\n\r\n{body}\r\n0\r\n\r\n")),
        ];
        for (what, rest) in broken {
            let mut stream = service.connect();
            write!(stream, "POST {path} HTTP/1.1\r\nHost: localhost\r\n{JSON}{rest}").unwrap();
            stream.shutdown(Shutdown::Write).unwrap();
            let mut answer = Vec::new();
            // a connection may be closed in place of an answer
            let _ = stream.read_to_end(&mut answer);
            assert!(!answer.starts_with(b"HTTP/1.1 2"), "{path}, {what}: {}", String::from_utf8_lossy(&answer));
            assert_eq!(settings(), before, "{path}, {what}");
        }
    }
    // whole, each of them is a change
    for (path, body) in &changes {
        let before = settings();
        assert_eq!(send(&service, "POST", path, body).0, 200, "{path}");
        service.until("the change", || settings() != before);
    }
    service.stop();
}
