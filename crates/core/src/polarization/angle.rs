use std::fmt;

/// Orientation of a linear polarizer, in degrees: 0° along the sensor's rows, counter-clockwise as the camera sees it.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub struct Angle(f64);

impl Angle {
    /// The angle of `degrees`; 0° and 180° are the same polarizer.
    pub const fn from_degrees(degrees: f64) -> Self {
        Self(degrees)
    }

    /// The angle in degrees, as given.
    pub const fn degrees(self) -> f64 {
        self.0
    }

    /// cos 2θ: the weight of S1 behind this polarizer.
    pub fn cos2(self) -> f64 {
        (2.0 * self.0.to_radians()).cos()
    }

    /// sin 2θ: the weight of S2 behind this polarizer.
    pub fn sin2(self) -> f64 {
        (2.0 * self.0.to_radians()).sin()
    }

    /// Weights of S0, S1 and S2 in the intensity behind an ideal polarizer at this angle: ½, ½·cos 2θ, ½·sin 2θ. Source:
    /// Born and Wolf, Principles of Optics, the Stokes parameters.
    ///
    /// ```
    /// # use stokescope_core::polarization::Angle;
    /// assert_eq!(Angle::from_degrees(0.0).analyzer(), [0.5, 0.5, 0.0]);
    /// ```
    pub fn analyzer(self) -> [f32; 3] {
        [0.5, (0.5 * self.cos2()) as f32, (0.5 * self.sin2()) as f32]
    }

    /// The three angles that determine linear polarization with the fewest stripes.
    pub fn three() -> Vec<Self> {
        [0.0, 45.0, 90.0].map(Self).to_vec()
    }

    /// The four angles of a common polarizer mosaic.
    pub fn four() -> Vec<Self> {
        [0.0, 45.0, 90.0, 135.0].map(Self).to_vec()
    }
}

impl fmt::Display for Angle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}°", self.0)
    }
}
