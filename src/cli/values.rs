//! Values of options whose types belong to the library: names as they are displayed, with a line of help each.

use std::fmt::Display;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use stokescope_core::optics::FftBackend;
use stokescope_core::refine::model::Precision;
use stokescope_core::solve::Method;

use crate::camera::sim::Knowledge;

/// Takes one of `all` by its displayed name.
fn one_of<T>(all: &'static [T], help: fn(T) -> &'static str) -> impl TypedValueParser<Value = T>
where
    T: Copy + Display + Send + Sync + 'static,
{
    let values = all.iter().map(move |value| PossibleValue::new(value.to_string()).help(help(*value)));
    let find = move |name: String| all.iter().copied().find(|value| value.to_string() == name);
    PossibleValuesParser::new(values).try_map(move |name| find(name).ok_or("not one of the names"))
}

/// `--method`, `--methods`.
pub(super) fn method() -> impl TypedValueParser<Value = Method> {
    one_of(&Method::ALL, |method| match method {
        Method::Guided => "S1 and S2; S0 comes from the guide camera",
        Method::Stokes => "S0, S1 and S2 without a guide; S0 alone without a mask",
        Method::Fista => "the paper's FISTA over angle intensities, with exact step and standard momentum",
        Method::FistaPublished => "the paper's FISTA with the published code's constants",
        Method::Admm => "the paper's ADMM with exact splitting",
        Method::AdmmPublished => "the paper's ADMM with inner conjugate gradients",
    })
}

/// `--fft`.
pub(super) fn fft() -> impl TypedValueParser<Value = FftBackend> {
    one_of(&FftBackend::ALL, |backend| match backend {
        FftBackend::Batched => "eight lines at once in vector registers; the fastest",
        FftBackend::Rustfft => "the library rustfft, line by line, any length",
        FftBackend::Microfft => "the library microfft, line by line, powers of two",
    })
}

/// `--precision`.
pub(super) fn precision() -> impl TypedValueParser<Value = Precision> {
    one_of(&Precision::ALL, |precision| match precision {
        Precision::F32 => "single precision",
        Precision::Int8 => "8-bit integers",
    })
}

/// `--knowledge`.
pub(super) fn knowledge() -> impl TypedValueParser<Value = Knowledge> {
    one_of(&Knowledge::ALL, |knowledge| match knowledge {
        Knowledge::Nominal => "the bundle says what the maker says: ideal stripes, the PSF as designed, no flaws",
        Knowledge::Exact => "the bundle knows the device exactly",
    })
}
