//! What a board computes with.

/// A processor: its cores are alike, or these are the ones the solver uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cpu {
    /// Kind of core.
    pub core: Core,
    /// How many.
    pub cores: usize,
    /// Clock of each, MHz.
    pub clock_mhz: u32,
}

/// A kind of core, as far as it decides what is fast on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Core {
    /// In order, 64-bit NEON data path (Zero 2 W, 3B+).
    CortexA53,
    /// Out of order, 128-bit NEON (Pi 4, CM4).
    CortexA72,
    /// Out of order, two 128-bit NEON pipes, int8 dot product (Pi 5, the large cores of RK3588).
    CortexA76,
    /// A PC.
    X86,
}

impl Core {
    /// All kinds.
    pub const ALL: [Self; 4] = [Self::CortexA53, Self::CortexA72, Self::CortexA76, Self::X86];

    /// As board files and `-C target-cpu` name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::CortexA53 => "cortex-a53",
            Self::CortexA72 => "cortex-a72",
            Self::CortexA76 => "cortex-a76",
            Self::X86 => "x86-64",
        }
    }

    /// Whether int8 products run faster than f32 ones: with a dot product instruction they do.
    pub fn has_int8_dot_product(self) -> bool {
        matches!(self, Self::CortexA76)
    }
}
