//! Many frames of one device from one file: what `stokescope reconstruct` does for one, planned once.
//!
//! ```sh
//! cargo run --release --example frames -- DEVICE raw.npy guide.npy|- stokes.npy [ITERATIONS] [on|off] [METHOD] [on|off]
//! ```
//!
//! `DEVICE` is a device bundle; `raw.npy` and `guide.npy` are f32 `[N, H, W]`, fractions of full scale, of a camera with a mask and
//! one channel, `-` is no guide; `stokes.npy` becomes f32 `[N, 3, H, W]`. The first `off` leaves the guide
//! where it is, the second one the PSF as large as it is. Prints how many times as large as calibrated it was taken for, frame by frame.
//! Physics alone, one thread.

use std::path::Path;

use stokescope::bundle::Bundle;
use stokescope::files::{read_npy, write_npy};
use stokescope_core::image::{Size, Stack};
use stokescope_core::pipeline::{Pipeline, Settings};

type Failure = Box<dyn std::error::Error>;

/// `[N, H, W]` as one plane for each frame.
fn frames(path: &str, size: Size) -> Result<Vec<Stack<f32>>, Failure> {
    let array = read_npy(Path::new(path))?;
    if array.shape.len() != 3 || array.shape[1..] != [size.height, size.width] {
        return Err(
            format!("{path}: its shape is {:?}, expected [N, {}, {}]", array.shape, size.height, size.width).into()
        );
    }
    let planes = array.into_f32();
    planes.chunks_exact(size.pixels()).map(|plane| Ok(Stack::from_vec(1, size, plane.to_vec())?)).collect()
}

#[expect(clippy::print_stdout, reason = "what it says of each frame")]
fn main() -> Result<(), Failure> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [device, raw, guide, out, rest @ ..] = &args[..] else {
        return Err(
            "usage: frames DEVICE raw.npy guide.npy|- stokes.npy [ITERATIONS] [on|off] [METHOD] [on|off]".into()
        );
    };
    let settings = Settings {
        guided: guide != "-",
        method: rest.get(2).map(|name| name.parse()).transpose()?,
        iterations: rest.first().map(|n| n.parse()).transpose()?,
        register: rest.get(1).is_none_or(|word| word != "off"),
        refit_psf: rest.get(3).is_none_or(|word| word != "off"),
        threads: 1,
        angles: false,
        ..Settings::default()
    };
    let calibration = Bundle::load(Path::new(device))?;
    let mut pipeline = Pipeline::new(&calibration, settings)?;
    let size = pipeline.size();
    let raw = frames(raw, size)?;
    let guides =
        if guide == "-" { vec![None; raw.len()] } else { frames(guide, size)?.into_iter().map(Some).collect() };
    if raw.len() != guides.len() {
        return Err(format!("{} raw frames and {} of the guide", raw.len(), guides.len()).into());
    }
    let mut stokes = Vec::with_capacity(raw.len() * 3 * size.pixels());
    for (raw, guide) in raw.iter().zip(&guides) {
        let report = pipeline.process(raw.view(), guide.as_ref().map(Stack::view))?.into_report();
        println!("{}", report.psf_scale);
        stokes.extend_from_slice(pipeline.result().stokes.as_slice());
    }
    write_npy(Path::new(out), &[raw.len(), 3, size.height, size.width], &stokes)?;
    Ok(())
}
