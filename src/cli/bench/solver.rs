//! `stokescope bench --solver`: a guided iteration against its own four FFTs, two threads against one, and what a frame's
//! preparation takes.

use std::sync::Arc;
use std::time::Instant;

use num_complex::Complex32;
use serde::Serialize;

use super::{Args, Machine, as_json, describe, process, settings, simulated};
use crate::Error;
use crate::camera::sim::SCENES;
use stokescope_core::image::Size;
use stokescope_core::optics::Convolver;
use stokescope_core::parallel::Workers;
use stokescope_core::pipeline::{Pipeline, Settings};
use stokescope_core::solve::Method;

/// What it finds, in milliseconds; the least of many rounds, for other load only adds.
#[derive(Debug, Serialize)]
struct Answer {
    machine: Machine,
    width: usize,
    height: usize,
    padded_width: usize,
    padded_height: usize,
    /// One guided iteration, one thread.
    iteration_ms: f64,
    /// Four plain complex 2-D FFTs of the padded size, every row and column of them.
    four_ffts_ms: f64,
    /// `iteration_ms / four_ffts_ms`
    iteration_per_four_ffts: f64,
    /// One guided iteration, two threads.
    two_threads_ms: f64,
    /// `iteration_ms / two_threads_ms`
    speed_up_of_two_threads: f64,
    /// Preparing a frame with one thread and finding its guide: of a first frame, and of one whose guide is as the last one's.
    first_preparation_ms: f64,
    next_preparation_ms: f64,
    /// Bytes of the solver's buffers with one thread, by part and together. What belongs to the camera (its spectrum, the maps,
    /// the direct start's equations) and the frame itself are not among them.
    workspace_parts: Vec<(&'static str, usize)>,
    workspace_bytes: usize,
}

/// Rounds of `--solver`, and iterations and FFTs of each.
const ROUNDS: usize = 40;
const MANY: usize = 20;

#[allow(clippy::print_stdout, reason = "the command's answer")]
pub(super) fn run(args: &Args, json: bool) -> Result<(), Error> {
    let scene = simulated(SCENES[0].0, args.size[0] as usize)?;
    let plan = |threads| Pipeline::new(&scene.calibration, settings(Method::Guided, MANY, threads, args.fft));
    let mut pipelines = [plan(1)?, plan(2)?];
    let registered =
        Settings { register: true, refit_psf: true, video: true, ..settings(Method::Guided, 1, 1, args.fft) };
    let mut registering = Pipeline::new(&scene.calibration, registered.clone())?;
    let mut preparations = [f64::INFINITY; 2];
    let psf = &scene.calibration.psf;
    let convolver = Convolver::new(psf.size(), psf.reach(), args.fft, Arc::new(Workers::new(1)))
        .map_err(stokescope_core::pipeline::PlanError::from)?;
    let padded = convolver.padded();
    let mut fft = Fft2::new(padded);
    // Both are short, about as long, and timed one by one, so that some fall into the gaps of other load.
    let (mut iterations, mut ffts) = ([f64::INFINITY; 2], f64::INFINITY);
    for _ in 0..ROUNDS {
        registering.forget_guide();
        for least in &mut preparations {
            let report = process(&mut registering, &scene)?;
            *least = (report.prepare + report.register).as_secs_f64().min(*least);
        }
        for (least, pipeline) in iterations.iter_mut().zip(&mut pipelines) {
            process(pipeline, &scene)?;
            *least = pipeline.shortest_iteration().map_or(f64::INFINITY, |t| t.as_secs_f64()).min(*least);
            for _ in 0..MANY {
                let start = Instant::now();
                (0..4).for_each(|_| fft.run());
                ffts = ffts.min(start.elapsed().as_secs_f64());
            }
        }
    }
    let [iteration, two_threads] = iterations;
    let workspace_parts = pipelines[0].solver_parts();
    let answer = Answer {
        machine: Machine::this(),
        width: psf.size().width,
        height: psf.size().height,
        padded_width: padded.width,
        padded_height: padded.height,
        iteration_ms: 1e3 * iteration,
        four_ffts_ms: 1e3 * ffts,
        iteration_per_four_ffts: iteration / ffts,
        two_threads_ms: 1e3 * two_threads,
        speed_up_of_two_threads: iteration / two_threads,
        first_preparation_ms: 1e3 * preparations[0],
        next_preparation_ms: 1e3 * preparations[1],
        workspace_bytes: workspace_parts.iter().map(|(_, bytes)| bytes).sum(),
        workspace_parts,
    };
    if json {
        println!("{}", as_json(&answer)?);
    } else {
        println!("{}", describe(&answer.machine));
        println!("guided, {} padded to {padded}, {:?}", psf.size(), args.fft);
        println!("one iteration, 1 thread     {:8.2} ms", answer.iteration_ms);
        println!("four complex 2-D FFTs       {:8.2} ms", answer.four_ffts_ms);
        println!("ratio                       {:8.2}", answer.iteration_per_four_ffts);
        println!("one iteration, 2 threads    {:8.2} ms", answer.two_threads_ms);
        println!("speed-up of 2 threads       {:8.2}", answer.speed_up_of_two_threads);
        println!("preparation, first frame    {:8.2} ms", answer.first_preparation_ms);
        println!("preparation, next frame     {:8.2} ms", answer.next_preparation_ms);
        println!("workspace, 1 thread         {:8} bytes", answer.workspace_bytes);
        answer.workspace_parts.iter().for_each(|(part, bytes)| println!("  {part:<30} {bytes:8}"));
    }
    Ok(())
}

/// The yardstick: a plain complex 2-D FFT by rustfft on one thread, whatever the solver uses. All rows, then all columns,
/// copied eight at a time, a cache line of each row, into lines and back; nothing is left out for being zero or not needed.
struct Fft2 {
    row: Arc<dyn rustfft::Fft<f32>>,
    column: Arc<dyn rustfft::Fft<f32>>,
    image: Vec<Complex32>,
    columns: Vec<Complex32>,
    scratch: Vec<Complex32>,
}

impl Fft2 {
    /// Columns at a time: a cache line.
    const COLUMNS: usize = 8;

