//! The service in figures: for the page, for monitoring, for a watchdog.

use std::fmt::Write as _;
use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::{Value, json};

use super::broadcast::Format;
use super::control::{MAX_ITERATIONS, NO_MODEL};
use super::hub::{Hub, Shown, Stage};
use super::pair::Lens;
use crate::output;
use crate::plane::{aolp_degrees, dolp};

/// Classes of the two histograms; an angle's are 5° wide.
const DOLP_CLASSES: usize = 50;
const AOLP_CLASSES: usize = 36;
/// A service without a result for this long, while its camera works, is not well.
const PATIENCE: Duration = Duration::from_secs(30);

/// `/state`.
pub(super) fn json(hub: &Hub) -> Value {
    let (raw, guide) = hub.pairing.lenses();
    let figures = hub.figures();
    let (saving, recording) = (figures.saving.clone(), figures.recording.clone());
    let head = json!({
        "frames": figures.frames,
        "failed": figures.failed,
        "fault": figures.fault,
        "fps": round(figures.fps()),
        "latency_ms": { "p50": figures.latency_ms(0.5), "p95": figures.latency_ms(0.95) },
    });
    drop(figures);
    let frame = hub.broadcast.frame();
    let stages: serde_json::Map<_, _> = Stage::ALL
        .into_iter()
        .filter_map(|stage| hub.timings.of(stage).map(|[p50, p95]| (stage, p50, p95)))
        .map(|(stage, p50, p95)| (stage.name().to_owned(), json!({ "p50": p50, "p95": p95 })))
        .collect();
    let mut state = json!({
        "board": hub.board,
        "uptime_seconds": round(hub.started.elapsed().as_secs_f64()),
        "size": [hub.broadcast.size().width, hub.broadcast.size().height],
        "views": hub.broadcast.views().map(|v| json!({ "name": v.name(), "label": v.label() })).collect::<Vec<_>>(),
        "frame": frame.as_ref().map(|f| f.index),
        "report": frame.map(|f| f.report.clone()),
        "dropped": dropped(&raw, guide.as_ref()),
        "cameras": { "raw": camera(&raw), "guide": guide.as_ref().map(camera) },
        "saving": { "out": hub.out, "written": saving.written, "failed": saving.failed, "fault": saving.fault },
        "recording": hub.records.then(|| json!({
            "session": recording.session, "written": recording.written, "failed": recording.failed,
            "dropped": recording.dropped, "removed": recording.removed, "fault": recording.fault,
        })),
        "stages_ms": stages,
        "quality": hub.quality(),
        "machine": hub.host(),
        "controls": {
            "allowed": hub.controls.allowed, "iterations": hub.controls.iterations(), "max_iterations": MAX_ITERATIONS,
            "jpeg_quality": hub.broadcast.quality(), "background": hub.broadcast.has_background(),
            "fusion": { "on": hub.controls.fused(), "available": hub.controls.model,
                "reason": (!hub.controls.model).then_some(NO_MODEL) },
        },
        "events": hub.events.recent(),
        "clients": hub.clients.load(Ordering::Relaxed),
        "peak_rss_bytes": output::peak_rss_bytes(),
        "rss_bytes": rss_bytes(),
    });
    if let (Some(state), Value::Object(head)) = (state.as_object_mut(), head) {
        state.extend(head);
    }
    state
}

/// Memory the process holds now; none where the system does not tell.
fn rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

/// Frames that arrived and were not processed.
pub(super) fn dropped(raw: &Lens, guide: Option<&Lens>) -> Value {
    json!({ "raw": raw.dropped, "guide": guide.map_or(0, |g| g.dropped), "unpaired": raw.unpaired })
}

fn camera(lens: &Lens) -> Value {
    json!({
        "name": lens.name, "online": lens.fault.is_none(), "fault": lens.fault, "frames": lens.received,
        "faults": lens.faults, "reopened": lens.reopened,
    })
}

fn round(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}

/// `/healthz`: the raw camera delivers and results come.
///
/// # Errors
/// What is wrong, in words.
pub(super) fn health(hub: &Hub) -> Result<(), String> {
    let (raw, _) = hub.pairing.lenses();
    if let Some(fault) = raw.fault {
        return Err(format!("raw camera offline: {fault}"));
    }
    let figures = hub.figures();
    match figures.last() {
        Some(last) if last.elapsed() > PATIENCE => Err(format!("no result for {} s", last.elapsed().as_secs())),
        None if hub.started.elapsed() > PATIENCE => Err("no result yet".to_owned()),
        _ => Ok(()),
    }
}

