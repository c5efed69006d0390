//! Search for a guide of which nothing is known: how it lies, how its colours are weighed, and what is wrong with its brightness.

use super::colors::{self, Weights};
use super::parallax::{self, Shifts};
use super::radiometry::{Curve, SMOOTH_PASSES};
use super::register::{self, Found, Parameters};
use super::track::Track;
use super::{Agreement, Content, GuideMode, Look, Plan, PsfSize, Summary, Workspace, beyond, brightness, fit};
use crate::image::Stack;

/// Times that the light of a margin is solved for, at most: polarization of other brightness is eliminated each time …
const SURROUNDS: usize = 4;
/// … until the brightness changes by no more than this, as a logarithm.
const ALIKE_LEVEL: f32 = 0.3;
/// Brightness of a margin over that of the frame, below which it is not what one extrapolates from the frame.
const DIM: f32 = 0.5;
/// Times that the colours of a guide are weighed, at most; weights that change by less than this are the same.
const WEIGHINGS: usize = 3;
const ALIKE_WEIGHTS: f32 = 0.03;
/// Readings from which on a corrected brightness tells about light from beyond the frame. In a smaller frame that light is so smooth that the
/// correction explains it.
const MANY_READINGS: f64 = 1e4;

impl Plan {
    /// Finds out how a guide lies and shines without knowledge of the last frame; none if it explains nothing of the readings
    /// or the PSF has another size.
    pub(super) fn search(
        &self,
        frame: &fit::Frame<'_>,
        content: Content<'_>,
        look: Look<'_>,
        w: &mut Workspace,
        summary: &mut Summary,
    ) -> Option<Track> {
        self.surround(frame, content, w);
        let aligned = self.align(frame, content, w);
        let (found, weights) = self.weigh_colors(frame, content, aligned, w);
        let content = Content { weights, ..content };
        let Some(shifts) = self.find_shifts(frame, content, &found, w) else {
            return self.correct_brightness(frame, content, found, look, w, summary);
        };
        // Errors of brightness pass for shifts and the other way round, so brightness is corrected without and with the shifts.
        let mut shifted = |shifts: Option<&Shifts>| {
            self.mark_surroundings(content, w);
            let content = Content { shifts, ..content };
            self.place(content, &found.parameters, &mut w.guide, w.border.plane());
            w.border.keep_hidden(&mut w.guide, &w.kept);
            let here = Self::judge(frame, w);
            let here = Found { parameters: found.parameters, uncertainty: found.uncertainty, ..here };
            let track = self.correct_brightness(frame, content, here, look, w, summary);
            (track, summary.rest)
        };
        let (alone, rest) = shifted(None);
        let (beside, _) = shifted(Some(&shifts));
        let better = match (&alone, &beside) {
            (Some(alone), Some(beside)) => parallax::explains(alone.rest(frame), beside.rest(frame), frame),
            (alone, beside) => alone.is_none() && beside.is_some(),
        };
        let track = if better { beside } else { shifted(None).0 };
        // Shifts would explain a part of an error of brightness, which must not pass for light from beyond the frame.
        summary.rest = rest;
        track
    }

