//! The loop on 64 bit ARM: dot products of bytes.

use std::arch::aarch64::*;
use std::arch::asm;
use std::ops::Range;

use super::{BLOCK, Conv, Loop, Work};

/// Adds the products of every lane's quad with quad I of the weights.
#[inline(always)]
fn dot<const I: usize>(mut sums: int32x4_t, values: int8x16_t, weights: int8x16_t) -> int32x4_t {
    // SAFETY: reached from `work` alone; touches registers only. The intrinsic is not stable yet.
    unsafe {
        asm!("sdot {0:v}.4s, {1:v}.16b, {2:v}.4b[{i}]", inout(vreg) sums, in(vreg) values, in(vreg) weights, i = const I,
             options(pure, nomem, nostack, preserves_flags));
    }
    sums
}

/// Quads of bytes, signed values.
pub(super) struct Dot;

impl Loop for Dot {
    const GROUP: usize = 4;
    const LANES: usize = 4;
    const VECTORS: usize = 4;
    type Stored = u8;
    type Sums = int32x4_t;
    type Group = int8x16_t;

    #[inline(always)]
    fn stored(byte: u8, _: i16) -> u8 {
        byte
    }

    #[inline(always)]
    fn zero() -> int32x4_t {
        // SAFETY: NEON is part of the architecture.
        unsafe { vdupq_n_s32(0) }
    }

    #[inline(always)]
    unsafe fn values(from: *const u8) -> int8x16_t {
        // SAFETY: the caller's promise.
        unsafe { vld1q_s8(from.cast()) }
    }

    #[inline(always)]
    unsafe fn accumulate<const N: usize>(
        total: &mut [[int32x4_t; N]; BLOCK],
        values: [int8x16_t; N],
        weights: *const u8,
    ) {
        // SAFETY: the caller's promise; six quads of weights.
        let (first, second) = unsafe {
            let second = vld1_s8(weights.add(16).cast());
            (vld1q_s8(weights.cast()), vcombine_s8(second, second))
        };
        for n in 0..N {
            total[0][n] = dot::<0>(total[0][n], values[n], first);
            total[1][n] = dot::<1>(total[1][n], values[n], first);
            total[2][n] = dot::<2>(total[2][n], values[n], first);
            total[3][n] = dot::<3>(total[3][n], values[n], first);
            total[4][n] = dot::<0>(total[4][n], values[n], second);
            total[5][n] = dot::<1>(total[5][n], values[n], second);
        }
    }

    #[inline(always)]
    unsafe fn store(sums: int32x4_t, to: *mut i32) {
        // SAFETY: the caller's promise.
        unsafe { vst1q_s32(to, sums) }
    }

    #[target_feature(enable = "neon,dotprod")]
    unsafe fn work(conv: &Conv, work: Work<'_, u8>, band: Range<usize>) {
        // SAFETY: the caller's promise.
        unsafe { conv.work::<Self>(work, band) }
    }
}
