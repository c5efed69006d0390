//! Stage II: answers compared with ONNX Runtime's, broken files, tiles, data consistency, memory, and its part in the pipeline.
#![cfg(feature = "fusion")]
#![allow(unsafe_code, reason = "a global allocator is unsafe by its trait")]
#![allow(clippy::unwrap_used, reason = "a test")]

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use common::{Rig, assert_physical, settings, spec};
use sha2::{Digest, Sha256};
use stokescope::board::Board;
use stokescope::camera::sim::{Flaws, SimSpec};
use stokescope::files::read_npy;
use stokescope::model::{Allowance, Choice, Model, ModelError, OpenError, Precision, Selection, SelectionError};
use stokescope::output::Report;
use stokescope_core::image::{Size, Stack};
use stokescope_core::optics::{FftBackend, StokesOperator};
use stokescope_core::parallel::Workers;
use stokescope_core::pipeline::{Pipeline, Settings, Warning};
use stokescope_core::refine::model::{CANDIDATES, CELL, Tiling};
use stokescope_core::refine::{self, Engine, Input, Network, Plan, PlanError, Runner};
use stokescope_core::solve::Method;

/// The system's allocator, counting what each thread holds.
struct Counting;

thread_local! {
    static HELD: Cell<usize> = const { Cell::new(0) };
    static PEAK: Cell<usize> = const { Cell::new(0) };
}

fn count(more: usize, less: usize) {
    // A thread that ends may free what it no longer counts.
    let _ = HELD.try_with(|held| {
        held.set((held.get() + more).saturating_sub(less));
        let _ = PEAK.try_with(|peak| peak.set(peak.get().max(held.get())));
    });
}

// SAFETY: every call goes to the system's allocator as it came; counting touches no memory it hands out.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        count(0, layout.size());
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Bytes that `work` held at its peak and holds afterwards, beyond what was held before.
fn held<T>(work: impl FnOnce() -> T) -> (T, usize, usize) {
    let before = HELD.get();
    PEAK.set(before);
    let result = work();
    (result, PEAK.get().saturating_sub(before), HELD.get().saturating_sub(before))
}

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/fusion").join(name)
}

fn load(folder: &Path, precision: Precision) -> Result<Network, OpenError> {
    Model::load(folder.to_str().unwrap())?.open(precision)
}

/// The model `mixes` with another f32 file and another manifest. The manifest's digest is changed to that of the file.
fn altered(onnx: &[u8], edit: impl Fn(String) -> String) -> (tempfile::TempDir, Result<Network, OpenError>) {
    let dir = tempfile::tempdir().unwrap();
    let manifest = dir.path().join("manifest.toml");
    std::fs::write(dir.path().join("model.onnx"), onnx).unwrap();
    std::fs::copy(golden("mixes/model-int8.onnx"), dir.path().join("model-int8.onnx")).unwrap();
    std::fs::write(&manifest, edit(std::fs::read_to_string(golden("mixes/manifest.toml")).unwrap())).unwrap();
    let mut network = load(dir.path(), Precision::F32);
    if let Err(OpenError::Model(ModelError::Digest { expected, found, .. })) = &network {
        let text = std::fs::read_to_string(&manifest).unwrap().replace(expected, found);
        std::fs::write(&manifest, text).unwrap();
        network = load(dir.path(), Precision::F32);
    }
    (dir, network)
}

fn mixes() -> Vec<u8> {
    std::fs::read(golden("mixes/model.onnx")).unwrap()
}

/// An engine that gives each candidate the same weight in every pixel.
#[derive(Clone, Debug)]
struct Fixed(Vec<f32>);

impl Runner for Fixed {
    fn run(&mut self, _: &[f32], _: &Arc<Workers>, take: &mut dyn FnMut(&[f32])) -> Result<(), PlanError> {
        take(&self.0);
        Ok(())
    }
}

impl Engine for Fixed {
    fn runner(&self) -> Result<Box<dyn Runner>, PlanError> {
        Ok(Box::new(self.clone()))
    }

