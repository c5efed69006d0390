//! Tests of the choice against tables of sensors and of what both pipeline handlers of the Raspberry Pi answer.

use super::*;
use crate::board::{Board, CameraSpec};
use stokescope_core::frame::Bayer;

/// A sensor of the Raspberry Pi as libcamera lists it.
struct Sensor {
    model: &'static str,
    /// Bayer order that is listed; none for a monochrome sensor.
    order: Option<Bayer>,
    /// Default rotation of the overlay in degrees.
    rotation: u32,
    /// Bit depth, width, height, and largest frame rate.
    modes: &'static [(u32, usize, usize, f64)],
}

const RGGB: Option<Bayer> = Some(Bayer::Rggb);

/// Modes as `rpicam-hello --list-cameras` shows them.
const SENSORS: [Sensor; 7] = [
    Sensor {
        model: "imx219",
        order: RGGB,
        rotation: 180,
        modes: &[
            (10, 640, 480, 103.0),
            (10, 1640, 1232, 41.85),
            (10, 1920, 1080, 47.57),
            (10, 3280, 2464, 21.19),
            (8, 1640, 1232, 41.85),
            (8, 3280, 2464, 21.19),
        ],
    },
    Sensor {
        model: "ov5647",
        order: Some(Bayer::Gbrg),
        rotation: 0,
        modes: &[(10, 640, 480, 58.9), (10, 1296, 972, 43.25), (10, 1920, 1080, 30.62), (10, 2592, 1944, 15.63)],
    },
    Sensor {
        model: "imx708",
        order: RGGB,
        rotation: 180,
        modes: &[(10, 1536, 864, 120.13), (10, 2304, 1296, 56.03), (10, 4608, 2592, 14.35)],
    },
    Sensor {
        model: "imx477",
        order: RGGB,
        rotation: 180,
        modes: &[(10, 1332, 990, 120.05), (12, 2028, 1080, 50.03), (12, 2028, 1520, 40.01), (12, 4056, 3040, 10.0)],
    },
    Sensor { model: "imx296", order: None, rotation: 180, modes: &[(10, 1456, 1088, 60.38)] },
    Sensor {
        model: "imx462",
        order: RGGB,
        rotation: 0,
        modes: &[(10, 1280, 720, 60.0), (10, 1920, 1080, 60.0), (12, 1280, 720, 60.0), (12, 1920, 1080, 60.0)],
    },
    Sensor {
        model: "ov9281",
        order: None,
        rotation: 0,
        modes: &[(8, 640, 400, 309.8), (8, 1280, 800, 143.7), (10, 640, 400, 247.8), (10, 1280, 800, 114.9)],
    },
];

fn sensor(model: &str) -> &'static Sensor {
    SENSORS.iter().find(|sensor| sensor.model == model).unwrap()
}

impl Sensor {
    /// Raw formats that libcamera lists: packed as on the bus, 8 bits unpacked.
    fn listed(&self) -> Vec<Listed> {
        let mut listed: Vec<Listed> = Vec::new();
        for &(bits, width, height, _) in self.modes {
            let samples = match bits {
                8 => Samples::U8,
                10 => Samples::Packed10,
                _ => Samples::Packed12,
            };
            let name = self.name(samples, false);
            let size = Size::new(width, height);
            match listed.iter_mut().find(|format| format.name == name) {
                Some(format) => format.sizes.push(size),
                None => listed.push(Listed { name, sizes: vec![size] }),
            }
        }
        listed
    }

    fn name(&self, samples: Samples, flipped: bool) -> String {
        let turned = |order| match order {
            Bayer::Rggb => Bayer::Bggr,
            Bayer::Bggr => Bayer::Rggb,
            Bayer::Grbg => Bayer::Gbrg,
            Bayer::Gbrg => Bayer::Grbg,
        };
        let bayer = |order| PixelFormat::Bayer(if flipped { turned(order) } else { order }, samples);
        driver_name(self.order.map_or(PixelFormat::Mono(samples), bayer)).unwrap()
    }