    /// Corrects the brightness of a guide that lies as `found`; none if it explains nothing of the readings or the PSF has another size.
    fn correct_brightness(
        &self,
        frame: &fit::Frame<'_>,
        content: Content<'_>,
        mut found: Found,
        look: Look<'_>,
        w: &mut Workspace,
        summary: &mut Summary,
    ) -> Option<Track> {
        *summary = Summary::default();
        summary.suspects_light = found.fit.beyond.tell(beyond::GUIDED);
        // That light is mistaken for another size of the PSF.
        let psf_size = if summary.suspects_light { PsfSize::Given } else { look.psf_size };
        let (lies, uncertainty) = (found.parameters, found.uncertainty as f32);
        let brightness = brightness(&w.guide);
        summary.shift = [lies[0] as f32, lies[1] as f32];
        if found.fit.gain.is_nan() || found.fit.gain <= 0.0 {
            return None;
        }
        let mut curves = [Curve::default(); 3];
        let foreign = self.is_foreign(frame, &mut found, &mut curves, w);
        if !foreign {
            w.weights = content.weights;
        }
        let detail = found.fit.detail_share() as f32;
        self.mark_hidden(content, &lies, &mut w.border);
        let hides = w.border.hidden_count > 0 && !foreign;
        let hidden = self.hidden_share(w);
        if hides {
            self.fill(frame, w);
            found = Self::judge(frame, w);
        }
        summary.rest = (found.fit.polarized / (frame.noise * frame.trusted)) as f32;
        summary.corrected_rest = summary.rest;
        let mut refined = false;
        // Light from a bright margin that the guide does not see is mistaken for an error of its brightness.
        let unseen = (hides && !self.field.margin().is_none()).then(|| self.field.level(w.guide.plane(0)));
        while !foreign && unseen.is_none_or(|level| level < DIM) && self.refine(frame, &mut curves, w) {
            refined = true;
            if hides {
                self.fill(frame, w);
            }
        }
        if !foreign {
            summary.growth = Self::growth(frame, psf_size, w);
            if summary.growth.is_some() {
                return None;
            }
        }
        if refined {
            found = Self::judge(frame, w);
        }
        let smooth = self.correct_smooth_error(frame, content, &lies, (&mut found, &mut curves), hides, w);
        if frame.trusted >= MANY_READINGS {
            summary.corrected_rest = (found.fit.polarized / (frame.noise * frame.trusted)) as f32;
        }
        let gains = self.apply_gains(&found, &brightness, w)?;
        let corrected = smooth > 0 || curves.iter().any(|curve| !curve.is_none());
        let off = if self.guide_mode == GuideMode::Placed { found.off.map(|v| v as f32) } else { [0.0; 2] };
        let dim_margin = unseen.filter(|level| *level < DIM).unwrap_or(0.0);
        let agreement = Agreement { foreign, detail, uncertainty, corrected, hidden, off, dim_margin };
        (summary.gain, summary.agreement) = (Some(gains), Some(agreement));
        let noise = frame.noise * frame.trusted;
        let mut track = Track::new(lies, agreement, &found, gains, brightness, look.mean_reading, noise);
        (track.curves, track.smooth, track.shifts) = (curves, smooth, content.shifts.copied());
        Some(track)
    }

    /// Marks what a guide as placed does not see of a field with a margin; nothing of the frame alone.
    fn mark_surroundings(&self, content: Content<'_>, w: &mut Workspace) {
        w.border.hidden_count = 0;
        if !self.field.margin().is_none() {
            self.mark_hidden(content, &Parameters::zeros(), &mut w.border);
        }
    }

    /// Solves for what a guide as placed does not see of a field with a margin, in the guide's units, into `w.guide` and `w.kept`.
    fn surround(&self, frame: &fit::Frame<'_>, content: Content<'_>, w: &mut Workspace) {
        self.mark_surroundings(content, w);
        if w.border.hidden_count == 0 {
            return;
        }
        let mut level = self.field.level(w.guide.plane(0));
        for _ in 0..SURROUNDS {
            for c in 0..self.sensor.channels {
                let Workspace { raw, guide, kept, border, scratch, fit, .. } = &mut *w;
                let gain = border.fill(frame, c, raw.plane_mut(c), guide.plane_mut(c), scratch, fit);
                if gain > 0.0 {
                    guide.plane_mut(c).iter_mut().for_each(|g| *g /= gain);
                }
                kept.plane_mut(c).copy_from_slice(guide.plane(c));
            }
            let found = self.field.level(w.guide.plane(0));
            let alike = (found / level).ln().abs() < ALIKE_LEVEL;
            level = found;
            w.fit.begin(frame, level);
            if alike {
                break;
            }
        }
    }

    /// The weights of a colour guide's channels beside a mono sensor, by the readings. A guide whose colours are weighed otherwise can look
    /// like one of another scene and lie anywhere, so it is aligned anew with every weights found. `found` is where it lies with those of
    /// `content`.
    fn weigh_colors(
        &self,
        frame: &fit::Frame<'_>,
        mut content: Content<'_>,
        mut found: Found,
        w: &mut Workspace,
    ) -> (Found, Weights) {
        if self.weights.is_some() || !self.mixes(content) {
            return (found, content.weights);
        }
        for _ in 0..WEIGHINGS {
            let Workspace { raw, guide, border, scratch, fit, kept, .. } = &mut *w;
            let (direction, plane, hidden) = border.buffers();
            let place = |weights: Weights, channel: &mut Stack<f32>| {
                self.place(Content { weights, ..content }, &found.parameters, channel, plane);
                let pixels = channel.as_mut_slice().iter_mut().zip(hidden);
                pixels.filter(|(_, hidden)| **hidden).for_each(|(v, _)| *v = 0.0);
            };
            let weights = colors::find(frame, content.weights, (raw, guide), place, (direction, kept), scratch, fit);
            // What was solved for where the guide does not see the scene.
            kept.as_mut_slice().copy_from_slice(guide.as_slice());
            let Some(weights) = weights else { break };
            let change = weights.iter().zip(content.weights).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            content.weights = weights;
            self.place(content, &Parameters::zeros(), &mut w.guide, w.border.plane());
            self.surround(frame, content, w);
            found = self.align(frame, content, w);
            if change < ALIKE_WEIGHTS {
                break;
            }
        }
        (found, content.weights)
    }

