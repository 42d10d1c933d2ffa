//! Gradients of several views, each given for the Gaussians that it shows alone, added in the views' order.
//!
//! The gradient of the higher harmonics is not given: of one view it is the product of the basis at the
//! direction of the Gaussian and of the colour's gradient, which that of degree 0 is but for a factor. No
//! product is fused with a sum, so that the bits depend neither on the number of threads nor on the machine.

use fearless_simd::{Simd, SimdBase, dispatch};
use hqgs::internals::{
    Error, check_len,
    project::sh,
    simd::{
        self, Lanes,
        groups::{Column, GROUP, get3},
    },
};
use rayon::prelude::*;

/// Gaussians per task: their sums fit in the second-level cache.
const CHUNK: usize = 2048;

/// What one view gives.
#[derive(Debug, Clone, Copy)]
pub struct ViewRows<'a> {
    /// Gaussians, ascending, `[M]`.
    pub rows: &'a [i32],
    /// Their numbers, `[M, W]`.
    pub values: &'a [f32],
}

/// A view's gradient of the coefficient of degree 0, of which that of the higher ones follows.
#[derive(Debug, Clone, Copy)]
pub struct ViewColors<'a> {
    /// `[M, 3]`.
    pub colors: ViewRows<'a>,
    /// Of the camera, in the world.
    pub center: [f64; 3],
    /// Of the harmonics; 0: the higher ones get nothing.
    pub degree: usize,
}

