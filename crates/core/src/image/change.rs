//! Comparison of two images.

/// Share of an image's contrast that makes its difference from another one a change of scene.
const CUT: f64 = 0.5;

/// True if `now` has little in common with `before`: their difference holds more than half of the contrast of `now`. Only the pixels that
/// `counts` says yes to are compared.
pub fn is_cut(now: &[f32], before: &[f32], counts: impl Fn(usize) -> bool) -> bool {
    let [mut n, mut sum, mut square, mut difference] = [0.0f64; 4];
    for (_, (a, b)) in now.iter().zip(before).enumerate().filter(|(i, _)| counts(*i)) {
        let (a, b) = (f64::from(*a), f64::from(*b));
        n += 1.0;
        sum += a;
        square += a * a;
        difference += (a - b).powi(2);
    }
    difference > CUT * (square - sum * sum / n)
}

/// Coefficient of correlation, from −1 to 1: 1 where one image is the other times a gain plus an offset. NaN for a flat image.
pub fn correlation(a: &[f32], b: &[f32]) -> f64 {
    let n = a.len() as f64;
    let [mut sum_a, mut sum_b, mut aa, mut ab, mut bb] = [0.0f64; 5];
    for (a, b) in a.iter().zip(b) {
        let (a, b) = (f64::from(*a), f64::from(*b));
        sum_a += a;
        sum_b += b;
        aa += a * a;
        ab += a * b;
        bb += b * b;
    }
    (ab - sum_a * sum_b / n) / ((aa - sum_a * sum_a / n) * (bb - sum_b * sum_b / n)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::super::noise::normal;
    use super::*;

    #[test]
    fn another_scene_is_a_cut_and_a_little_of_it_is_not() {
        let (a, b) = (normal(3200, 1.0, 1), normal(3200, 1.0, 2));
        assert!(is_cut(&a, &b, |_| true) && !is_cut(&a, &a, |_| true));
        let mixed: Vec<f32> = a.iter().zip(&b).map(|(a, b)| a + 0.3 * b).collect();
        assert!(!is_cut(&mixed, &a, |_| true));
        // What does not count is no part of the scene.
        let beyond = |v: &[f32]| [v, &[100.0; 3200][..]].concat();
        assert!(!is_cut(&beyond(&a), &beyond(&b), |_| true) && is_cut(&beyond(&a), &beyond(&b), |i| i < 3200));
    }

    #[test]
    fn gain_and_offset_do_not_matter_to_correlation_and_its_sign_does() {
        let (a, b) = (normal(3200, 1.0, 1), normal(3200, 1.0, 2));
        let brighter: Vec<f32> = a.iter().map(|v| 0.3 * v + 5.0).collect();
        let negative: Vec<f32> = a.iter().map(|v| 1.0 - v).collect();
        assert!((correlation(&a, &brighter) - 1.0).abs() < 1e-4);
        assert!((correlation(&a, &negative) + 1.0).abs() < 1e-4);
        assert!(correlation(&a, &b).abs() < 0.1);
        assert!(correlation(&a, &[0.5; 3200]).is_nan());
    }
}
