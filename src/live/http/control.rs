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

/// End of the scale of degrees of polarization.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(untagged)]
enum Degrees {
    At(f32),
    Named(Follow),
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Follow {
    /// As most pixels of the frame have it.
    Auto,
}

/// Smallest end of that scale.
const LEAST_DEGREE: f32 = 0.01;

/// Body of a request to change settings. Settings that are left out stay.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Change {
    iterations: Option<i64>,
    jpeg_quality: Option<i64>,
    background: Option<Background>,
    fusion: Option<bool>,
    dolp_scale: Option<Degrees>,
}

/// Makes the changes, all of them or none.
///
/// # Errors
/// [`Refusal::Change`] with the key, the value found and what is allowed.
pub(super) fn apply(context: &Context, change: &Change) -> Result<(), Refusal> {
    let (controls, broadcast) = (&context.controls, &context.broadcast);
    let iterations = within("iterations", change.iterations, MAX_ITERATIONS)?;
    let quality = within("jpeg_quality", change.jpeg_quality, 100)?;
    if let Some(Degrees::At(end)) = change.dolp_scale.filter(|degrees| !degrees.is_possible()) {
        return Err(Refusal::Change(format!("dolp_scale = {end}, allowed: {LEAST_DEGREE} to 1, or \"auto\"")));
    }
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
    match change.dolp_scale {
        Some(Degrees::At(end)) => broadcast.set_degrees(Some(end)),
        Some(Degrees::Named(Follow::Auto)) => broadcast.set_degrees(None),
        None => {}
    }
    if let Some(background) = change.background {
        let s0 = frame.filter(|_| background == Background::Store);
        broadcast.set_background(s0.map(|frame| (0..frame.size().pixels()).map(|i| frame.stokes_at(0, i)).collect()));
    }
    let detail = json!({ "iterations": iterations, "jpeg_quality": quality, "fusion": change.fusion });
    context.events.emit("control", detail);
    Ok(())
}

impl Degrees {
    fn is_possible(&self) -> bool {
        matches!(self, Self::At(end) if (LEAST_DEGREE..=1.0).contains(end)) || matches!(self, Self::Named(_))
    }
}

/// Checks that a setting, if it is given, is 1 to `high`.
fn within(key: &str, value: Option<i64>, high: usize) -> Result<Option<usize>, Refusal> {
    match value {
        Some(v) if v < 1 || v > high as i64 => Err(Refusal::Change(format!("{key} = {v}, allowed: 1 to {high}"))),
        v => Ok(v.map(|v| v as usize)),
    }
}
