//! `/metrics`: the service's figures in Prometheus's text format.

use std::fmt::Write as _;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::context::Context;
use super::state::rss_bytes;
use crate::live::frame::PublishedFrame;
use crate::live::machine::Machine;
use crate::live::pairing::CameraStatus;
use crate::live::quality::Quality;
use crate::live::statistics::{Stage, Statistics};
use crate::output;

/// Figures of the service at one moment.
struct Snapshot<'a> {
    context: &'a Context,
    cameras: Vec<(&'static str, CameraStatus)>,
    statistics: Statistics,
    frame: Option<Arc<PublishedFrame>>,
    quality: Quality,
    machine: Machine,
}

/// One value of a family, with the labels that tell it from the others.
struct Sample {
    labels: Vec<(&'static str, String)>,
    value: f64,
}

/// A family of values of one name: name, type, help, and the function that gives the samples. One without samples is left out.
type Family = (&'static str, &'static str, &'static str, fn(&Snapshot<'_>) -> Vec<Sample>);

/// All families, in the order they are written. The prefix `stokescope_` is not part of the names here.
const FAMILIES: &[Family] = &[
    ("frames_total", "counter", "Frames processed", |s| one(s.statistics.frames as f64)),
    ("frames_failed_total", "counter", "Frames that gave no result", |s| one(s.statistics.failed as f64)),
    ("frames_per_second", "gauge", "Results per second of late", |s| one(s.statistics.fps())),
    ("latency_seconds", "gauge", "Time from a frame's arrival to its result, of the recent frames", latency),
    ("results_written_total", "counter", "Results written to disk", |s| one(s.statistics.saving.written as f64)),
    ("results_unwritten_total", "counter", "Results that could not be written", |s| {
        one(s.statistics.saving.failed as f64)
    }),
    ("saturated_share", "gauge", "Share of the raw readings of the latest frame that are saturated", |s| {
        s.frame.iter().flat_map(|frame| one(f64::from(frame.saturated))).collect()
    }),
    ("recorded_total", "counter", "Frames recorded", |s| recording(s, s.statistics.recording.written as f64)),
    ("unrecorded_total", "counter", "Frames that could not be recorded, or made room for newer ones", |s| {
        recording(s, (s.statistics.recording.failed + s.statistics.recording.dropped) as f64)
    }),
    ("recording", "gauge", "1 while frames can be recorded", |s| {
        recording(s, flag(s.statistics.recording.fault.is_none()))
    }),
    ("saving", "gauge", "1 while results can be saved", |s| one(flag(s.statistics.saving.fault.is_none()))),
    ("camera_online", "gauge", "1 while the camera delivers", |s| cameras(s, |c| flag(c.fault.is_none()))),
    ("camera_frames_total", "counter", "Frames that arrived", |s| cameras(s, |c| c.received as f64)),
    ("camera_dropped_total", "counter", "Frames that made room for newer ones", |s| cameras(s, |c| c.dropped as f64)),
    ("camera_unpaired_total", "counter", "Frames without a partner in time", |s| cameras(s, |c| c.unpaired as f64)),
    ("camera_faults_total", "counter", "Broken frames, and waits that ended without a frame", |s| {
        cameras(s, |c| c.faults as f64)
    }),
    ("camera_reopened_total", "counter", "Times the camera was opened again", |s| cameras(s, |c| c.reopened as f64)),
    ("stage_seconds", "gauge", "Time of each stage for the latest frame", stages),
    ("warnings", "gauge", "Warnings of the latest frame", |s| {
        s.frame.iter().flat_map(|frame| one(frame.report.warnings.len() as f64)).collect()
    }),
    (
        "stage_quantile_seconds",
        "gauge",
        "Time of each stage over the recent frames; preview is from a frame's arrival to its picture",
        stage_quantiles,
    ),
    (
        "iterations",
        "gauge",
        "Iterations of the solver: asked for, allowed by the frame rate, run for the latest frame",
        |s| {
            let run = s.frame.as_ref().map(|frame| ("run", frame.report.iterations));
            let kinds = [("asked", s.quality.asked_iterations), ("allowed", s.quality.iterations)];
            kinds.into_iter().chain(run).map(|(kind, n)| labelled(&[("kind", kind)], n as f64)).collect()
        },
    ),
    ("frame_rate_asked", "gauge", "Frames per second to hold", |s| {
        s.quality.target_fps.into_iter().flat_map(one).collect()
    }),
    ("frame_rate_held", "gauge", "1 while the frame rate asked for is reached", |s| {
        one(flag(s.quality.clone().judge(s.statistics.rate(), s.context.watchers.slowest()).held))
    }),
    ("machine_throttled", "gauge", "1 while heat lowers the processor's clock", |s| one(flag(s.machine.throttled))),
    ("machine_undervoltage", "gauge", "1 while the supply voltage is too low", |s| one(flag(s.machine.undervoltage))),
    ("machine_temperature_celsius", "gauge", "The hottest zone", |s| {
        s.machine.temperature_c.into_iter().flat_map(|celsius| one(f64::from(celsius))).collect()
    }),
    ("rss_bytes", "gauge", "Memory the process holds", |_| one(bytes(rss_bytes()))),
    ("preview_clients", "gauge", "Connections being served", |s| one(s.context.clients.load(Ordering::Relaxed) as f64)),
    ("preview_encoded_total", "counter", "Pictures encoded", |s| {
        let encoded = s.context.broadcast.encoded();
        encoded
            .map(|(view, format, n)| labelled(&[("view", &view.name()), ("format", format.name())], n as f64))
            .collect()
    }),
    ("peak_rss_bytes", "gauge", "Most memory the process ever held", |_| one(bytes(output::peak_rss_bytes()))),
];

