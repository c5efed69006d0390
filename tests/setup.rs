//! The setup of a device without a bundle, over HTTP: cameras as they are, calibration steps, and the live service that follows.

#![allow(clippy::unwrap_used, reason = "a test")]

mod emulated;
mod running;

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;

use running::{Running, board};
use serde_json::{Value, json};
use stokescope::bundle::Bundle;

const PROOF: &str = "Origin: http://localhost\r\nContent-Type: application/json\r\n";
/// A device of few pixels, whose guide is displaced.
const DEVICE: &str = "size=96,seed=5,fine=2";
const NO_BUNDLE: [(&str, &str); 3] = [
    ("calibration = \"simulated\"", "calibration = \"bundle\""),
    ("wedges,size=48", "wedges,size=96,seed=5,fine=2"),
    ("frame_rate = 10.0", "frame_rate = 50.0"),
];

/// Posts a change; gives the status and the answer, which is JSON unless it is refused.
fn post(service: &Running, path: &str, body: &Value) -> (u16, String) {
    let body = body.to_string();
    let length = body.len();
    let answer = service.raw(&format!(
        "POST {path} HTTP/1.1\r\nHost: localhost\r\n{PROOF}Content-Length: {length}\r\nConnection: close\r\n\r\n{body}"
    ));
    let text = answer.split_once("\r\n\r\n").expect("headers").1.to_owned();
    (answer[9..12].parse().unwrap(), text)
}

fn get(service: &Running, path: &str) -> Value {
    let (status, text) = service.text(path);
    assert_eq!(status, 200, "{path}: {text}");
    serde_json::from_str(&text).unwrap()
}

