//! Answers in JSON: state of the service, polarization of a pixel, histograms.

use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::{Value, json};

use super::context::Context;
use crate::live::controls::MAX_ITERATIONS;
use crate::live::frame::PublishedFrame;
use crate::live::pairing::CameraStatus;
use crate::live::statistics::Stage;
use crate::output;
use stokescope_core::polarization::{aolp_degrees, dolp};
use stokescope_core::uncertainty::{aolp_error_degrees, dolp_error};

/// Classes of a histogram of DoLP, 0.02 wide.
const DOLP_CLASSES: usize = 50;
/// Classes of a histogram of AoLP, 5° wide.
const AOLP_CLASSES: usize = 36;
/// Longest time without a result while the raw camera works, before the service counts as unhealthy.
const PATIENCE: Duration = Duration::from_secs(30);

/// `/state`: everything that the page shows.
pub(super) fn json(context: &Context) -> Value {
    let (raw, guide) = context.pairing.cameras();
    let statistics = context.statistics.lock().clone();
    let (saving, recording) = (&statistics.saving, &statistics.recording);
    let frame = context.broadcast.frame();
    let degrees = context.broadcast.degrees();
    let stages: serde_json::Map<_, _> = Stage::ALL
        .into_iter()
        .filter_map(|stage| context.timings.of(stage).map(|[p50, p95]| (stage, p50, p95)))
        .map(|(stage, p50, p95)| (stage.name().to_owned(), json!({ "p50": p50, "p95": p95 })))
        .collect();
    json!({
        "mode": "run",
        "board": context.board,
        "frames": statistics.frames,
        "failed": statistics.failed,
        "fault": statistics.fault,
        "fps": round(statistics.fps()),
        "latency_ms": { "p50": statistics.latency_ms(0.5), "p95": statistics.latency_ms(0.95) },
        "uptime_seconds": round(context.started.elapsed().as_secs_f64()),
        "size": [context.broadcast.size().width, context.broadcast.size().height],
        "views": context.broadcast.views().map(|v| json!({ "name": v.name(), "label": v.label() })).collect::<Vec<_>>(),
        "frame": frame.as_ref().map(|f| f.index),
        "saturated": frame.as_ref().map(|f| f.saturated),
        "report": frame.map(|f| f.report.clone()),
        "dropped": dropped(&raw, guide.as_ref()),
        "cameras": { "raw": camera(&raw), "guide": guide.as_ref().map(camera) },
        "saving": { "out": context.out, "written": saving.written, "failed": saving.failed, "fault": saving.fault },
        "recording": context.recorder.as_ref().map(|(recorder, _)| json!({
            "on": recorder.is_on(), "session": recording.session, "frames": recording.frames, "written": recording.written,
            "failed": recording.failed, "dropped": recording.dropped, "removed": recording.removed, "fault": recording.fault,
        })),
        "stages_ms": stages,
        "quality": context.quality.get().judge(statistics.rate().map(round), context.watchers.slowest().map(round)),
        "machine": context.machine.get(),
        "controls": {
            "allowed": context.controls.allowed, "iterations": context.controls.iterations(), "max_iterations": MAX_ITERATIONS,
            "jpeg_quality": context.broadcast.quality(), "background": context.broadcast.has_background(),
            "dolp_scale": { "auto": degrees.set.is_none(), "end": degrees.drawn },
            "fusion": { "on": context.controls.fused(), "available": context.controls.has_model(),
                "model": context.controls.selection.model, "precision": context.controls.selection.precision,
                "reason": context.controls.selection.why },
        },
        "events": context.events.recent(),
        "clients": context.clients.load(Ordering::Relaxed),
        "peak_rss_bytes": output::peak_rss_bytes(),
        "rss_bytes": rss_bytes(),
    })
}

/// Memory that the process holds now; none where the system does not tell.
pub(super) fn rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

/// Frames that arrived and were not processed.
fn dropped(raw: &CameraStatus, guide: Option<&CameraStatus>) -> Value {
    json!({ "raw": raw.dropped, "guide": guide.map_or(0, |g| g.dropped), "unpaired": raw.unpaired })
}

fn camera(status: &CameraStatus) -> Value {
    json!({
        "name": status.name, "online": status.fault.is_none(), "fault": status.fault, "waiting": status.waiting, "frames": status.received,
        "faults": status.faults, "reopened": status.reopened, "behind_ms": round(1e3 * status.behind.as_secs_f64()),
    })
}

fn round(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}

/// `/healthz`: whether the raw camera delivers and results come.
///
/// # Errors
/// The problem, in words.
pub(super) fn health(context: &Context) -> Result<(), String> {
    let (raw, _) = context.pairing.cameras();
    if let Some(fault) = raw.fault {
        return Err(format!("raw camera offline: {fault}"));
    }
    let last = context.statistics.lock().last();
    match last {
        _ if context.pairing.is_idle() => Ok(()),
        Some(last) if last.elapsed() > PATIENCE => Err(format!("no result for {} s", last.elapsed().as_secs())),
        None if context.started.elapsed() > PATIENCE => Err("no result yet".to_owned()),
        _ => Ok(()),
    }
}

/// `/pixel`: the polarization of one pixel of the latest frame with its standard errors; null before the first. The error of an angle
/// that means nothing is null.
pub(super) fn pixel(context: &Context, x: usize, y: usize) -> Value {
    let Some(frame) = context.broadcast.frame() else { return Value::Null };
    let i = y * frame.size().width + x;
    let [s0, s1, s2] = [0, 1, 2].map(|k| frame.stokes_at(k, i));
    let polarized = frame.polarized();
    let errors = frame.images().errors_at(i);
    json!({
        "frame": frame.index, "x": x, "y": y, "s0": s0, "valid": frame.valid[i],
        "dolp": polarized.then(|| dolp(s0, s1, s2)),
        "dolp_error": errors.map(|[stokes, errors]| dolp_error(stokes, errors)),
        "aolp_degrees": polarized.then(|| aolp_degrees(s1, s2)),
        "aolp_error_degrees": errors.and_then(|[stokes, errors]| aolp_error_degrees(stokes, errors)),
    })
}

/// `/histogram`: valid pixels by DoLP (0 to 1), their polarized light by AoLP (0° to 180°), both as fractions of the sum, and
/// the mean Stokes vector, for the latest frame or a region of it (left, top, width, height). Null before the first frame or
/// without polarization.
pub(super) fn histogram(context: &Context, region: Option<[usize; 4]>) -> Value {
    match context.broadcast.frame() {
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

/// Distribution and mean of the polarization of many pixels.
#[derive(Debug)]
struct Classes {
    dolp: [f32; DOLP_CLASSES],
    aolp: [f32; AOLP_CLASSES],
    /// Mean Stokes vector.
    mean: [f32; 3],
    pixels: usize,
}

fn classes(frame: &PublishedFrame, region: Option<[usize; 4]>) -> Classes {
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
        // an angle counts by the polarized light that has it
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::frame::tests::frame;
    use stokescope_core::image::{Size, Stack};

    #[test]
    fn histograms_count_valid_pixels_and_weigh_angles_by_polarized_light() {
        let size = Size::new(4, 1);
        let stokes = [[1.0, 1.0, 1.0, 9.0], [0.0, 0.5, 0.0, 9.0], [0.0, 0.0, 0.25, 0.0]].concat();
        let frame = PublishedFrame {
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
}