    fn weight_bytes(&self) -> usize {
        0
    }

    fn run_bytes(&self) -> usize {
        0
    }

    fn macs(&self) -> u64 {
        0
    }

    fn parameters(&self) -> usize {
        0
    }
}

/// A network on tiles of `tile` pixels that gives candidates fixed weights; those that are not listed have none.
fn fixed(tile: usize, halo: usize, weights: &'static [(usize, f32)]) -> Network {
    let model = refine::Model { name: "fixed".to_owned(), tiling: Tiling { tile, halo, multiple: 16 } };
    let plan = move |model: &refine::Model| {
        let cells = model.tiling.tile / CELL;
        let mut all = vec![0.0; CELL * CELL * CANDIDATES * cells * cells];
        for (candidate, weight) in weights {
            all.chunks_exact_mut(CELL * CELL * cells * cells).nth(*candidate).unwrap().fill(*weight);
        }
        Ok(Arc::new(Fixed(all)) as Arc<dyn Engine>)
    };
    Network::with_engine(model, Precision::F32, plan).unwrap()
}

fn replace(from: &str, to: &str) -> impl Fn(String) -> String {
    move |text| {
        assert!(text.contains(from), "{from:?} is not in {text}");
        text.replace(from, to)
    }
}

/// The pattern of `golden_input` in scripts/train/ship.py, `[6, 256, 256]`.
fn pattern(tile: usize) -> Vec<f32> {
    let wave = |a: f32, b: f32, c: f32| move |x: f32, y: f32| (a * x + b * y + c).sin();
    let s0 = |x: f32, y: f32| 1.0 + 0.3 * wave(0.11, 0.05, 0.0)(x, y) + 0.1 * wave(0.7, -0.4, 1.0)(x, y);
    let asked = move |x: f32, y: f32| 0.2 * wave(0.7, -0.4, 1.0)(x, y);
    let planes: [Box<dyn Fn(f32, f32) -> f32>; 6] = [
        Box::new(s0),
        Box::new(move |x, y| 0.2 * s0(x, y) * wave(0.03, 0.02, 2.0)(x, y)),
        Box::new(move |x, y| 0.2 * s0(x, y) * wave(-0.02, 0.04, 3.0)(x, y)),
        Box::new(move |x, y| 0.03 * wave(0.09, 0.1, 4.0)(x, y)),
        // The residual contains detail of the guide.
        Box::new(move |x, y| 0.03 * wave(0.08, -0.1, 5.0)(x, y) + asked(x, y) * wave(0.03, 0.02, 2.0)(x, y)),
        Box::new(move |x, y| 0.03 * wave(0.1, 0.03, 6.0)(x, y) + asked(x, y) * wave(-0.02, 0.04, 3.0)(x, y)),
    ];
    let pixels = || (0..tile * tile).map(|i| ((i % tile) as f32, (i / tile) as f32));
    planes.iter().flat_map(|plane| pixels().map(move |(x, y)| plane(x, y))).collect()
}

/// The power of a PSF of `golden_input`, `[256, 256]`.
fn power(tile: usize) -> Vec<f32> {
    let signed = |k: usize| if k < tile / 2 { k as f32 } else { k as f32 - tile as f32 };
    (0..tile * tile).map(|i| 1.0 / (1.0 + (signed(i % tile).powi(2) + signed(i / tile).powi(2)) / 100.0)).collect()
}

