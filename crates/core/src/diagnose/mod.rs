//! How far a result can be believed, and what is wrong where it cannot.
//!
//! [`Figures`] of every frame give a [`Verdict`]. [`Pipeline::diagnose`](crate::Pipeline::diagnose) tries other set-ups on the latest frame
//! and its guide — PSF, mask, frame or guide turned, another PSF size, other stripes, another order of angles — and names those under
//! which the readings are explained better than under the declared one, each with its [remedy](Fault::remedy).
//!
//! Some faults leave no trace in any reading: an order of angles that is reversed or begins elsewhere turns all angles of polarization
//! and fits as well. Only light of known polarization shows them (`stokescope calibrate verify`).
//!
//! Allocation: trials allocate; figures and verdicts do not.

mod trial;

use std::fmt;
use std::sync::Arc;

use num_complex::Complex32;

use crate::device::Device;
use crate::image::{Planes, Size};
use crate::optics::LengthError;
use crate::parallel::Workers;
use crate::readings::Readings;
use trial::{Blurred, Response, Rest, Stray, Trial};

/// How far a result can be believed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    /// Nothing speaks against it.
    #[default]
    Credible,
    /// The solver was stopped before it explains the readings, or is a reference method that never does: they say nothing about the set-up.
    NotJudged,
    /// Something is off; the result may be wrong in part.
    Doubtful,
    /// The readings contradict the set-up or hold too little light.
    NotCredible,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Credible => "credible",
            Self::NotJudged => "not judged",
            Self::Doubtful => "doubtful",
            Self::NotCredible => "not credible",
        })
    }
}

/// Residual over noise from which a result is doubtful, and from which it is not credible.
const RESIDUAL: [f32; 2] = [1.5, 3.0];
/// Mean reading over noise below which a result is doubtful, and below which it is not credible.
const LIGHT: [f32; 2] = [4.0, 1.0];
/// Share of saturated readings from which a result is doubtful, and from which it is not credible.
const SATURATED: [f32; 2] = [0.1, 0.5];
/// A set-up is suspected if its fit leaves less than this share of the sum of squares that the declared one leaves.
const BETTER: f32 = 0.8;
/// This share where the solver does not explain the readings: something is wrong then, and the likeliest is named.
const BETTER_THAN_WRONG: f32 = 0.9;
/// A rest of this many times the noise is none.
const NOISE: f64 = 1.2;
/// The true set-up leaves no more than this many times the noise, and this share of the mean reading. Light from beyond the frame that the
/// guide does not see leaves more under any set-up, of which one may fit it by chance.
const TRUE_NOISE: f64 = 40.0;
const TRUE_SHARE: f64 = 0.02;
/// Smallest shift of a guide that is a fault, in pixels.
const SHIFTED: f32 = 4.0;
/// A black level beside light from beyond the frame leaves less than this share of the sum of squares that such light alone leaves, is
/// more than this share of the mean reading, and leaves little more than smooth stray light does. Right set-ups find less than 0.05 of the
/// mean reading; a guide that weighs colours otherwise than the sensor may find more, and leaves more.
const BESIDE_LIGHT: f64 = 0.92;
const LEVEL: f64 = 0.08;
const LITTLE_MORE: f64 = 2.0;
/// Bytes that a trial allocates, at most, and gives back.
pub const TRIAL_BYTES: usize = 24 << 20;
/// Suspects that are named.
const NAMED: usize = 3;

/// Figures of one frame on which its verdict rests.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Figures {
    /// Root mean square residual over the noise of the readings, or over 0.2 % of the mean reading if that is more; 1 where the model
    /// explains everything.
    pub residual_over_noise: f32,
    /// Mean reading over the noise of a reading.
    pub light_over_noise: f32,
    /// Share of saturated readings.
    pub saturated: f32,
    /// Whether the guide shows another scene, or nothing.
    pub foreign_guide: bool,
    /// Whether the residual tells of the set-up: the solver is one of this program's own and was given its usual iterations.
    pub settled: bool,
}

