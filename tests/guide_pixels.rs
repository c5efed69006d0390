//! Pixels of a guide that have no value, or a false one, cost hardly anything; points of light are kept.
#![allow(clippy::unwrap_used, reason = "a test")]

mod common;

use std::sync::LazyLock;

use common::{Rig, map, s12_psnr, spec};
use stokescope_core::image::{Size, Stack};
use stokescope_core::pipeline::{FrameReport, Settings};

const SIZE: Size = Size::new(160, 160);

static RIG: LazyLock<Rig> = LazyLock::new(|| Rig::new(spec("plastic", SIZE)));

fn solve(guide: Option<&Stack<f32>>) -> (Stack<f32>, FrameReport) {
    let mut pipeline = RIG.pipeline(guide.is_some(), &Settings { threads: 1, ..Settings::default() });
    let report = pipeline.process(RIG.raw.view(), guide.map(Stack::view)).unwrap().into_report();
    (pipeline.result().stokes.clone(), report)
}

/// The guide with `value` in about one of `every` pixels.
fn speckled(guide: &Stack<f32>, every: usize, value: f32) -> Stack<f32> {
    let mut i = 0usize;
    map(guide, |v| {
        i += 1;
        // A fixed scatter without rows or columns.
        if i.wrapping_mul(2_654_435_761) >> 7 & 0xFFFF < 0x1_0000 / every { value } else { v }
    })
}

#[test]
fn bad_pixels_cost_little_and_are_reported() {
    let (clean, report) = solve(Some(&RIG.guide));
    assert_eq!(report.guide_replaced, 0.0);
    let best = s12_psnr(&clean, &RIG.truth);
    let none = s12_psnr(&solve(None).0, &RIG.truth);
    let mut block = RIG.guide.clone();
    for y in 60..86 {
        block.plane_mut(0)[y * 160 + 70..y * 160 + 96].fill(f32::NAN);
    }
    let cases = [
        ("1 % NaN", speckled(&RIG.guide, 100, f32::NAN), 0.01),
        ("5 % infinite", speckled(&RIG.guide, 20, f32::INFINITY), 0.05),
        ("a block of NaN", block, 0.0264),
        ("2 % hot", speckled(&RIG.guide, 50, 1.0), 0.02),
        ("2 % dead", speckled(&RIG.guide, 50, 0.0), 0.02),
    ];
    for (what, guide, share) in cases {
        let (stokes, report) = solve(Some(&guide));
        let psnr = s12_psnr(&stokes, &RIG.truth);
        println!("{what}: {psnr:.2} dB, clean {best:.2}, no guide {none:.2}, replaced {:.4}", report.guide_replaced);
        assert!(psnr > best - 1.5 && psnr > none, "{what}: {psnr} beside {best}, without a guide {none}");
        assert!((report.guide_replaced / share - 1.0).abs() < 0.4, "{what}: {}", report.guide_replaced);
        assert!(report.warnings.iter().any(|w| w.to_string().contains("dead or hot")), "{what}: {:?}", report.warnings);
    }
}