#[test]
fn answers_are_those_of_onnx_runtime() {
    let random = golden("mixes");
    let shipped = Model::shipped().map(|name| (name.to_owned(), golden(&format!("shipped/{name}-"))));
    for (name, answers) in shipped.chain([(random.to_str().unwrap().to_owned(), random.join(""))]) {
        for (precision, largest, mean) in [(Precision::F32, 1e-4, 1e-5), (Precision::Int8, 1e-2, 1e-3)] {
            let network = Model::load(&name).unwrap().open(precision).unwrap();
            let tile = network.model().tiling.tile;
            let answer = network.answer(&pattern(tile), &power(tile)).unwrap();
            let expected = read_npy(Path::new(&format!("{}{precision}.npy", answers.display()))).unwrap();
            let [_, planes, rows, columns] = expected.shape[..] else { panic!("{:?}", expected.shape) };
            // Golden files hold both planes of the first corner, then those of the last.
            let corner = (0..planes * rows).flat_map(|k| {
                let (plane, row, far) = (k / rows % 2, k % rows, k / rows / 2 * (tile - rows));
                let first = (plane * tile + far + row) * tile + far;
                &answer[first..first + columns]
            });
            let expected = expected.into_f32();
            let errors: Vec<f32> = corner.zip(&expected).map(|(a, b)| (a - b).abs()).collect();
            let (max, average) =
                (errors.iter().copied().fold(0.0, f32::max), errors.iter().sum::<f32>() / errors.len() as f32);
            println!("{name} {precision}: max {max:e}, mean {average:e}");
            assert!(max <= largest && average <= mean, "{name} {precision}: {max:e} {average:e}");
            assert!(expected.iter().any(|v| v.abs() > 3e-3), "the answer is all but zero");
        }
    }
}

#[test]
fn a_file_that_is_not_the_manifests_is_refused_with_both_digests() {
    let dir = tempfile::tempdir().unwrap();
    for file in ["manifest.toml", "model.onnx", "model-int8.onnx"] {
        std::fs::copy(golden("mixes").join(file), dir.path().join(file)).unwrap();
    }
    let mut bytes = mixes();
    bytes[1000] ^= 1;
    std::fs::write(dir.path().join("model.onnx"), bytes).unwrap();
    let e = load(dir.path(), Precision::F32).unwrap_err().to_string();
    assert!(e.contains("model.onnx: its SHA-256 is ") && e.contains("manifest.toml expects "), "{e}");
    std::fs::remove_file(dir.path().join("model.onnx")).unwrap();
    let e = load(dir.path(), Precision::F32).unwrap_err().to_string();
    assert!(e.contains("model.onnx: No such file"), "{e}");
}

#[test]
fn broken_networks_are_refused_with_file_expected_and_found() {
    let message = |onnx: &[u8]| altered(onnx, |text| text).1.unwrap_err().to_string();
    let whole = mixes();
    for cut in [0, 1, whole.len() / 3, whole.len() - 1] {
        let e = message(&whole[..cut]);
        assert!(e.contains("model.onnx: "), "{cut}: {e}");
    }
    for (file, expected) in [
        ("unknown.onnx", "operator Refine is unknown; allowed: the standard ONNX operators"),
        ("double.onnx", "the network's input is 1,55,64,64,F64, its manifest makes it f32 [1, 55, 64, 64]"),
        ("identity.onnx", "the network's output is 1,55,64,64,F32, its manifest makes it f32 [1, 240, 64, 64]"),
    ] {
        let e = message(&std::fs::read(golden(file)).unwrap());
        assert!(e.ends_with(&format!("model.onnx: {expected}")), "{e}");
    }
    let narrow = altered(&std::fs::read(golden("identity.onnx")).unwrap(), replace("tile = 256", "tile = 128"));
    let e = narrow.1.unwrap_err().to_string();
    assert!(e.ends_with("the network's input is 1,55,64,64,F32, its manifest makes it f32 [1, 55, 32, 32]"), "{e}");
}

#[test]
fn damaged_bytes_never_panic() {
    let whole = mixes();
    let mut seed = 1u64;
    for _ in 0..60 {
        let mut bytes = whole.clone();
        for _ in 0..3 {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            bytes[(seed >> 33) as usize % 400] = (seed >> 24) as u8;
        }
        // Some are valid networks still. No change ends this thread.
        let _ = altered(&bytes, |text| text).1;
    }
}