/// `/pixel`: the polarization of one pixel of the latest frame; null before the first.
pub(super) fn pixel(hub: &Hub, x: usize, y: usize) -> Value {
    let Some(frame) = hub.broadcast.frame() else { return Value::Null };
    let i = y * frame.size().width + x;
    let [s0, s1, s2] = [0, 1, 2].map(|k| frame.stokes_at(k, i));
    let polarized = frame.polarized();
    json!({
        "frame": frame.index, "x": x, "y": y, "s0": s0, "valid": frame.valid[i],
        "dolp": polarized.then(|| dolp(s0, s1, s2)),
        "aolp_degrees": polarized.then(|| aolp_degrees(s1, s2)),
    })
}

/// `/histogram`: of the valid pixels of the latest frame, or of a region of it (left, top, width, height): shares by DoLP
/// (0 to 1), their polarized light by AoLP (0° to 180°), and the mean Stokes vector; null before the first frame or without
/// polarization.
pub(super) fn histogram(hub: &Hub, region: Option<[usize; 4]>) -> Value {
    match hub.broadcast.frame() {
        Some(frame) if frame.polarized() => {
            let classes = classes(&frame, region);
            let [s0, s1, s2] = classes.mean;
            json!({
                "frame": frame.index, "pixels": classes.pixels, "dolp": &classes.dolp[..], "aolp": &classes.aolp[..],
                "stokes": classes.mean, "mean_dolp": (classes.pixels > 0).then(|| dolp(s0, s1, s2)),
                "mean_aolp_degrees": (classes.pixels > 0).then(|| aolp_degrees(s1, s2)),
            })
        }
        _ => Value::Null,
    }
}

/// The polarization of many pixels.
#[derive(Debug)]
struct Classes {
    dolp: [f32; DOLP_CLASSES],
    aolp: [f32; AOLP_CLASSES],
    /// Angles are never averaged, Stokes vectors are.
    mean: [f32; 3],
    pixels: usize,
}

fn classes(frame: &Shown, region: Option<[usize; 4]>) -> Classes {
    let mut found = Classes { dolp: [0.0; DOLP_CLASSES], aolp: [0.0; AOLP_CLASSES], mean: [0.0; 3], pixels: 0 };
    let size = frame.size();
    let [left, top, width, height] = region.unwrap_or([0, 0, size.width, size.height]);
    let (right, bottom) = (left.saturating_add(width).min(size.width), top.saturating_add(height).min(size.height));
    let pixels = (top..bottom).flat_map(|y| (left..right).map(move |x| y * size.width + x));
    let mut sum = [0.0f64; 3];
    for i in pixels.filter(|&i| frame.valid[i]) {
        let [s0, s1, s2] = [0, 1, 2].map(|k| frame.stokes_at(k, i));
        let class = (dolp(s0, s1, s2) * DOLP_CLASSES as f32) as usize;
        found.dolp[class.min(DOLP_CLASSES - 1)] += 1.0;
        // an angle counts as much as there is light that has it
        let class = (aolp_degrees(s1, s2) / 180.0 * AOLP_CLASSES as f32) as usize;
        found.aolp[class.min(AOLP_CLASSES - 1)] += s1.hypot(s2);
        sum.iter_mut().zip([s0, s1, s2]).for_each(|(sum, v)| *sum += f64::from(v));
        found.pixels += 1;
    }
    normalize(&mut found.dolp);
    normalize(&mut found.aolp);
    found.mean = sum.map(|v| (v / found.pixels.max(1) as f64) as f32);
    found
}

fn normalize(classes: &mut [f32]) {
    let sum: f32 = classes.iter().sum();
    if sum > 0.0 {
        classes.iter_mut().for_each(|v| *v /= sum);
    }
}