    /// Local shifts of the guide as it lies, by the readings. Leaves it placed by them.
    fn find_shifts(
        &self,
        frame: &fit::Frame<'_>,
        content: Content<'_>,
        found: &Found,
        w: &mut Workspace,
    ) -> Option<Shifts> {
        let light = found.fit.beyond.tell(beyond::GUIDED);
        if self.guide_mode != GuideMode::Aligned || found.fit.gain.is_nan() || found.fit.gain <= 0.0 || light {
            return None;
        }
        // Without a mask S0 is solved for itself.
        if frame.coarse.is_empty() {
            return None;
        }
        let Workspace { raw, guide, border, scratch, fit, kept, .. } = w;
        let mut search = parallax::Search { frame, raw, guide, border, scratch, fit };
        search.run(found.hessian.trace() / found.moving, |shifts, guide, border| {
            self.place(Content { shifts, ..content }, &found.parameters, guide, border.plane());
            border.keep_hidden(guide, kept);
        })
    }

    /// Aligns the guide with the readings, or judges it where the bundle places it.
    fn align(&self, frame: &fit::Frame<'_>, content: Content<'_>, w: &mut Workspace) -> Found {
        if self.guide_mode != GuideMode::Aligned {
            return Self::judge(frame, w);
        }
        let Workspace { raw, guide, border, scratch, fit, kept, .. } = w;
        let place = |p: &Parameters, guide: &mut Stack<f32>| {
            self.place(content, p, guide, border.plane());
            border.keep_hidden(guide, kept);
        };
        register::find(frame, raw, place, guide, scratch, fit)
    }

    /// Whether the guide shows another scene. A tone curve alone can make it look so, but for its detail: if that is found,
    /// the curves are fitted and the guide is judged anew.
    fn is_foreign(
        &self,
        frame: &fit::Frame<'_>,
        found: &mut Found,
        curves: &mut [Curve; 3],
        w: &mut Workspace,
    ) -> bool {
        let foreign = found.fit.is_foreign(frame);
        if foreign && found.fit.shows_detail(frame) && self.refine(frame, curves, w) {
            while self.refine(frame, curves, w) {}
            *found = Self::judge(frame, w);
            return found.fit.is_foreign(frame);
        }
        foreign
    }

    /// Where curves leave an error of the guide's brightness, takes the guide without them and solves for a smooth error;
    /// returns in how many passes.
    fn correct_smooth_error(
        &self,
        frame: &fit::Frame<'_>,
        content: Content<'_>,
        lies: &Parameters,
        (found, curves): (&mut Found, &mut [Curve; 3]),
        hides: bool,
        w: &mut Workspace,
    ) -> usize {
        let erroneous =
            |found: &Found, already| !frame.coarse.is_empty() && found.fit.is_to_be_corrected(frame, already);
        // Light from a margin that the guide does not see is mistaken for such an error.
        let unseen = hides && !self.field.margin().is_none();
        if unseen || !erroneous(found, curves.iter().any(|curve| !curve.is_none())) {
            return 0;
        }
        // Curves, and what was solved for at the border, made up for the error: both are dropped.
        *curves = Default::default();
        self.place(content, lies, &mut w.guide, w.border.plane());
        let mut smooth = 0;
        while smooth < SMOOTH_PASSES && (smooth == 0 || erroneous(found, true)) {
            smooth += 1;
            self.correct(frame, w);
            if hides {
                self.fill(frame, w);
            }
            *found = Self::judge(frame, w);
        }
        smooth
    }

    /// Scales the guide by the gains found. Returns its mean over `brightness`, that of the guide as placed, for each channel;
    /// none if a gain is not positive.
    fn apply_gains(&self, found: &Found, brightness: &[f32; 3], w: &mut Workspace) -> Option<[f32; 3]> {
        let mut gains = [1.0; 3];
        for c in 0..self.sensor.channels {
            let gain = found.fit.gains[c] as f32;
            if gain.is_nan() || gain <= 0.0 {
                return None;
            }
            w.guide.plane_mut(c).iter_mut().for_each(|g| *g *= gain);
            gains[c] = fit::mean(w.guide.plane(c)) / brightness[c];
        }
        Some(gains)
    }

    /// Whether a colour guide is mixed for a mono sensor.
    pub(super) fn mixes(&self, content: Content<'_>) -> bool {
        self.sensor.channels == 1 && content.frame.count() == 3
    }
}