const SIZE: Size = Size::new(96, 80);

fn rig() -> Rig {
    Rig::new(spec("plastic", SIZE))
}

fn operators(rig: &Rig, threads: usize) -> Vec<StokesOperator> {
    let (c, workers) = (&rig.calibration, Arc::new(Workers::new(threads)));
    StokesOperator::for_channels(&c.psf, &c.response, c.sensor.channels, FftBackend::default(), workers).unwrap()
}

/// A polarized scene and readings that contradict nothing, because none is trusted.
fn scene(rig: &Rig) -> (Stack<f32>, Stack<f32>) {
    (rig.truth.clone(), Stack::zeros(rig.calibration.sensor.channels, rig.spec.size))
}

/// Refines the true images of `rig`, which no reading contradicts, on `threads` threads.
fn refined(rig: &Rig, network: &Network, threads: usize) -> (Stack<f32>, usize) {
    let (mut stokes, untrusted) = scene(rig);
    let plan = Plan::new(network, &operators(rig, threads)).unwrap();
    let input = Input { raw: &rig.raw, weight: &untrusted, sigma: 1e-6 };
    let report = plan.run(&input, &mut stokes, &mut plan.make_workspace().unwrap());
    assert!(report.is_learned() && report.refused + report.quiet == 0, "{report:?}");
    (stokes, report.tiles)
}

#[test]
fn tiles_leave_no_seams() {
    let rig = Rig::new(spec("plastic", Size::new(192, 192)));
    // Candidates see 24 pixels far, the network of `mixes` three more cells: a halo of 36 pixels hides both.
    let tiling = |tile: usize, halo: usize| {
        move |text: String| {
            let text = replace("tile = 256", &format!("tile = {tile}"))(text);
            replace("halo = 32", &format!("halo = {halo}"))(text)
        }
    };
    let file = |tile, halo| altered(&mixes(), tiling(tile, halo)).1.unwrap();
    let weights = &[(0, -0.3), (1, 0.5), (2, 0.4), (5, -0.3), (6, 0.2), (8, 0.3), (11, 0.3), (12, 0.1)];
    let cases: [&dyn Fn(usize, usize) -> Network; 2] = [&file, &|tile, halo| fixed(tile, halo, weights)];
    for network in cases {
        let (whole, one) = refined(&rig, &network(192, 40), 1);
        assert_eq!(one, 1);
        let change = common::relative_difference(whole.as_slice(), rig.truth.as_slice());
        assert!(change > 1e-3, "the network changes too little to tell: {change:e}");
        for threads in [1, 3] {
            let (tiled, many) = refined(&rig, &network(128, 40), threads);
            assert!(many > 8);
            let worst = tiled.as_slice().iter().zip(whole.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1e-5, "{many} tiles differ from one by {worst:e}");
        }
    }
}

#[test]
fn quiet_and_unchanged_tiles_are_not_run() {
    let rig = rig();
    let (truth, untrusted) = scene(&rig);
    let plan = Plan::new(&fixed(48, 16, &[(0, -0.1)]), &operators(&rig, 2)).unwrap();
    let mut w = plan.make_workspace().unwrap();
    let mut run = |stokes: &Stack<f32>| {
        let mut stokes = stokes.clone();
        let input = Input { raw: &rig.raw, weight: &untrusted, sigma: 0.002 };
        let report = plan.run(&input, &mut stokes, &mut w);
        assert_physical(&stokes, "refined");
        (report, stokes)
    };
    let mut unpolarized = truth.clone();
    (1..3).for_each(|k| unpolarized.plane_mut(k).fill(0.0));
    let (report, same) = run(&unpolarized);
    let tiles = report.tiles;
    assert_eq!(report, refine::Report { tiles, quiet: tiles, ..refine::Report::default() });
    assert!(same == unpolarized);
    let (first, refined) = run(&truth);
    assert!(first.run > 0 && first.kept == 0 && first.run + first.quiet == tiles, "{first:?}");
    let (second, again) = run(&truth);
    assert_eq!((second.run, second.kept, second.quiet), (0, first.run, first.quiet));
    assert!(again == refined, "a kept correction is applied again");
    // Something appears in one corner: only the tiles there are run again.
    let mut moved = truth.clone();
    for y in 0..8 {
        moved.plane_mut(1)[y * SIZE.width..][..8].iter_mut().for_each(|v| *v += 0.2);
    }
    let (third, _) = run(&moved);
    assert!((1..=4).contains(&third.run) && third.kept >= first.run - 4, "{third:?}");
}