/// `/metrics`, in Prometheus's text format.
pub(super) fn metrics(hub: &Hub) -> String {
    let mut text = Metrics::default();
    let (raw, guide) = hub.pairing.lenses();
    let lenses: Vec<_> =
        [("raw", Some(raw)), ("guide", guide)].into_iter().filter_map(|(n, l)| Some((n, l?))).collect();
    {
        let figures = hub.figures();
        text.family("frames_total", "counter", "Frames processed");
        text.sample("frames_total", &[], figures.frames as f64);
        text.family("frames_failed_total", "counter", "Frames that gave no result");
        text.sample("frames_failed_total", &[], figures.failed as f64);
        text.family("frames_per_second", "gauge", "Results per second of late");
        text.sample("frames_per_second", &[], figures.fps());
        text.family("latency_seconds", "gauge", "Time from a frame's arrival to its result, of the recent frames");
        for (share, label) in [(0.5, "0.5"), (0.95, "0.95")] {
            let seconds = figures.latency_ms(share).map_or(f64::NAN, |ms| f64::from(ms) * 1e-3);
            text.sample("latency_seconds", &[("quantile", label)], seconds);
        }
        text.family("results_written_total", "counter", "Results written to disk");
        text.sample("results_written_total", &[], figures.saving.written as f64);
        text.family("results_unwritten_total", "counter", "Results that could not be written");
        text.sample("results_unwritten_total", &[], figures.saving.failed as f64);
        if hub.records {
            let recording = &figures.recording;
            text.family("recorded_total", "counter", "Frames recorded");
            text.sample("recorded_total", &[], recording.written as f64);
            text.family(
                "unrecorded_total",
                "counter",
                "Frames that could not be recorded, or made room for newer ones",
            );
            text.sample("unrecorded_total", &[], (recording.failed + recording.dropped) as f64);
            text.family("recording", "gauge", "1 while frames can be recorded");
            text.sample("recording", &[], f64::from(u8::from(recording.fault.is_none())));
        }
        text.family("saving", "gauge", "1 while results can be saved");
        text.sample("saving", &[], f64::from(u8::from(figures.saving.fault.is_none())));
    }
    text.family("camera_online", "gauge", "1 while the camera delivers");
    for (name, lens) in &lenses {
        text.sample("camera_online", &[("camera", name)], f64::from(u8::from(lens.fault.is_none())));
    }
    type Count = fn(&Lens) -> u64;
    let counters: [(&str, &str, Count); 5] = [
        ("camera_frames_total", "Frames that arrived", |l| l.received),
        ("camera_dropped_total", "Frames that made room for newer ones", |l| l.dropped),
        ("camera_unpaired_total", "Frames without a partner in time", |l| l.unpaired),
        ("camera_faults_total", "Broken frames and waits in vain", |l| l.faults),
        ("camera_reopened_total", "Times the camera was opened again", |l| l.reopened),
    ];
    for (name, help, count) in counters {
        text.family(name, "counter", help);
        for (camera, lens) in &lenses {
            text.sample(name, &[("camera", camera)], count(lens) as f64);
        }
    }
    if let Some(frame) = hub.broadcast.frame() {
        let seconds = frame.report.seconds;
        text.family("stage_seconds", "gauge", "Time of each stage for the latest frame");
        let stages = [
            ("prepare", seconds.prepare),
            ("register", seconds.register),
            ("recon", seconds.recon),
            ("fusion", seconds.fusion),
            ("total", seconds.total),
        ];
        for (stage, seconds) in stages {
            text.sample("stage_seconds", &[("stage", stage)], seconds);
        }
        text.family("warnings", "gauge", "Warnings of the latest frame");
        text.sample("warnings", &[], frame.report.warnings.len() as f64);
    }
    text.family(
        "stage_quantile_seconds",
        "gauge",
        "Time of each stage over the recent frames; preview is from a frame's arrival to its picture",
    );
    for stage in Stage::ALL {
        for (quantile, ms) in ["0.5", "0.95"].into_iter().zip(hub.timings.of(stage).into_iter().flatten()) {
            let labels = [("stage", stage.name()), ("quantile", quantile)];
            text.sample("stage_quantile_seconds", &labels, f64::from(ms) * 1e-3);
        }
    }
    let (quality, machine) = (hub.quality(), hub.host());
    text.family("iterations", "gauge", "Iterations of the solver: asked for, and run to hold the frame rate");
    text.sample("iterations", &[("kind", "asked")], quality.asked_iterations as f64);
    text.sample("iterations", &[("kind", "run")], quality.iterations as f64);
    text.family("frame_rate_held", "gauge", "1 while the frame rate asked for is held");
    text.sample("frame_rate_held", &[], f64::from(u8::from(quality.held)));
    text.family("machine_throttled", "gauge", "1 while heat holds the processor's clock down");
    text.sample("machine_throttled", &[], f64::from(u8::from(machine.throttled)));
    text.family("machine_undervoltage", "gauge", "1 while the supply is too weak");
    text.sample("machine_undervoltage", &[], f64::from(u8::from(machine.undervoltage)));
    if let Some(celsius) = machine.temperature_c {
        text.family("machine_temperature_celsius", "gauge", "The hottest zone");
        text.sample("machine_temperature_celsius", &[], f64::from(celsius));
    }
    text.family("rss_bytes", "gauge", "Memory the process holds");
    text.sample("rss_bytes", &[], rss_bytes().map_or(f64::NAN, |b| b as f64));
    text.family("preview_clients", "gauge", "Connections being served");
    text.sample("preview_clients", &[], hub.clients.load(Ordering::Relaxed) as f64);
    text.family("preview_encoded_total", "counter", "Pictures encoded");
    for (view, format, _, encoded) in hub.broadcast.figures() {
        let format = if format == Format::Jpeg { "jpeg" } else { "png" };
        text.sample("preview_encoded_total", &[("view", &view.name()), ("format", format)], encoded as f64);
    }
    text.family("peak_rss_bytes", "gauge", "Most memory the process ever held");
    text.sample("peak_rss_bytes", &[], output::peak_rss_bytes().map_or(f64::NAN, |b| b as f64));
    text.0
}