impl Figures {
    /// Whether the solver explains the readings beside the guide: what is left is noise.
    pub(crate) fn explains(&self) -> bool {
        self.residual_over_noise < RESIDUAL[0] && !self.foreign_guide
    }

    /// The verdict of these figures alone.
    pub fn verdict(&self) -> Verdict {
        let over = |v: f32, [doubtful, wrong]: [f32; 2]| grade(v > doubtful, v > wrong);
        let [dim, dark] = LIGHT;
        let foreign = grade(self.foreign_guide, false);
        let light = grade(self.light_over_noise < dim, self.light_over_noise < dark);
        let residual = match over(self.residual_over_noise, RESIDUAL) {
            Verdict::Doubtful | Verdict::NotCredible if !self.settled => Verdict::NotJudged,
            residual => residual,
        };
        residual.max(over(self.saturated, SATURATED)).max(light).max(foreign)
    }

    /// Faults that these figures show without a trial.
    pub fn suspects(&self) -> impl Iterator<Item = Suspect> {
        let suspect = |is: bool, fault| is.then_some(Suspect { fault, rest: 1.0 });
        [
            suspect(self.light_over_noise < LIGHT[0], Fault::TooLittleLight { over_noise: self.light_over_noise }),
            suspect(self.saturated > SATURATED[0], Fault::Saturated { share: self.saturated }),
            suspect(self.foreign_guide, Fault::ForeignGuide),
        ]
        .into_iter()
        .flatten()
    }

    /// These faults together with those that trials found, the likeliest first. A dim or clipped frame tells more than trials on it; a
    /// guide seems foreign for any other reason too. Allocates where there are any.
    pub fn suspects_with(&self, tried: &[Suspect]) -> Vec<Suspect> {
        let own = |foreign| self.suspects().filter(move |s| (s.fault == Fault::ForeignGuide) == foreign);
        let last = own(true).filter(|_| tried.is_empty());
        own(false).chain(tried.iter().copied()).chain(last).collect()
    }
}

fn grade(doubtful: bool, wrong: bool) -> Verdict {
    match (doubtful, wrong) {
        (_, true) => Verdict::NotCredible,
        (true, false) => Verdict::Doubtful,
        _ => Verdict::Credible,
    }
}

/// A set-up that explains the readings better than the declared one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Suspect {
    /// The fault.
    pub fault: Fault,
    /// Mean square that it leaves of the readings over what the declared set-up leaves, 0 to 1; 1 where nothing was tried.
    pub rest: f32,
}

impl Suspect {
    /// The verdict on results under a set-up of which this is suspected: doubtful. Only [`Figures`] make a
    /// result not credible.
    pub fn verdict(&self) -> Verdict {
        // Only a plain level is named.
        grade(self.rest < BETTER || matches!(self.fault, Fault::BlackLevel { .. }), false)
    }
}

/// A turn or reflection of an array.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Turn {
    /// By 90°, counter-clockwise.
    Quarter,
    /// By 180°.
    Half,
    /// By 270°, counter-clockwise.
    ThreeQuarters,
    /// Left and right swapped.
    Mirror,
    /// Top and bottom swapped.
    Flip,
    /// Rows and columns swapped.
    Transpose,
    /// Rows and columns swapped, and turned by 180°.
    AntiTranspose,
}

impl Turn {
    const ALL: [Self; 7] = [
        Self::Half,
        Self::Mirror,
        Self::Flip,
        Self::Transpose,
        Self::Quarter,
        Self::ThreeQuarters,
        Self::AntiTranspose,
    ];

    /// Whether rows become columns.
    fn swaps(self) -> bool {
        !matches!(self, Self::Half | Self::Mirror | Self::Flip)
    }

    /// Signs of x and y after they were swapped, where they are.
    fn signs(self) -> (f64, f64) {
        match self {
            Self::Transpose => (1.0, 1.0),
            Self::Quarter | Self::Mirror => (-1.0, 1.0),
            Self::ThreeQuarters | Self::Flip => (1.0, -1.0),
            Self::Half | Self::AntiTranspose => (-1.0, -1.0),
        }
    }