fn labelled(labels: &[(&'static str, &str)], value: f64) -> Sample {
    Sample { labels: labels.iter().map(|&(key, value)| (key, value.to_owned())).collect(), value }
}

fn one(value: f64) -> Vec<Sample> {
    vec![labelled(&[], value)]
}

fn flag(value: bool) -> f64 {
    f64::from(u8::from(value))
}

/// Bytes as a value. Unknown ones are not a number.
fn bytes(known: Option<u64>) -> f64 {
    known.map_or(f64::NAN, |bytes| bytes as f64)
}

fn cameras(snapshot: &Snapshot<'_>, value: impl Fn(&CameraStatus) -> f64) -> Vec<Sample> {
    snapshot.cameras.iter().map(|(name, status)| labelled(&[("camera", name)], value(status))).collect()
}

/// A value that is there only where frames are recorded.
fn recording(snapshot: &Snapshot<'_>, value: f64) -> Vec<Sample> {
    if snapshot.context.recorder.is_some() { one(value) } else { Vec::new() }
}

fn latency(snapshot: &Snapshot<'_>) -> Vec<Sample> {
    let sample = |(share, quantile)| {
        let seconds = snapshot.statistics.latency_ms(share).map_or(f64::NAN, |ms| f64::from(ms) * 1e-3);
        labelled(&[("quantile", quantile)], seconds)
    };
    [(0.5, "0.5"), (0.95, "0.95")].map(sample).into()
}

fn stages(snapshot: &Snapshot<'_>) -> Vec<Sample> {
    let Some(frame) = &snapshot.frame else { return Vec::new() };
    let seconds = frame.report.seconds;
    let stages = [
        ("prepare", seconds.prepare),
        ("register", seconds.register),
        ("recon", seconds.recon),
        ("fusion", seconds.fusion),
        ("total", seconds.total),
    ];
    stages.map(|(stage, seconds)| labelled(&[("stage", stage)], seconds)).into()
}

fn stage_quantiles(snapshot: &Snapshot<'_>) -> Vec<Sample> {
    let sample =
        |stage: Stage, quantile, ms| labelled(&[("stage", stage.name()), ("quantile", quantile)], f64::from(ms) * 1e-3);
    let known = Stage::ALL.into_iter().filter_map(|stage| snapshot.context.timings.of(stage).map(|q| (stage, q)));
    known.flat_map(|(stage, [p50, p95])| [sample(stage, "0.5", p50), sample(stage, "0.95", p95)]).collect()
}

/// All families with their samples.
pub(super) fn text(context: &Context) -> String {
    let (raw, guide) = context.pairing.cameras();
    let snapshot = Snapshot {
        context,
        cameras: std::iter::once(("raw", raw)).chain(guide.map(|guide| ("guide", guide))).collect(),
        statistics: context.statistics.lock().clone(),
        frame: context.broadcast.frame(),
        quality: context.quality.get(),
        machine: context.machine.get(),
    };
    let mut text = String::new();
    for (name, kind, help, samples) in FAMILIES {
        write_family(&mut text, name, kind, help, &samples(&snapshot));
    }
    text
}

/// Writes a family, if it has samples. Names and label values are the program's own, so nothing needs escaping.
fn write_family(text: &mut String, name: &str, kind: &str, help: &str, samples: &[Sample]) {
    // writing to a string cannot fail
    if !samples.is_empty() {
        let _ = writeln!(text, "# HELP stokescope_{name} {help}.\n# TYPE stokescope_{name} {kind}");
    }
    for Sample { labels, value } in samples {
        let labels: Vec<_> = labels.iter().map(|(key, value)| format!("{key}=\"{value}\"")).collect();
        let labels = if labels.is_empty() { String::new() } else { format!("{{{}}}", labels.join(",")) };
        let _ = writeln!(text, "stokescope_{name}{labels} {value}");
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::super::context::tests::context;
    use super::*;

    #[test]
    fn a_family_has_prometheus_form() {
        let mut text = String::new();
        let samples = [labelled(&[("camera", "raw"), ("kind", "a")], 3.0), labelled(&[], f64::NAN)];
        write_family(&mut text, "a_total", "counter", "Things", &samples);
        write_family(&mut text, "b_total", "counter", "Others", &[]);
        let expected = "# HELP stokescope_a_total Things.\n# TYPE stokescope_a_total counter\n\
                        stokescope_a_total{camera=\"raw\",kind=\"a\"} 3\nstokescope_a_total NaN\n";
        assert_eq!(text, expected);
    }

    #[test]
    fn families_have_names_of_their_own_and_counters_end_in_total() {
        let names: BTreeSet<_> = FAMILIES.iter().map(|family| family.0).collect();
        assert_eq!(names.len(), FAMILIES.len());
        for (name, kind, ..) in FAMILIES {
            assert_eq!(*kind == "counter", name.ends_with("_total"), "{name}");
        }
        let text = text(&context());
        for line in
            ["stokescope_camera_online{camera=\"raw\"} 1", "stokescope_recording 1", "stokescope_frames_total 0"]
        {
            assert!(text.contains(line), "{line} in {text}");
        }
        assert!(!text.contains("stokescope_warnings"), "there is no frame yet");
    }
}
