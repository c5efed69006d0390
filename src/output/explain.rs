//! A result in plain sentences: one HTML page made from `report.json` and the pictures beside it.

use std::fmt::Write as _;

use serde::Deserialize;

/// Residual over noise below which the readings are explained, and above which the result is not credible.
const RESIDUAL: [f64; 2] = [1.5, 3.0];
/// Mean reading over noise below which there is little light, and below which there is too little.
const LIGHT: [f64; 2] = [20.0, 4.0];
/// Relative change of the PSF's size, and shift of the guide in pixels, that are told.
const CHANGED: f64 = 0.001;
const SHIFTED: f64 = 0.05;

/// Keys of `report.json` that the page tells about. Reports of other versions may lack some.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Facts {
    verdict: String,
    method: String,
    iterations: usize,
    modelled: Modelled,
    field: Field,
    averaged: usize,
    figures: Figures,
    suspects: Vec<Suspect>,
    shift_px: [f64; 2],
    psf_scale: Option<f64>,
    mean_dolp: Option<f64>,
    errors: Option<Errors>,
    valid_fraction: Option<f64>,
    model: Option<String>,
    model_why: String,
    warnings: Vec<String>,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
struct Modelled {
    unknowns: Vec<String>,
    why: String,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
struct Field {
    margin_px: usize,
    light_from_beyond: f64,
    why: String,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
struct Figures {
    residual_over_noise: Option<f64>,
    light_over_noise: Option<f64>,
    saturated: f64,
    foreign_guide: bool,
    /// Whether the residual tells of the set-up; earlier reports do not say.
    settled: Option<bool>,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
struct Suspect {
    what: String,
    remedy: String,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
struct Errors {
    s1_s2: f64,
    dolp: f64,
}

/// Pictures of a result folder with their captions, in the order of the page.
pub const PICTURES: [(&str, &str); 5] = [
    ("intensity.png", "S0, the intensity: what an ordinary camera sees."),
    (
        "dolp.png",
        "DoLP, the degree of linear polarization: 0 is unpolarized light, 1 is light of one direction of vibration.",
    ),
    (
        "aolp.png",
        "AoLP, the angle of linear polarization, as a colour: angles that differ by 180° are the same. Gray: no angle is certain.",
    ),
    ("composite.png", "Intensity with the angle as colour, where there is polarization."),
    (
        ERROR_PICTURE,
        "Standard error of the DoLP, on the scale of DoLP: the brighter, the less certain. Black is certain.",
    ),
];
/// Picture of the standard errors, drawn for the page.
pub const ERROR_PICTURE: &str = "dolp_error.png";

/// The page, with those of [`PICTURES`] that `shows` says are there. Pictures are named relative to the page.
pub fn page(facts: &Facts, shows: impl Fn(&str) -> bool) -> String {
    let mut html = String::from(HEAD);
    let (class, headline) = headline(&facts.verdict);
    let _ = writeln!(html, "<p class=\"verdict {class}\"><b>{}.</b> {headline}</p>", escaped(&capital(&facts.verdict)));
    list(&mut html, "What to do next", &next_steps(facts));
    html += "<h2>The result</h2>\n<div class=\"pictures\">\n";
    for (name, caption) in PICTURES.into_iter().filter(|(name, _)| shows(name)) {
        let _ =
            writeln!(html, "<figure><img src=\"{name}\" alt=\"{name}\"><figcaption>{caption}</figcaption></figure>");
    }
    html += "</div>\n";
    list(&mut html, "What was modelled", &modelled(facts));
    list(&mut html, "What the readings say", &readings(facts));
    html += TERMS;
    html
}

fn list(html: &mut String, title: &str, sentences: &[String]) {
    let _ = writeln!(html, "<h2>{title}</h2>\n<ul>");
    for sentence in sentences {
        let _ = writeln!(html, "<li>{}</li>", escaped(sentence));
    }
    html.push_str("</ul>\n");
}

/// Class of the page's style and sentence of a verdict.
fn headline(verdict: &str) -> (&'static str, &'static str) {
    match verdict {
        "not judged" => (
            "doubtful",
            "The method stopped before it explains the readings: they say nothing about the set-up, and the error bars may be too small.",
        ),
        "credible" => ("good", "The readings agree with the set-up: the result can be believed within its error bars."),
        "doubtful" => ("doubtful", "Something is off: parts of the result may be wrong."),
        _ => ("bad", "The readings contradict the set-up or hold too little light: do not use the result."),
    }
}

fn next_steps(facts: &Facts) -> Vec<String> {
    let mut steps: Vec<_> =
        facts.suspects.iter().map(|s| format!("Probably {}. Remedy: {}.", s.what, s.remedy)).collect();
    // The suspects stand among the warnings too.
    let told = |warning: &&String| !facts.suspects.iter().any(|s| warning.contains(&s.what));
    steps.extend(facts.warnings.iter().filter(told).map(|warning| format!("{}.", capital(warning))));
    let dim = facts.figures.light_over_noise.is_some_and(|light| light < LIGHT[0]);
    if dim && facts.suspects.is_empty() {
        steps.push(
            "Expose longer, add light, or average the frames of a still scene: the error bars shrink.".to_owned(),
        );
    }
    if steps.is_empty() {
        steps.push("Nothing needs to be done.".to_owned());
    }
    steps.push(
        "Check once with light of known polarization (stokescope calibrate verify): angles that begin elsewhere or run the other way \
         leave no trace in any reading."
            .to_owned(),
    );
    steps
}

fn modelled(facts: &Facts) -> Vec<String> {
    let Facts { method, iterations, averaged, shift_px: [right, down], .. } = facts;
    let name = |unknown: &String| match unknown.as_str() {
        "angles" => "the picture behind each polarizer".to_owned(),
        component => component.to_uppercase(),
    };
    let unknowns = facts.modelled.unknowns.iter().map(name).collect::<Vec<_>>().join(", ");
    let unknowns = if unknowns.is_empty() { "nothing".to_owned() } else { unknowns };
    let mut sentences = vec![format!(
        "Method {method} solved for {unknowns} in {iterations} iterations. Reason: {}.",
        facts.modelled.why
    )];
    let Field { margin_px, light_from_beyond, why } = &facts.field;
    sentences.push(if *margin_px == 0 {
        format!("The scene was taken to end at the frame: {why}.")
    } else {
        let percent = 100.0 * light_from_beyond;
        format!("{margin_px} pixels around the frame were solved for too, and {percent:.1} % of the light came from there: {why}.")
    });
    if *averaged > 1 {
        sentences.push(format!("The readings of {averaged} frames were averaged."));
    }
    if right.hypot(*down) > SHIFTED {
        sentences
            .push(format!("The guide lay {right:+.1} px (right) and {down:+.1} px (down) off and was moved back."));
    }
    if let Some(change) = facts.psf_scale.map(|scale| scale - 1.0).filter(|change| change.abs() > CHANGED) {
        let direction = if change > 0.0 { "larger" } else { "smaller" };
        sentences.push(format!(
            "The PSF is {:.1} % {direction} than when it was calibrated, and was scaled.",
            100.0 * change.abs()
        ));
    }
    sentences.push(match &facts.model {
        Some(model) => format!("The learned model {model} refined the result where the readings allow it."),
        None => format!("No learned model took part: {}.", facts.model_why),
    });
    sentences
}

fn readings(facts: &Facts) -> Vec<String> {
    let Figures { residual_over_noise, light_over_noise, saturated, foreign_guide, settled } = facts.figures;
    let mut sentences = Vec::new();
    if let Some(residual) = residual_over_noise {
        let meaning = match residual {
            r if r < RESIDUAL[0] => "the model explains them",
            _ if settled == Some(false) => {
                "a reference method, or one with fewer iterations than usual, stops before the readings are explained, so that this says \
                 nothing about the set-up"
            }
            r if r < RESIDUAL[1] => "something is not modelled",
            _ => "the model contradicts them",
        };
        sentences.push(format!("The model leaves {residual:.1} times the noise of the readings: {meaning}."));
    }
    if let Some(light) = light_over_noise {
        let meaning = match light {
            l if l < LIGHT[1] => "too little light",
            l if l < LIGHT[0] => "little light",
            _ => "enough light",
        };
        sentences.push(format!("The mean reading is {light:.0} times the noise of one reading: {meaning}."));
    }
    sentences.push(if saturated > 0.0 {
        format!("{:.1} % of the readings are saturated and were ignored.", 100.0 * saturated)
    } else {
        "No reading is saturated.".to_owned()
    });
    if foreign_guide {
        sentences.push("The guide shows another scene or nothing of this one.".to_owned());
    }
    if let Some(valid) = facts.valid_fraction {
        sentences.push(format!(
            "{:.1} % of the pixels can be trusted; the others are dark or were read through a pixel that cannot be trusted.",
            100.0 * valid
        ));
    }
    if let Some(dolp) = facts.mean_dolp {
        sentences.push(format!("The mean degree of polarization is {dolp:.3}."));
    }
    if let Some(Errors { s1_s2, dolp }) = &facts.errors {
        sentences.push(format!(
            "The degree of polarization of a typical pixel is known to ±{dolp:.3}, S1 and S2 to ±{s1_s2:.4} of full scale (one standard \
             error): smaller differences between two pixels mean nothing."
        ));
    }
    sentences
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

const HEAD: &str = "<!doctype html>
<html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\"><title>Result of stokescope</title>
<style>
body { font: 16px/1.5 sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
.verdict { padding: .8rem 1rem; border-left: .4rem solid } .good { background: #e7f4ec; border-color: #009e73 }
.doubtful { background: #fdf3dc; border-color: #e69f00 } .bad { background: #fbe5dc; border-color: #d55e00 }
.pictures { display: flex; flex-wrap: wrap; gap: 1rem } figure { margin: 0; width: 18rem } img { width: 100% }
figcaption { font-size: .9rem; color: #555 } dt { font-weight: bold }
</style>
<h1>What this result says</h1>
";
const TERMS: &str = "<h2>Terms</h2>
<dl>
<dt>S0, S1, S2</dt><dd>Stokes components: the intensity, horizontal less vertical light, and light at 45° less light at 135°.</dd>
<dt>PSF</dt><dd>Point spread function: the pattern that one point of the scene casts through the diffuser.</dd>
<dt>Guide</dt><dd>Picture of an ordinary camera beside the lensless one. It gives S0, which leaves S1 and S2 to be found.</dd>
<dt>Noise</dt><dd>Standard deviation of one reading, measured in the frame.</dd>
</dl>
</html>
";

#[cfg(test)]
mod tests {
    use super::*;

    fn facts(verdict: &str) -> Facts {
        let text = format!(
            r#"{{"verdict": "{verdict}", "method": "guided", "iterations": 20, "modelled": {{"unknowns": ["s1", "s2"], "why": "the guide gives s0"}},
            "figures": {{"residual_over_noise": 0.98, "light_over_noise": 84.1}}, "errors": {{"s1_s2": 0.0134, "dolp": 0.034}},
            "suspects": [{{"what": "the psf file is <transposed>", "remedy": "transpose it"}}],
            "warnings": ["doubtful: probably the psf file is <transposed>; transpose it", "the guide is off"], "unknown_key": 1}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    #[test]
    fn a_page_tells_verdict_reason_and_remedy_once() {
        let html = page(&facts("doubtful"), |name| name == "dolp.png");
        assert!(html.contains("<b>Doubtful.</b> Something is off"));
        assert!(html.contains("Method guided solved for S1, S2 in 20 iterations. Reason: the guide gives s0."));
        assert_eq!(html.matches("the psf file is &lt;transposed&gt;").count(), 1);
        assert!(html.contains("Remedy: transpose it.") && html.contains("The guide is off."));
        assert!(html.contains("1.0 times the noise of the readings: the model explains them."));
        assert!(html.contains("±0.034") && html.contains("84 times the noise of one reading: enough light."));
        assert!(html.contains("dolp.png") && !html.contains("aolp.png") && !html.contains("<transposed>"));
    }

    #[test]
    fn a_reference_method_is_told_without_a_judgement_of_its_residual() {
        let text = r#"{"verdict": "not judged", "method": "fista", "modelled": {"unknowns": ["angles"], "why": "the method asked for"},
            "figures": {"residual_over_noise": 1.7, "settled": false}}"#;
        let html = page(&serde_json::from_str(text).unwrap(), |_| false);
        assert!(html.contains("solved for the picture behind each polarizer in"), "{html}");
        assert!(html.contains("1.7 times the noise of the readings: a reference method"), "{html}");
        assert!(html.contains("<b>Not judged.</b>") && !html.contains("something is not modelled"), "{html}");
    }

    #[test]
    fn a_report_without_most_keys_is_told_as_far_as_it_goes() {
        let html = page(&serde_json::from_str(r#"{"verdict": "credible"}"#).unwrap(), |_| false);
        assert!(html.contains("within its error bars") && html.contains("Nothing needs to be done."));
    }
}