    /// Index of the pixel that comes to lie at index `i` of an image, square where sides are swapped.
    fn source(self, i: usize, Size { width, height }: Size) -> usize {
        let (x, y) = (i % width, i / width);
        let (x, y) = if self.swaps() { (y, x) } else { (x, y) };
        let (sx, sy) = self.signs();
        let along = |v: usize, sign: f64, n: usize| if sign < 0.0 { n - 1 - v } else { v };
        along(y, sy, height) * width + along(x, sx, width)
    }

    /// Where a displacement of a PSF goes when its file, of `size`, is turned so.
    fn displaced(self, (dx, dy): (f64, f64), Size { width, height }: Size) -> (f64, f64) {
        let (dx, dy) = if self.swaps() { (dy, dx) } else { (dx, dy) };
        let (sx, sy) = self.signs();
        // The zero displacement of an even side is half a pixel off its middle.
        let off = |sign: f64, n: usize| if sign < 0.0 && n.is_multiple_of(2) { -1.0 } else { 0.0 };
        (sx * dx + off(sx, width), sy * dy + off(sy, height))
    }

    fn remedy(self) -> &'static str {
        match self {
            Self::Half => "turn it by 180°",
            Self::Mirror => "swap its left and right",
            Self::Flip => "swap its top and bottom",
            Self::Transpose => "swap its rows and columns (transpose it)",
            Self::Quarter | Self::ThreeQuarters => "turn it by 90°",
            Self::AntiTranspose => "swap its rows and columns and turn it by 180°",
        }
    }
}

impl fmt::Display for Turn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Half => "turned by 180°",
            Self::Mirror => "mirrored left to right",
            Self::Flip => "mirrored top to bottom",
            Self::Transpose => "transposed",
            Self::Quarter | Self::ThreeQuarters => "turned by 90°",
            Self::AntiTranspose => "transposed and turned by 180°",
        })
    }
}

/// Something that is wrong with a set-up or a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Fault {
    /// The PSF's file is turned or mirrored.
    PsfTurned(Turn),
    /// The PSF has another size than the declared one.
    PsfScaled {
        /// True size over the declared size.
        scale: f64,
    },
    /// The mask lies turned or mirrored on the sensor.
    MaskTurned(Turn),
    /// The mask's stripes have another width.
    Stripes {
        /// Their width over the declared one.
        factor: f64,
    },
    /// The mask's angles come in another order.
    AngleOrder {
        /// Position in the declared list of each angle in the true order; three or four angles.
        order: [usize; 4],
        /// Number of angles.
        count: usize,
    },
    /// The raw frame is turned or mirrored against the calibration.
    RawTurned(Turn),
    /// The guide is turned or mirrored.
    GuideTurned(Turn),
    /// The guide's content lies elsewhere.
    GuideShifted {
        /// Pixels right and down that it has to be moved.
        by: [f32; 2],
    },
    /// The readings stand on a level that the set-up does not declare.
    BlackLevel {
        /// The level above the declared one, fraction of full scale.
        level: f32,
    },
    /// There is hardly any light.
    TooLittleLight {
        /// Mean reading over the noise.
        over_noise: f32,
    },
    /// Many readings are saturated.
    Saturated {
        /// Their share.
        share: f32,
    },
    /// The guide shows another scene.
    ForeignGuide,
}

