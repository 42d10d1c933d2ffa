//! Gradients of several views, each given for the Gaussians that it shows alone, added in the views' order.
//!
//! The gradient of the higher harmonics is not given: of one view it is the product of the basis at the
//! direction of the Gaussian and of the colour's gradient, which that of degree 0 is but for a factor. No
//! product is fused with a sum, so that the bits depend neither on the number of threads nor on the machine.

use crate::{
    error::{Error, check_len},
    project::sh,
    simd::{
        self, Lanes,
        groups::{Column, GROUP, get3},
    },
};
use fearless_simd::{Simd, SimdBase, dispatch};
use rayon::prelude::*;

/// Numbers of a row that are added; the last three are the gradient of the coefficient of degree 0.
pub const ADDED: usize = 14;
/// Numbers of a row.
pub const WIDTH: usize = ADDED + 1;
/// Gaussians per task: their sums fit in the second-level cache.
const CHUNK: usize = 2048;

/// What one view gives.
#[derive(Debug, Clone, Copy)]
pub struct ViewRows<'a> {
    /// Gaussians, ascending, `[M]`.
    pub rows: &'a [i32],
    /// Their gradients, `[M, WIDTH]`.
    pub values: &'a [f32],
    /// Of the camera, in the world.
    pub center: [f64; 3],
    /// Of the harmonics; 0: the higher ones get nothing.
    pub degree: usize,
}

