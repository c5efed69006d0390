//! `stokescope bench --solver`: measures one guided iteration against four plain FFTs, two threads against one, and the preparation
//! of a frame.

use std::sync::Arc;
use std::time::Instant;

use num_complex::Complex32;
use serde::Serialize;

use super::{Args, Machine, as_json, describe, process, settings, simulated};
use crate::Error;
use crate::camera::sim::SCENES;
use stokescope_core::image::Size;
use stokescope_core::optics::{Convolver, Field};
use stokescope_core::parallel::Workers;
use stokescope_core::pipeline::{Pipeline, Settings};
use stokescope_core::solve::Method;

/// Output of the command. Times are in milliseconds, the shortest of many rounds, because other load can only add time.
#[derive(Debug, Serialize)]
struct Output {
    machine: Machine,
    width: usize,
    height: usize,
    padded_width: usize,
    padded_height: usize,
    /// One guided iteration with one thread.
    iteration_ms: f64,
    /// Four plain complex 2-D FFTs of the padded size.
    four_ffts_ms: f64,
    /// `iteration_ms / four_ffts_ms`.
    iteration_per_four_ffts: f64,
    /// One guided iteration with two threads.
    two_threads_ms: f64,
    /// `iteration_ms / two_threads_ms`.
    speed_up_of_two_threads: f64,
    /// Preparation with alignment of the guide, one thread: of a first frame, and of a frame with an unchanged guide.
    first_preparation_ms: f64,
    next_preparation_ms: f64,
    /// Memory of the solver's buffers with one thread in bytes, by part and in total, without the frame and the data of the device
    /// (spectrum, maps, normal equations of the direct start).
    workspace_parts: Vec<(&'static str, usize)>,
    workspace_bytes: usize,
}

/// Number of rounds.
const ROUNDS: usize = 40;
/// Iterations, and sets of four FFTs, per round.
const REPEATS: usize = 20;

#[allow(clippy::print_stdout, reason = "output of the command")]
pub(super) fn run(args: &Args, json: bool) -> Result<(), Error> {
    let output = measure(args)?;
    if json {
        println!("{}", as_json(&output)?);
        return Ok(());
    }
    println!("{}", describe(&output.machine));
    println!(
        "guided, {} padded to {}, {:?}",
        Size::new(output.width, output.height),
        Size::new(output.padded_width, output.padded_height),
        args.fft
    );
    println!("one iteration, 1 thread     {:8.2} ms", output.iteration_ms);
    println!("four complex 2-D FFTs       {:8.2} ms", output.four_ffts_ms);
    println!("ratio                       {:8.2}", output.iteration_per_four_ffts);
    println!("one iteration, 2 threads    {:8.2} ms", output.two_threads_ms);
    println!("speed-up of 2 threads       {:8.2}", output.speed_up_of_two_threads);
    println!("preparation, first frame    {:8.2} ms", output.first_preparation_ms);
    println!("preparation, next frame     {:8.2} ms", output.next_preparation_ms);
    println!("workspace, 1 thread         {:8} bytes", output.workspace_bytes);
    output.workspace_parts.iter().for_each(|(part, bytes)| println!("  {part:<30} {bytes:8}"));
    Ok(())
}

fn measure(args: &Args) -> Result<Output, Error> {
    let scene = simulated(SCENES[0].0, args.size[0] as usize)?;
    let plan = |threads| Pipeline::new(&scene.bundle, settings(Method::Guided, REPEATS, threads, args.fft));
    let mut pipelines = [plan(1)?, plan(2)?];
    let registered =
        Settings { register: true, refit_psf: true, video: true, ..settings(Method::Guided, 1, 1, args.fft) };
    let mut registering = Pipeline::new(&scene.bundle, registered)?;
    let mut preparations = [f64::INFINITY; 2];
    let psf = &scene.bundle.psf;
    let convolver = Convolver::new(Field::of_frame(psf.size()), psf.reach(), args.fft, Arc::new(Workers::new(1)))
        .map_err(stokescope_core::pipeline::PlanError::from)?;
    let padded = convolver.padded();
    let mut fft = Fft2::new(padded);
    // iterations and FFTs alternate in short runs, so that some of each fall into gaps of other load
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
            for _ in 0..REPEATS {
                let start = Instant::now();
                (0..4).for_each(|_| fft.run());
                ffts = ffts.min(start.elapsed().as_secs_f64());
            }
        }
    }
    let [iteration, two_threads] = iterations;
    let workspace_parts = pipelines[0].solver_parts();
    Ok(Output {
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
    })
}

/// Reference for the solver's speed: a plain complex 2-D FFT by rustfft on one thread, of all rows and then all columns. Columns are
/// copied to contiguous memory and back, eight at a time.
struct Fft2 {
    row: Arc<dyn rustfft::Fft<f32>>,
    column: Arc<dyn rustfft::Fft<f32>>,
    image: Vec<Complex32>,
    columns: Vec<Complex32>,
    scratch: Vec<Complex32>,
}

impl Fft2 {
    /// Columns copied at a time: one cache line of each row.
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