impl fmt::Display for Fault {
    /// Says what is wrong.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::PsfTurned(turn) => write!(f, "the psf file is {turn}"),
            Self::PsfScaled { scale } => write!(f, "the psf is about {} than the file's", percent(scale)),
            Self::MaskTurned(turn) => write!(f, "the mask is {turn}"),
            Self::Stripes { factor } => write!(f, "the mask's stripes are {factor} times as wide as declared"),
            Self::AngleOrder { .. } => f.write_str("the mask's angles are in another order"),
            Self::RawTurned(turn) => write!(f, "the raw frame is {turn} against the calibration"),
            Self::GuideTurned(turn) => write!(f, "the guide is {turn}"),
            Self::GuideShifted { by: [right, down] } => {
                write!(
                    f,
                    "the guide lies {:.0} px from its place ({:+.0} right, {:+.0} down)",
                    right.hypot(down),
                    -right,
                    -down
                )
            }
            Self::BlackLevel { level } => {
                write!(f, "the readings stand on a level of {:.2} % of full scale that is not declared", 100.0 * level)
            }
            Self::TooLittleLight { over_noise } => {
                write!(f, "there is too little light: the mean reading is {over_noise:.1} times the noise")
            }
            Self::Saturated { share } => write!(f, "{:.0} % of the readings are saturated", 100.0 * share),
            Self::ForeignGuide => f.write_str("the guide shows another scene or nothing of this one"),
        }
    }
}

fn percent(scale: f64) -> String {
    format!("{:.0} % {}", 100.0 * (scale - 1.0).abs(), if scale > 1.0 { "larger" } else { "smaller" })
}

impl Fault {
    /// Remedy, as a clause.
    pub fn remedy(&self) -> String {
        match *self {
            Self::PsfTurned(turn) => format!("{} in the bundle", turn.remedy()),
            Self::PsfScaled { scale } => format!(
                "measure it anew at this distance and focus, or scale the file by {scale:.2}; check that no binning or resizing lies between"
            ),
            Self::MaskTurned(turn) => format!("measure the mask (calibrate mask), or {} in the bundle", turn.remedy()),
            Self::Stripes { factor } => format!("multiply stripes under [mask] by {}", factor.recip()),
            Self::AngleOrder { order, count } => format!(
                "list the angles under [mask] in the order {}, counted from 1 in the present list, and check it with calibrate verify",
                order[..count].iter().map(|p| (p + 1).to_string()).collect::<Vec<_>>().join(", ")
            ),
            Self::RawTurned(turn) => format!("undo the camera's rotation or mirroring since the calibration: {}", turn.remedy()),
            Self::GuideTurned(turn) => format!("{}, or set [guide] homography (calibrate align)", turn.remedy()),
            Self::GuideShifted { .. } => "run calibrate align, or set [guide] homography".to_owned(),
            Self::BlackLevel { .. } => "set black_level or take a dark frame (calibrate dark), and shut out stray light".to_owned(),
            Self::TooLittleLight { .. } => "expose longer or add light".to_owned(),
            Self::Saturated { .. } => "expose shorter, and check bit_depth under [sensor]".to_owned(),
            Self::ForeignGuide => {
                "check that guide and raw frame were taken of the same scene, and where the guide lies (calibrate align)".to_owned()
            }
        }
    }
}

/// A solved frame, as far as trials need it.
pub(crate) struct Solved {
    /// Where the guide's content lies in the frame, right and down, in pixels.
    pub(crate) shift_px: [f32; 2],
    /// Standard deviation of the readings' noise.
    pub(crate) noise: f32,
    /// Whether the solver explains the readings beside the guide: what is left is noise.
    pub(crate) explained: bool,
    /// Whether light from beyond the frame is modelled.
    pub(crate) light_modelled: bool,
    /// Weights of a colour guide's channels beside a mono sensor, where they are known or were found.
    pub(crate) weights: Option<[f32; 3]>,
}

