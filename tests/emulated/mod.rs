//! Tests under an emulator (`scripts/cross.sh`): all is slower by tens there, and memory is the emulator's.

/// How many times as long things may take.
pub(crate) fn slowness() -> u32 {
    if std::env::var_os("QEMU_LD_PREFIX").is_some() { 20 } else { 1 }
}
