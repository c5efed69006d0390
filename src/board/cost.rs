//! Processing time of a frame on a board: times measured on that board, or an estimate from counted instructions.
//!
//! The estimate for a stage is instructions / (clock × instructions per cycle × speed-up by threads), but at least the time of its
//! memory traffic. `scripts/arm-cost.sh` counts the instructions; counts of different recordings differ by a few percent. The
//! instructions per cycle and the speed-up are ranges, so the estimate is a range too.

use super::{Board, Core};
use crate::model::{Model, Network, Precision};
use stokescope_core::image::Size;

/// Instructions and memory traffic of one stage, per pixel and colour channel.
#[derive(Clone, Copy, Debug)]
struct StageCost {
    stage: &'static str,
    /// aarch64 instructions.
    instructions: f64,
    /// Bytes copied from memory to memory.
    bytes: f64,
    /// Whether the stage runs on all solver threads.
    shared: bool,
}

/// Stages that run once per frame, as printed by `scripts/arm-cost.sh --physics 96`: a guided frame of a moving scene, 4 angles,
/// one thread, profile `board`. Alignment counts as `prepare`, its transforms as `start`.
///
/// Larger frames need fewer instructions per pixel: the number of low-frequency modes is fixed and the padding is relatively smaller
/// (at 64 × 64 a start takes 4522, an iteration 431). The estimate is therefore too slow rather than too fast.
const FRAME: [StageCost; 2] = [
    StageCost { stage: "prepare", instructions: 457.0, bytes: 120.0, shared: false },
    StageCost { stage: "start", instructions: 3423.0, bytes: 300.0, shared: true },
];
/// One solver iteration. It reads the unknowns, multipliers and maps twice.
const ITERATION: StageCost = StageCost { stage: "iterations", instructions: 361.0, bytes: 100.0, shared: true };
/// Validity map, copies of the result for its readers, and the rest of a frame.
const FINISH: StageCost = StageCost { stage: "finish", instructions: 72.0, bytes: 40.0, shared: false };
/// Stage II without its network: checks against the readings, candidates, mixing. This and the next two are printed by
/// `scripts/arm-cost.sh 64`.
const FUSION: StageCost = StageCost { stage: "fusion", instructions: 2338.0, bytes: 400.0, shared: true };
/// Instructions per multiply-add of the network: int8 with dot products, and f32.
const MULTIPLY_ADD: [f64; 2] = [0.314, 0.651];

/// Cropping and binning, for each reading of the camera in blocks of 4 × 4: 13 to 13.5 instructions of 16-bit words and 10-bit packed samples, 11
/// to 11.5 of 12-bit packed ones, counted under qemu without defective readings. A block that has one takes 11 000 more. One thread
/// captures, beside the solver.
const BIN: StageCost = StageCost { stage: "bin", instructions: 14.0, bytes: 2.0, shared: false };

/// Speed-up per additional thread, least and most. The memory bus, the shared cache and idle loop ends cost the rest.
const THREAD_GAIN: [f64; 2] = [0.4, 0.85];

impl Core {
    /// Instructions per cycle of the solver, least and most: vector arithmetic on rows that mostly lie in the second-level cache.
    fn ipc(self) -> [f64; 2] {
        match self {
            Self::CortexA53 => [0.5, 0.9],
            Self::CortexA72 => [0.9, 1.6],
            Self::CortexA76 => [1.5, 2.7],
            Self::X86 => [1.5, 3.0],
        }
    }

    /// Whether the core has an int8 dot product instruction.
    pub(super) fn has_dot_product(self) -> bool {
        matches!(self, Self::CortexA76 | Self::X86)
    }

    /// Bytes per second that one core copies from memory to memory, as published for boards with this core.
    fn copy_rate(self) -> f64 {
        match self {
            Self::CortexA53 => 1.3e9,
            Self::CortexA72 => 2.2e9,
            Self::CortexA76 => 6.0e9,
            Self::X86 => 8.0e9,
        }
    }
}

/// Processing time of a frame as `scripts/on-board.sh` measured it on the board, in milliseconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasuredTimes {
    /// Size of the frames.
    pub size: Size,
    /// Solver iterations.
    pub iterations: usize,
    /// Preparation without alignment.
    pub prepare_ms: f64,
    /// Alignment of the guide.
    pub register_ms: f64,
    /// Solver.
    pub recon_ms: f64,
    /// Fusion model; 0 without one.
    pub fusion_ms: f64,
}

