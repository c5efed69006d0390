//! Tests of the libcamera backend. Most need the two virtual cameras that scripts/libcamera-virtual.sh provides.

use super::*;
use crate::board::Mode;
use crate::camera::Clock;

/// Environment variable that is set when the virtual cameras exist.
const VARIABLE: &str = "STOKESCOPE_VIRTUAL_CAMERAS";
const LONG: Duration = Duration::from_secs(10);

fn virtual_cameras() -> bool {
    let there = std::env::var_os(VARIABLE).is_some();
    if !there {
        eprintln!("SKIPPED: no virtual cameras; scripts/libcamera-virtual.sh runs this test with them");
    }
    there
}

fn request(source: &str, mode: Mode, clock: &Clock) -> Request {
    Request { source: source.to_owned(), mode, ..Request::new(Role::Raw, clock) }
}

fn nv12(width: usize, height: usize) -> Mode {
    Mode { size: Some(Size::new(width, height)), format: Some(PixelFormat::Nv12Luma), ..Mode::default() }
}

/// Opens the raw camera without detection of stuck frames.
fn open_one(mode: Mode) -> LibCamera {
    let request = request("stokescope-raw", mode, &Clock::default());
    LibCamera::open(&request).unwrap()
}

#[test]
fn names_are_libcameras_own() {
    for format in PixelFormat::named() {
        let name = driver_name(format).unwrap();
        assert!(name.parse::<::libcamera::pixel_format::PixelFormat>().is_ok(), "{name}");
    }
}

#[test]
fn the_virtual_cameras_are_listed_with_their_modes() {
    if !virtual_cameras() {
        return;
    }
    let offers = list().unwrap();
    let sources: Vec<_> = offers.iter().map(|offer| offer.source.as_str()).collect();
    assert_eq!(sources, ["stokescope-raw", "stokescope-large", "stokescope-guide"], "by place");
    let mode = &offers[0].modes[0];
    assert_eq!(
        (mode.driver_name.as_str(), &mode.formats[..]),
        ("NV12", &["nv12".to_owned(), "nv12-luma".to_owned()][..])
    );
}

#[test]
fn frames_come_in_order_in_their_own_memory_and_none_is_lost_by_reopening() {
    if !virtual_cameras() {
        return;
    }
    for _ in 0..3 {
        let mut camera = open_one(nv12(256, 250));
        let mut last: Option<Metadata> = None;
        for _ in 0..20 {
            let frame = camera.next_frame(LONG).unwrap();
            assert_eq!((frame.size(), frame.rows().len()), (Size::new(256, 250), 250));
            assert!(frame.row(100).iter().any(|v| *v != frame.row(0)[0]), "a picture");
            let metadata = frame.metadata;
            assert!(last.is_none_or(|l| metadata.sequence > l.sequence && metadata.timestamp > l.timestamp));
            last = Some(metadata);
        }
    }
}

#[test]
fn unsupported_modes_and_controls_are_refused() {
    if !virtual_cameras() {
        return;
    }
    let clock = Clock::default();
    let refused = |source: &str, mode| open(&request(source, mode, &clock)).err().unwrap();
    let e = refused("stokescope-raw", nv12(64, 64));
    assert!(
        matches!(&e, CameraError::Mode { asked, offered, .. } if asked == "64×64 nv12-luma" && offered.contains("nv12")),
        "{e}"
    );
    let e = refused("stokescope-raw", Mode { format: Some("bggr10".parse().unwrap()), ..Mode::default() });
    assert!(matches!(e, CameraError::Mode { .. }), "{e}");
    for (mode, key) in [
        (Mode { exposure_us: Some(1000.0), ..nv12(256, 250) }, "exposure_us"),
        (Mode { gain: Some(2.0), ..nv12(256, 250) }, "gain"),
        (Mode { sync: Sync::Server, ..nv12(256, 250) }, "sync"),
    ] {
        let e = refused("stokescope-raw", mode);
        assert!(matches!(e, CameraError::Control { control, .. } if control == key), "{e}");
    }
    let e = refused("nothing", Mode::default()).to_string();
    assert!(e.starts_with("nothing: no such camera, allowed: 0: "), "{e}");
    let [raw, guide] = ["stokescope-raw", "stokescope-guide"].map(|id| e.find(id).unwrap());
    assert!(raw < guide, "{e}");
    assert!(refused("stokescope", Mode::default()).to_string().contains("several cameras match"));
    let _first = open_one(nv12(256, 250));
    let e = refused("stokescope-raw", nv12(256, 250)).to_string();
    assert!(e.contains("in use by another program, or already opened"), "{e}");
}

#[test]
fn a_stopped_driver_is_a_lost_camera_that_can_be_opened_again() {
    if !virtual_cameras() {
        return;
    }
    let mut camera = open_one(nv12(256, 250));
    camera.next_frame(LONG).unwrap();
    camera.camera.stop().unwrap();
    let failed = (0..10).find_map(|_| camera.next_frame(LONG).err());
    assert!(matches!(failed, Some(CameraError::Lost { .. })), "{failed:?}");
    drop(camera);
    open_one(nv12(256, 250)).next_frame(LONG).unwrap();
}

#[test]
fn a_missing_frame_is_reported_in_time() {
    if !virtual_cameras() {
        return;
    }
    let clock = Clock::default();
    let mode = Mode { sync: Sync::Clock, ..nv12(256, 250) };
    let request = Request { frame_rate: Some(0.1), ..request("stokescope-raw", mode, &clock) };
    let mut camera = open(&request).unwrap();
    camera.next_frame(LONG).unwrap();
    let begin = Instant::now();
    let e = camera.next_frame(Duration::from_millis(200)).unwrap_err();
    assert!(matches!(e, CameraError::Timeout { .. }) && begin.elapsed() < Duration::from_secs(5), "{e}");
}