/// The state; none where the service does not answer, as while the setup ends and the live service begins.
fn state_if_there(service: &Running) -> Option<Value> {
    let mut stream = TcpStream::connect(service.address).ok()?;
    write!(stream, "GET /state HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    serde_json::from_str(answer.split_once("\r\n\r\n")?.1).ok()
}

/// Lets both cameras look at another scene.
fn look_at(service: &Running, scene: &str) {
    let source = format!("{scene},{DEVICE}");
    let (status, text) =
        post(service, "/control", &json!({ "raw": { "source": source }, "guide": { "source": source } }));
    assert_eq!(status, 200, "{text}");
}

/// Posts to a step, waits until it is done, and gives its state.
fn work(service: &Running, path: &str, body: &Value) -> Value {
    let (status, text) = post(service, path, body);
    assert_eq!(status, 202, "{path}: {text}");
    let step = path.split('/').nth(2).unwrap();
    let mut state = Value::Null;
    service.until(path, || {
        state = get(service, &format!("/calibrate/{step}"));
        !["taking", "measuring"].contains(&state["state"].as_str().unwrap())
    });
    state
}

fn keep(service: &Running, step: &str) {
    let (status, text) = post(service, &format!("/calibrate/{step}/keep"), &json!({}));
    assert!(status == 200 && text.contains("\"kept\":true"), "{text}");
}

fn is_lit(state: &Value, name: &str) -> bool {
    state["lamps"].as_array().unwrap().iter().find(|lamp| lamp["name"] == name).unwrap()["lit"].as_bool().unwrap()
}

#[test]
fn without_a_bundle_the_cameras_are_shown_as_they_are() {
    let service = Running::begin(&NO_BUNDLE, &["--control"]);
    service.until("frames", || service.state()["cameras"]["raw"]["frames"].as_u64().is_some_and(|n| n > 1));
    let state = service.state();
    assert_eq!((&state["mode"], &state["missing"]), (&json!("setup"), &json!(["dark", "mask", "psf"])));
    assert_eq!(state["steps"], json!(["dark", "mask", "psf", "align", "verify"]), "a mono sensor has no white step");
    assert_eq!(
        (&state["cameras"]["raw"]["white"], &state["cameras"]["guide"]["white"]),
        (&json!(65535.0), &json!(4095.0))
    );
    let (status, page) = service.text("/");
    assert!(status == 200 && page.contains("setup"));
    for path in ["/page/setup.js", "/page/setup.css", "/healthz", "/version", "/log"] {
        assert_eq!(service.get(path).0, 200, "{path}");
    }
    let (status, refused) = service.text("/stream");
    assert!(status == 404 && refused.contains("during setup"), "{refused}");

    // a lamp that is far too bright is red, and the counts are those of the sensor
    look_at(&service, "uniform,light=30");
    service.until("saturation", || service.state()["cameras"]["raw"]["figures"]["saturated"].as_f64() > Some(0.5));
    let (_, jpeg) = service.get("/snapshot?view=raw");
    assert!(jpeg.starts_with(&[0xff, 0xd8]) && jpeg.ends_with(&[0xff, 0xd9]));
    let (_, png) = service.get("/snapshot?view=raw&format=png");
    let picture = image(&png);
    let red = picture.iter().filter(|pixel| **pixel == [255, 48, 48]).count();
    assert!(red * 2 > picture.len(), "{red} of {}", picture.len());
    let pixel = get(&service, "/pixel?view=raw&x=48&y=48");
    assert!(pixel["saturated"] == true && pixel["counts"] == json!([65535.0]), "{pixel}");
    assert!(is_lit(&get(&service, "/calibrate/mask"), "too bright"));
    look_at(&service, "dark");
    assert!(
        is_lit(&get(&service, "/calibrate/mask"), "too dark")
            && !is_lit(&get(&service, "/calibrate/dark"), "too bright")
    );
    let pixel = get(&service, "/pixel?view=raw&x=48&y=48");
    assert!((pixel["counts"][0].as_f64().unwrap() - 1024.0).abs() < 2000.0 && pixel["saturated"] == false, "{pixel}");
    let classes = get(&service, "/histogram?view=raw");
    let sum: f64 = classes["classes"].as_array().unwrap().iter().filter_map(Value::as_f64).sum();
    assert!((sum - 1.0).abs() < 1e-3 && classes["saturated"] == 0.0, "{classes}");
    let lowest: f64 = (0..2).filter_map(|k| classes["classes"][k].as_f64()).sum();
    assert!(lowest > 0.99, "the black level is 1024 of 65535 counts: {classes}");

    // what a camera took is shown beside what it was asked for, with its limits
    let raw = &service.state()["cameras"]["raw"];
    assert_eq!(
        (&raw["exposure_us"]["limits"], &raw["gain"]["limits"], &raw["frame_rate"]),
        (
            &json!([20.0, 20_000.0]),
            &json!([1.0, 16.0]),
            &json!({ "asked": 50.0, "took": 50.0, "limits": [0.001, 1000.0] })
        )
    );
    let (status, said) =
        post(&service, "/control", &json!({ "raw": { "exposure_us": 25, "gain": 2, "frame_rate": 40 } }));
    assert_eq!(status, 200, "{said}");
    let took = &serde_json::from_str::<Value>(&said).unwrap()["cameras"]["raw"];
    let set = |asked: f64, limits: [f64; 2]| json!({ "asked": asked, "took": asked, "limits": limits });
    assert_eq!(
        (&took["exposure_us"], &took["gain"], &took["frame_rate"]),
        (&set(25.0, [20.0, 25_000.0]), &set(2.0, [1.0, 16.0]), &set(40.0, [0.001, 1000.0]))
    );
    // the longest exposure follows the frame rate, so a change of both is the camera's to judge
    let (status, said) = post(&service, "/control", &json!({ "guide": { "exposure_us": 90_000, "frame_rate": 20 } }));
    assert_eq!(status, 200, "{said}");
    let exposure = &service.state()["cameras"]["guide"]["exposure_us"];
    assert_eq!(exposure, &json!({ "asked": 90_000.0, "took": 50_000.0, "limits": [20.0, 50_000.0] }));
    // what a camera does not take is said, and it goes on as before
    let (status, said) = post(&service, "/control", &json!({ "raw": { "source": "dark,size=0" } }));
    assert!(status == 400 && said.contains("raw:") && said.contains("it goes on"), "{status} {said}");
    for (body, key) in [
        (json!({ "raw": { "exposure_us": 5 } }), "raw.exposure_us = 5, allowed: 20 to 25000, or null"),
        (json!({ "raw": { "gain": 16.5 } }), "raw.gain = 16.5, allowed: 1 to 16, or null"),
        (json!({ "guide": { "frame_rate": 2000 } }), "guide.frame_rate = 2000, allowed: 0.001 to 1000, or null"),
        (json!({ "raw": { "shutter": 1 } }), "shutter"),
        (json!({ "raw": { "source": "no-such-scene" } }), "no-such-scene"),
    ] {
        let (status, said) = post(&service, "/control", &body);
        assert!(status == 400 && said.contains(key), "{status} {said}");
    }
    let frames = service.state()["cameras"]["raw"]["frames"].as_u64().unwrap();
    service.until("frames again", || service.state()["cameras"]["raw"]["frames"].as_u64() > Some(frames));

    // the cameras are opened again with the settings that they have
    let (status, said) = post(&service, "/cameras/restart", &json!({}));
    assert!(status == 202 && said.contains("\"mode\":\"setup\""), "{status} {said}");
    service.until("the log", || service.text("/log").1.contains("guide camera: opened again by request"));
    let frames = service.state()["cameras"]["raw"]["frames"].as_u64().unwrap();
    service.until("frames once more", || service.state()["cameras"]["raw"]["frames"].as_u64() > Some(frames + 2));
    assert_eq!(service.state()["cameras"]["raw"]["exposure_us"], set(25.0, [20.0, 25_000.0]));

    let dir = service.dir.path().join("bundle");
    let summary = service.stop();
    assert_eq!((&summary["mode"], &summary["missing"]), (&json!("setup"), &json!(["dark", "mask", "psf"])));
    assert!(!dir.exists());
}

/// Pixels of a PNG file.
fn image(png: &[u8]) -> Vec<[u8; 3]> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    std::fs::write(&path, png).unwrap();
    match stokescope::files::read_image(&path).unwrap() {
        stokescope::files::Samples::U8(planes) => {
            (0..planes.size().pixels()).map(|i| std::array::from_fn(|c| planes.plane(c)[i])).collect()
        }
        _ => panic!("8 bits a sample"),
    }
}

