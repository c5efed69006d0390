//! Step sizes: the largest eigenvalue of AᵀA by power iteration, from a fixed seed.

/// Rounds at most; the estimate settles long before.
const ROUNDS: usize = 60;
/// Relative change that ends the iteration.
const SETTLED: f64 = 1e-4;
/// The estimate approaches from below, so it is raised by this factor.
const SAFETY: f64 = 1.02;

/// ‖A‖² of an operator on `len` values, slightly over-estimated; `normal` replaces x by AᵀAx. Allocates one vector.
pub(super) fn norm_squared(len: usize, mut normal: impl FnMut(&mut [f32])) -> f32 {
    let mut seed = 0x2545_F491_4F6C_DD1Du64;
    let mut x: Vec<f32> = (0..len)
        .map(|_| {
            seed ^= seed << 13;
            seed ^= seed >> 7;
            seed ^= seed << 17;
            // Mostly constant, as the leading eigenvector of a blur is, plus noise that leaves no direction out.
            1.0 + (seed >> 40) as f32 / (1u64 << 24) as f32
        })
        .collect();
    let mut estimate = 0.0;
    for _ in 0..ROUNDS {
        let norm = x.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        if norm == 0.0 {
            break;
        }
        x.iter_mut().for_each(|v| *v = (f64::from(*v) / norm) as f32);
        normal(&mut x);
        let next = x.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        let settled = (next - estimate).abs() <= SETTLED * next;
        estimate = next;
        if settled {
            break;
        }
    }
    (estimate * SAFETY) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_largest_eigenvalue_of_a_diagonal() {
        let got = norm_squared(50, |x| x.iter_mut().enumerate().for_each(|(i, v)| *v *= i as f32 / 10.0));
        assert!((4.9..=4.9 * 1.021).contains(&got), "{got}");
        assert_eq!(norm_squared(3, |x| x.fill(0.0)), 0.0);
    }
}
