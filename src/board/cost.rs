//! How long a frame takes on a board: a model of counted instructions, or what was measured on the board itself.
//!
//! A stage takes instructions / (clock × instructions per cycle × speed-up by threads), and no less than its memory traffic takes
//! the bus. Instructions are counted (`scripts/arm-cost.sh`), some percent more or less from one recorded session to the next; the
//! rates are ranges that stand in this file, and so is the result.

use super::{Board, Core};
use crate::model::Precision;
use stokescope_core::image::Size;

/// What a stage costs by the model.
#[derive(Clone, Copy, Debug)]
struct Work {
    stage: &'static str,
    /// aarch64 instructions per pixel and colour channel.
    instructions: f64,
    /// Bytes per pixel and colour channel that cross the bus, copied from memory to memory.
    bytes: f64,
    /// Whether the solver's threads share it.
    shared: bool,
}

/// Printed by `scripts/arm-cost.sh --physics 96`: a frame of a moving scene beside a guide, 4 angles, one thread, as the board
/// profile builds it. Alignment is part of `prepare`, its transforms of `start`. Larger frames take less for a pixel, for the slow
/// modes are as many in every frame and transforms are padded by less of it (at 64 a start is 4522, an iteration 431): the estimate
/// errs on the slow side.
const FRAME: [Work; 2] = [
    Work { stage: "prepare", instructions: 457.0, bytes: 120.0, shared: false },
    Work { stage: "start", instructions: 3423.0, bytes: 300.0, shared: true },
];
/// The same of one iteration; it goes over the solver's unknowns, multipliers and maps twice.
const ITERATION: Work = Work { stage: "iterations", instructions: 361.0, bytes: 100.0, shared: true };
/// Validity, copies for who looks at the result, and what else there is to a frame.
const FINISH: Work = Work { stage: "finish", instructions: 72.0, bytes: 40.0, shared: false };
/// What a fusion model takes beside its network: the readings' say, candidates, mixing. This and the next two by `scripts/arm-cost.sh 64`.
const FUSION: Work = Work { stage: "fusion", instructions: 2338.0, bytes: 400.0, shared: true };
/// Instructions of a multiply-add in the network: in bytes with dot products, and in floating point.
const MULTIPLY_ADD: [f64; 2] = [0.314, 0.651];

/// Share of an additional thread that is gained, least and most: the bus, the shared cache and the ends of loops take the rest.
const THREAD_GAIN: [f64; 2] = [0.4, 0.85];

impl Core {
    /// Instructions per cycle of code like the solver's, least and most: vector arithmetic on rows that mostly come from the
    /// second-level cache.
    fn ipc(self) -> [f64; 2] {
        match self {
            Self::CortexA53 => [0.5, 0.9],
            Self::CortexA72 => [0.9, 1.6],
            Self::CortexA76 => [1.5, 2.7],
            Self::X86 => [1.5, 3.0],
        }
    }

    /// Whether it has dot products of bytes.
    fn has_dot_product(self) -> bool {
        matches!(self, Self::CortexA76 | Self::X86)
    }

    /// Bytes per second that one core copies from memory to memory, as published for boards with it.
    fn copies(self) -> f64 {
        match self {
            Self::CortexA53 => 1.3e9,
            Self::CortexA72 => 2.2e9,
            Self::CortexA76 => 6.0e9,
            Self::X86 => 8.0e9,
        }
    }
}

/// What `scripts/on-board.sh` found on the board: a frame's milliseconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Size of the frames.
    pub size: Size,
    /// Iterations of the solver.
    pub iterations: usize,
    /// Preparation without alignment.
    pub prepare_ms: f64,
    /// Alignment.
    pub register_ms: f64,
    /// The solver.
    pub recon_ms: f64,
    /// The fusion model; 0 without one.
    pub fusion_ms: f64,
}

/// What is to be done for a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Load {
    /// Size of the frames.
    pub size: Size,
    /// Colour channels.
    pub channels: usize,
    /// Iterations of the solver.
    pub iterations: usize,
    /// The fusion model, if there is one.
    pub fusion: Option<Learned>,
}

/// A fusion model's part.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Learned {
    /// Its arithmetic.
    pub precision: Precision,
    /// Multiply-adds of the network for each pixel.
    pub macs: f64,
}

/// How long a frame takes.
#[derive(Clone, Debug, PartialEq)]
pub struct Times {
    /// Whether it was measured on the board; else it is estimated.
    pub measured: bool,
    /// Least and most milliseconds of every stage; the same twice where they were measured.
    pub stages: Vec<(&'static str, [f64; 2])>,
}

impl Times {
    /// Milliseconds of all stages, least and most.
    pub fn total_ms(&self) -> [f64; 2] {
        [0, 1].map(|end| self.stages.iter().map(|(_, ms)| ms[end]).sum())
    }

