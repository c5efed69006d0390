//! The loop on x86: AVX-512 VNNI and AVX2.

use std::arch::x86_64::*;
use std::ops::Range;

use super::{BLOCK, Conv, Loop, Work, add_all};

/// Pairs of i16.
pub(super) struct Avx2;

impl Loop for Avx2 {
    const GROUP: usize = 2;
    const LANES: usize = 8;
    const VECTORS: usize = 2;
    type Stored = i16;
    type Sums = __m256i;
    type Group = __m256i;

    #[inline(always)]
    fn stored(_: u8, value: i16) -> i16 {
        value
    }

    #[inline(always)]
    fn zero() -> __m256i {
        // SAFETY: reached from `work` alone.
        unsafe { _mm256_setzero_si256() }
    }

    #[inline(always)]
    unsafe fn values(from: *const i16) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_loadu_si256(from.cast()) }
    }

    #[inline(always)]
    unsafe fn accumulate<const N: usize>(total: &mut [[__m256i; N]; BLOCK], values: [__m256i; N], weights: *const i16) {
        // SAFETY: the caller's promise; reached from a function that has the instructions.
        let group = |o: usize| unsafe { _mm256_set1_epi32(weights.cast::<i32>().add(o).read_unaligned()) };
        // SAFETY: as above.
        add_all(total, values, group, |sums, v, w| unsafe { _mm256_add_epi32(sums, _mm256_madd_epi16(v, w)) });
    }

    #[inline(always)]
    unsafe fn store(sums: __m256i, to: *mut i32) {
        // SAFETY: the caller's promise.
        unsafe { _mm256_storeu_si256(to.cast(), sums) }
    }

    #[target_feature(enable = "avx2")]
    unsafe fn work(conv: &Conv, work: Work<'_, i16>, band: Range<usize>) {
        // SAFETY: the caller's promise.
        unsafe { conv.work::<Self>(work, band) }
    }
}

/// Quads of bytes, unsigned values.
pub(super) struct Vnni;

impl Loop for Vnni {
    const GROUP: usize = 4;
    const LANES: usize = 16;
    const VECTORS: usize = 2;
    type Stored = u8;
    type Sums = __m512i;
    type Group = __m512i;

    #[inline(always)]
    fn stored(byte: u8, _: i16) -> u8 {
        byte
    }

    #[inline(always)]
    fn zero() -> __m512i {
        // SAFETY: reached from `work` alone.
        unsafe { _mm512_setzero_si512() }
    }

    #[inline(always)]
    unsafe fn values(from: *const u8) -> __m512i {
        // SAFETY: the caller's promise.
        unsafe { _mm512_loadu_si512(from.cast()) }
    }

    #[inline(always)]
    unsafe fn accumulate<const N: usize>(total: &mut [[__m512i; N]; BLOCK], values: [__m512i; N], weights: *const u8) {
        // SAFETY: the caller's promise; reached from a function that has the instructions.
        let group = |o: usize| unsafe { _mm512_set1_epi32(weights.cast::<i32>().add(o).read_unaligned()) };
        // SAFETY: as above.
        add_all(total, values, group, |sums, v, w| unsafe { _mm512_dpbusd_epi32(sums, v, w) });
    }

    #[inline(always)]
    unsafe fn store(sums: __m512i, to: *mut i32) {
        // SAFETY: the caller's promise.
        unsafe { _mm512_storeu_si512(to.cast(), sums) }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    unsafe fn work(conv: &Conv, work: Work<'_, u8>, band: Range<usize>) {
        // SAFETY: the caller's promise.
        unsafe { conv.work::<Self>(work, band) }
    }
}
