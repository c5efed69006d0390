//! The service in figures: for the page, for monitoring, for a watchdog.

use std::fmt::Write as _;
use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::{Value, json};

use super::broadcast::Format;
use super::hub::{Hub, Shown};
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
    let saving = figures.saving.clone();
    let head = json!({
        "frames": figures.frames,
        "failed": figures.failed,
        "fault": figures.fault,
        "fps": round(figures.fps()),
        "latency_ms": { "p50": figures.latency_ms(0.5), "p95": figures.latency_ms(0.95) },
    });
    drop(figures);
    let frame = hub.broadcast.frame();
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
        "clients": hub.clients.load(Ordering::Relaxed),
        "peak_rss_bytes": output::peak_rss_bytes(),
    });
    if let (Some(state), Value::Object(head)) = (state.as_object_mut(), head) {
        state.extend(head);
    }
    state
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

/// `/histogram`: shares of the valid pixels of the latest frame by DoLP (0 to 1), and of their polarized light by AoLP
/// (0° to 180°); null before the first frame or without polarization.
pub(super) fn histogram(hub: &Hub) -> Value {
    match hub.broadcast.frame() {
        Some(frame) if frame.polarized() => {
            let (dolp, aolp) = classes(&frame);
            json!({ "frame": frame.index, "dolp": &dolp[..], "aolp": &aolp[..] })
        }
        _ => Value::Null,
    }
}

fn classes(frame: &Shown) -> ([f32; DOLP_CLASSES], [f32; AOLP_CLASSES]) {
    let (mut by_dolp, mut by_aolp) = ([0.0; DOLP_CLASSES], [0.0; AOLP_CLASSES]);
    for i in (0..frame.valid.len()).filter(|&i| frame.valid[i]) {
        let [s0, s1, s2] = [0, 1, 2].map(|k| frame.stokes_at(k, i));
        let class = (dolp(s0, s1, s2) * DOLP_CLASSES as f32) as usize;
        by_dolp[class.min(DOLP_CLASSES - 1)] += 1.0;
        // an angle counts as much as there is light that has it
        let class = (aolp_degrees(s1, s2) / 180.0 * AOLP_CLASSES as f32) as usize;
        by_aolp[class.min(AOLP_CLASSES - 1)] += s1.hypot(s2);
    }
    normalize(&mut by_dolp);
    normalize(&mut by_aolp);
    (by_dolp, by_aolp)
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
    use crate::output::Report;
    use crate::plane::{Size, Stack};

    #[test]
    fn histograms_count_valid_pixels_and_weigh_angles_by_polarized_light() {
        let size = Size::new(4, 1);
        let stokes = [[1.0, 1.0, 1.0, 9.0], [0.0, 0.5, 0.0, 9.0], [0.0, 0.0, 0.25, 0.0]].concat();
        let frame = Shown {
            index: 0,
            channels: 1,
            raw: Stack::zeros(1, size),
            guide: Stack::zeros(1, size),
            guided: true,
            stokes: Stack::from_vec(3, size, stokes).unwrap(),
            angles: None,
            angle_list: Vec::new(),
            valid: vec![true, true, true, false],
            report: Report::default(),
        };
        let (by_dolp, by_aolp) = classes(&frame);
        let third = 1.0 / 3.0;
        assert_eq!([by_dolp[0], by_dolp[25], by_dolp[12], by_dolp[49]], [third, third, third, 0.0]);
        assert!((by_aolp[0] - 2.0 / 3.0).abs() < 1e-6 && (by_aolp[9] - third).abs() < 1e-6, "{by_aolp:?}");
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