    /// Frames per second, least and most, when nothing else keeps the processor busy.
    pub fn frames_per_second(&self) -> [f64; 2] {
        let [least, most] = self.total_ms();
        [1e3 / most, 1e3 / least]
    }
}

impl Board {
    /// How long a frame takes here, stage by stage.
    pub fn times(&self, load: &Load) -> Times {
        let Load { size, channels, iterations, fusion } = *load;
        let values = (size.pixels() * channels) as f64;
        if let Some(m) = self.measured {
            let by_size = size.pixels() as f64 / m.size.pixels() as f64;
            // the start costs as much as some iterations
            let start = FRAME[1].instructions / ITERATION.instructions;
            let by_iterations = (iterations as f64 + start) / (m.iterations as f64 + start);
            let stages = [
                ("prepare", m.prepare_ms),
                ("register", if self.register { m.register_ms } else { 0.0 }),
                ("recon", m.recon_ms * by_iterations),
                ("fusion", if fusion.is_some() { m.fusion_ms } else { 0.0 }),
            ];
            let stages = stages.into_iter().filter(|(_, ms)| *ms > 0.0);
            return Times { measured: true, stages: stages.map(|(stage, ms)| (stage, [ms * by_size; 2])).collect() };
        }
        let milliseconds = |work: &Work, times: f64| {
            let most = |end: usize| {
                let more = if work.shared { (self.threads.min(self.cpu.cores) - 1) as f64 } else { 0.0 };
                let rate = f64::from(self.cpu.clock_mhz) * 1e6 * self.cpu.core.ipc()[end];
                let computed = work.instructions / (rate * (1.0 + more * THREAD_GAIN[end]));
                1e3 * times * values * computed.max(work.bytes / self.cpu.core.copies())
            };
            (work.stage, [most(1), most(0)])
        };
        let mut stages: Vec<_> = FRAME.iter().map(|work| milliseconds(work, 1.0)).collect();
        stages.push(milliseconds(&ITERATION, iterations as f64));
        if let Some(Learned { precision, macs }) = fusion {
            let [bytes, floats] = MULTIPLY_ADD;
            // bytes gain nothing on cores without a dot product of them; the engine's own convolutions have one thread for a tile
            let in_bytes = precision == Precision::Int8 && self.cpu.core.has_dot_product();
            let instructions = macs * if in_bytes { bytes } else { floats };
            let network = Work { stage: FUSION.stage, instructions, bytes: 0.0, shared: in_bytes };
            let [mixing, network] = [&FUSION, &network].map(|work| milliseconds(work, 1.0).1);
            stages.push((FUSION.stage, [0, 1].map(|end| mixing[end] + network[end])));
        }
        stages.push(milliseconds(&FINISH, 1.0));
        Times { measured: false, stages }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(250, 250);
    const LOAD: Load = Load { size: SIZE, channels: 1, iterations: 6, fusion: None };

    #[test]
    fn faster_cores_more_threads_and_fewer_pixels_take_less_time() {
        let fps = |board: &Board, size| board.times(&Load { size, ..LOAD }).frames_per_second();
        let [zero, four, five] = ["rpi-zero-2w", "rpi4", "rpi5"].map(|name| Board::load(name).unwrap());
        for end in [0, 1] {
            assert!(fps(&zero, SIZE)[end] < fps(&four, SIZE)[end] && fps(&four, SIZE)[end] < fps(&five, SIZE)[end]);
            assert!(fps(&zero, SIZE)[end] < fps(&zero, Size::new(128, 128))[end]);
            let single = Board { threads: 1, ..five.clone() };
            assert!(fps(&single, SIZE)[end] < fps(&five, SIZE)[end]);
        }
        let [least, most] = fps(&five, SIZE);
        assert!(0.0 < least && least < most);
        let fused = |board: &Board, precision| {
            let fusion = Some(Learned { precision, macs: 5000.0 });
            board.times(&Load { fusion, ..LOAD }).stages.iter().find(|(stage, _)| *stage == "fusion").unwrap().1
        };
        let [bytes, floats] = [Precision::Int8, Precision::F32].map(|precision| fused(&five, precision));
        assert!(bytes[0] < floats[0] && bytes[1] < floats[1], "{bytes:?} {floats:?}");
        assert_eq!(fused(&four, Precision::Int8), fused(&four, Precision::F32));
    }

    #[test]
    fn what_was_measured_takes_the_place_of_the_estimate() {
        let measured = "inherit = \"rpi5\"\n[measured]\nwidth = 250\nheight = 250\niterations = 10\nprepare_ms = 2.0\n\
                        register_ms = 6.0\nrecon_ms = 20.0\n";
        let board = Board::parse(std::path::Path::new("b.toml"), measured).unwrap();
        let times = board.times(&Load { iterations: 10, ..LOAD });
        assert!(times.measured);
        assert_eq!(times.total_ms(), [28.0; 2]);
        let half = board.times(&Load { iterations: 10, size: Size::new(250, 125), ..LOAD });
        assert_eq!(half.frames_per_second(), [1e3 / 14.0; 2]);
        let [ms, _] = board.times(&Load { iterations: 20, ..LOAD }).total_ms();
        assert!(28.0 < ms && ms < 48.0, "the start is made once: {ms}");
    }

    #[test]
    fn measurements_are_not_inherited_and_are_checked() {
        let parse = |text: &str| Board::parse(std::path::Path::new("b.toml"), text);
        assert_eq!(parse("inherit = \"rpi5\"").unwrap().measured, None);
        let e = parse(
            "inherit = \"rpi5\"\n[measured]\nwidth = 0\nheight = 9\niterations = 1\nprepare_ms = -1\nregister_ms = 0\nrecon_ms = 1\n",
        );
        let e = e.unwrap_err().to_string();
        assert!(e.contains("measured.width = 0") && e.contains("measured.prepare_ms = -1"), "{e}");
    }
}