/// Workload of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Workload {
    /// Size of the frames.
    pub size: Size,
    /// Colour channels.
    pub channels: usize,
    /// Solver iterations.
    pub iterations: usize,
    /// Fusion model, if one runs.
    pub fusion: Option<FusionWorkload>,
}

/// Workload of the fusion model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FusionWorkload {
    /// Number format of the network.
    pub precision: Precision,
    /// Multiply-adds of the network per pixel.
    pub macs: f64,
}

impl FusionWorkload {
    /// Workload of a network on frames of `size`.
    pub fn new(network: &Network, size: Size) -> Self {
        Self { precision: network.precision(), macs: network.macs_per_pixel(size) }
    }

    /// Workload of a model on frames of `size` as its manifest states it; none where it does not.
    pub fn stated(model: &Model, precision: Precision, size: Size) -> Option<Self> {
        let macs = *model.metrics.get(Model::MACS)?;
        Some(Self { precision, macs: model.network.macs_per_pixel(macs, size) })
    }
}

/// Processing time of one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameTimes {
    /// Whether the times were measured on the board; otherwise they are estimates.
    pub measured: bool,
    /// Milliseconds of every stage, least and most; both are equal when measured.
    pub stages: Vec<(&'static str, [f64; 2])>,
}

impl FrameTimes {
    /// Milliseconds of all stages together, least and most.
    pub fn total_ms(&self) -> [f64; 2] {
        [0, 1].map(|end| self.stages.iter().map(|(_, ms)| ms[end]).sum())
    }

    /// The times on a field of `field` pixels in place of a frame of `frame` pixels. Everything but stage II and the copies of the result works
    /// on the field. The share of padding, which falls, is neglected.
    #[must_use]
    pub fn on_field(&self, frame: Size, field: Size) -> Self {
        let more = field.pixels() as f64 / frame.pixels() as f64;
        let of_frame = [FUSION.stage, FINISH.stage];
        let stages = self.stages.iter().map(|(stage, ms)| {
            let more = if of_frame.contains(stage) { 1.0 } else { more };
            (*stage, ms.map(|ms| more * ms))
        });
        Self { measured: self.measured, stages: stages.collect() }
    }

    /// Frames per second on an otherwise idle processor, least and most.
    pub fn frames_per_second(&self) -> [f64; 2] {
        let [least, most] = self.total_ms();
        [1e3 / most, 1e3 / least]
    }
}

impl Board {
    /// Time to crop and bin `readings` readings of a frame, in milliseconds, least and most: an estimate from counted instructions.
    pub fn binning_ms(&self, readings: usize) -> [f64; 2] {
        [1, 0].map(|end| {
            let rate = f64::from(self.cpu.clock_mhz) * 1e6 * self.cpu.core.ipc()[end];
            1e3 * readings as f64 * (BIN.instructions / rate).max(BIN.bytes / self.cpu.core.copy_rate())
        })
    }

