//! Scale of counts: clipping below the declared saturation, and samples of another bit depth or alignment, found in the frame itself.

use std::fmt;

/// Levels below the largest reading that are compared with it, at most.
const LEVELS: usize = 512;
/// Share of the range of the readings that these levels are.
const NEAR: f32 = 1.0 / 128.0;
/// Equal readings at the top that clipping leaves, at least …
const CLIPPED_MIN: u32 = 16;
/// … and more than so many times those of any level below: without clipping, few readings are the largest.
const ABOVE_OTHERS: u32 = 4;
/// Levels between the smallest and the largest reading from which on their distribution tells something.
const RANGE: f32 = 32.0;

/// How integer readings contradict the scale of counts that is declared for them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OffScale {
    /// Many readings are exactly `level` and none is above: they are clipped there, below the declared saturation.
    Clipped {
        /// Largest reading, in counts.
        level: f32,
        /// Declared saturation, in counts.
        saturation: f32,
    },
    /// Readings have more bits than the declared saturation.
    Deeper {
        /// Largest reading, in counts.
        largest: f32,
        /// Declared saturation, in counts.
        saturation: f32,
    },
    /// All readings are multiples of a power of two, as left-aligned samples are, and the declared saturation is not.
    LeftAligned {
        /// The power of two.
        step: u32,
        /// Declared saturation, in counts.
        saturation: f32,
    },
    /// The declared saturation is that of left-aligned samples, and the readings are low-aligned.
    LowAligned {
        /// Largest reading, in counts.
        largest: f32,
        /// Declared saturation, in counts.
        saturation: f32,
    },
    /// Floating-point readings are counts rather than fractions of full scale.
    Counts {
        /// Largest reading.
        largest: f32,
    },
}

impl fmt::Display for OffScale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const REMEDY: &str =
            "set bit_depth, black_level and saturation of the bundle's [sensor] to those of these frames";
        match *self {
            Self::Clipped { level, saturation } => write!(
                f,
                "the raw readings are clipped at {level} counts, below the declared saturation of {saturation}, and were ignored from there \
                 on: set saturation of the bundle's [sensor] to {level} if the camera reaches no more, and lower the exposure"
            ),
            Self::Deeper { largest, saturation } => write!(
                f,
                "raw readings up to {largest} counts have more bits than the declared saturation of {saturation}: {REMEDY}"
            ),
            Self::LeftAligned { step, saturation } => write!(
                f,
                "all raw readings are multiples of {step}, so the samples are left-aligned, and the declared saturation of {saturation} is \
                 none: {REMEDY}"
            ),
            Self::LowAligned { largest, saturation } => write!(
                f,
                "the declared saturation of {saturation} is that of left-aligned samples, and the raw readings, up to {largest} counts, are \
                 low-aligned: {REMEDY}"
            ),
            Self::Counts { largest } => write!(
                f,
                "floating-point raw readings up to {largest} are no fractions of full scale: give counts as integers, or say that the unit is \
                 counts"
            ),
        }
    }
}

impl OffScale {
    /// How the readings of a plane, in counts, contradict their declared saturation: by clipping below it, or by their bit depth or alignment.
    pub(crate) fn find(plane: &[f32], saturation: f32) -> Option<Self> {
        let finite = || plane.iter().copied().filter(|v| v.is_finite());
        let (lowest, highest) = finite().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        if highest < lowest {
            return None;
        }
        let step = common_step(finite(), 0);
        let mut top = Top::new(lowest, highest, step).filter(|_| highest < saturation);
        if let Some(top) = &mut top {
            finite().for_each(|v| top.add(v));
        }
        let clipped = top.and_then(|top| top.clipped()).map(|level| Self::Clipped { level, saturation });
        clipped.or_else(|| Self::of_samples(step, highest, highest - lowest, saturation))
    }

    /// Judges bit depth and alignment of readings up to `largest` over a range of `range` counts that are all multiples of `step`.
    pub(crate) fn of_samples(step: u32, largest: f32, range: f32, saturation: f32) -> Option<Self> {
        let declared = saturation as u32;
        if largest as u32 >= (declared + 1).next_power_of_two() {
            return Some(Self::Deeper { largest, saturation });
        }
        if declared == 0 || range < RANGE * step as f32 {
            return None;
        }
        let step = step & step.wrapping_neg();
        if step > 1 && !declared.is_multiple_of(step) {
            return Some(Self::LeftAligned { step, saturation });
        }
        // of 16 bits, of which the lower ones are never used
        let unused = declared.trailing_zeros();
        let left_aligned = unused > 0 && declared >= 1 << 15 && ((declared >> unused) + 1).is_power_of_two();
        let low = step < 1 << unused && largest as u32 <= declared >> unused;
        (left_aligned && low).then_some(Self::LowAligned { largest, saturation })
    }
}