/// Set-ups that explain the frame better than the declared one, the best first. `report` is that of the frame.
///
/// # Errors
/// [`LengthError`] when there is no transform long enough.
pub(crate) fn suspects(
    device: &Device,
    readings: &Readings,
    guide: Planes<'_>,
    solved: &Solved,
    workers: Arc<Workers>,
) -> Result<Vec<Suspect>, LengthError> {
    let mut trial = Trial::new(device, readings, (guide, solved.weights), workers)?;
    let bin = trial.bin() as f32;
    let (shift, noise) = (solved.shift_px, f64::from(solved.noise / bin).powi(2));
    let floor = NOISE * noise;
    // Where the solver explains the readings with light from beyond the frame, only a set-up that does so too is suspected.
    let most = if solved.explained && solved.light_modelled {
        TRUE_NOISE * noise + (TRUE_SHARE * f64::from(readings.quality.mean)).powi(2)
    } else {
        f64::INFINITY
    };
    let mut images = trial.blur(|x, y| (x, y));
    let mut declared = trial.left(&images);
    let mut found = Vec::new();
    // The guide's place first: everything else is tried with the guide where it belongs.
    let moved = trial.shift(&images);
    if moved != [0, 0] {
        trial.shift_guide(moved);
        let there = trial.blur(|x, y| (x, y));
        let rest = trial.left(&there);
        // `shift` is where the guide's content lies, `moved` what brings it back.
        let by = moved.map(|v| v as f32 * bin);
        let aligned = (by[0] + shift[0]).hypot(by[1] + shift[1]) < SHIFTED;
        if !aligned && by[0].hypot(by[1]) >= SHIFTED {
            found.push((Fault::GuideShifted { by }, rest));
        }
        if rest < declared && aligned {
            (images, declared) = (there, rest);
        } else {
            trial.shift_guide(moved.map(|v| -v));
        }
    }
    // Light from beyond the frame that the guide does not see is smooth at its source, not on the sensor.
    let light = trial.light_from_beyond();
    let beside_light = trial.rest(&images, &trial.declared, Stray::Beyond(&light)).mean_square;
    if declared <= floor {
        // A black level passes for smooth stray light, and nothing else is left to explain.
        let level = trial.try_black_level(&images, &light, (beside_light, most.min(LITTLE_MORE * floor)));
        return Ok(level.into_iter().filter(|_| found.is_empty()).collect());
    }
    trial.try_psfs(&mut found);
    trial.try_masks(&images, &mut found);
    trial.try_turns(&images, &mut found);
    found.retain(|(_, rest)| *rest <= most);
    let least = declared.min(beside_light);
    let suspect = |(fault, rest): (Fault, f64)| Suspect { fault, rest: (rest.max(floor) / least).min(1.0) as f32 };
    let mut suspects: Vec<_> = found.into_iter().map(suspect).collect();
    let better = if solved.explained { BETTER } else { BETTER_THAN_WRONG };
    suspects.retain(|s| s.rest < better);
    if suspects.is_empty() {
        suspects.extend(trial.try_black_level(&images, &light, (beside_light, most.min(LITTLE_MORE * declared))));
    }
    suspects.sort_by(|a, b| a.rest.total_cmp(&b.rest));
    suspects.truncate(NAMED);
    Ok(suspects)
}

