//! Scenes that go on beyond the frame: light from there is noticed, modelled, and does not spoil the frame.
#![allow(clippy::print_stdout, reason = "figures of a failed or a curious run")]
#![allow(clippy::unwrap_used, reason = "a test")]

mod common;

use std::sync::Arc;

use common::{Rig, assert_physical, s12_psnr, spec};
use rand::{Rng, SeedableRng, rngs::StdRng};
use rand_distr::StandardNormal;
use stokescope_core::device::{Device, Homography};
use stokescope_core::image::{Size, Stack};
use stokescope_core::optics::{FftBackend, Field, Margin, Mask, Psf, StokesOperator};
use stokescope_core::parallel::Workers;
use stokescope_core::pipeline::{FrameReport, Pipeline, Settings};
use stokescope_core::solve::Method;

const FRAME: Size = Size::new(112, 104);
/// Reach of the PSF, and so of the light from beyond.
const REACH: usize = 24;
const NOISE: f32 = 0.002;

/// A frame of a scene that goes on, and everything that is known of it.
struct Case {
    device: Device,
    raw: Stack<f32>,
    /// S0 of the field.
    scene: Stack<f32>,
    /// Stokes images of the frame.
    truth: Stack<f32>,
}

/// A pattern of spots of up to `REACH` pixels from the middle.
fn psf() -> Stack<f32> {
    let mut random = StdRng::seed_from_u64(5);
    let mut psf = Stack::zeros(1, FRAME);
    for (i, v) in psf.plane_mut(0).iter_mut().enumerate() {
        let (x, y) = ((i % FRAME.width).abs_diff(FRAME.width / 2), (i / FRAME.width).abs_diff(FRAME.height / 2));
        let spot = random.random::<f32>().powi(4);
        *v = if x * x + y * y <= REACH * REACH { spot } else { 0.0 };
    }
    psf
}

impl Case {
    /// A built-in scene whose surroundings are `level` times as bright as they are.
    fn new(scene: &str, level: f32) -> Self {
        let field = Field::new(FRAME, Margin::uniform(REACH));
        let n = field.size().pixels();
        let rig = Rig::new(spec(scene, field.size()));
        let mut stokes = rig.truth.as_slice()[..3 * n].to_vec();
        for (i, v) in stokes.iter_mut().enumerate() {
            *v *= if field.shows(i % n) { 1.0 } else { level };
        }
        let margin = REACH as f64;
        let device = Device::builder(FRAME)
            .psf(psf())
            .mask(Mask::stripes(&[0.0, 45.0, 90.0, 135.0], 16))
            .guide(Homography([1.0, 0.0, margin, 0.0, 1.0, margin, 0.0, 0.0, 1.0]))
            .build()
            .unwrap();
        let response = Mask::stripes(&[0.0, 45.0, 90.0, 135.0], 16).response(FRAME).unwrap();
        let psf = Psf::new(psf(), FRAME, 1).unwrap();
        let workers = Arc::new(Workers::new(1));
        let whole = StokesOperator::on_field(&psf, &response, 1, field.margin(), FftBackend::Rustfft, workers);
        let camera = whole.unwrap().remove(0);
        let mut y = vec![0.0; n];
        camera.forward(&stokes, &mut y, &mut camera.convolver.make_scratch());
        let mut random = StdRng::seed_from_u64(7);
        let (mut raw, mut truth) = (Stack::zeros(1, FRAME), Stack::zeros(3, FRAME));
        field.crop(&y, raw.plane_mut(0));
        raw.as_mut_slice().iter_mut().for_each(|v| *v += NOISE * random.sample::<f32, _>(StandardNormal));
        let planes = Stack::from_vec(3, field.size(), stokes.clone()).unwrap();
        field.crop_planes(&planes, &mut truth);
        let s0 = stokes[..n].iter().map(|v| (v + 0.003 * random.sample::<f32, _>(StandardNormal)).max(0.0)).collect();
        Self { device, raw, scene: Stack::from_vec(1, field.size(), s0).unwrap(), truth }
    }

    /// The guide of a camera that sees the frame and nothing else.
    fn narrow_guide(&mut self) -> Stack<f32> {
        self.device.guide = Homography::IDENTITY;
        let mut guide = Stack::zeros(1, FRAME);
        Field::new(FRAME, Margin::uniform(REACH)).crop_planes(&self.scene, &mut guide);
        guide
    }

    fn solve(&self, guide: Option<&Stack<f32>>, method: Option<Method>, iterations: usize) -> (f64, FrameReport) {
        let guided = guide.is_some();
        let settings = Settings { guided, method, iterations: Some(iterations), threads: 2, ..Settings::default() };
        let mut pipeline = Pipeline::new(&self.device, settings).unwrap();
        let frame = pipeline.process(self.raw.view(), guide.map(Stack::view)).unwrap();
        if method.is_none() {
            assert_physical(frame.stokes(), "a scene that goes on");
        }
        (s12_psnr(frame.stokes(), &self.truth), frame.into_report())
    }
}

