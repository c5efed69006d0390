//! A guide that is expected to lie and to shine as that of the last frame of a video.

use super::radiometry::Curve;
use super::register::{self, Parameters};
use super::track::{self, Track};
use super::{Content, GuideMode, Look, Plan, Summary, Workspace, beyond, brightness, fit, parallax};
use crate::image::correlation;

/// Correlation with the last frame's guide below which a guide is looked at anew.
const ALIKE: f64 = 0.7;

impl Plan {
    /// Places and corrects a guide as that of the last frame; none if the readings say that it lies or shines otherwise.
    pub(super) fn follow(
        &self,
        mut track: Track,
        frame: &fit::Frame<'_>,
        content: Content<'_>,
        look: Look<'_>,
        w: &mut Workspace,
        summary: &mut Summary,
    ) -> Option<Track> {
        if !track.is_fresh() {
            return None;
        }
        let shifts = track.shifts;
        let content = Content { shifts: shifts.as_ref(), ..content };
        self.place(content, &track.lies, &mut w.guide, w.border.plane());
        if track.agreement.foreign {
            return self.follow_foreign(track, frame, w, summary);
        }
        // Strong slow polarization, or a correction of brightness, can explain what another scene's guide does not: such a
        // guide does not look like the last one.
        let alike = w.guide.planes().zip(w.kept.planes()).all(|(now, before)| correlation(now, before) > ALIKE);
        if !alike {
            return None;
        }
        let exposure = track.exposure(look.mean_reading);
        let brightness = brightness(&w.guide);
        self.correct_as_before(&track, frame, (exposure, &brightness), w);
        let mut seen = track::Look::default();
        let (mut gains, mut beyond) = ([1.0; 3], beyond::Traces::default());
        for c in 0..self.sensor.channels {
            let guide = w.guide.plane_mut(c);
            let glance = w.fit.glance(frame, c, w.raw.plane_mut(c), guide, track.shares[c], &mut w.scratch);
            seen.add(&glance, &fit::moments(guide, self.field.size()));
            guide.iter_mut().for_each(|g| *g *= glance.gain as f32);
            gains[c] = fit::mean(guide) / brightness[c];
            if let Some(pattern) = frame.beyond {
                beyond.add(pattern, &w.fit.rest, self.field.size(), f64::from(fit::mean(guide)), frame.noise);
            }
        }
        if beyond.tell(beyond::GUIDED) {
            return None;
        }
        let step = track.judge(&seen, frame)?;
        if step != Parameters::zeros() {
            self.shift(&mut track, &step, content, (gains, exposure), w)?;
        }
        if track.is_slow_turn()
            && (self.asks_for_shifts(&track, frame, w) || Self::growth(frame, look.psf_size, w).is_some())
        {
            return None;
        }
        track.look();
        track.remember(gains, brightness, look.mean_reading);
        summary.shift = [track.lies[0] as f32, track.lies[1] as f32];
        (summary.gain, summary.agreement) = (Some(gains), Some(track.agreement));
        Some(track)
    }

    /// Corrects the brightness of a placed guide of mean `brightness` as that of the last frame, which was `exposure` times as bright.
    fn correct_as_before(
        &self,
        track: &Track,
        frame: &fit::Frame<'_>,
        (exposure, brightness): (f32, &[f32; 3]),
        w: &mut Workspace,
    ) {
        if track.smooth > 0 {
            (0..track.smooth).for_each(|_| self.correct(frame, w));
            return;
        }
        Self::dress(&track.curves, track.expected_gains(exposure, brightness), exposure, w);
        if w.border.hidden_count > 0 && track.is_turn() {
            self.fill(frame, w);
        }
    }

    /// Scales the guide of another scene; none if it shows this scene now, or explains nothing.
    fn follow_foreign(
        &self,
        mut track: Track,
        frame: &fit::Frame<'_>,
        w: &mut Workspace,
        summary: &mut Summary,
    ) -> Option<Track> {
        let found = Self::judge(frame, w);
        let gains = found.fit.gains.map(|g| g as f32);
        if !found.fit.is_foreign(frame) || gains[..self.sensor.channels].iter().any(|g| g.is_nan() || *g <= 0.0) {
            return None;
        }
        w.guide.planes_mut().zip(gains).for_each(|(g, gain)| g.iter_mut().for_each(|g| *g *= gain));
        track.look();
        (summary.gain, summary.agreement) = (Some(gains), Some(track.agreement));
        Some(track)
    }

    /// Whether the last channel's rest asks for local shifts of a guide that was followed.
    fn asks_for_shifts(&self, track: &Track, frame: &fit::Frame<'_>, w: &mut Workspace) -> bool {
        if self.guide_mode != GuideMode::Aligned || track.smooth > 0 {
            return false;
        }
        let Workspace { guide, border, scratch, fit, .. } = w;
        let last = self.sensor.channels - 1;
        parallax::hint(frame, (last, guide.plane(last), 1.0), track.moves(), border, scratch, fit)
    }

    /// Places the guide a step further; none if that cannot be followed.
    fn shift(
        &self,
        track: &mut Track,
        step: &Parameters,
        content: Content<'_>,
        (gains, exposure): ([f32; 3], f32),
        w: &mut Workspace,
    ) -> Option<()> {
        if self.guide_mode != GuideMode::Aligned || track.smooth > 0 {
            return None;
        }
        track.lies += step;
        if !register::is_within_reach(&track.lies, self.field.size()) {
            return None;
        }
        self.place(content, &track.lies, &mut w.guide, w.border.plane());
        self.mark_hidden(content, &track.lies, &mut w.border);
        Self::dress(&track.curves, gains, exposure, w);
        track.agreement.hidden = self.hidden_share(w);
        Some(())
    }

    /// Applies curves and gains to the guide as placed, and takes the last frame's guide where it is hidden.
    fn dress(curves: &[Curve; 3], gains: [f32; 3], exposure: f32, w: &mut Workspace) {
        let Workspace { guide, kept, border, .. } = w;
        let size = guide.size();
        for (((guide, kept), gain), curve) in guide.planes_mut().zip(kept.planes()).zip(gains).zip(curves) {
            // Gains are those of the mean, whatever the curve makes of it.
            let before = fit::mean(guide);
            curve.apply(guide, size);
            let gain = if curve.is_none() { gain } else { gain * before / fit::mean(guide) };
            for ((g, kept), hidden) in guide.iter_mut().zip(kept).zip(&border.hidden) {
                *g = if *hidden { kept * exposure } else { *g * gain };
            }
        }
    }
}
