//! Frames of a step: taken from the cameras, and averaged in groups as they arrive.

use std::time::Instant;

use super::{Calibration, Fault, GROUPS, MAX_VIEWS, PACE, PATIENCE, Take};
use crate::bundle::Draft;
use crate::live::setup::camera::SetupCamera;
use crate::live::setup::folder::place;
use crate::live::stop::Stop;
use stokescope_core::calibrate::{Shots, Step};
use stokescope_core::image::{Size, Stack};
use stokescope_core::readings::{Binned, Binning, Unit};

/// Frames of a step, averaged in groups.
pub(super) struct Taken {
    pub(super) raw: Shots,
    pub(super) guide: Option<Shots>,
    /// Frames in a group, on average.
    pub(super) each: f32,
}

/// Mean of a group of frames in the making. A reading that is saturated in one of them is saturated in the mean.
struct Group {
    sum: Stack<f32>,
    count: usize,
}

impl Group {
    fn new(count: usize, size: Size) -> Self {
        Self { sum: Stack::zeros(count, size), count: 0 }
    }

    fn add(&mut self, frame: &Stack<f32>, saturation: f32) {
        for (sum, v) in self.sum.as_mut_slice().iter_mut().zip(frame.as_slice()) {
            *sum += if *v < saturation { *v } else { f32::INFINITY };
        }
        self.count += 1;
    }

    fn mean(mut self, saturation: f32) -> Stack<f32> {
        let share = 1.0 / self.count.max(1) as f32;
        self.sum.as_mut_slice().iter_mut().for_each(|v| *v = if v.is_finite() { *v * share } else { saturation });
        self.sum
    }
}

/// One camera's part of a step: its groups, and how its frames come to the working size.
struct Series<'a> {
    camera: &'a SetupCamera,
    binning: Option<Binning>,
    binned: Binned,
    saturation: f32,
    unit: Unit,
    groups: Vec<Group>,
    number: u64,
}

impl<'a> Series<'a> {
    fn new(camera: &'a SetupCamera, binning: Option<Binning>, saturation: Option<f32>) -> Self {
        let latest = camera.latest();
        let fits = |binning: &Binning| binning.window().frame() == latest.planes.size();
        let binning = binning.filter(fits);
        let unit = if binning.is_some() { Unit::Counts } else { latest.unit() };
        let white = latest.white();
        let limit = if unit == Unit::Counts { saturation.unwrap_or(white).min(white) } else { 1.0 };
        let (binned, number) = (Binned::default(), latest.number);
        Self { camera, binning, binned, saturation: limit, unit, groups: Vec::new(), number }
    }

    /// Planes and size of a frame of the series.
    fn shape(&self) -> (usize, Size) {
        let latest = self.camera.latest();
        let whole = latest.planes.size();
        (latest.planes.count(), self.binning.as_ref().map_or(whole, |binning| binning.window().working()))
    }

    fn bytes(&self) -> usize {
        let (count, size) = self.shape();
        count * size.pixels() * size_of::<f32>()
    }

    /// Waits for the next frame and adds it to group `index`; none leaves it out.
    fn next(&mut self, index: Option<usize>, stop: &Stop) -> Result<(), Fault> {
        let begun = Instant::now();
        let role = self.camera.role;
        let latest = loop {
            if let Some(latest) = self.camera.newer(self.number, PACE) {
                break latest;
            }
            if stop.is_set() || begun.elapsed() > PATIENCE {
                let error = format!("the {role} camera gives no frames");
                return Err(Fault::new(error, "see what its lamp says, and repeat the step"));
            }
        };
        self.number = latest.number;
        let Some(index) = index else { return Ok(()) };
        let frame = match &mut self.binning {
            Some(binning) if binning.window().frame() == latest.planes.size() => {
                binning.image(&latest.planes.view().in_unit(latest.unit()), &mut self.binned);
                &self.binned.values
            }
            _ => &latest.planes,
        };
        if self.groups.len() <= index {
            self.groups.push(Group::new(frame.count(), frame.size()));
        }
        let group = &mut self.groups[index];
        if (group.sum.count(), group.sum.size()) != (frame.count(), frame.size()) {
            let error = format!("the {role} camera gives frames of another size than before");
            return Err(Fault::new(error, "leave its settings as they are while frames are taken"));
        }
        group.add(frame, self.saturation);
        Ok(())
    }