/// Greatest common divisor of integer readings; 1 for other numbers, 0 where all are 0. Ends as soon as it is 1.
pub(crate) fn common_step(readings: impl IntoIterator<Item = f32>, mut step: u32) -> u32 {
    for v in readings {
        let (mut a, mut b) = (v as u32, step);
        if a as f32 != v {
            return 1;
        }
        while a != 0 {
            (a, b) = (b % a, a);
        }
        step = b;
        if step == 1 {
            break;
        }
    }
    step
}

/// Number of readings at each of the levels next to the largest one of a plane.
#[derive(Debug)]
pub(crate) struct Top {
    highest: f32,
    near: usize,
    counts: [u32; LEVELS + 1],
}

impl Top {
    /// Counts for readings from `lowest` to `highest`; none if these levels are too few to tell, at multiples of `step`.
    pub(crate) fn new(lowest: f32, highest: f32, step: u32) -> Option<Self> {
        let range = highest - lowest;
        let enough = range.is_finite() && range >= RANGE * step.max(1) as f32;
        enough.then(|| Self { highest, near: ((NEAR * range) as usize).clamp(1, LEVELS), counts: [0; LEVELS + 1] })
    }

    /// The lowest level that is counted.
    pub(crate) fn lowest(&self) -> f32 {
        self.highest - self.near as f32
    }

    /// Counts a reading; one below [`Self::lowest`] does not matter.
    pub(crate) fn add(&mut self, v: f32) {
        if v >= self.lowest() && v <= self.highest {
            self.counts[(self.highest - v).round() as usize] += 1;
        }
    }

    /// The level at which the readings are clipped.
    pub(crate) fn clipped(&self) -> Option<f32> {
        let [top, others @ ..] = &self.counts;
        let most = others[..self.near].iter().copied().max().unwrap_or(0);
        (*top >= CLIPPED_MIN && *top > ABOVE_OTHERS * most).then_some(self.highest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::noise::normal;

    fn clipped(values: &[f32]) -> Option<f32> {
        let fold = |start, f: fn(f32, f32) -> f32| values.iter().copied().fold(start, f);
        let step = common_step(values.iter().copied(), 0);
        let mut top = Top::new(fold(f32::INFINITY, f32::min), fold(f32::NEG_INFINITY, f32::max), step)?;
        values.iter().for_each(|v| top.add(*v));
        top.clipped()
    }

    #[test]
    fn a_plateau_is_clipping_and_the_top_of_noise_or_of_smooth_light_is_none() {
        let noise = normal(60_000, 8.0, 3);
        let light = |i: usize| 1000.0 + 2500.0 * (i as f32 / 60_000.0);
        let values: Vec<f32> = noise.iter().enumerate().map(|(i, v)| (light(i) + v).round()).collect();
        assert_eq!(clipped(&values), None);
        let at = |level: f32, scale: f32| values.iter().map(|v| v.min(level) * scale).collect::<Vec<_>>();
        assert_eq!(clipped(&at(3490.0, 1.0)), Some(3490.0), "less than 1 %");
        assert_eq!(clipped(&at(3000.0, 1.0)), Some(3000.0));
        assert_eq!(clipped(&at(3000.0, 16.0)), Some(48_000.0), "left-aligned");
        // smooth light without noise, of 8 bits and of 8 bits spread over 16
        let bump = |i: usize| (200.0 - 0.002 * (i as f32 - 30_000.0).abs().powf(1.1)).round();
        for scale in [1.0, 257.0, 256.0] {
            let values: Vec<f32> = (0..60_000).map(|i| bump(i) * scale).collect();
            assert_eq!(clipped(&values), None, "{scale}");
        }
        let dark: Vec<f32> = noise.iter().map(|v| (0.2 * v + 64.0).round()).collect();
        assert_eq!(clipped(&dark), None);
    }

    #[test]
    fn bit_depth_and_alignment_are_judged_against_the_saturation() {
        let of = |step, largest, saturation| OffScale::of_samples(step, largest, largest, saturation);
        for (step, largest, saturation) in [
            (1, 4095.0, 4095.0),
            (16, 65520.0, 65520.0),
            (1, 65535.0, 60000.0),
            (16, 30000.0, 4000.0 * 16.0),
            (2, 40.0, 255.0),
        ] {
            assert_eq!(of(step, largest, saturation), None, "{step} {largest} {saturation}");
        }
        assert_eq!(of(16, 65520.0, 4095.0), Some(OffScale::Deeper { largest: 65520.0, saturation: 4095.0 }));
        assert_eq!(of(16, 40000.0, 65535.0), Some(OffScale::LeftAligned { step: 16, saturation: 65535.0 }));
        assert_eq!(of(1, 3000.0, 65520.0), Some(OffScale::LowAligned { largest: 3000.0, saturation: 65520.0 }));
        assert_eq!(common_step([0.0, 48.0, 160.0], 0), 16);
        assert_eq!(common_step([48.5, 160.0], 0), 1);
    }
}