/// The pipeline's settings with a network of fixed weights on tiles of `tile` pixels.
fn with_network(weights: &'static [(usize, f32)], tile: usize) -> Settings {
    Settings { fusion: Some(fixed(tile, Tiling::largest_halo(tile, 16), weights)), ..settings(Method::Guided, 10, 2) }
}

#[test]
fn what_the_readings_contradict_is_refused() {
    let rig = rig();
    let mut physics = rig.pipeline(true, &settings(Method::Guided, 10, 2));
    physics.process(rig.raw.view(), rig.guide.view()).unwrap();
    let stage1 = &physics.result().stokes;
    for tile in [48, 96] {
        let mut wild = rig.pipeline(true, &with_network(&[(0, 5.0)], tile));
        let report = wild.process(rig.raw.view(), rig.guide.view()).unwrap().into_report();
        let fusion = report.fusion.unwrap();
        assert!((fusion.tiles == 1) == (tile == 96) && fusion.run > 0, "{fusion:?}");
        assert!(fusion.refused == fusion.run && !fusion.is_learned(), "{fusion:?}");
        assert!(wild.result().stokes == *stage1, "refused everywhere, yet not the result of stage I");
        let mut mild = rig.pipeline(true, &with_network(&[(0, 0.001)], tile));
        let report = mild.process(rig.raw.view(), rig.guide.view()).unwrap().into_report();
        let fusion = report.fusion.unwrap();
        assert!(fusion.is_learned() && fusion.refused == 0, "{fusion:?}");
        assert!(mild.result().stokes != *stage1);
        assert_physical(&mild.result().stokes, "mild");
        let fixed_model = Selection { model: Some("fixed".to_owned()), ..Selection::default() };
        let json = serde_json::to_value(Report::new(&mild, &report, &fixed_model, "", [report.recon; 2])).unwrap();
        assert_eq!((&json["model"], &json["fusion"]["result"]), (&"fixed".into(), &"learned".into()));
        let kept = mild.stage1().unwrap();
        let physics = wild.result().angles.as_ref().unwrap();
        assert!(common::relative_difference(kept.as_slice(), physics.as_slice()) == 0.0);
    }
}

#[test]
fn the_readings_see_little_of_what_is_added() {
    let rig = rig();
    let operator = &operators(&rig, 1)[0];
    let (result, _) = refined(&rig, &fixed(96, 16, &[(0, -0.2)]), 1);
    let energy = |v: &[f32]| v.iter().map(|v| v * v).sum::<f32>();
    let visible = |image: &[f32]| {
        let mut seen = vec![0.0; image.len()];
        operator.blur(image, &mut seen, &mut operator.convolver.make_scratch());
        energy(&seen) / energy(image)
    };
    for k in [1, 2] {
        let added: Vec<f32> = result.plane(k).iter().zip(rig.truth.plane(k)).map(|(a, b)| a - b).collect();
        let (before, after) = (visible(rig.truth.plane(k)), visible(&added));
        assert!(after < 0.2 * before, "S{k}: {before} of the network's answer shows, {after} of what is added");
    }
}

