//! Whether two images show the same.

/// Share of an image's contrast that makes its difference from another one a change of scene.
const CUT: f64 = 0.5;

/// Whether `now` has little in common with `before`: their difference holds more than half of the contrast of `now`.
pub fn is_cut(now: &[f32], before: &[f32]) -> bool {
    let n = now.len() as f64;
    let [mut sum, mut square, mut difference] = [0.0f64; 3];
    for (a, b) in now.iter().zip(before) {
        let (a, b) = (f64::from(*a), f64::from(*b));
        sum += a;
        square += a * a;
        difference += (a - b).powi(2);
    }
    difference > CUT * (square - sum * sum / n)
}

#[cfg(test)]
mod tests {
    use super::super::noise::normal;
    use super::*;

    #[test]
    fn another_scene_is_a_cut_and_a_little_of_it_is_not() {
        let (a, b) = (normal(3200, 1.0, 1), normal(3200, 1.0, 2));
        assert!(is_cut(&a, &b) && !is_cut(&a, &a));
        let mixed: Vec<f32> = a.iter().zip(&b).map(|(a, b)| a + 0.3 * b).collect();
        assert!(!is_cut(&mixed, &a));
    }
}
