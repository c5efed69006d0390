//! Local means of an image.

/// Means over squares of 2·`radius` + 1 pixels a side, of the part that lies within the image. `columns` holds one row.
pub(crate) fn local_mean(image: &[f32], radius: usize, columns: &mut [f32], out: &mut [f32]) {
    let width = columns.len();
    let height = image.len() / width;
    let span = |i: usize, n: usize| i.saturating_sub(radius)..(i + radius + 1).min(n);
    for (y, out) in out.chunks_exact_mut(width).enumerate() {
        let rows = span(y, height);
        columns.fill(0.0);
        for row in image[rows.start * width..rows.end * width].chunks_exact(width) {
            columns.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
        }
        // Shifted rows are added, which the compiler does for many pixels at once.
        out.copy_from_slice(columns);
        for step in 1..=radius.min(width - 1) {
            out[step..].iter_mut().zip(&*columns).for_each(|(sum, x)| *sum += x);
            out.iter_mut().zip(&columns[step..]).for_each(|(sum, x)| *sum += x);
        }
        let scale = |x: usize| 1.0 / (rows.len() * span(x, width).len()) as f32;
        let inner = radius.min(width)..width.saturating_sub(radius).max(radius.min(width));
        let whole = scale(width / 2);
        out[inner.clone()].iter_mut().for_each(|sum| *sum *= whole);
        (0..inner.start).chain(inner.end..width).for_each(|x| out[x] *= scale(x));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_means_are_those_of_the_part_within_the_image() {
        let image: Vec<f32> = (0..12).map(|i| i as f32).collect();
        let (mut columns, mut out) = (vec![0.0; 4], vec![0.0; 12]);
        local_mean(&image, 1, &mut columns, &mut out);
        assert!((out[0] - 2.5).abs() < 1e-6 && (out[5] - 5.0).abs() < 1e-6 && (out[11] - 8.5).abs() < 1e-6, "{out:?}");
    }
}