#[test]
fn colour_channels_are_refined_each_by_itself() {
    let rig = Rig::new(SimSpec { color: true, ..spec("plastic", Size::new(40, 32)) });
    let mut pipeline = rig.pipeline(true, &with_network(&[(0, 0.001)], 32));
    let fusion = pipeline.process(rig.raw.view(), rig.guide.view()).unwrap().into_report().fusion.unwrap();
    assert!(fusion.tiles.is_multiple_of(3) && fusion.is_learned(), "{fusion:?}");
    assert_physical(&pipeline.result().stokes, "colour");
}

#[test]
fn refitting_a_psf_takes_no_more_memory_than_the_limit_counts() {
    let flaws = Flaws { drift: 0.02, ..Flaws::default() };
    let rig = Rig::new(SimSpec { flaws, ..spec("spheres", Size::new(128, 128)) });
    let settings = settings(Method::Guided, 5, 1);
    let mut pipeline = rig.pipeline(true, &settings);
    let stages: usize = pipeline.stages().map(|(_, bytes)| bytes).sum();
    let mut tight = rig.pipeline(true, &Settings { memory_limit_bytes: stages, ..settings });
    let refused = tight.process(rig.raw.view(), rig.guide.view()).unwrap().into_report().warnings;
    let needs = refused.iter().find_map(|warning| match warning {
        Warning::PsfNotFollowed { needed, .. } => Some(*needed),
        _ => None,
    });
    let counted = needs.unwrap() - stages;
    let (report, peak, _) = held(|| pipeline.process(rig.raw.view(), rig.guide.view()).unwrap().into_report());
    assert!(report.psf_scale > 1.01, "{}", report.psf_scale);
    println!("a refit holds {peak} bytes for a moment, {counted} are counted");
    assert!(peak > 0 && peak <= counted, "a refit holds {peak} bytes, {counted} are counted");
}

#[test]
fn memory_is_what_the_plan_states() {
    let rig = rig();
    let (truth, untrusted) = scene(&rig);
    let (f32, int8) = (Precision::F32, Precision::Int8);
    for (name, precision) in [("mixes", f32), ("mixes", int8), ("default", f32), ("default", int8)] {
        let model = || {
            if name == "default" { Model::load(name) } else { Model::load(golden(name).to_str().unwrap()) }
        };
        let (network, _, kept) = held(|| model().unwrap().open(precision).unwrap());
        let plan = Plan::new(&network, &operators(&rig, 1)).unwrap();
        let (w, _, buffers) = held(|| plan.make_workspace().unwrap());
        let (mut w, stated) = (w, plan.workspace_bytes());
        assert!(buffers.abs_diff(stated) < 64 << 10, "{name}: workspace {buffers}, stated {stated}");
        let input = Input { raw: &rig.raw, weight: &untrusted, sigma: 1e-6 };
        let mut stokes = truth.clone();
        let (report, peak, left) = held(|| plan.run(&input, &mut stokes, &mut w));
        assert!(report.run > 0);
        println!(
            "{name} {precision}: network {kept}, workspace {buffers}, peak of a run {peak}, stated {}",
            plan.bytes()
        );
        assert!(peak <= plan.bytes(), "{name} {precision}: a run holds {peak}, stated {}", plan.bytes());
        assert!(left < 64 << 10, "{name} {precision}: {left} bytes stay");
    }
}

/// Physics alone, planned without a model.
fn physics_of(rig: &Rig) -> Pipeline {
    rig.pipeline(true, &settings(Method::Guided, 10, 2))
}

