use std::borrow::Cow;
use std::io;
use std::path::Path;

use super::panel::{Legend, panel, write_png};
use super::{OutputError, Report};
use crate::files::{encode_npy, write_atomic, write_npy};
use stokescope_core::image::{Size, Stack};
use stokescope_core::polarization::Angle;
use stokescope_core::polarization::color::{self, AolpMode};
use stokescope_core::uncertainty::{self, aolp_error_degrees};

const REPORT: &str = "report.json";
/// Files of a result with polarization.
const POLARIZED: [&str; 5] = ["angles.npy", "dolp.png", "aolp.png", "composite.png", STAGE1];
/// Angle images of stage I, before the fusion model.
const STAGE1: &str = "stage1_angles.npy";
/// Standard errors of the Stokes images.
const ERRORS: &str = "stokes_error.npy";

/// Borrowed images of one result.
#[derive(Clone, Copy, Debug)]
pub struct ResultImages<'a> {
    /// Size of every plane.
    pub size: Size,
    /// Colour channels C: 1 or 3.
    pub channels: usize,
    /// Intensities behind ideal polarizers, `[C·P, H, W]`, in units of full scale, if the method solves for them; otherwise they are
    /// computed from `stokes`.
    pub angles: Option<&'a Stack<f32>>,
    /// The P polarizer angles; empty without a mask.
    pub angle_list: &'a [Angle],
    /// Stokes images in units of full scale: S0, S1, S2 per channel `[C·3, H, W]`, or S0 alone `[C, H, W]` without a mask.
    pub stokes: &'a Stack<f32>,
    /// Standard errors of `stokes`, of the same shape, if they are known.
    pub errors: Option<&'a Stack<f32>>,
    /// Validity of each pixel: its reading is neither saturated nor bad.
    pub valid: &'a [bool],
    /// Angle images of stage I, if a fusion model changed the result.
    pub stage1: Option<&'a Stack<f32>>,
}

impl ResultImages<'_> {
    /// Stokes component 0, 1 or 2 of pixel `i`, summed over the channels; 0 if it was not solved for.
    pub fn stokes_at(&self, component: usize, i: usize) -> f32 {
        let per_channel = self.stokes.count() / self.channels;
        if component >= per_channel {
            return 0.0;
        }
        (0..self.channels).map(|c| self.stokes.plane(c * per_channel + component)[i]).sum()
    }

    /// S0, S1 and S2 of pixel `i` and their standard errors, both summed over the channels; none without polarization or errors.
    pub fn errors_at(&self, i: usize) -> Option<[[f32; 3]; 2]> {
        let errors = self.errors.filter(|_| self.stokes.count() == 3 * self.channels)?;
        Some(uncertainty::summed(self.stokes, errors, i))
    }

    /// Whether the angle of pixel `i` means anything: √(S1² + S2²) is above its standard error, or no error is known.
    pub fn has_angle(&self, i: usize) -> bool {
        self.errors_at(i).is_none_or(|[stokes, errors]| aolp_error_degrees(stokes, errors).is_some())
    }
}