impl Trial<'_> {
    fn left(&self, images: &Blurred) -> f64 {
        self.rest(images, &self.declared, Stray::Smooth).mean_square
    }

    fn try_psfs(&mut self, found: &mut Vec<(Fault, f64)>) {
        let size = self.sensor_size();
        for turn in Turn::ALL {
            let images = self.blur(|x, y| turn.displaced((x, y), size));
            found.push((Fault::PsfTurned(turn), self.left(&images)));
        }
        for scale in [0.9, 0.95, 1.05, 1.1] {
            let images = self.blur(|x, y| (scale * x, scale * y));
            found.push((Fault::PsfScaled { scale }, self.left(&images)));
        }
    }

    fn try_masks(&self, images: &Blurred, found: &mut Vec<(Fault, f64)>) {
        if !self.tells_masks() {
            return;
        }
        let (size, mask) = (self.size(), &self.declared);
        let left = |mask: &Response| self.rest(images, mask, Stray::Smooth).mean_square;
        for turn in Turn::ALL.into_iter().filter(|turn| !turn.swaps() || size.width == size.height) {
            found.push((Fault::MaskTurned(turn), left(&mask.turned(size, turn))));
        }
        for factor in [0.5, 2.0] {
            found.push((Fault::Stripes { factor }, left(&mask.widened(size, factor))));
        }
        let angles: Vec<Complex32> =
            self.angles().iter().map(|a| Complex32::new(a.cos2() as f32, a.sin2() as f32)).collect();
        // Orders that differ by where they begin or by their sense leave no trace.
        let orders: &[[usize; 4]] = match angles.len() {
            4 => &[[0, 2, 1, 3], [0, 1, 3, 2]],
            _ => &[],
        };
        for order in orders {
            let to: Vec<_> = order[..angles.len()].iter().map(|p| angles[*p]).collect();
            let fault = Fault::AngleOrder { order: *order, count: angles.len() };
            found.push((fault, left(&mask.relabelled(&angles, &to))));
        }
    }

    fn try_turns(&mut self, images: &Blurred, found: &mut Vec<(Fault, f64)>) {
        for turn in [Turn::Half, Turn::Mirror, Turn::Flip] {
            self.turn_readings(turn);
            found.push((Fault::RawTurned(turn), self.left(images)));
            self.turn_readings(turn);
        }
        // The guide is turned with its margin, which need not be the same on all sides.
        let field = self.field_size();
        let square = field.width == field.height;
        let there_and_back = [
            (Turn::Half, Turn::Half),
            (Turn::Mirror, Turn::Mirror),
            (Turn::Flip, Turn::Flip),
            (Turn::Quarter, Turn::ThreeQuarters),
            (Turn::ThreeQuarters, Turn::Quarter),
        ];
        for (turn, back) in there_and_back.into_iter().filter(|(turn, _)| square || !turn.swaps()) {
            self.turn_guide(turn);
            let turned = self.blur(|x, y| (x, y));
            found.push((Fault::GuideTurned(turn), self.left(&turned)));
            self.turn_guide(back);
        }
    }

    /// A level under the readings that no light from beyond the frame explains.
    /// `without` is what is left beside such light, and `most` what may be left beside both.
    fn try_black_level(&self, images: &Blurred, light: &[Vec<f32>], (without, most): (f64, f64)) -> Option<Suspect> {
        let Rest { mean_square, constant } = self.rest(images, &self.declared, Stray::ConstantAndBeyond(light));
        let plain = mean_square < BESIDE_LIGHT * without && constant > LEVEL * self.mean_reading();
        let rest = (mean_square / without.max(f64::MIN_POSITIVE)) as f32;
        (plain && mean_square <= most).then_some(Suspect { fault: Fault::BlackLevel { level: constant as f32 }, rest })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_are_those_of_numpy() {
        // [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
        let size = Size::new(3, 3);
        let turned = |turn: Turn| (0..9).map(|i| turn.source(i, size)).collect::<Vec<_>>();
        assert_eq!(turned(Turn::Quarter), [2, 5, 8, 1, 4, 7, 0, 3, 6]);
        assert_eq!(turned(Turn::ThreeQuarters), [6, 3, 0, 7, 4, 1, 8, 5, 2]);
        assert_eq!(turned(Turn::Mirror), [2, 1, 0, 5, 4, 3, 8, 7, 6]);
        assert_eq!(turned(Turn::Transpose), [0, 3, 6, 1, 4, 7, 2, 5, 8]);
        assert_eq!(turned(Turn::AntiTranspose), [8, 5, 2, 7, 4, 1, 6, 3, 0]);
    }

    #[test]
    fn verdicts_grow_with_the_figures() {
        let right = Figures { residual_over_noise: 1.0, light_over_noise: 60.0, settled: true, ..Figures::default() };
        assert_eq!(right.verdict(), Verdict::Credible);
        assert_eq!(right.suspects().count(), 0);
        assert_eq!(Figures { residual_over_noise: 2.0, ..right }.verdict(), Verdict::Doubtful);
        assert_eq!(Figures { residual_over_noise: 4.0, ..right }.verdict(), Verdict::NotCredible);
        assert_eq!(Figures { residual_over_noise: 4.0, settled: false, ..right }.verdict(), Verdict::NotJudged);
        assert_eq!(Figures { settled: false, ..right }.verdict(), Verdict::Credible);
        let dim = Figures { light_over_noise: 0.5, ..right };
        assert_eq!(dim.verdict(), Verdict::NotCredible);
        assert!(dim.suspects().next().unwrap().fault.remedy().contains("expose longer"));
    }
}