    /// Answer of libcamera 0.7 to a configuration, after `validate` of each pipeline handler.
    fn answer(&self, pipeline: Pipeline, ask: &Ask) -> Answer {
        let valid = self.modes.iter().any(|&(bits, w, h, _)| (bits, Size::new(w, h)) == (ask.bits, ask.size));
        let orientation = ask.orientation.unwrap_or(0);
        let flipped = orientation != self.rotation;
        let samples = samples_of(ask.format).unwrap();
        let mut format = self.name(samples, flipped);
        if pipeline == Pipeline::Pisp {
            let wide = self.name(Samples::U16, flipped);
            let order = if self.order.is_some() { &wide[1..5] } else { "MONO" };
            format = if samples.is_packed() { format!("{order}_PISP_COMP1") } else { wide };
        }
        Answer { valid, format, size: ask.size, orientation: Some(orientation) }
    }
}

fn wanted(spec: &CameraSpec) -> Wanted {
    Wanted { format: spec.mode.format, bits: spec.mode.bits, size: spec.mode.size, orientation: None }
}

fn name(text: &str) -> PixelFormat {
    text.parse().unwrap()
}

#[test]
fn every_shipped_board_gets_a_lossless_stream_from_its_pipeline() {
    let mut raw = 0;
    for board in Board::shipped().map(|name| Board::load(name).unwrap()) {
        let pipeline = if board.soc == "BCM2712" { Pipeline::Pisp } else { Pipeline::Unicam };
        for spec in [Some(&board.raw), board.guide.as_ref()].into_iter().flatten() {
            // virtual cameras are no sensors; streams of the ISP are not raw
            if spec.backend != "libcamera" || board.name == "x86-libcamera-virtual" {
                continue;
            }
            let context = format!("{}: {} {}", board.name, spec.source, spec.mode);
            let sensor = sensor(&spec.source);
            let rate = |&&(bits, w, h, _): &&(u32, usize, usize, f64)| {
                spec.mode.bits.is_none_or(|own| own == bits)
                    && spec.mode.size.is_none_or(|size| size == Size::new(w, h))
            };
            if spec.mode.format.is_some_and(|format| samples_of(format).is_none()) {
                let fastest = sensor.modes.iter().map(|mode| mode.3).fold(0.0, f64::max);
                assert!(spec.frame_rate.unwrap() <= fastest, "{context}");
                continue;
            }
            raw += 1;
            let ask = choose(&sensor.listed(), pipeline, &wanted(spec)).unwrap();
            let found = judge(&ask, &sensor.answer(pipeline, &ask)).unwrap_or_else(|e| panic!("{context}: {e}"));
            assert_eq!((Some(found.size), Some(found.bits)), (spec.mode.size, spec.mode.bits), "{context}");
            assert!(found.format.bits() >= Some(found.bits), "{context}: {}", found.format);
            assert!(spec.frame_rate.unwrap() <= sensor.modes.iter().find(rate).unwrap().3, "{context}");
        }
    }
    assert_eq!(raw, 6, "the lensless camera of every Raspberry Pi");
}

#[test]
fn every_mode_of_every_sensor_can_be_had_whole_on_both_pipelines() {
    for sensor in &SENSORS {
        for pipeline in [Pipeline::Unicam, Pipeline::Pisp] {
            let asks = every(&sensor.listed(), pipeline);
            assert_eq!(asks.len(), sensor.modes.len());
            for ask in asks {
                let found = judge(&ask, &sensor.answer(pipeline, &ask)).unwrap();
                assert_eq!((found.bits, found.size), (ask.bits, ask.size));
                let packed = samples_of(found.format).is_some_and(Samples::is_packed);
                assert_eq!(packed, pipeline == Pipeline::Unicam && ask.bits > 8, "{}", found.format);
                let exact = Wanted { bits: Some(ask.bits), size: Some(ask.size), ..Wanted::default() };
                assert_eq!(choose(&sensor.listed(), pipeline, &exact), Ok(ask), "{}", sensor.model);
            }
        }
    }
}