    fn new(padded: Size) -> Self {
        let mut planner = rustfft::FftPlanner::new();
        let (row, column) = (planner.plan_fft_forward(padded.width), planner.plan_fft_forward(padded.height));
        let scratch = row.get_inplace_scratch_len().max(column.get_inplace_scratch_len());
        Self {
            row,
            column,
            image: vec![Complex32::ZERO; padded.pixels()],
            columns: vec![Complex32::ZERO; Self::COLUMNS * padded.height],
            scratch: vec![Complex32::ZERO; scratch],
        }
    }

    fn run(&mut self) {
        let (width, height) = (self.row.len(), self.column.len());
        self.row.process_with_scratch(&mut self.image, &mut self.scratch);
        for first in (0..width).step_by(Self::COLUMNS) {
            let count = Self::COLUMNS.min(width - first);
            for (y, row) in self.image.chunks_exact(width).enumerate() {
                (0..count).for_each(|x| self.columns[x * height + y] = row[first + x]);
            }
            self.column.process_with_scratch(&mut self.columns[..count * height], &mut self.scratch);
            for (y, row) in self.image.chunks_exact_mut(width).enumerate() {
                (0..count).for_each(|x| row[first + x] = self.columns[x * height + y]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_plain_fft_of_an_impulse_is_a_wave_in_both_directions() {
        let mut fft = Fft2::new(Size::new(20, 8));
        fft.image[20 + 1] = Complex32::ONE;
        fft.run();
        for (i, v) in fft.image.iter().enumerate() {
            let phase = -std::f32::consts::TAU * ((i % 20) as f32 / 20.0 + (i / 20) as f32 / 8.0);
            assert!((v - Complex32::cis(phase)).norm() < 1e-5, "{i}: {v}");
        }
    }
}
