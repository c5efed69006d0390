/// Weights of the four neighbours of a place `by` samples off, and how far off the first of them is: the cubic of Catmull and Rom (1974).
pub fn cubic(by: f64) -> (isize, [f32; 4]) {
    let t = by - by.floor();
    let (t2, t3) = (t * t, t * t * t);
    let taps = [-t + 2.0 * t2 - t3, 2.0 - 5.0 * t2 + 3.0 * t3, t + 4.0 * t2 - 3.0 * t3, t3 - t2];
    (by.floor() as isize - 1, taps.map(|v| (0.5 * v) as f32))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_is_met_exactly() {
        for by in [-3.0, -0.25, 0.0, 0.5, 1.75] {
            let (first, taps) = cubic(by);
            let parabola = |x: f64| 1.0 + 2.0 * x - 0.5 * x * x;
            let found: f64 = taps.iter().zip(first..).map(|(tap, x)| f64::from(*tap) * parabola(x as f64)).sum();
            assert!((found - parabola(by)).abs() < 1e-6, "{by}: {found}");
        }
    }
}