/// `scale` times the sums over `views`: `low [N, ADDED]`, and `high [N, K, 3]` of the higher harmonics, with
/// the Gaussians' `means [N, 3]`. What no view shows becomes 0.
///
/// # Errors
/// Names the array whose length does not fit, rows that are not ascending, or a degree that there is not.
pub fn add(
    views: &[ViewRows<'_>],
    means: &[f32],
    low: &mut [f32],
    high: &mut [f32],
    scale: f32,
) -> Result<(), Error> {
    let n = means.len() / 3;
    check_len("means", means, 3 * n)?;
    check_len("low", low, ADDED * n)?;
    let width = high.len().checked_div(n).unwrap_or(0);
    check_len("high", high, width * n)?;
    for view in views {
        check_len("values", view.values, WIDTH * view.rows.len())?;
        let inside = view.rows.first().is_none_or(|&row| row >= 0)
            && view.rows.last().is_none_or(|&row| (row as usize) < n);
        if !inside || !view.rows.is_sorted_by(|a, b| a < b) {
            return Err(Error::new("rows", format!("must ascend within 0..{n}")));
        }
        if view.degree > sh::MAX_DEGREE || 3 * (sh::count(view.degree) - 1) > width {
            let message = format!("{} is too high for {width} numbers a Gaussian", view.degree);
            return Err(Error::new("degree", message));
        }
    }
    let level = simd::level()?.token;
    // Where there are no higher harmonics, each task gets none of them.
    let mut highs: Vec<&mut [f32]> = high.chunks_mut((CHUNK * width).max(1)).collect();
    highs.resize_with(n.div_ceil(CHUNK), Default::default);
    low.par_chunks_mut(CHUNK * ADDED)
        .zip(highs)
        .enumerate()
        .for_each(|(i, (low, high))| {
            low.fill(0.0);
            high.fill(0.0);
            for view in views {
                dispatch!(level, simd => add_view(simd, view, means, i * CHUNK, low, high, width));
            }
            for value in low.iter_mut().chain(high) {
                *value *= scale;
            }
        });
    Ok(())
}

/// Add what one view gives to the Gaussians `first..` that `low` and `high` have room for.
#[inline(always)]
fn add_view<S: Simd>(
    simd: S,
    view: &ViewRows<'_>,
    means: &[f32],
    first: usize,
    low: &mut [f32],
    high: &mut [f32],
    width: usize,
) {
    let end = first + low.len() / ADDED;
    let from = view.rows.partition_point(|&row| (row as usize) < first);
    let to = view.rows.partition_point(|&row| (row as usize) < end);
    let values = &view.values[WIDTH * from..WIDTH * to];
    let count = sh::count(view.degree);
    for (rows, values) in view.rows[from..to]
        .chunks(GROUP)
        .zip(values.chunks(WIDTH * GROUP))
    {
        let mut basis = [Column::<f32>::ZERO; sh::MAX_COUNT];
        if count > 1 {
            let mut direction = [Column::<f32>::ZERO; 3];
            for (lane, &row) in rows.iter().enumerate() {
                let mean = &means[3 * row as usize..][..3];
                let offset = [0, 1, 2].map(|k| (f64::from(mean[k]) - view.center[k]) as f32);
                let [x, y, z] = offset;
                let length = (x * x + y * y + z * z).sqrt().max(f32::MIN_POSITIVE);
                for (column, value) in direction.iter_mut().zip(offset) {
                    column.0[lane] = value / length;
                }
            }
            for at in (0..GROUP).step_by(Lanes::<f32, S>::LEN) {
                let found = sh::basis::<S, f32>(simd, view.degree, get3(simd, &direction, at));
                for k in 1..count {
                    basis[k].set(simd, at, found[k]);
                }
            }
        }
        for (lane, (&row, values)) in rows.iter().zip(values.chunks_exact(WIDTH)).enumerate() {
            let at = row as usize - first;
            let sums = &mut low[ADDED * at..][..ADDED];
            for k in 0..ADDED {
                sums[k] += values[k];
            }
            let color = [0, 1, 2].map(|k| values[ADDED - 3 + k] / sh::C0 as f32);
            let sums = &mut high[width * at..][..3 * (count - 1)];
            for (sums, basis) in sums.chunks_exact_mut(3).zip(&basis[1..]) {
                for k in 0..3 {
                    sums[k] += basis.0[lane] * color[k];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn adds_in_the_order_of_the_views() {
        let values: Vec<f32> = (0..2 * WIDTH).map(|k| k as f32).collect();
        let view = ViewRows {
            rows: &[0, 2],
            values: &values,
            center: [0.0, 0.0, -2.0],
            degree: 1,
        };
        let means = [0.0, 0.0, 1.0, 9.0, 9.0, 9.0, 3.0, 0.0, 2.0];
        let (mut low, mut high) = (vec![7.0; 3 * ADDED], vec![7.0; 27]);
        add(&[view, view], &means, &mut low, &mut high, 0.5).unwrap();
        assert_eq!(low[..ADDED], values[..ADDED]);
        assert!(
            low[ADDED..2 * ADDED]
                .iter()
                .chain(&high[9..18])
                .all(|&v| v == 0.0)
        );
        assert_eq!(low[2 * ADDED..], values[WIDTH..WIDTH + ADDED]);
        // The first one is straight ahead: the gradient is all in the second function, sqrt(3) z.
        for k in 0..3 {
            assert_eq!((high[k], high[6 + k]), (0.0, 0.0));
            assert!((high[3 + k] - 3f32.sqrt() * values[11 + k]).abs() < 1e-5 * values[11 + k]);
        }
    }

    #[test]
    fn what_does_not_fit_is_told() {
        let mut view = ViewRows {
            rows: &[1, 0],
            values: &[0.0; 2 * WIDTH],
            center: [0.0; 3],
            degree: 0,
        };
        let told =
            |view| add(&[view], &[0.0; 6], &mut [0.0; 28], &mut [], 1.0).map_err(|e| e.to_string());
        assert!(told(view).unwrap_err().contains("rows"));
        view.rows = &[0, 2];
        assert!(told(view).unwrap_err().contains("rows"));
        view.rows = &[0, 1];
        assert!(told(view).is_ok());
        view.degree = 1;
        assert!(told(view).unwrap_err().contains("degree"));
    }
}
