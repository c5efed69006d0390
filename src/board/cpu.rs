//! The processor of a board.

/// The processor cores that the solver uses; all are of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cpu {
    /// Kind of core.
    pub core: Core,
    /// Number of cores.
    pub cores: usize,
    /// Clock of each core in MHz.
    pub clock_mhz: u32,
}

/// A kind of processor core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Core {
    /// In order, 64-bit NEON data path (Zero 2 W, 3B+).
    CortexA53,
    /// Out of order, 128-bit NEON (Pi 4, CM4).
    CortexA72,
    /// Out of order, two 128-bit NEON pipes, int8 dot product (Pi 5, the large cores of RK3588).
    CortexA76,
    /// 64-bit PC.
    X86,
}

impl Core {
    /// All kinds of core.
    pub const ALL: [Self; 4] = [Self::CortexA53, Self::CortexA72, Self::CortexA76, Self::X86];

    /// Name in board files and for rustc's `-C target-cpu`.
    pub fn name(self) -> &'static str {
        match self {
            Self::CortexA53 => "cortex-a53",
            Self::CortexA72 => "cortex-a72",
            Self::CortexA76 => "cortex-a76",
            Self::X86 => "x86-64",
        }
    }
}