/// Writes a result into the folder `dir`, which is created if needed.
///
/// The files are `stokes.npy` and `intensity.png`, `stokes_error.npy` where errors are known, with a mask also `angles.npy`, `dolp.png`,
/// `aolp.png` and `composite.png`, and `report.json` last. Each file appears whole or not at all, and the report exists only while all files of its result do. Files of
/// an earlier result are replaced or removed.
///
/// DoLP, AoLP and composite of a colour camera are those of the Stokes images summed over the channels.
///
/// # Errors
/// [`OutputError`]: sizes that do not match, values that are not finite, files that cannot be written.
pub fn write_all(dir: &Path, images: &ResultImages<'_>, report: &Report) -> Result<(), OutputError> {
    let polarized = check(images)?;
    let ResultImages { size, channels, angles, angle_list, stokes, .. } = *images;
    std::fs::create_dir_all(dir).map_err(|source| OutputError::Folder { path: dir.to_path_buf(), source })?;
    remove(dir, REPORT)?;
    POLARIZED.iter().chain([&ERRORS]).try_for_each(|name| remove(dir, name))?;

    let npy = |name: &str, planes: usize, stack: &Stack<f32>| {
        let shape = [channels, planes, size.height, size.width];
        write_npy(&dir.join(name), &shape[usize::from(channels == 1)..], stack.as_slice())
    };
    npy("stokes.npy", stokes.count() / channels, stokes)?;
    if let Some(errors) = images.errors {
        npy(ERRORS, errors.count() / channels, errors)?;
    }
    match angles {
        Some(angles) => npy("angles.npy", angle_list.len(), angles)?,
        None if polarized && !angle_list.is_empty() => {
            let shape = [channels, angle_list.len(), size.height, size.width];
            let values = behind_polarizers(stokes, angle_list);
            let path = dir.join("angles.npy");
            write_atomic(&path, |out| encode_npy(out, &shape[usize::from(channels == 1)..], values))?;
        }
        None => {}
    }
    if let Some(stage1) = images.stage1 {
        npy(STAGE1, angle_list.len(), stage1)?;
    }
    let mut pixels = vec![color::MASKED; size.pixels()];
    let white = draw_intensity(images, &mut pixels);
    write_png(&dir.join("intensity.png"), &panel(size, pixels, Legend::Intensity { white }))?;
    if polarized {
        write_polarization(dir, images)?;
    }
    let mut json = serde_json::to_vec_pretty(report)
        .map_err(|e| OutputError::Encode { format: "JSON", message: e.to_string() })?;
    json.push(b'\n');
    Ok(write_atomic(&dir.join(REPORT), |out| out.write_all(&json))?)
}

/// Intensities behind ideal polarizers at `angles`, `[C·P, H, W]`, one by one.
fn behind_polarizers(stokes: &Stack<f32>, angles: &[Angle]) -> impl Iterator<Item = f32> {
    let n = stokes.size().pixels();
    stokes.as_slice().chunks_exact(3 * n).flat_map(move |channel| {
        angles.iter().flat_map(move |angle| {
            let [a, b, c] = angle.analyzer();
            (0..n).map(move |i| a * channel[i] + b * channel[n + i] + c * channel[2 * n + i])
        })
    })
}

/// Checks that sizes match and values are finite; returns whether the result has polarization.
pub(super) fn check(images: &ResultImages<'_>) -> Result<bool, OutputError> {
    let ResultImages { size, channels, angles, angle_list, stokes, errors, valid, stage1 } = *images;
    let require = |what, ok: bool, found: String, allowed: String| {
        if ok { Ok(()) } else { Err(OutputError::Shape { what, found, allowed }) }
    };
    let planes = |stack: &Stack<f32>| format!("{} planes of {}", stack.count(), stack.size());
    require("channels", matches!(channels, 1 | 3), channels.to_string(), "1 or 3".to_owned())?;
    let polarized = stokes.count() == 3 * channels;
    let fits = stokes.size() == size && (polarized || stokes.count() == channels);
    require("stokes", fits, planes(stokes), format!("{channels} or {} planes of {size}", 3 * channels))?;
    if let Some(angles) = angles {
        let count = channels * angle_list.len();
        let fits = angles.size() == size && angles.count() == count && polarized;
        require("angles", fits, planes(angles), format!("{count} planes of {size}, with S0, S1 and S2"))?;
        finite("angles", angles)?;
    }
    if let Some(stage1) = stage1 {
        let fits = polarized && stage1.size() == size && stage1.count() == channels * angle_list.len();
        require("stage1_angles", fits, planes(stage1), "as many planes as angles".to_owned())?;
        finite("stage1_angles", stage1)?;
    }
    if let Some(errors) = errors {
        let fits = errors.size() == size && errors.count() == stokes.count();
        require("stokes_error", fits, planes(errors), "the shape of stokes".to_owned())?;
        finite("stokes_error", errors)?;
    }
    require("valid", valid.len() == size.pixels(), format!("{} pixels", valid.len()), format!("{size} pixels"))?;
    finite("stokes", stokes)?;
    Ok(polarized)
}

fn finite(what: &'static str, stack: &Stack<f32>) -> Result<(), OutputError> {
    match stack.as_slice().iter().position(|v| !v.is_finite()) {
        Some(index) => Err(OutputError::NonFinite { what, index, value: stack.as_slice()[index] }),
        None => Ok(()),
    }
}

fn remove(dir: &Path, name: &str) -> Result<(), OutputError> {
    let path = dir.join(name);
    match std::fs::remove_file(&path) {
        Err(source) if source.kind() != io::ErrorKind::NotFound => Err(OutputError::Folder { path, source }),
        _ => Ok(()),
    }
}