    /// Processing time of a frame on this board, stage by stage.
    pub fn times(&self, load: &Workload) -> FrameTimes {
        let Workload { size, channels, iterations, fusion } = *load;
        let values = (size.pixels() * channels) as f64;
        if let Some(m) = self.measured {
            let by_size = size.pixels() as f64 / m.size.pixels() as f64;
            // the direct start takes as long as some iterations
            let start = FRAME[1].instructions / ITERATION.instructions;
            let by_iterations = (iterations as f64 + start) / (m.iterations as f64 + start);
            let stages = [
                ("prepare", m.prepare_ms),
                ("register", if self.register { m.register_ms } else { 0.0 }),
                ("recon", m.recon_ms * by_iterations),
                ("fusion", if fusion.is_some() { m.fusion_ms } else { 0.0 }),
            ];
            let stages = stages.into_iter().filter(|(_, ms)| *ms > 0.0);
            return FrameTimes {
                measured: true,
                stages: stages.map(|(stage, ms)| (stage, [ms * by_size; 2])).collect(),
            };
        }
        let milliseconds = |work: &StageCost, times: f64| {
            let time = |end: usize| {
                let more = if work.shared { (self.threads.min(self.cpu.cores) - 1) as f64 } else { 0.0 };
                let rate = f64::from(self.cpu.clock_mhz) * 1e6 * self.cpu.core.ipc()[end];
                let computed = work.instructions / (rate * (1.0 + more * THREAD_GAIN[end]));
                1e3 * times * values * computed.max(work.bytes / self.cpu.core.copy_rate())
            };
            (work.stage, [time(1), time(0)])
        };
        let mut stages: Vec<_> = FRAME.iter().map(|work| milliseconds(work, 1.0)).collect();
        stages.push(milliseconds(&ITERATION, iterations as f64));
        if let Some(FusionWorkload { precision, macs }) = fusion {
            let [bytes, floats] = MULTIPLY_ADD;
            // bytes gain nothing on cores without a dot product of them; the engine's own convolutions have one thread for a tile
            let in_bytes = precision == Precision::Int8 && self.cpu.core.has_dot_product();
            let instructions = macs * if in_bytes { bytes } else { floats };
            let network = StageCost { stage: FUSION.stage, instructions, bytes: 0.0, shared: in_bytes };
            let [mixing, network] = [&FUSION, &network].map(|work| milliseconds(work, 1.0).1);
            stages.push((FUSION.stage, [0, 1].map(|end| mixing[end] + network[end])));
        }
        stages.push(milliseconds(&FINISH, 1.0));
        FrameTimes { measured: false, stages }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(250, 250);
    const LOAD: Workload = Workload { size: SIZE, channels: 1, iterations: 6, fusion: None };

    #[test]
    fn faster_cores_more_threads_and_fewer_pixels_take_less_time() {
        let fps = |board: &Board, size| board.times(&Workload { size, ..LOAD }).frames_per_second();
        let [zero, four, five] = ["rpi-zero-2w", "rpi4", "rpi5"].map(|name| Board::load(name).unwrap());
        for end in [0, 1] {
            assert!(fps(&zero, SIZE)[end] < fps(&four, SIZE)[end] && fps(&four, SIZE)[end] < fps(&five, SIZE)[end]);
            assert!(fps(&zero, SIZE)[end] < fps(&zero, Size::new(128, 128))[end]);
            let single = Board { threads: 1, ..five.clone() };
            assert!(fps(&single, SIZE)[end] < fps(&five, SIZE)[end]);
        }
        let on_frame = five.times(&LOAD);
        let on_field = on_frame.on_field(SIZE, Size::new(500, 250));
        assert_eq!(on_frame.on_field(SIZE, SIZE), on_frame);
        for (alone, beside) in on_frame.stages.iter().zip(&on_field.stages) {
            let more = if alone.0 == "finish" { 1.0 } else { 2.0 };
            assert_eq!(beside.1, alone.1.map(|ms| more * ms), "{}", alone.0);
        }
        let [least, most] = fps(&five, SIZE);
        assert!(0.0 < least && least < most);
        let fused = |board: &Board, precision| {
            let fusion = Some(FusionWorkload { precision, macs: 5000.0 });
            board.times(&Workload { fusion, ..LOAD }).stages.iter().find(|(stage, _)| *stage == "fusion").unwrap().1
        };
        let [bytes, floats] = [Precision::Int8, Precision::F32].map(|precision| fused(&five, precision));
        assert!(bytes[0] < floats[0] && bytes[1] < floats[1], "{bytes:?} {floats:?}");
        assert_eq!(fused(&four, Precision::Int8), fused(&four, Precision::F32));
    }

    #[test]
    fn measured_times_replace_the_estimate() {
        let measured = "inherit = \"rpi5\"\n[measured]\nwidth = 250\nheight = 250\niterations = 10\nprepare_ms = 2.0\n\
                        register_ms = 6.0\nrecon_ms = 20.0\n";
        let board = Board::parse(std::path::Path::new("b.toml"), measured).unwrap();
        let times = board.times(&Workload { iterations: 10, ..LOAD });
        assert!(times.measured);
        assert_eq!(times.total_ms(), [28.0; 2]);
        let half = board.times(&Workload { iterations: 10, size: Size::new(250, 125), ..LOAD });
        assert_eq!(half.frames_per_second(), [1e3 / 14.0; 2]);
        let [ms, _] = board.times(&Workload { iterations: 20, ..LOAD }).total_ms();
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