    fn shots(self, scale: f32, unit: Unit) -> Shots {
        let saturation = self.saturation;
        let scaled = |mut frame: Stack<f32>| {
            frame.as_mut_slice().iter_mut().for_each(|v| *v *= scale);
            frame
        };
        let mean = |group: Group| group.mean(saturation);
        let frames = self.groups.into_iter().map(mean).map(|frame| if scale == 1.0 { frame } else { scaled(frame) });
        Shots { frames: frames.collect(), unit }
    }
}

impl Calibration {
    /// Takes frames of the cameras that a step looks through.
    pub(super) fn collect(&self, step: Step, take: &Take, draft: &Draft, stop: &Stop) -> Result<Taken, Fault> {
        let binning = draft.binning().filter(|_| step != Step::Dark);
        let saturation = draft.known.sensor.map(|sensor| sensor.saturation).filter(|_| step != Step::Dark);
        let mut raw = Series::new(&self.raw, binning, saturation);
        let guide = self.guide.as_deref().filter(|_| matches!(step, Step::Align | Step::Verify));
        let mut guide = guide.map(|camera| Series::new(camera, None, None));
        let bytes = raw.bytes() + guide.as_ref().map_or(0, Series::bytes);
        let (most, least) = if take.dial.is_some() { (GROUPS[1], 1) } else { (GROUPS[0], 2) };
        let groups = self.groups(step, take, bytes, (least, most))?;
        let asked = self.raw.latest().asked.clone();
        // the frame that arrives next may have begun before this was asked for
        raw.next(None, stop)?;
        guide.as_mut().map_or(Ok(()), |guide| guide.next(None, stop))?;
        for n in 0..take.frames {
            let index = Some(n * groups / take.frames);
            raw.next(index, stop)?;
            guide.as_mut().map_or(Ok(()), |guide| guide.next(index, stop))?;
            if self.raw.latest().asked != asked {
                let error = format!("{step}: the settings of the camera changed while frames were taken");
                return Err(Fault::new(error, "repeat the step"));
            }
            if let Some(busy) = &mut self.inner.lock().busy {
                busy.1 = n + 1;
            }
        }
        let unit = raw.unit;
        let guide = guide.map(|guide| {
            // as the live service has it: fractions of full scale
            let white = guide.camera.latest().white();
            guide.shots(1.0 / white, Unit::FullScale)
        });
        Ok(Taken { raw: raw.shots(1.0, unit), guide, each: take.frames as f32 / groups as f32 })
    }

    /// Number of groups that frames are averaged in, as the memory beside the views that there are allows.
    fn groups(&self, step: Step, take: &Take, bytes: usize, (least, most): (usize, usize)) -> Result<usize, Fault> {
        let inner = self.inner.lock();
        let views = inner.steps.iter().flat_map(|entry| &entry.views);
        let of = |stack: &Stack<f32>| size_of_val(stack.as_slice());
        let held: usize =
            views.map(|view| view.raw.frames.iter().map(of).sum::<usize>() + view.guide.as_ref().map_or(0, of)).sum();
        let count = inner.steps[place(step)].views.len();
        if take.dial.is_some() && count >= MAX_VIEWS {
            let error = format!("{step}: {count} views, allowed: at most {MAX_VIEWS}");
            return Err(Fault::new(error, "measure with them, or begin the step again"));
        }
        let free = self.budget.saturating_sub(held);
        let fit = if take.dial.is_some() {
            free / bytes.max(1) / MAX_VIEWS.saturating_sub(count).max(1)
        } else {
            free / bytes.max(1)
        };
        let fit = if fit < least && take.dial.is_some() && free >= bytes { 1 } else { fit };
        if fit < least {
            let error = format!(
                "{step}: {least} frames of {bytes} bytes do not fit into the {free} bytes that the board's memory leaves"
            );
            return Err(Fault::new(error, "use fewer views, or a smaller mode, crop or larger bin in the board file"));
        }
        let groups = fit.clamp(least, most).min(take.frames.max(1));
        // groups of equal size, where there are some
        Ok((least..=groups).rev().find(|groups| take.frames.is_multiple_of(*groups)).unwrap_or(groups))
    }
}