/// Draws S0 in gray or colour; returns the S0 that is drawn white, the largest of the channels.
fn draw_intensity(images: &ResultImages<'_>, pixels: &mut [[u8; 3]]) -> f32 {
    let per_channel = images.stokes.count() / images.channels;
    let s0 = |channel: usize| images.stokes.plane(channel * per_channel);
    let mut scratch = Vec::new();
    let white = (0..images.channels).map(|c| color::white_level(s0(c), &mut scratch)).fold(0.0, f32::max);
    if images.channels == 1 {
        color::intensity(s0(0), white, pixels);
    } else {
        color::intensity_rgb([0, 1, 2].map(s0), white, pixels);
    }
    white
}

fn write_polarization(dir: &Path, images: &ResultImages<'_>) -> Result<(), OutputError> {
    let size = images.size;
    let summed = [0, 1, 2].map(|component| sum_over_channels(images, component));
    let stokes = [&*summed[0], &*summed[1], &*summed[2]];
    let mut scratch = Vec::new();
    let mut shown = vec![false; size.pixels()];
    color::polarized_pixels(stokes[0], images.valid, &mut scratch, &mut shown);
    let white = 0.5 * color::white_level(stokes[0], &mut scratch);
    // frees memory of one picture before the pictures are made
    drop(scratch);
    let write = |name: &str, legend: Legend, draw: &dyn Fn(&mut [[u8; 3]])| {
        let mut pixels = vec![color::MASKED; size.pixels()];
        draw(&mut pixels);
        write_png(&dir.join(name), &panel(size, pixels, legend))
    };
    write("dolp.png", Legend::Dolp, &|out| color::dolp(stokes, &shown, 1.0, out))?;
    shown.iter_mut().enumerate().for_each(|(i, shown)| *shown &= images.has_angle(i));
    let mode = AolpMode::Value;
    write("aolp.png", Legend::Aolp(mode), &|out| color::aolp(stokes, &shown, mode, 1.0, out))?;
    write("composite.png", Legend::Composite, &|out| color::composite(stokes, images.valid, white, out))?;
    Ok(())
}

