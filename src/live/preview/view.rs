//! Views: the pictures of a frame that a watcher can choose from.

use stokescope_core::polarization::Angle;

/// A way to show a frame as a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::live) enum View {
    Intensity,
    Dolp,
    /// Standard error of the DoLP.
    DolpError,
    /// AoLP as hue, DoLP as brightness.
    Aolp,
    /// AoLP as hue, DoLP as saturation.
    AolpSaturation,
    Composite,
    /// Least intensity behind a polarizer: the scene without polarized glare.
    Imin,
    /// Intensity behind an ideal polarizer at this angle.
    Angle(Angle),
    Guide,
    Raw,
    /// Absolute difference of the intensity from the stored background.
    Difference,
}

impl View {
    /// Views that a camera with these polarizer angles has. Without angles there is no polarization.
    pub(in crate::live) fn all(angles: &[Angle], guide: bool) -> Vec<Self> {
        let mut views = vec![Self::Intensity];
        if !angles.is_empty() {
            views.extend([Self::Dolp, Self::Aolp, Self::AolpSaturation, Self::Composite, Self::Imin, Self::DolpError]);
            views.extend(angles.iter().copied().map(Self::Angle));
        }
        views.extend(guide.then_some(Self::Guide));
        views.extend([Self::Raw, Self::Difference]);
        views
    }

    /// Whether the view shows a raw or guide frame, which are copied only while somebody watches them.
    pub(in crate::live) fn is_sketch(self) -> bool {
        matches!(self, Self::Raw | Self::Guide)
    }

    /// Name in addresses: `i45` is the picture behind a polarizer at 45°.
    pub(in crate::live) fn name(self) -> String {
        match self {
            Self::Intensity => "intensity".to_owned(),
            Self::Dolp => "dolp".to_owned(),
            Self::DolpError => "dolp-error".to_owned(),
            Self::Aolp => "aolp".to_owned(),
            Self::AolpSaturation => "aolp-saturation".to_owned(),
            Self::Composite => "composite".to_owned(),
            Self::Imin => "imin".to_owned(),
            Self::Angle(angle) => format!("i{}", angle.degrees()),
            Self::Guide => "guide".to_owned(),
            Self::Raw => "raw".to_owned(),
            Self::Difference => "difference".to_owned(),
        }
    }

    /// Name for people.
    pub(in crate::live) fn label(self) -> String {
        match self {
            Self::Intensity => "Intensity".to_owned(),
            Self::Dolp => "DoLP".to_owned(),
            Self::DolpError => "DoLP error".to_owned(),
            Self::Aolp => "AoLP".to_owned(),
            Self::AolpSaturation => "AoLP on white".to_owned(),
            Self::Composite => "Composite".to_owned(),
            Self::Imin => "No glare".to_owned(),
            Self::Angle(angle) => format!("{}°", angle.degrees()),
            Self::Guide => "Guide".to_owned(),
            Self::Raw => "Raw".to_owned(),
            Self::Difference => "Difference".to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_view_has_its_own_name() {
        let names: Vec<_> = View::all(&Angle::four(), true).into_iter().map(View::name).collect();
        let expected = [
            "intensity",
            "dolp",
            "aolp",
            "aolp-saturation",
            "composite",
            "imin",
            "dolp-error",
            "i0",
            "i45",
            "i90",
            "i135",
            "guide",
            "raw",
            "difference",
        ];
        assert_eq!(names, expected);
        let plain: Vec<_> = View::all(&[], false).into_iter().map(View::name).collect();
        assert_eq!(plain, ["intensity", "raw", "difference"]);
    }
}
