//! Parsers of option values whose types belong to the library: each value has its displayed name and a line of help.

use std::fmt::Display;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use stokescope_core::optics::FftBackend;
use stokescope_core::refine::model::Precision;
use stokescope_core::solve::Method;

use crate::camera::sim::Knowledge;

/// Parser for one of `all` by its displayed name.
fn one_of<T>(all: &'static [T], help: fn(T) -> &'static str) -> impl TypedValueParser<Value = T>
where
    T: Copy + Display + Send + Sync + 'static,
{
    let values = all.iter().map(move |value| PossibleValue::new(value.to_string()).help(help(*value)));
    let find = move |name: String| all.iter().copied().find(|value| value.to_string() == name);
    PossibleValuesParser::new(values).try_map(move |name| find(name).ok_or("not one of the names"))
}

/// Parser of `--methods`.
pub(super) fn method() -> impl TypedValueParser<Value = Method> {
    one_of(&Method::ALL, |method| match method {
        Method::Guided => "S1 and S2; S0 comes from the guide camera",
        Method::Stokes => "S0, S1 and S2 without a guide; S0 alone without a mask",
        Method::Fista => "FISTA over angle intensities as in the paper, with exact step and standard momentum",
        Method::FistaPublished => "FISTA as the published code runs it, on twice the frame's sides",
        Method::FistaPublishedScaled => "the same with its threshold in units of the readings",
        Method::FistaPublishedFrame => "the same on the frame alone",
        Method::Admm => "ADMM as in the paper, with exact splitting",
        Method::AdmmPublished => "ADMM as published, with inner conjugate gradients",
    })
}

/// Parser of `--fft`.
pub(super) fn fft() -> impl TypedValueParser<Value = FftBackend> {
    one_of(&FftBackend::ALL, |backend| match backend {
        FftBackend::Batched => "eight lines at a time in vector registers; the fastest",
        FftBackend::Rustfft => "library rustfft, line by line, any length",
        FftBackend::Microfft => "library microfft, line by line, powers of two",
    })
}

/// Parser of `--precision`.
pub(super) fn precision() -> impl TypedValueParser<Value = Precision> {
    one_of(&Precision::ALL, |precision| match precision {
        Precision::F32 => "single precision",
        Precision::Int8 => "8-bit integers",
    })
}

/// Parser of `--knowledge`.
pub(super) fn knowledge() -> impl TypedValueParser<Value = Knowledge> {
    one_of(&Knowledge::ALL, |knowledge| match knowledge {
        Knowledge::Nominal => "the bundle has nominal values: ideal stripes, the PSF as designed, no flaws",
        Knowledge::Exact => "the bundle describes the device exactly",
    })
}
