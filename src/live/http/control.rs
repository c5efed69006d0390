//! Changes of settings that a request asks for.

use serde::Deserialize;
use serde_json::json;

use super::context::Context;
use super::refusal::Refusal;
use crate::live::controls::MAX_ITERATIONS;

/// Change of the background that differences are taken against.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Background {
    /// Store the latest frame.
    Store,
    /// Forget the stored frame.
    Clear,
}

/// Body of a request to change settings. Settings that are left out stay.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Change {
    iterations: Option<i64>,
    jpeg_quality: Option<i64>,
    background: Option<Background>,
    fusion: Option<bool>,
}

/// Makes the changes that the JSON `body` asks for, all of them or none.
///
/// # Errors
/// [`Refusal::Change`] with the key, the value found and what is allowed.
pub(super) fn apply(context: &Context, body: &[u8]) -> Result<(), Refusal> {
    let change: Change = serde_json::from_slice(body).map_err(|e| Refusal::Change(e.to_string()))?;
    let (controls, broadcast) = (&context.controls, &context.broadcast);
    let iterations = within("iterations", change.iterations, MAX_ITERATIONS)?;
    let quality = within("jpeg_quality", change.jpeg_quality, 100)?;
    if change.fusion == Some(true) && !controls.has_model() {
        return Err(Refusal::Change(format!(
            "fusion = true, allowed: false; no fusion model runs ({})",
            controls.selection.why
        )));
    }
    let frame = broadcast.frame();
    if change.background == Some(Background::Store) && frame.is_none() {
        return Err(Refusal::Change("background = \"store\": there is no frame yet; ask again later".to_owned()));
    }
    if let Some(iterations) = iterations {
        controls.set_iterations(iterations);
    }
    if let Some(fused) = change.fusion {
        controls.set_fused(fused);
    }
    if let Some(quality) = quality {
        broadcast.set_quality(quality as u8);
    }
    if let Some(background) = change.background {
        let s0 = frame.filter(|_| background == Background::Store);
        broadcast.set_background(s0.map(|frame| (0..frame.size().pixels()).map(|i| frame.stokes_at(0, i)).collect()));
    }
    let detail = json!({ "iterations": iterations, "jpeg_quality": quality, "fusion": change.fusion });
    context.events.emit("control", detail);
    Ok(())
}

/// Checks that a setting, if it is given, is 1 to `high`.
fn within(key: &str, value: Option<i64>, high: usize) -> Result<Option<usize>, Refusal> {
    match value {
        Some(v) if v < 1 || v > high as i64 => Err(Refusal::Change(format!("{key} = {v}, allowed: 1 to {high}"))),
        v => Ok(v.map(|v| v as usize)),
    }
}
