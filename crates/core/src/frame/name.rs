//! Names of pixel formats in configuration files and messages.

use std::str::FromStr;

use super::{Bayer, PixelFormat, Range, Samples};

const ORDERS: [(Bayer, &str); 4] =
    [(Bayer::Rggb, "rggb"), (Bayer::Bggr, "bggr"), (Bayer::Grbg, "grbg"), (Bayer::Gbrg, "gbrg")];
const SAMPLES: [(Samples, &str); 6] = [
    (Samples::U8, "8"),
    (Samples::U10, "10"),
    (Samples::U12, "12"),
    (Samples::U16, "16"),
    (Samples::Packed10, "10p"),
    (Samples::Packed12, "12p"),
];

/// A text that names no pixel format.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("pixel format `{found}`, allowed: {}", FormatNameError::allowed())]
pub struct FormatNameError {
    /// The text found.
    pub found: String,
}

impl FormatNameError {
    /// All names, separated by commas.
    pub fn allowed() -> String {
        PixelFormat::named().map(PixelFormat::name).collect::<Vec<_>>().join(", ")
    }
}

impl PixelFormat {
    /// Every format a camera can be asked for.
    pub fn named() -> impl Iterator<Item = Self> {
        let bayer = ORDERS.iter().flat_map(|&(order, _)| SAMPLES.iter().map(move |&(s, _)| Self::Bayer(order, s)));
        let mono = SAMPLES.iter().map(|&(samples, _)| Self::Mono(samples));
        let yuyv = [Range::Limited, Range::Full].map(Self::Yuyv);
        mono.chain(bayer).chain([Self::Rgb(Samples::U8), Self::Nv12Rgb, Self::Nv12Luma]).chain(yuyv)
    }

    /// Name in a board file: `mono10p`, `bggr10`, `rgb8`, `nv12`, `nv12-luma`, `yuyv`; `p` for packed samples.
    pub fn name(self) -> String {
        let bits = |samples| SAMPLES.iter().find(|(s, _)| *s == samples).map_or("float", |(_, name)| name);
        match self {
            Self::Mono(samples) => format!("mono{}", bits(samples)),
            Self::Bayer(order, samples) => {
                let name = ORDERS.iter().find(|(o, _)| *o == order).map_or("bayer", |(_, name)| name);
                format!("{name}{}", bits(samples))
            }
            Self::Rgb(samples) => format!("rgb{}", bits(samples)),
            Self::Nv12Luma => "nv12-luma".to_owned(),
            Self::Nv12Rgb => "nv12".to_owned(),
            Self::Yuyv(Range::Limited) => "yuyv".to_owned(),
            Self::Yuyv(Range::Full) => "yuyv-full".to_owned(),
        }
    }
}

impl FromStr for PixelFormat {
    type Err = FormatNameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::named().find(|format| format.name() == text).ok_or_else(|| FormatNameError { found: text.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_is_read_back_and_no_two_are_alike() {
        let names: std::collections::BTreeSet<String> = PixelFormat::named().map(PixelFormat::name).collect();
        assert_eq!(names.len(), PixelFormat::named().count());
        for format in PixelFormat::named() {
            assert_eq!(format.name().parse(), Ok(format));
        }
        assert_eq!("bggr10p".parse(), Ok(PixelFormat::Bayer(Bayer::Bggr, Samples::Packed10)));
        let e = "BGGR10".parse::<PixelFormat>().unwrap_err().to_string();
        assert!(e.starts_with("pixel format `BGGR10`, allowed: mono8, mono10,"), "{e}");
    }
}