#[test]
fn the_setup_takes_all_steps_and_the_live_service_follows_at_the_same_address() {
    let service = Running::begin(&NO_BUNDLE, &["--control"]);
    let bundle = service.dir.path().join("bundle");
    let take = |step: &str, frames: i64| work(&service, &format!("/calibrate/{step}"), &json!({ "frames": frames }));

    let early = take("psf", 2);
    assert!(
        early["state"] == "failed" && early["fault"]["error"].as_str().unwrap().contains("no dark frame yet"),
        "{early}"
    );
    look_at(&service, "print");
    let lit = take("dark", 4);
    assert!(lit["fault"]["remedy"].as_str().unwrap().contains("cover") && lit["result"].is_null(), "{lit}");
    assert_eq!(post(&service, "/calibrate/dark/keep", &json!({})).0, 400, "there is nothing to keep");
    look_at(&service, "dark");
    let dark = take("dark", 12);
    assert!(dark["state"] == "measured" && dark["result"]["good"] == true, "{dark}");
    // the noise is that of one frame, though frames were averaged in groups
    let noise = dark["result"]["quality"]["read_noise"].as_f64().unwrap();
    assert!((noise - 0.002).abs() < 0.0003, "{noise}");
    assert!(service.get("/calibrate/dark/picture").1.starts_with(b"\x89PNG"));
    assert_eq!(service.state()["kept"], json!([]), "not before it is kept");
    keep(&service, "dark");
    assert!(!bundle.exists(), "the board's bundle is not there before it is complete");

    // one view for each angle; a description that is wrong can be given again without taking them anew
    let refused = post(&service, "/calibrate/mask", &json!({ "frames": 4 }));
    assert!(refused.0 == 400 && refused.1.contains("angle is missing"), "{refused:?}");
    for angle in [0, 45, 90, 135] {
        look_at(&service, &format!("uniform,polarizer={angle}"));
        let state = work(&service, "/calibrate/mask", &json!({ "frames": 4, "angle": angle }));
        assert_eq!(state["fault"], Value::Null, "{state}");
    }
    let wrong = work(&service, "/calibrate/mask/measure", &json!({ "zero": 45 }));
    assert!(wrong["state"] == "failed" && wrong["views"] == json!([0.0, 45.0, 90.0, 135.0]), "{wrong}");
    let mask = work(&service, "/calibrate/mask/measure", &json!({}));
    assert!(mask["result"]["good"] == true, "{mask}");
    keep(&service, "mask");
    assert_eq!(post(&service, "/calibrate/finish", &json!({})).0, 400, "there is no PSF");

    look_at(&service, "point");
    let point = take("psf", 16);
    assert!(point["state"] == "measured", "{point}");
    keep(&service, "psf");
    look_at(&service, "print,shift=1.5:-1");
    let aligned = take("align", 8);
    assert!(aligned["result"]["quality"]["residual_px"].as_f64() < Some(0.5), "{aligned}");
    // again drops it, and it can be taken once more
    assert!(post(&service, "/calibrate/align/again", &json!({})).1.contains("\"ready\""));
    take("align", 8);
    keep(&service, "align");
    for angle in [0, 60, 120] {
        look_at(&service, &format!("film,polarizer={angle}"));
        work(&service, "/calibrate/verify", &json!({ "frames": 4, "angle": angle }));
    }
    let tested = work(&service, "/calibrate/verify/measure", &json!({}));
    assert!(tested["result"]["quality"]["aolp_error_deg"].as_f64() < Some(2.0), "{tested}");
    keep(&service, "verify");

    let (status, answer) = post(&service, "/calibrate/finish", &json!({}));
    assert_eq!(status, 200, "{answer}");
    service.until("the live service", || {
        state_if_there(&service).is_some_and(|state| state["mode"] == "run" && state["frames"].as_u64() > Some(0))
    });
    let made = Bundle::load(&bundle).unwrap();
    assert!(answer.contains(&made.digest) && made.name == "bundle", "{answer}");
    assert_eq!(made.camera.unwrap().name, "simulated raw camera 5");
    assert!(!service.dir.path().join("bundle.setup").exists());
    assert_eq!(service.state()["report"]["calibration"], json!(made.digest));
    assert_eq!(service.get("/calibrate").0, 404, "the setup is over");
    assert!(service.stop()["frames"].as_u64() > Some(0));
}

