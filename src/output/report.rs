use std::time::Duration;

use serde::{Serialize, Serializer};
use stokescope_core::diagnose::{self, Verdict};
use stokescope_core::pipeline::{FrameReport, Pipeline};

use super::ResultImages;
use crate::model::Selection;

/// Content of `report.json` for one reconstruction. Numbers that are not finite are written as null.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// Name of the method.
    pub method: String,
    /// Iterations of the solver.
    pub iterations: usize,
    /// Unknown images of the solver and the reason for their choice.
    pub modelled: Modelled,
    /// Part of the scene that was modelled.
    pub field: Field,
    /// Relation to the previous frame of a video: cold, moving or still.
    pub course: String,
    /// Number of frames whose readings were averaged.
    pub averaged: usize,
    /// Width and height of the result in pixels.
    pub size: [usize; 2],
    /// Processing time of each stage.
    pub seconds: Seconds,
    /// Root mean square difference of the raw frame and the model, in units of full scale.
    pub residual_rms: f64,
    /// How far the result can be believed: credible, doubtful or not credible.
    pub verdict: String,
    /// Figures behind the verdict.
    pub figures: Figures,
    /// Probable faults, the likeliest first.
    pub suspects: Vec<Suspect>,
    /// Gain from guide to raw frame, one per channel. Written as a number for one channel, as a list for more.
    #[serde(serialize_with = "number_or_list")]
    pub gain: Vec<f64>,
    /// Shift of the guide against the raw frame in pixels: right, down.
    pub shift_px: [f64; 2],
    /// Length of the longest local shift of the guide that was undone beside it, in pixels.
    pub local_shift_px: f64,
    /// Weights of a colour guide's red, green and blue beside a mono sensor, of sum 1; `None` for other guides.
    pub guide_weights: Option<[f64; 3]>,
    /// Share of the guide's values that were replaced by what is around them: missing ones, and those of dead or hot pixels.
    pub guide_replaced: f64,
    /// Scale of the PSF relative to its calibration.
    pub psf_scale: f64,
    /// Mean degree of linear polarization of the valid pixels; `None` without a mask.
    pub mean_dolp: Option<f64>,
    /// Median standard errors of the valid pixels; `None` without a mask.
    pub errors: Option<Errors>,
    /// Fraction of pixels that are neither dark nor saturated.
    pub valid_fraction: f64,
    /// Memory of the solver in bytes.
    pub workspace_bytes: usize,
    /// Peak resident memory of the process in bytes: [`peak_rss_bytes`].
    pub peak_rss_bytes: Option<u64>,
    /// SHA-256 of the device bundle.
    pub calibration: String,
    /// Name of the fusion model; `None` for physics only.
    pub model: Option<String>,
    /// Why it is this model, or none.
    pub model_why: String,
    /// Statistics of the fusion model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fusion: Option<Fusion>,
    /// Warnings about the frame.
    pub warnings: Vec<String>,
}

