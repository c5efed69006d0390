//! What may be changed while the service runs.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use serde::Deserialize;

use super::hub::Hub;
use super::request::Refusal;

/// Most iterations that can be asked for at run time.
pub(super) const MAX_ITERATIONS: usize = 1000;

/// What is asked for.
#[derive(Debug)]
pub(super) struct Controls {
    /// Whether watchers may change anything.
    pub(super) allowed: bool,
    /// Whether there is a fusion model.
    pub(super) model: bool,
    iterations: AtomicUsize,
    fused: AtomicBool,
}

/// The background that differences are taken against.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Background {
    /// The latest frame.
    Store,
    /// None.
    Clear,
}

/// The body of a request to change something: what is left out stays.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Change {
    iterations: Option<i64>,
    jpeg_quality: Option<i64>,
    background: Option<Background>,
    fusion: Option<bool>,
}

impl Controls {
    /// As the command line asks.
    pub(super) fn new(allowed: bool, iterations: usize, model: bool) -> Self {
        Self { allowed, model, iterations: AtomicUsize::new(iterations), fused: AtomicBool::new(model) }
    }

    /// Whether results are to be fused.
    pub(super) fn fused(&self) -> bool {
        self.fused.load(Ordering::Relaxed)
    }

    /// The iterations asked for.
    pub(super) fn iterations(&self) -> usize {
        self.iterations.load(Ordering::Relaxed)
    }
}

/// Does what the JSON `body` asks for, all of it or nothing.
///
/// # Errors
/// [`Refusal::Change`] with the key, the value found and what is allowed.
pub(super) fn apply(hub: &Hub, body: &[u8]) -> Result<(), Refusal> {
    let refuse = |text: String| Refusal::Change(text);
    let change: Change = serde_json::from_slice(body).map_err(|e| refuse(e.to_string()))?;
    let within = |key: &str, value: Option<i64>, high: usize| match value {
        Some(v) if v < 1 || v > high as i64 => Err(refuse(format!("{key} = {v}, allowed: 1 to {high}"))),
        v => Ok(v.map(|v| v as usize)),
    };
    let iterations = within("iterations", change.iterations, MAX_ITERATIONS)?;
    let quality = within("jpeg_quality", change.jpeg_quality, 100)?;
    if change.fusion == Some(true) && !hub.controls.model {
        return Err(refuse(format!("fusion = true, allowed: false; {NO_MODEL}")));
    }
    let background = match change.background {
        Some(Background::Store) => {
            Some(Some(hub.broadcast.frame().ok_or_else(|| refuse("background: there is no frame yet".to_owned()))?))
        }
        Some(Background::Clear) => Some(None),
        None => None,
    };
    if let Some(n) = iterations {
        hub.controls.iterations.store(n, Ordering::Relaxed);
    }
    if let Some(fused) = change.fusion {
        hub.controls.fused.store(fused, Ordering::Relaxed);
    }
    if let Some(q) = quality {
        hub.broadcast.set_quality(q as u8);
    }
    if let Some(frame) = background {
        let s0 = frame.map(|frame| (0..frame.size().pixels()).map(|i| frame.stokes_at(0, i)).collect());
        hub.broadcast.set_background(s0);
    }
    hub.events.emit(
        "control",
        serde_json::json!({ "iterations": iterations, "jpeg_quality": quality, "fusion": change.fusion }),
    );
    Ok(())
}

/// Why results are not fused.
pub(super) const NO_MODEL: &str = "no fusion model is loaded";