#[test]
fn auto_is_the_best_model_that_time_and_memory_allow_and_a_name_is_that_model_or_an_error() {
    let rig = rig();
    let select = |choice: &Choice, allowance: &Allowance<'_>| {
        let mut pipeline = physics_of(&rig);
        let selection = Selection::add(&mut pipeline, choice, Precision::Int8, allowance)?;
        assert_eq!(pipeline.fusion().map(|plan| plan.network().model().name.clone()), selection.model);
        Ok::<_, SelectionError>(selection)
    };
    let best = select(&Choice::Auto, &Allowance::ALL).unwrap();
    assert_eq!((best.model.as_deref(), best.precision), (Some("default"), Some(Precision::Int8)));
    let slow = |model: &Model, _| (model.network.name == "default").then(|| "too slow".to_owned());
    let quick = select(&Choice::Auto, &Allowance { too_slow: &slow, ..Allowance::ALL }).unwrap();
    assert!(quick.model.as_deref() == Some("preview") && quick.why.contains("default (too slow)"), "{quick:?}");
    let held = physics_of(&rig).stages().map(|(_, bytes)| bytes).sum::<usize>();
    let tight = Allowance { limit: held + physics_of(&rig).field_bytes() + (1 << 16), ..Allowance::ALL };
    let none = select(&Choice::Auto, &tight).unwrap();
    assert!(none.model.is_none() && none.why.contains("MiB"), "{none:?}");
    let named = Choice::from("preview".to_owned());
    let error = select(&named, &tight).unwrap_err();
    assert!(matches!(error, SelectionError::Plan(stokescope_core::pipeline::PlanError::Memory { .. })), "{error}");
    assert_eq!(select(&Choice::Off, &Allowance::ALL).unwrap().model, None);
    let missing = Choice::from("none-such".to_owned());
    let error = select(&missing, &Allowance::ALL).unwrap_err();
    assert!(matches!(error, SelectionError::Model(OpenError::Model(ModelError::Missing { .. }))), "{error}");
    let folder = Choice::from(golden("mixes").to_str().unwrap().to_owned());
    assert_eq!(select(&folder, &Allowance::ALL).unwrap().model.as_deref(), Some("mixes"));
}

#[test]
fn auto_is_physics_without_a_guide() {
    let rig = rig();
    let mut pipeline = rig.pipeline(false, &Settings { guided: false, ..settings(Method::Stokes, 10, 2) });
    let selection = Selection::add(&mut pipeline, &Choice::Auto, Precision::Int8, &Allowance::ALL).unwrap();
    assert!(selection.model.is_none() && selection.why.contains("guide"), "{selection:?}");
}

#[test]
fn every_board_gets_the_model_that_its_plan_names() {
    let model = |board: &str| {
        let board = Board::load(board).unwrap();
        stokescope::plan::Plan::new(&board, Some(Size::new(250, 250))).unwrap().selection.model
    };
    let found: Vec<_> = Board::shipped().filter_map(|board| Some((board, model(board)?))).collect();
    let name = |board| (board, "default".to_owned());
    assert_eq!(found, ["cm4-microscope", "rock-5b", "orange-pi-5", "x86-sim", "x86-libcamera-virtual"].map(name));
}

/// Fields of an ONNX file, which is a protocol buffer.
mod onnx {
    fn varint(mut n: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        while n >= 128 {
            bytes.push(n as u8 | 128);
            n >>= 7;
        }
        bytes.push(n as u8);
        bytes
    }

    fn number(field: usize, value: usize) -> Vec<u8> {
        [varint(field << 3), varint(value)].concat()
    }

    fn bytes(field: usize, content: &[u8]) -> Vec<u8> {
        [varint(field << 3 | 2), varint(content.len()), content.to_vec()].concat()
    }

    pub(crate) fn attribute(name: &str, value: usize) -> Vec<u8> {
        const INT: usize = 2;
        bytes(5, &[bytes(1, name.as_bytes()), number(3, value), number(20, INT)].concat())
    }

    pub(crate) fn node(operator: &str, inputs: &[&str], output: &str, attributes: &[u8]) -> Vec<u8> {
        let inputs: Vec<u8> = inputs.iter().flat_map(|name| bytes(1, name.as_bytes())).collect();
        bytes(1, &[inputs, bytes(2, output.as_bytes()), bytes(4, operator.as_bytes()), attributes.to_vec()].concat())
    }

    /// Whole numbers that belong to the network.
    pub(crate) fn integers(name: &str, values: &[i64]) -> Vec<u8> {
        const INT64: usize = 7;
        let raw: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        bytes(5, &[number(1, values.len()), number(2, INT64), bytes(8, name.as_bytes()), bytes(9, &raw)].concat())
    }

