//! Finds a camera by its place, its sensor or its id.

use std::cmp::Reverse;
use std::fmt;

/// Names and addresses that identify a camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Identity {
    /// Id in libcamera: the path of the sensor in the device tree, or of a USB camera.
    pub(super) id: String,
    /// Name of the sensor, such as `imx296`, or the model.
    pub(super) model: String,
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.model, self.id)
    }
}

/// Sorts cameras by their place. The places are those of `rpicam-hello --list-cameras`: cameras on a connector by descending id, so that
/// place 0 is connector `CAM0` of a Raspberry Pi 5; USB cameras, which it leaves out, follow.
pub(super) fn sort_by_place<T>(cameras: &mut [T], id: impl Fn(&T) -> &str) {
    cameras.sort_by(|a, b| {
        let key = |id: &str| (id.contains("/usb"), Reverse(id.to_owned()));
        key(id(a)).cmp(&key(id(b)))
    });
}

/// Index of the camera that `source` names among `cameras`, which are sorted by place: its id, its place, its sensor, or a part of
/// its id. A number is always a place, never a part of an id.
///
/// # Errors
/// The reason, with all cameras, when none or several match.
pub(super) fn find(source: &str, cameras: &[Identity]) -> Result<usize, String> {
    if cameras.is_empty() {
        return Err("libcamera finds no camera; check cable and power".to_owned());
    }
    let list = |of: &[usize]| of.iter().map(|i| format!("{i}: {}", cameras[*i])).collect::<Vec<_>>().join(", ");
    let all: Vec<usize> = (0..cameras.len()).collect();
    if let Some(exact) = cameras.iter().position(|camera| camera.id == source) {
        return Ok(exact);
    }
    if !source.is_empty() && source.bytes().all(|c| c.is_ascii_digit()) {
        let place = source.parse().ok().filter(|place| *place < cameras.len());
        return place.ok_or_else(|| format!("no camera in this place, allowed: {}", list(&all)));
    }
    let matching = |matches: &dyn Fn(&Identity) -> bool| -> Vec<usize> {
        all.iter().copied().filter(|i| matches(&cameras[*i])).collect()
    };
    let mut found = matching(&|camera| camera.model == source);
    if found.is_empty() {
        found = matching(&|camera| camera.id.contains(source));
    }
    match found[..] {
        [one] => Ok(one),
        [] => Err(format!("no such camera, allowed: {}", list(&all))),
        _ => Err(format!("several cameras match, use the place or the id of one: {}", list(&found))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAM0: &str = "/base/axi/pcie@120000/rp1/i2c@88000/imx296@1a";
    const CAM1: &str = "/base/axi/pcie@120000/rp1/i2c@80000/imx477@1a";
    const USB: &str = "/base/axi/pcie@120000/rp1/usb@200000-1:1.0-046d:0825";

    fn cameras(listed: &[(&str, &str)]) -> Vec<Identity> {
        let camera = |&(id, model): &(&str, &str)| Identity { id: id.to_owned(), model: model.to_owned() };
        let mut cameras: Vec<_> = listed.iter().map(camera).collect();
        sort_by_place(&mut cameras, |camera| &camera.id);
        cameras
    }

    #[test]
    fn a_number_is_a_place_and_never_a_part_of_an_id() {
        let two = cameras(&[(CAM1, "imx477"), (USB, "HD Webcam"), (CAM0, "imx296")]);
        let ids: Vec<_> = two.iter().map(|camera| camera.id.as_str()).collect();
        assert_eq!(ids, [CAM0, CAM1, USB], "the order of rpicam-hello, USB cameras last");
        assert_eq!([find("0", &two), find("1", &two), find("2", &two)], [Ok(0), Ok(1), Ok(2)]);
        let e = find("80000", &two).unwrap_err();
        assert!(e.starts_with(&format!("no camera in this place, allowed: 0: imx296 ({CAM0}), 1: imx477 (")), "{e}");
        assert!(find("99999999999999999999", &two).is_err(), "no number at all");
        // the one camera of a Zero 2 W has a 1 in its id, but there is no place 1
        let one = cameras(&[("/base/soc/i2c0mux/i2c@1/imx219@10", "imx219")]);
        assert_eq!((find("0", &one), find("1", &one).is_err()), (Ok(0), true));
    }

    #[test]
    fn a_sensor_or_an_id_names_a_camera() {
        let two = cameras(&[(CAM0, "imx296"), (CAM1, "imx477")]);
        assert_eq!([find("imx477", &two), find(CAM0, &two), find("i2c@80000", &two)], [Ok(1), Ok(0), Ok(1)]);
        // the name of a sensor is not a part of another's
        let wide = cameras(&[("/base/a/imx708@1a", "imx708"), ("/base/b/imx708@1a", "imx708_wide")]);
        assert_eq!([find("imx708", &wide), find("imx708_wide", &wide)], [Ok(1), Ok(0)]);
        assert_eq!(find("", &wide[..1]), Ok(0), "the only camera needs no name");
    }

    #[test]
    fn an_ambiguous_name_lists_the_cameras() {
        let twins = cameras(&[(CAM0, "imx296"), (&CAM1.replace("imx477", "imx296"), "imx296")]);
        let e = find("imx296", &twins).unwrap_err();
        assert!(
            e.starts_with("several cameras match") && e.contains("0: imx296 (/base") && e.contains("1: imx296 ("),
            "{e}"
        );
        assert!(find("", &twins).is_err() && find("rp1", &twins).is_err());
        let e = find("imx219", &twins).unwrap_err();
        assert!(e.starts_with("no such camera, allowed: 0: imx296"), "{e}");
        assert_eq!(find("0", &[]).unwrap_err(), "libcamera finds no camera; check cable and power");
    }
}
