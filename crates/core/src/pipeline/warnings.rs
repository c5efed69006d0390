//! What a user should know before trusting a result.

use crate::guide::Agreement;
use crate::readings::Quality;

/// Shares of untrusted readings that a user is told about.
const WARN_SHARE: f32 = 0.001;
/// Uncertainty of the guide's position that a user is told about, in pixels.
const WARN_SHIFT: f32 = 1.0;

/// What is wrong with the guide.
pub(super) fn of_guide(a: &Agreement) -> Option<String> {
    if a.foreign {
        let percent = 100.0 * a.detail;
        return Some(format!(
            "the guide shows another scene or nothing of this one (its detail is found in the raw frame with {percent:.0} % of its \
             brightness): S0 was solved for without it"
        ));
    }
    (a.uncertainty > WARN_SHIFT)
        .then(|| format!("the guide's position is only known to ±{:.1} px: the scene has little detail", a.uncertainty))
}

/// What is wrong with the raw frame.
pub(super) fn of_readings(q: &Quality) -> Vec<String> {
    let mut warnings = Vec::new();
    let percent = |share: f32| 100.0 * share;
    if q.saturated > WARN_SHARE {
        warnings.push(format!("{:.1} % of the raw readings are saturated and were ignored", percent(q.saturated)));
    }
    if q.not_finite > 0.0 {
        warnings
            .push(format!("{:.3} % of the raw readings are NaN or infinite and were ignored", percent(q.not_finite)));
    }
    if q.defective > 0.0 {
        warnings.push(format!(
            "{:.3} % of the raw readings are far from all around them (dead or hot pixels) and were ignored",
            percent(q.defective)
        ));
    }
    if q.peak <= 0.0 {
        warnings.push("the raw frame is dark: no reading is above black".to_owned());
    } else if q.peak - q.floor <= 1e-6 * q.peak.abs() {
        warnings.push(format!("the raw frame is blank: every reading is {:.4}", q.peak));
    }
    warnings
}
