//! What growth goes by, and what guards a step: passes over all Gaussians that leave nothing to do for one thread.

use hqgs::internals::{Error, check_len, simd::Real};
use rayon::prelude::*;

/// Elements per task.
const CHUNK: usize = 1 << 13;

/// How strongly the views so far pull at the Gaussians in the image, of N Gaussians.
#[derive(Debug)]
pub struct Pulls<'a> {
    /// Sums of the norms, in loss per half image, `[N]`.
    pub sums: &'a mut [f32],
    /// In how many views the Gaussian was visible, `[N]`.
    pub views: &'a mut [f32],
}

impl Pulls<'_> {
    /// Add one view: the gradient of the projected means in pixels, [N, 2], where the radii, [N, 2], are not 0. `half`:
    /// half the sides of the image, in pixels.
    ///
    /// # Errors
    /// Names the array whose length does not fit.
    pub fn add(&mut self, gradient: &[f32], radii: &[i32], half: [f32; 2]) -> Result<(), Error> {
        let n = self.sums.len();
        check_len("views", self.views, n)?;
        check_len("gradient", gradient, 2 * n)?;
        check_len("radii", radii, 2 * n)?;
        self.sums
            .par_chunks_mut(CHUNK)
            .zip(self.views.par_chunks_mut(CHUNK))
            .zip(gradient.par_chunks(2 * CHUNK))
            .zip(radii.par_chunks(2 * CHUNK))
            .for_each(|(((sums, views), gradient), radii)| {
                let (gradient, radii) = (gradient.as_chunks::<2>().0, radii.as_chunks::<2>().0);
                let rows = sums.iter_mut().zip(views).zip(gradient).zip(radii);
                for (((sum, views), g), radii) in rows {
                    // In f64, where the squares are exact and nothing overflows.
                    let [x, y] = [0, 1].map(|k| f64::from(g[k] * half[k]));
                    let visible = radii[0] > 0 && radii[1] > 0;
                    *sum += if visible {
                        (x * x + y * y).sqrt() as f32
                    } else {
                        0.0
                    };
                    *views += f32::from(u8::from(visible));
                }
            });
        Ok(())
    }
}

/// Whether all values of several arrays are nearer to 0 than the limit of theirs; NaN is not.
pub fn all_below<T: Real>(arrays: &[(&[T], f64)]) -> bool {
    let mut tasks = Vec::new();
    for &(values, limit) in arrays {
        let limit = T::from_f64(limit);
        tasks.extend(values.chunks(CHUNK).map(|chunk| (chunk, limit)));
    }
    tasks.into_par_iter().all(|(chunk, limit)| {
        // No early end: so it goes through as vectors.
        let inside = |x: &T| -limit < *x && *x < limit;
        chunk.iter().fold(true, |all, x| all & inside(x))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise;

    #[test]
    fn norms_are_added_where_a_gaussian_is_visible() {
        let n = CHUNK + 37; // of two tasks
        let gradient: Vec<f32> = noise(1, 2 * n).iter().map(|x| *x as f32 - 0.5).collect();
        let radii: Vec<i32> = (0..2 * n as i32).map(|k| k % 3).collect();
        let (mut sums, mut views) = (vec![1.0; n], vec![2.0; n]);
        let mut pulls = Pulls {
            sums: &mut sums,
            views: &mut views,
        };
        pulls.add(&gradient, &radii, [252.0, 189.0]).unwrap();
        for i in 0..n {
            let [x, y] = [252.0, 189.0].map(f64::from);
            let (x, y) = (
                x * f64::from(gradient[2 * i]),
                y * f64::from(gradient[2 * i + 1]),
            );
            let visible = 2 * i % 3 > 0 && (2 * i + 1) % 3 > 0;
            let expected = if visible { 1.0 + x.hypot(y) } else { 1.0 };
            assert!((f64::from(sums[i]) - expected).abs() < 1e-6 * expected);
            assert_eq!(views[i], if visible { 3.0 } else { 2.0 });
        }
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let (mut sums, mut views) = ([0.0; 3], [0.0; 3]);
        let mut pulls = Pulls {
            sums: &mut sums,
            views: &mut views,
        };
        let name = |result: Result<(), Error>| result.unwrap_err().name().to_owned();
        assert_eq!(name(pulls.add(&[0.0; 5], &[1; 6], [1.0; 2])), "gradient");
        assert_eq!(name(pulls.add(&[0.0; 6], &[1; 4], [1.0; 2])), "radii");
        pulls.views = &mut [];
        assert_eq!(name(pulls.add(&[0.0; 6], &[1; 6], [1.0; 2])), "views");
    }

    #[test]
    fn one_value_out_of_bounds_is_found_wherever_it_lies() {
        let mut values = vec![-9.0f32; 2 * CHUNK + 5];
        let near = [1.0f32; 3];
        assert!(all_below(&[(&near, 2.0), (&values, 10.0)]) && all_below::<f64>(&[]));
        assert!(!all_below(&[(&near, 1.0), (&values, 10.0)]));
        for k in [0, CHUNK - 1, CHUNK, 2 * CHUNK + 4] {
            for bad in [10.0, -10.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                let good = std::mem::replace(&mut values[k], bad);
                assert!(!all_below(&[(&near, 2.0), (&values, 10.0)]), "{bad} at {k}");
                values[k] = good;
            }
        }
    }
}