#[test]
fn pipelines_are_told_apart_by_their_answer() {
    // the answers of a Raspberry Pi 5 that were published, and what a Raspberry Pi 4 makes of the same
    for (listed, five, four) in [
        ("R8", "R16", "R8"),
        ("R10_CSI2P", "MONO_PISP_COMP1", "R10_CSI2P"),
        ("SRGGB10_CSI2P", "BGGR_PISP_COMP1", "SBGGR10_CSI2P"),
        ("SRGGB10_CSI2P", "BGGR16_PISP_COMP1", "SBGGR10_CSI2P"),
    ] {
        assert_eq!([Pipeline::of(listed, five), Pipeline::of(listed, four)], [Pipeline::Pisp, Pipeline::Unicam]);
    }
    assert_eq!(Pipeline::of("R16", "R16"), Pipeline::Unicam, "a sensor of 16 bits");
}

/// The answer to `format` in a mode of `bits` and `size`.
fn judged(pipeline: Pipeline, format: &str, bits: u32, size: Size, answered: &str) -> Result<Delivered, Refusal> {
    let ask = Ask { pipeline, format: name(format), bits, size, orientation: None };
    judge(&ask, &Answer { valid: true, format: answered.to_owned(), size, orientation: Some(0) })
}

#[test]
fn published_answers_of_a_raspberry_pi_5_are_judged() {
    let whole = judged(Pipeline::Pisp, "mono8", 8, Size::new(1280, 800), "R16").unwrap();
    assert_eq!(
        (whole.format, whole.levels("ov9281")),
        (name("mono16"), Levels { black: Some(4096.0), white: 65280.0 })
    );
    for (format, size, answered, remedy) in [
        ("mono10p", Size::new(1280, 800), "MONO_PISP_COMP1", "mono16"),
        ("rggb10p", Size::new(3280, 2464), "BGGR_PISP_COMP1", "rggb16"),
        ("rggb10p", Size::new(1456, 1088), "BGGR16_PISP_COMP1", "rggb16"),
    ] {
        let e = judged(Pipeline::Pisp, format, 10, size, answered).unwrap_err().to_string();
        let text = format!("{answered}, which is compressed with loss: use format = \"{remedy}\"");
        assert!(e.contains(&text), "{e}");
    }
    let e = judged(Pipeline::Pisp, "rggb16", 10, Size::new(8, 8), "BGGR_PISP_COMP1").unwrap_err().to_string();
    assert!(e.ends_with("update libcamera, because a lossless format was asked for"), "{e}");
}

#[test]
fn a_raspberry_pi_4_gives_the_order_after_the_flip() {
    let found = judged(Pipeline::Unicam, "rggb10p", 10, Size::new(3280, 2464), "SBGGR10_CSI2P").unwrap();
    assert_eq!((found.format, found.levels("imx219")), (name("bggr10p"), Levels { black: Some(64.0), white: 1023.0 }));
    // the orientation of the mounting leaves the sensor as it is
    let sensor = sensor("imx219");
    for (orientation, order) in [(None, "bggr10p"), (Some(0), "bggr10p"), (Some(180), "rggb10p")] {
        let ask = choose(&sensor.listed(), Pipeline::Unicam, &Wanted { orientation, ..Wanted::default() }).unwrap();
        assert_eq!(judge(&ask, &sensor.answer(Pipeline::Unicam, &ask)).unwrap().format, name(order));
    }
}

#[test]
fn what_differs_from_the_request_is_refused() {
    let size = Size::new(1456, 1088);
    let refused = |format, answered| judged(Pipeline::Unicam, format, 10, size, answered).unwrap_err().to_string();
    assert_eq!(
        refused("mono10p", "SRGGB10_CSI2P"),
        "libcamera delivers SRGGB10_CSI2P 1456×1088 turned by 0° instead of R10_CSI2P 1456×1088"
    );
    assert!(refused("mono10p", "R8").contains("delivers R8"));
    // only PiSP is known to align its samples to the left
    assert!(refused("mono10p", "R16").contains("delivers R16"));
    let ask = Ask { pipeline: Pipeline::Pisp, format: name("mono16"), bits: 10, size, orientation: Some(180) };
    let answer = Answer { valid: true, format: "R16".to_owned(), size, orientation: Some(180) };
    assert!(judge(&ask, &answer).is_ok());
    for other in [
        Answer { valid: false, ..answer.clone() },
        Answer { size: Size::new(728, 544), ..answer.clone() },
        Answer { orientation: Some(0), ..answer.clone() },
        Answer { orientation: None, ..answer.clone() },
    ] {
        assert!(judge(&ask, &other).is_err(), "{other:?}");
    }
}