impl Report {
    /// Report of the pipeline's latest frame, with the verdict of its figures alone; [`Self::suspect`] adds what trials found. `digest` is that of the bundle, `load` the time to read the files, `total` the time of
    /// everything.
    pub fn new(
        pipeline: &Pipeline,
        frame: &FrameReport,
        selection: &Selection,
        digest: &str,
        [load, total]: [Duration; 2],
    ) -> Self {
        Self {
            method: frame.method.to_string(),
            iterations: frame.iterations,
            modelled: Modelled { unknowns: frame.modelled.unknowns(), why: frame.why },
            field: Field {
                margin_px: frame.field.margin.columns.max(frame.field.margin.rows),
                light_from_beyond: f64::from(frame.field.light_from_beyond),
                why: frame.field.why,
            },
            course: frame.course.to_string(),
            averaged: frame.averaged,
            size: [pipeline.size().width, pipeline.size().height],
            seconds: Seconds {
                load: load.as_secs_f64(),
                prepare: frame.prepare.as_secs_f64(),
                register: frame.register.as_secs_f64(),
                recon: frame.recon.as_secs_f64(),
                fusion: frame.fusion_time.as_secs_f64(),
                total: total.as_secs_f64(),
            },
            residual_rms: f64::from(frame.residual_rms),
            verdict: frame.figures.verdict().to_string(),
            figures: Figures {
                residual_over_noise: f64::from(frame.figures.residual_over_noise),
                light_over_noise: f64::from(frame.figures.light_over_noise),
                saturated: f64::from(frame.figures.saturated),
                foreign_guide: frame.figures.foreign_guide,
                settled: frame.figures.settled,
            },
            suspects: frame.figures.suspects().map(Suspect::from).collect(),
            gain: frame.gain.iter().copied().map(f64::from).collect(),
            shift_px: frame.shift_px.map(f64::from),
            local_shift_px: f64::from(frame.local_shift_px),
            guide_weights: frame.guide_weights.map(|weights| weights.map(f64::from)),
            guide_replaced: f64::from(frame.guide_replaced),
            psf_scale: f64::from(frame.psf_scale),
            mean_dolp: frame.mean_dolp.map(f64::from),
            errors: frame.errors.map(|e| Errors { s1_s2: f64::from(e.polarization), dolp: f64::from(e.dolp) }),
            valid_fraction: f64::from(frame.valid_fraction),
            workspace_bytes: pipeline.workspace_bytes(),
            peak_rss_bytes: peak_rss_bytes(),
            calibration: digest.to_owned(),
            model: selection.model.clone(),
            model_why: selection.why.clone(),
            fusion: pipeline.fusion().zip(frame.fusion).map(|(plan, r)| Fusion {
                result: if r.is_learned() { "learned" } else { "physics" },
                precision: plan.network().precision().to_string(),
                tiles: r.tiles,
                run: r.run,
                kept: r.kept,
                quiet: r.quiet,
                refused: r.refused,
            }),
            warnings: frame.warnings.iter().map(ToString::to_string).collect(),
        }
    }
}

impl Report {
    /// Adds what trials found to be wrong ([`Pipeline::diagnose`]); the verdict becomes that of the worst, and each is a warning too.
    /// Returns the verdict.
    pub fn suspect(&mut self, figures: &diagnose::Figures, suspects: &[diagnose::Suspect]) -> Verdict {
        let verdict = suspects.iter().map(diagnose::Suspect::verdict).fold(figures.verdict(), Verdict::max);
        self.verdict = verdict.to_string();
        self.suspects = suspects.iter().copied().map(Suspect::from).collect();
        let warning = |s: &Suspect| format!("{verdict}: probably {}; {}", s.what, s.remedy);
        self.warnings.extend(self.suspects.iter().map(warning));
        verdict
    }
}

/// Images of a pipeline's latest result, for [`write_all`](super::write_all).
pub fn images(pipeline: &Pipeline) -> ResultImages<'_> {
    let result = pipeline.result();
    ResultImages {
        size: pipeline.size(),
        channels: pipeline.raw().count(),
        angles: result.angles.as_ref(),
        angle_list: pipeline.angles(),
        stokes: &result.stokes,
        errors: Some(&result.errors),
        valid: &result.valid,
        stage1: pipeline.stage1(),
    }
}

/// Unknowns of the solver.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Modelled {
    /// Names of the unknown images, such as s1 and s2 where the guide gives s0.
    pub unknowns: &'static [&'static str],
    /// Reason for this choice, as text.
    pub why: &'static str,
}

/// Part of the scene that was modelled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Field {
    /// Pixels around the frame that were solved for; 0 where the scene was taken to end with the frame.
    pub margin_px: usize,
    /// Share of the light on the sensor that came from there, 0 to 1.
    pub light_from_beyond: f64,
    /// Reason for the margin, as text.
    pub why: &'static str,
}

/// Figures from which the verdict on a result comes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Figures {
    /// Residual over the noise of the readings; about 1 where the model explains everything.
    pub residual_over_noise: f64,
    /// Mean reading over the noise of a reading.
    pub light_over_noise: f64,
    /// Share of saturated readings, 0 to 1.
    pub saturated: f64,
    /// Whether the guide shows another scene or nothing of this one.
    pub foreign_guide: bool,
    /// Whether the residual tells of the set-up: the method is one of this program's own and was given its usual iterations.
    pub settled: bool,
}