#[test]
fn nothing_changes_without_leave_and_a_run_without_a_page_needs_its_bundle() {
    let service = Running::begin(&NO_BUNDLE, &[]);
    assert_eq!(service.state()["controls"]["allowed"], false);
    for path in ["/control", "/calibrate/dark", "/calibrate/dark/keep", "/calibrate/finish"] {
        assert_eq!(service.post(path, PROOF, "{}"), 403, "{path}");
    }
    service.stop();

    let dir = tempfile::tempdir().unwrap();
    let run = |board: &Path, more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_stokescope"));
        let answer =
            command.args(["run", "--board"]).arg(board).arg("--out").arg(dir.path().join("out")).args(more).output();
        let answer = answer.unwrap();
        (answer.status.code(), String::from_utf8(answer.stderr).unwrap())
    };
    let path = board(dir.path(), &NO_BUNDLE);
    let (code, said) = run(&path, &["--frames", "1", "--no-preview"]);
    assert!(code == Some(66) && said.contains("bundle/calibration.toml"), "{code:?} {said}");
    let path = board(dir.path(), &[]);
    let (code, said) = run(&path, &["--setup", "--listen", "127.0.0.1:0"]);
    assert!(code == Some(2) && said.contains("needs no setup"), "{code:?} {said}");
}