#[test]
fn a_layout_that_the_pipeline_does_not_deliver_is_refused_with_the_one_it_does() {
    let choose = |model: &str, pipeline, format: &str, bits| {
        choose(&sensor(model).listed(), pipeline, &Wanted { format: Some(name(format)), bits, ..Wanted::default() })
    };
    for (pipeline, format, remedy) in [
        (Pipeline::Pisp, "mono10p", "format = \"mono16\" and bits = 10"),
        (Pipeline::Pisp, "mono10", "format = \"mono16\" and bits = 10"),
        (Pipeline::Unicam, "mono16", "format = \"mono10p\" and bits = 10"),
    ] {
        let e = choose("imx296", pipeline, format, None).unwrap_err().to_string();
        assert!(e.contains(remedy), "{e}");
    }
    assert_eq!(choose("imx296", Pipeline::Unicam, "mono10", None).unwrap().format, name("mono10"));
    assert_eq!(choose("imx477", Pipeline::Pisp, "bggr16", None).map(|ask| (ask.bits, ask.size.width)), Ok((12, 4056)));
    assert_eq!(
        choose("imx477", Pipeline::Pisp, "bggr16", Some(10)).map(|ask| (ask.bits, ask.size.width)),
        Ok((10, 1332))
    );
    assert_eq!(choose("imx477", Pipeline::Pisp, "mono16", None), Err(Refusal::NoMode), "a colour sensor");
    assert_eq!(choose("imx477", Pipeline::Unicam, "rggb12p", Some(10)), Err(Refusal::NoMode));
    let turned = Wanted { orientation: Some(90), ..Wanted::default() };
    let e = super::choose(&sensor("imx296").listed(), Pipeline::Pisp, &turned).unwrap_err().to_string();
    assert_eq!(e, "orientation = 90, allowed: 0 or 180 degrees, which a sensor can read out");
}

#[test]
fn levels_are_on_the_scale_of_the_frames() {
    let size = Size::new(4056, 3040);
    let levels = |format, bits, model| Delivered { format: name(format), size, bits }.levels(model);
    assert_eq!(levels("bggr16", 12, "imx477"), Levels { black: Some(4096.0), white: 65520.0 });
    assert_eq!(levels("mono16", 10, "imx296"), Levels { black: Some(3840.0), white: 65472.0 });
    assert_eq!(levels("mono10p", 10, "imx296"), Levels { black: Some(60.0), white: 1023.0 });
    assert_eq!(levels("rggb12", 12, "imx477"), Levels { black: Some(256.0), white: 4095.0 });
    assert_eq!(levels("gbrg10p", 10, "ov5647"), Levels { black: Some(16.0), white: 1023.0 });
    assert_eq!(levels("rggb10p", 10, "imx708_wide").black, Some(64.0));
    assert_eq!(levels("mono16", 16, "unknown"), Levels { black: None, white: 65535.0 });
    let reported = |format, bits| Delivered { format: name(format), size, bits }.reported_black_level([3840; 4]);
    assert_eq!([reported("mono16", 10), reported("mono10p", 10), reported("mono12", 12)], [3840.0, 60.0, 240.0]);
}

#[test]
fn the_read_out_of_known_modes_takes_as_long_as_their_lines() {
    let ms = |model, width, height| {
        readout(model, Size::new(width, height)).map(|time| (1e4 * time.as_secs_f64()).round() / 10.0)
    };
    assert_eq!(ms("imx219", 1640, 1232), Some(23.3));
    assert_eq!(ms("imx708_wide", 2304, 1296), Some(17.4));
    assert_eq!(ms("imx296", 1456, 1088), None, "a global shutter");
}