#[test]
fn light_from_beyond_is_modelled_where_it_is_and_costs_little() {
    for scene in ["wedges", "spheres", "tissue"] {
        let dark = Case::new(scene, 0.0);
        let (alone, report) = dark.solve(Some(&dark.scene), None, 20);
        assert_eq!((report.field.margin, report.field.light_from_beyond), (Margin::default(), 0.0), "{scene}, dark");
        for level in [0.1, 1.0] {
            let case = Case::new(scene, level);
            let (psnr, report) = case.solve(Some(&case.scene), None, 20);
            println!("{scene}, level {level}: {psnr:.2} dB, dark {alone:.2} dB, {:?}", report.field);
            assert_eq!(report.field.margin, Margin::uniform(REACH), "{scene}, level {level}");
            assert!(report.field.light_from_beyond > 0.01 * f64::from(level) as f32, "{:?}", report.field);
            assert!(report.warnings.is_empty(), "{scene}, level {level}: {:?}", report.warnings);
            assert!(psnr > alone - 2.0, "{scene}, level {level}: {psnr:.2} dB, dark {alone:.2} dB");
        }
    }
}

#[test]
fn what_the_guide_does_not_see_is_solved_for() {
    for scene in ["wedges", "tissue"] {
        let mut dark = Case::new(scene, 0.0);
        let guide = dark.narrow_guide();
        let (alone, _) = dark.solve(Some(&guide), None, 20);
        let mut case = Case::new(scene, 1.0);
        let guide = case.narrow_guide();
        let (psnr, report) = case.solve(Some(&guide), None, 20);
        println!("{scene}: {psnr:.2} dB, dark {alone:.2} dB, {:?}", report.field);
        assert_eq!(report.field.margin, Margin::uniform(REACH), "{scene}");
        assert!(psnr > alone - 6.0, "{scene}: {psnr:.2} dB, dark {alone:.2} dB");
    }
}

#[test]
fn without_a_guide_the_frame_is_solved_again_with_its_margin() {
    let (dark, case) = (Case::new("wedges", 0.0), Case::new("wedges", 1.0));
    let (alone, report) = dark.solve(None, None, 60);
    assert_eq!(report.field.margin, Margin::default());
    let (psnr, report) = case.solve(None, None, 60);
    println!("{psnr:.2} dB, dark {alone:.2} dB, {:?}", report.field);
    assert_eq!(report.field.margin, Margin::uniform(REACH));
    assert!(psnr > alone - 3.0, "{psnr:.2} dB, dark {alone:.2} dB");
}

#[test]
fn beside_a_guide_of_another_scene_light_from_beyond_is_modelled_too() {
    let (case, other) = (Case::new("wedges", 1.0), Case::new("spheres", 1.0));
    let (_, report) = case.solve(Some(&other.scene), None, 60);
    assert_eq!((report.method, report.field.margin), (Method::Stokes, Margin::uniform(REACH)), "{:?}", report.warnings);
}

#[test]
fn a_field_stop_is_taken_at_its_word_and_the_reference_methods_know_the_margin() {
    let mut case = Case::new("spheres", 1.0);
    let (with, report) = case.solve(None, Some(Method::Fista), 60);
    assert_eq!(report.field.margin, Margin::uniform(REACH));
    case.device.margin = Margin::default();
    let (without, report) = case.solve(None, Some(Method::Fista), 60);
    assert_eq!(report.field.margin, Margin::default());
    println!("fista with the margin {with:.2} dB, without {without:.2} dB");
    assert!(with > without + 3.0, "with the margin {with:.2} dB, without {without:.2} dB");
}

#[test]
fn a_memory_limit_that_leaves_no_room_for_the_margin_is_said() {
    let case = Case::new("spheres", 1.0);
    let plan = |limit| {
        let settings = Settings { iterations: Some(5), threads: 1, memory_limit_bytes: limit, ..Settings::default() };
        Pipeline::new(&case.device, settings).unwrap()
    };
    let needed: usize = plan(usize::MAX).stages().map(|(_, bytes)| bytes).sum();
    let mut pipeline = plan(needed);
    let frame = pipeline.process(case.raw.view(), case.scene.view()).unwrap();
    let told = frame.warnings().iter().any(|warning| warning.to_string().contains("beyond the frame"));
    assert!(told, "{:?}", frame.warnings());
}

