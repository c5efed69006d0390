//! Lensless polarization imaging: frames in memory become Stokes images in memory.
//!
//! A diffuser and a polarizer mask turn a bare sensor into a camera whose raw frame looks like noise. With the PSF of the diffuser, the
//! layout of the mask and one frame of an ordinary camera, the *guide*, this crate solves for the scene in front of it: intensity, degree
//! and angle of linear polarization.
//!
//! ```
//! use stokescope_core::{Device, Mask, Pipeline, Settings};
//! # use stokescope_core::image::{Size, Stack};
//! # use stokescope_simulator::{SimSpec, Simulator};
//! # let spec: SimSpec = "wedges,size=64,stripes=16,noise=0.001,black=0,surround=0,guide_margin=0".parse()?;
//! # let (size, psf, capture) = (spec.size, spec.psf(), Simulator::new(spec)?.capture(0));
//! # let (raw, guide): (Stack<u16>, Stack<f32>) = (capture.raw, capture.guide);
//! let device = Device::builder(size).psf(psf).mask(Mask::stripes(&[0.0, 45.0, 90.0, 135.0], 16)).build()?;
//! let mut pipeline = Pipeline::new(&device, Settings { iterations: Some(10), ..Settings::default() })?;
//! let frame = pipeline.process(raw.view(), guide.view())?; // borrowed views of u8, u16, f32 or f64
//! println!("{:?}, mean DoLP {:?}", frame.warnings(), frame.report().mean_dolp);
//! let (s0, s1) = (frame.stokes().plane(0), frame.stokes().plane(1));
//! # assert!(s0.iter().zip(s1).all(|(s0, s1)| *s0 >= 0.0 && s1.abs() <= 1.001 * s0));
//! # assert!(frame.report().mean_dolp.unwrap() > 0.2 && frame.valid().iter().any(|valid| *valid));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! | a [`Device`] | and a frame | go through | and become |
//! |---|---|---|---|
//! | [`Psf`](optics::Psf), [`Mask`], [`Sensor`](device::Sensor) | [`ImageView`](image::ImageView)s of raw and guide | [`Pipeline::process`] | a [`ProcessedFrame`] with [`Warning`]s |
//!
//! The modules stand in the order of the flow. Raw counts become weighted [`readings`]; the guide is aligned with them; [`solve`] finds
//! the Stokes images behind the [`optics`]; [`refine`] improves them by a learned network, where one is given; [`pipeline`] joins these
//! steps. [`calibrate`] measures a device. [`polarization`] has the formulas of angles, Stokes components, DoLP and AoLP.
//!
//! Units: readings and images are fractions of the sensor's full scale, angles are degrees, counter-clockwise from the sensor's rows.
//! Allocation: plans and workspaces allocate when they are made; processing a frame does not. The crate opens no files, sockets or
//! clocks but the monotonic one, and logs nothing.

#![warn(clippy::too_many_lines)]

pub mod image;
pub mod parallel;
pub mod polarization;

pub mod optics;

pub mod device;
pub mod frame;

mod guide;
pub mod readings;
pub mod refine;
pub mod solve;

pub mod calibrate;
pub mod diagnose;
pub mod pipeline;
pub mod uncertainty;

pub use device::Device;
pub use optics::{Mask, Mosaic};
pub use pipeline::{Pipeline, ProcessedFrame, Settings, Warning};