/// Something that is probably wrong.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Suspect {
    /// The fault, as text.
    pub what: String,
    /// Remedy, as text.
    pub remedy: String,
    /// Mean square that the readings keep if it is put right, over what they keep as declared; 1 where nothing was tried.
    pub rest: f64,
}

impl From<diagnose::Suspect> for Suspect {
    fn from(suspect: diagnose::Suspect) -> Self {
        let diagnose::Suspect { fault, rest } = suspect;
        Self { what: fault.to_string(), remedy: fault.remedy(), rest: f64::from(rest) }
    }
}

/// Median standard errors of the valid pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Errors {
    /// Standard error of S1 and S2, fractions of full scale.
    pub s1_s2: f64,
    /// Standard error of the degree of linear polarization.
    pub dolp: f64,
}

/// Statistics of the fusion model: numbers of tiles over all channels.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fusion {
    /// "learned" when the fusion model changed the result, else "physics".
    pub result: &'static str,
    /// Number format of the network.
    pub precision: String,
    /// All tiles.
    pub tiles: usize,
    /// Tiles that the network was run on.
    pub run: usize,
    /// Tiles whose previous output was reused because their input did not change.
    pub kept: usize,
    /// Tiles without polarization above the noise.
    pub quiet: usize,
    /// Tiles whose output was rejected because the readings contradict it.
    pub refused: usize,
}

/// Processing time per stage in seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Seconds {
    /// Reading the files.
    pub load: f64,
    /// Unpacking, black level and dark frame.
    pub prepare: f64,
    /// Aligning the guide.
    pub register: f64,
    /// Solving.
    pub recon: f64,
    /// The fusion model.
    pub fusion: f64,
    /// Everything.
    pub total: f64,
}

fn number_or_list<S: Serializer>(values: &[f64], serializer: S) -> Result<S::Ok, S::Error> {
    match values {
        [value] => value.serialize(serializer),
        values => values.serialize(serializer),
    }
}

/// Peak resident memory of this process in bytes (`VmHWM` of Linux); `None` on other systems.
pub fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kibibytes * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_keys_are_as_documented_and_nothing_is_nan() {
        let report = Report { residual_rms: f64::NAN, gain: vec![f64::INFINITY], ..Report::default() };
        let text = serde_json::to_string(&report).unwrap();
        let expected = r#"{"method":"","iterations":0,"modelled":{"unknowns":[],"why":""},"field":{"margin_px":0,"light_from_beyond":0.0,"why":""},"course":"","averaged":0,"size":[0,0],"seconds":{"load":0.0,"prepare":0.0,"register":0.0,"#
            .to_owned()
            + r#""recon":0.0,"fusion":0.0,"total":0.0},"residual_rms":null,"verdict":"","figures":{"residual_over_noise":0.0,"#
            + r#""light_over_noise":0.0,"saturated":0.0,"foreign_guide":false,"settled":false},"suspects":[],"gain":null,"shift_px":[0.0,0.0],"local_shift_px":0.0,"guide_weights":null,"guide_replaced":0.0,"psf_scale":0.0,"mean_dolp":null,"errors":null,"#
            + r#""valid_fraction":0.0,"workspace_bytes":0,"peak_rss_bytes":null,"calibration":"","model":null,"model_why":"","warnings":[]}"#;
        assert_eq!(text, expected);
    }

    #[test]
    fn the_gain_is_a_number_or_a_list() {
        let gain =
            |gain: Vec<f64>| serde_json::to_value(Report { gain, ..Report::default() }).unwrap()["gain"].to_string();
        assert_eq!((gain(vec![0.5]), gain(vec![0.5, 1.0, 2.0])), ("0.5".to_owned(), "[0.5,1.0,2.0]".to_owned()));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_peak_grows_with_used_memory() {
        let before = peak_rss_bytes().unwrap();
        let held = std::hint::black_box(vec![1u8; 64 << 20]);
        assert!(peak_rss_bytes().unwrap() >= before.max(held.len() as u64));
    }
}