/// A video plans the field first: where light comes from beyond the frame, nothing is planned for the frame alone, and where none
/// comes the result is that of the frame alone, also in memory that has no room for both.
#[test]
fn a_video_begins_on_the_field_and_takes_no_more_memory_than_it_needs() {
    let settings = |video: bool, memory_limit_bytes: usize| Settings {
        video,
        iterations: Some(10),
        threads: 1,
        memory_limit_bytes,
        ..Settings::default()
    };
    let held = |pipeline: &Pipeline| pipeline.stages().map(|(_, bytes)| bytes).sum::<usize>();
    let plan = |case: &Case, video: bool, limit: usize| Pipeline::new(&case.device, settings(video, limit)).unwrap();

    let bright = Case::new("tissue", 1.0);
    let mut video = plan(&bright, true, usize::MAX);
    let (field, begun) = (held(&video), Margin::uniform(REACH));
    assert_eq!(video.field_bytes(), 0, "the field is planned");
    let report = video.process(bright.raw.view(), bright.scene.view()).unwrap().into_report();
    assert_eq!((report.field.margin, held(&video)), (begun, field));
    let mut single = plan(&bright, false, usize::MAX);
    single.process(bright.raw.view(), bright.scene.view()).unwrap();
    assert_eq!(video.result().stokes.as_slice(), single.result().stokes.as_slice());
    assert!(held(&single) > field + field / 4, "a single frame began on the frame alone");

    for narrow in [false, true] {
        let mut dark = Case::new("tissue", 0.0);
        let guide = if narrow { dark.narrow_guide() } else { dark.scene.clone() };
        let mut alone = plan(&dark, false, usize::MAX);
        alone.process(dark.raw.view(), guide.view()).unwrap();
        for limit in [usize::MAX, field] {
            let mut video = plan(&dark, true, limit);
            let frame = video.process(dark.raw.view(), guide.view()).unwrap();
            let found = (frame.report().field.margin, frame.warnings().len());
            assert_eq!(found, (Margin::default(), 0), "narrow guide {narrow}, limit {limit}");
            assert_eq!(video.result().stokes.as_slice(), alone.result().stokes.as_slice(), "narrow guide {narrow}");
            assert!(held(&video) <= limit);
            assert!(limit < usize::MAX || held(&video) > field, "room for both");
        }
    }
}

/// The scene's surroundings turn dark while the guide, which sees the frame alone, cannot tell.
#[test]
fn a_video_goes_back_to_the_frame_alone_where_the_margin_turns_dark_unseen() {
    let (mut bright, mut dark) = (Case::new("tissue", 1.0), Case::new("tissue", 0.0));
    let (bright_guide, dark_guide) = (bright.narrow_guide(), dark.narrow_guide());
    let settings = |video| Settings { video, iterations: Some(10), threads: 1, ..Settings::default() };
    let mut video = Pipeline::new(&bright.device, settings(true)).unwrap();
    let report = video.process(bright.raw.view(), bright_guide.view()).unwrap().into_report();
    assert_eq!(report.field.margin, Margin::uniform(REACH));
    let (alone, _) = dark.solve(Some(&dark_guide), None, 10);
    for frame in 0..3 {
        let report = video.process(dark.raw.view(), dark_guide.view()).unwrap().into_report();
        assert_eq!((report.field.margin, report.warnings.len()), (Margin::default(), 0), "frame {frame}");
        let psnr = s12_psnr(&video.result().stokes, &dark.truth);
        assert!(psnr > alone - 0.1, "frame {frame}: {psnr:.2} dB, by itself {alone:.2} dB");
    }
    let report = video.process(bright.raw.view(), bright_guide.view()).unwrap().into_report();
    assert_eq!(report.field.margin, Margin::uniform(REACH), "the light is back");
}

#[test]
fn a_frame_after_others_has_the_bits_that_it_has_alone() {
    let (light, dark, other) = (Case::new("wedges", 1.0), Case::new("wedges", 0.0), Case::new("spheres", 1.0));
    let settings = Settings { iterations: Some(4), threads: 1, ..Settings::default() };
    let plan = || Pipeline::new(&light.device, settings.clone()).unwrap();
    let frames = [
        ("light from beyond", &light.raw, Some(&light.scene)),
        ("none", &dark.raw, Some(&dark.scene)),
        ("another scene's guide", &light.raw, Some(&other.scene)),
        ("no guide", &dark.raw, None),
        ("light from beyond, again", &light.raw, Some(&light.scene)),
    ];
    let mut pipeline = plan();
    for (name, raw, guide) in frames {
        let after = pipeline.process(raw.view(), guide.map(Stack::view)).unwrap().stokes().clone();
        let mut alone = plan();
        let alone = alone.process(raw.view(), guide.map(Stack::view)).unwrap();
        assert!(after.as_slice() == alone.stokes().as_slice(), "{name}");
    }
}