fn sum_over_channels<'a>(images: &ResultImages<'a>, component: usize) -> Cow<'a, [f32]> {
    if images.channels == 1 {
        return Cow::Borrowed(images.stokes.plane(component));
    }
    let mut sum = images.stokes.plane(component).to_vec();
    for channel in 1..images.channels {
        for (sum, v) in sum.iter_mut().zip(images.stokes.plane(3 * channel + component)) {
            *sum += v;
        }
    }
    Cow::Owned(sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::{Samples, read_image, read_npy};

    const SIZE: Size = Size::new(6, 4);

    fn stack(count: usize) -> Stack<f32> {
        let data = (0..count * SIZE.pixels()).map(|i| 0.2 + 0.01 * (i % 37) as f32).collect();
        Stack::from_vec(count, SIZE, data).unwrap()
    }

    fn names(dir: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_result_has_the_documented_files_and_shapes() {
        let angle_list = Angle::four();
        for (channels, lead) in [(1, vec![]), (3, vec![3])] {
            let dir = tempfile::tempdir().unwrap();
            let out = dir.path().join("a/b");
            let (angles, stokes, valid) = (stack(4 * channels), stack(3 * channels), [true; 24]);
            let images = ResultImages {
                size: SIZE,
                channels,
                angles: Some(&angles),
                angle_list: &angle_list,
                stokes: &stokes,
                errors: None,
                valid: &valid,
                stage1: None,
            };
            write_all(&out, &images, &Report::default()).unwrap();
            let all =
                ["angles.npy", "aolp.png", "composite.png", "dolp.png", "intensity.png", "report.json", "stokes.npy"];
            assert_eq!(names(&out), all);
            assert_eq!(read_npy(&out.join("angles.npy")).unwrap().shape, [lead.as_slice(), &[4, 4, 6]].concat());
            let read = read_npy(&out.join("stokes.npy")).unwrap();
            assert_eq!(read.shape, [lead.as_slice(), &[3, 4, 6]].concat());
            assert_eq!(read.into_f32(), stokes.as_slice());
        }
    }

    #[test]
    fn without_a_mask_files_of_polarization_are_removed() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("dolp.png"), "old").unwrap();
        std::fs::write(dir.path().join("notes.txt"), "kept").unwrap();
        for (channels, shape) in [(1, vec![1, 4, 6]), (3, vec![3, 1, 4, 6])] {
            let (stokes, valid) = (stack(channels), [true; 24]);
            let images = ResultImages { channels, ..of_stokes(&stokes, &valid) };
            write_all(dir.path(), &images, &Report::default()).unwrap();
            assert_eq!(names(dir.path()), ["intensity.png", "notes.txt", "report.json", "stokes.npy"]);
            assert_eq!(read_npy(&dir.path().join("stokes.npy")).unwrap().shape, shape);
        }
    }

    #[test]
    fn angles_that_were_not_solved_for_are_computed_from_stokes() {
        let dir = tempfile::tempdir().unwrap();
        for channels in [1, 3] {
            let (stokes, valid, four) = (stack(3 * channels), [true; 24], Angle::four());
            let images = ResultImages { channels, angle_list: &four, ..of_stokes(&stokes, &valid) };
            write_all(dir.path(), &images, &Report::default()).unwrap();
            let angles = read_npy(&dir.path().join("angles.npy")).unwrap();
            let lead: &[usize] = if channels == 3 { &[3] } else { &[] };
            assert_eq!(angles.shape, [lead, &[4, 4, 6]].concat());
            let found = angles.into_f32();
            let last = 24 * (4 * channels - 1) + 5;
            let expected = 0.5 * (stokes.plane(3 * channels - 3)[5] - stokes.plane(3 * channels - 1)[5]);
            assert!((found[last] - expected).abs() < 1e-6, "135°: {} for {expected}", found[last]);
        }
    }

    fn of_stokes<'a>(stokes: &'a Stack<f32>, valid: &'a [bool]) -> ResultImages<'a> {
        ResultImages {
            size: SIZE,
            channels: 1,
            angles: None,
            angle_list: &[],
            stokes,
            errors: None,
            valid,
            stage1: None,
        }
    }

    #[test]
    fn values_that_are_not_finite_are_never_written() {
        let dir = tempfile::tempdir().unwrap();
        let (mut stokes, valid) = (stack(3), [true; 24]);
        stokes.plane_mut(2)[5] = f32::NAN;
        let images = of_stokes(&stokes, &valid);
        let e = write_all(dir.path(), &images, &Report::default()).unwrap_err().to_string();
        assert_eq!(e, "stokes: value 53 is NaN, allowed: finite values");
        assert!(names(dir.path()).is_empty());
    }

    #[test]
    fn sizes_that_do_not_match_are_named() {
        let (stokes, valid) = (stack(4), [true; 24]);
        let images = of_stokes(&stokes, &valid);
        let e = check(&images).unwrap_err().to_string();
        assert_eq!(e, "stokes: 4 planes of 6×4, allowed: 1 or 3 planes of 6×4");
        let stokes = stack(3);
        let e = check(&ResultImages { stokes: &stokes, valid: &valid[1..], ..images }).unwrap_err().to_string();
        assert_eq!(e, "valid: 23 pixels, allowed: 6×4 pixels");
    }

    #[test]
    fn polarization_of_a_colour_camera_is_that_of_the_summed_stokes() {
        let dir = tempfile::tempdir().unwrap();
        // red is polarized at 0° and blue equally at 90°, so their sum is unpolarized
        let mut stokes = Stack::zeros(9, SIZE);
        for (plane, value) in [(0, 0.5), (1, 0.4), (3, 0.5), (6, 0.5), (7, -0.4)] {
            stokes.plane_mut(plane).fill(value);
        }
        let mut valid = [true; 24];
        valid[7] = false;
        let images = ResultImages {
            size: SIZE,
            channels: 3,
            angles: None,
            angle_list: &[],
            stokes: &stokes,
            errors: None,
            valid: &valid,
            stage1: None,
        };
        write_all(dir.path(), &images, &Report::default()).unwrap();
        let Samples::U8(dolp) = read_image(&dir.path().join("dolp.png")).unwrap() else { panic!("depth") };
        let pixel = |x: usize, y: usize| [0, 1, 2].map(|c| dolp.plane(c)[y * dolp.size().width + x]);
        assert_eq!((pixel(0, 0), pixel(1, 1)), (color::dolp_color(0.0), color::MASKED));
    }
}