    /// A network from `x` to `y` with the shapes that the manifest of `mixes` asks for; `nodes` makes `last` of `x`, in its shape.
    pub(crate) fn file(nodes: &[u8], last: &str) -> Vec<u8> {
        const FLOAT: usize = 1;
        let tensor = |field, name: &str, planes| {
            let shape: Vec<u8> = [1, planes, 64, 64].iter().flat_map(|n| bytes(1, &number(1, *n))).collect();
            let kind = bytes(1, &[number(1, FLOAT), bytes(2, &shape)].concat());
            bytes(field, &[bytes(1, name.as_bytes()), bytes(2, &kind)].concat())
        };
        // 240 planes of 55: five copies, and their beginning
        let five = node("Concat", &[last; 5], "five", &attribute("axis", 1));
        let cut = node("Slice", &["five", "from", "to", "axis"], "y", &[]);
        let ends = [integers("from", &[0]), integers("to", &[240]), integers("axis", &[1])].concat();
        let graph = [nodes.to_vec(), five, cut, ends, tensor(11, "x", 55), tensor(12, "y", 240)].concat();
        [number(1, 8), bytes(7, &[graph, bytes(2, b"g")].concat()), bytes(8, &number(2, 13))].concat()
    }
}

#[cfg(target_os = "linux")]
#[test]
fn networks_that_take_gigabytes_or_minutes_are_refused_by_the_program() {
    use onnx::{attribute, file, integers, node};
    let gigabytes = [
        node("ConstantOfShape", &["shape"], "zeros", &[]),
        node("Add", &["zeros", "zeros"], "sum", &[]),
        node("ReduceMean", &["sum"], "mean", &attribute("keepdims", 0)),
        node("Add", &["x", "mean"], "last", &[]),
        integers("shape", &[1 << 16, 1 << 14]),
    ];
    let name = |n: usize| if n == 0 { "x".to_owned() } else { format!("{n:x}") };
    const LONG: usize = 7000;
    let minutes: Vec<_> = (0..LONG).flat_map(|n| node("Relu", &[&name(n)], &name(n + 1), &[])).collect();
    for (onnx, most, reason) in [
        (file(&gigabytes.concat(), "last"), 1_000, "takes too much memory"),
        (file(&minutes, &name(LONG)), 140_000, "takes too long"),
    ] {
        assert!(onnx.len() < most, "{} bytes", onnx.len());
        let dir = tempfile::tempdir().unwrap();
        let digest: String = Sha256::digest(&onnx).iter().map(|byte| format!("{byte:02x}")).collect();
        let text = std::fs::read_to_string(golden("mixes/manifest.toml")).unwrap();
        let (start, rest) = text.split_once("f32 = ").unwrap();
        let (_, end) = rest.split_once("[input]").unwrap();
        let file = format!("f32 = {{ file = \"model.onnx\", sha256 = \"{digest}\" }}\n");
        std::fs::write(dir.path().join("manifest.toml"), format!("{start}{file}[input]{end}")).unwrap();
        std::fs::write(dir.path().join("model.onnx"), &onnx).unwrap();
        let run = |words: &str| {
            let mut command = std::process::Command::new("sh");
            command.args(["-c", "ulimit -v 2097152 && exec \"$@\"", "sh", env!("CARGO_BIN_EXE_stokescope")]);
            command.args(words.split(' ')).current_dir(dir.path()).output().unwrap()
        };
        assert!(run("simulate --size 16 --out bundle").status.success());
        let frames = "--raw bundle/raw.npy --guide bundle/guide.npy";
        let refused = run(&format!("reconstruct --calibration bundle {frames} --fusion . --out out"));
        let text = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(65), "{text}");
        assert!(text.contains("model.onnx: cannot be used: its analysis ") && text.contains(reason), "{text}");
    }
}