/// `scale` times the sums `[N, width]` over `views`. What no view shows becomes 0.
///
/// # Errors
/// Names the array whose length does not fit, or rows that are not ascending.
pub fn add(
    views: &[ViewRows<'_>],
    sums: &mut [f32],
    width: usize,
    scale: f32,
) -> Result<(), Error> {
    let n = sums.len().checked_div(width).unwrap_or(0);
    check_len("sums", sums, width * n)?;
    for view in views {
        check_rows(view, n, width)?;
    }
    sums.par_chunks_mut((CHUNK * width).max(1))
        .enumerate()
        .for_each(|(i, sums)| {
            sums.fill(0.0);
            let end = i * CHUNK + sums.len() / width;
            for view in views {
                let (rows, values) = part(view, i * CHUNK, end, width);
                for (&row, values) in rows.iter().zip(values.chunks_exact(width)) {
                    let sums = &mut sums[width * (row as usize - i * CHUNK)..][..width];
                    for (sum, value) in sums.iter_mut().zip(values) {
                        *sum += value;
                    }
                }
            }
            for value in sums {
                *value *= scale;
            }
        });
    Ok(())
}

/// `scale` times the sums over `views` of the gradients of the higher harmonics, `high [N, K, 3]`, with the
/// Gaussians' `means [N, 3]`. What no view shows becomes 0.
///
/// # Errors
/// Names the array whose length does not fit, rows that are not ascending, or a degree that there is not.
pub fn add_harmonics(
    views: &[ViewColors<'_>],
    means: &[f32],
    high: &mut [f32],
    scale: f32,
) -> Result<(), Error> {
    let n = means.len() / 3;
    check_len("means", means, 3 * n)?;
    let width = high.len().checked_div(n).unwrap_or(0);
    check_len("high", high, width * n)?;
    for view in views {
        check_rows(&view.colors, n, 3)?;
        if view.degree > sh::MAX_DEGREE || 3 * (sh::count(view.degree) - 1) > width {
            let message = format!("{} is too high for {width} numbers a Gaussian", view.degree);
            return Err(Error::new("degree", message));
        }
    }
    let level = simd::level()?.token();
    high.par_chunks_mut((CHUNK * width).max(1))
        .enumerate()
        .for_each(|(i, high)| {
            high.fill(0.0);
            for view in views {
                dispatch!(level, simd => add_view(simd, view, means, i * CHUNK, high, width));
            }
            for value in high {
                *value *= scale;
            }
        });
    Ok(())
}

/// That a view has `width` numbers for each of its rows, which ascend below `n`.
fn check_rows(view: &ViewRows<'_>, n: usize, width: usize) -> Result<(), Error> {
    check_len("values", view.values, width * view.rows.len())?;
    let inside = view.rows.first().is_none_or(|&row| row >= 0)
        && view.rows.last().is_none_or(|&row| (row as usize) < n);
    if !inside || !view.rows.is_sorted_by(|a, b| a < b) {
        return Err(Error::new("rows", format!("must ascend within 0..{n}")));
    }
    Ok(())
}

/// The rows from `first` to before `end`, and their numbers.
fn part<'a>(view: &ViewRows<'a>, first: usize, end: usize, width: usize) -> (&'a [i32], &'a [f32]) {
    let from = view.rows.partition_point(|&row| (row as usize) < first);
    let to = view.rows.partition_point(|&row| (row as usize) < end);
    (&view.rows[from..to], &view.values[width * from..width * to])
}

/// Add what one view gives to the Gaussians `first..` that `high` has room for.
#[inline(always)]
fn add_view<S: Simd>(
    simd: S,
    view: &ViewColors<'_>,
    means: &[f32],
    first: usize,
    high: &mut [f32],
    width: usize,
) {
    let (rows, colors) = part(&view.colors, first, first + high.len() / width, 3);
    let count = sh::count(view.degree);
    if count == 1 {
        return;
    }
    for (rows, colors) in rows.chunks(GROUP).zip(colors.chunks(3 * GROUP)) {
        let mut basis = [Column::<f32>::ZERO; sh::MAX_COUNT];
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
        for (lane, (&row, color)) in rows.iter().zip(colors.chunks_exact(3)).enumerate() {
            let color = [0, 1, 2].map(|k| color[k] / sh::C0 as f32);
            let sums = &mut high[width * (row as usize - first)..][..3 * (count - 1)];
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
        let values: Vec<f32> = (0..10).map(|k| k as f32).collect();
        let view = ViewRows {
            rows: &[0, 2],
            values: &values,
        };
        let mut sums = vec![7.0; 15];
        add(&[view, view], &mut sums, 5, 0.5).unwrap();
        assert_eq!(sums[..5], values[..5]);
        assert_eq!(sums[5..10], [0.0; 5]);
        assert_eq!(sums[10..], values[5..]);
    }

    #[test]
    fn higher_harmonics_follow_from_the_colors() {
        let colors = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let view = ViewColors {
            colors: ViewRows {
                rows: &[0, 2],
                values: &colors,
            },
            center: [0.0, 0.0, -2.0],
            degree: 1,
        };
        let means = [0.0, 0.0, 1.0, 9.0, 9.0, 9.0, 3.0, 0.0, 2.0];
        let mut high = vec![7.0; 27];
        add_harmonics(&[view, view], &means, &mut high, 0.5).unwrap();
        assert_eq!(high[9..18], [0.0; 9]);
        // The first one is straight ahead: the gradient is all in the second function, sqrt(3) z.
        for k in 0..3 {
            assert_eq!((high[k], high[6 + k]), (0.0, 0.0));
            assert!((high[3 + k] - 3f32.sqrt() * colors[k]).abs() < 1e-5 * colors[k]);
        }
    }

    #[test]
    fn what_does_not_fit_is_told() {
        let mut view = ViewRows {
            rows: &[1, 0],
            values: &[0.0; 6],
        };
        let told = |view| add(&[view], &mut [0.0; 6], 3, 1.0).map_err(|e| e.to_string());
        assert!(told(view).unwrap_err().contains("rows"));
        view.rows = &[0, 2];
        assert!(told(view).unwrap_err().contains("rows"));
        view.rows = &[0];
        assert!(told(view).unwrap_err().contains("values"));
        view.rows = &[0, 1];
        assert!(told(view).is_ok());
        let colors = ViewColors {
            colors: view,
            center: [0.0; 3],
            degree: 1,
        };
        let told = add_harmonics(&[colors], &[0.0; 6], &mut [], 1.0).map_err(|e| e.to_string());
        assert!(told.unwrap_err().contains("degree"));
    }
}