/// Prometheus's text format. Names and label values are our own, so nothing needs escaping.
#[derive(Default)]
struct Metrics(String);

impl Metrics {
    fn family(&mut self, name: &str, kind: &str, help: &str) {
        // writing to a string cannot fail
        let _ = writeln!(self.0, "# HELP stokescope_{name} {help}.\n# TYPE stokescope_{name} {kind}");
    }

    fn sample(&mut self, name: &str, labels: &[(&str, &str)], value: f64) {
        let labels: Vec<_> = labels.iter().map(|(key, value)| format!("{key}=\"{value}\"")).collect();
        let labels = if labels.is_empty() { String::new() } else { format!("{{{}}}", labels.join(",")) };
        let _ = writeln!(self.0, "stokescope_{name}{labels} {value}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plane::{Size, Stack};
    use crate::service::view::tests::frame;

    #[test]
    fn histograms_count_valid_pixels_and_weigh_angles_by_polarized_light() {
        let size = Size::new(4, 1);
        let stokes = [[1.0, 1.0, 1.0, 9.0], [0.0, 0.5, 0.0, 9.0], [0.0, 0.0, 0.25, 0.0]].concat();
        let frame = Shown {
            stokes: Stack::from_vec(3, size, stokes).unwrap(),
            valid: vec![true, true, true, false],
            ..frame(1)
        };
        let Classes { dolp: by_dolp, aolp: by_aolp, mean, pixels } = classes(&frame, None);
        let third = 1.0 / 3.0;
        assert_eq!([by_dolp[0], by_dolp[25], by_dolp[12], by_dolp[49]], [third, third, third, 0.0]);
        assert!((by_aolp[0] - 2.0 / 3.0).abs() < 1e-6 && (by_aolp[9] - third).abs() < 1e-6, "{by_aolp:?}");
        assert_eq!((pixels, mean), (3, [1.0, 0.5 / 3.0, 0.25 / 3.0]));
        let part = classes(&frame, Some([1, 0, usize::MAX, 1]));
        assert_eq!((part.pixels, part.dolp[25], part.mean[1]), (2, 0.5, 0.25));
        assert_eq!(classes(&frame, Some([9, 9, 1, 1])).pixels, 0);
    }

    #[test]
    fn metrics_have_prometheus_form() {
        let mut m = Metrics::default();
        m.family("a_total", "counter", "Things");
        m.sample("a_total", &[("camera", "raw")], 3.0);
        m.sample("a_total", &[], f64::NAN);
        let expected = "# HELP stokescope_a_total Things.\n# TYPE stokescope_a_total counter\n\
                        stokescope_a_total{camera=\"raw\"} 3\nstokescope_a_total NaN\n";
        assert_eq!(m.0, expected);
    }
}
