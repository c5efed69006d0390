//! Names of pixel formats in libcamera.

use stokescope_core::frame::{Bayer, PixelFormat, Samples};

/// Name of a format in libcamera; `None` if it has none.
pub(super) fn driver_name(format: PixelFormat) -> Option<String> {
    let samples = |samples| match samples {
        Samples::U8 => Some("8"),
        Samples::U10 => Some("10"),
        Samples::U12 => Some("12"),
        Samples::U16 => Some("16"),
        Samples::Packed10 => Some("10_CSI2P"),
        Samples::Packed12 => Some("12_CSI2P"),
        Samples::F32 => None,
    };
    match format {
        PixelFormat::Mono(s) => Some(format!("R{}", samples(s)?)),
        PixelFormat::Bayer(order, s) => {
            let order = match order {
                Bayer::Rggb => "RGGB",
                Bayer::Bggr => "BGGR",
                Bayer::Grbg => "GRBG",
                Bayer::Gbrg => "GBRG",
            };
            Some(format!("S{order}{}", samples(s)?))
        }
        // libcamera names components from the highest byte down; red is first in memory
        PixelFormat::Rgb(Samples::U8) => Some("BGR888".to_owned()),
        PixelFormat::Rgb(_) => None,
        PixelFormat::Nv12Luma | PixelFormat::Nv12Rgb => Some("NV12".to_owned()),
        PixelFormat::Yuyv(_) => Some("YUYV".to_owned()),
    }
}

/// Formats that libcamera calls `name`; several where only their use differs.
pub(super) fn formats_of(name: &str) -> impl Iterator<Item = PixelFormat> {
    PixelFormat::named().filter(move |format| driver_name(*format).is_some_and(|own| own == name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_is_found_by_its_name() {
        for format in PixelFormat::named() {
            assert!(formats_of(&driver_name(format).unwrap()).any(|found| found == format));
        }
        assert_eq!(driver_name("bggr10p".parse().unwrap()).unwrap(), "SBGGR10_CSI2P");
        assert_eq!(formats_of("MONO_PISP_COMP1").next(), None);
    }
}
