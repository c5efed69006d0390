//! Time of cropping and binning a frame, in nanoseconds for each reading, on one core.
#![allow(clippy::print_stdout, reason = "output of the benchmark")]

use std::sync::Arc;
use std::time::Instant;

use stokescope_core::Device;
use stokescope_core::device::DeviceError;
use stokescope_core::frame::{Bayer, Frame, Metadata, PixelFormat, Samples};
use stokescope_core::image::{Size, Stack};
use stokescope_core::parallel::Workers;
use stokescope_core::readings::Binning;

const FRAME: Size = Size::new(1456, 1088);
const ROUNDS: usize = 20;

/// A device whose frames have planes of `size`.
fn device(size: Size, channels: usize, bin: usize) -> Result<Device, DeviceError> {
    let working = Size::new(size.width / bin, size.height / bin);
    let mut psf = Stack::zeros(1, working);
    psf.plane_mut(0)[working.height / 2 * working.width + working.width / 2] = 1.0;
    Device::builder(size).channels(channels).bin(bin).psf(psf).levels(240.0, 4095.0).build()
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("ns for each reading of a frame of {FRAME}, in blocks of 4 × 4");
    let mono = PixelFormat::Mono;
    let formats = [
        mono(Samples::U8),
        mono(Samples::Packed10),
        mono(Samples::Packed12),
        mono(Samples::U12),
        PixelFormat::Bayer(Bayer::Bggr, Samples::Packed12),
        PixelFormat::Bayer(Bayer::Rggb, Samples::U12),
    ];
    for format in formats {
        let planes = format.plane_size(FRAME);
        let device = device(planes, format.planes(), 4)?;
        let mut binning = Binning::new(&device, Arc::new(Workers::new(1))).ok_or("nothing to bin")?;
        let stride = format.row_bytes(FRAME.width).next_multiple_of(64);
        // smooth light: the high byte of packed samples, and of words
        let byte = |i: usize| {
            if i % stride % 3 == 2 && format.name().ends_with("12p") { 0x53 } else { 90 + (i / stride / 64) as u8 }
        };
        let words = matches!(format, PixelFormat::Mono(Samples::U12) | PixelFormat::Bayer(_, Samples::U12));
        let data: Vec<u8> = (0..stride * FRAME.height).map(|i| if words && i % 2 == 1 { 5 } else { byte(i) }).collect();
        let frame = Frame::new(&data, format, FRAME, stride, Metadata::default())?;
        let mut out = binning.make_output();
        let mut best = f64::INFINITY;
        for _ in 0..ROUNDS {
            let start = Instant::now();
            binning.frame(&frame, &mut out)?;
            best = best.min(start.elapsed().as_secs_f64());
        }
        let looked_at = out.weights.as_slice().iter().filter(|w| **w != 1.0).count();
        println!(
            "{:>24}: {:.2}, {looked_at} blocks without full weight",
            format.to_string(),
            1e9 * best / FRAME.pixels() as f64
        );
    }
    Ok(())
}
