//! What growth goes by.

use hqgs::internals::{Error, check_len};
use rayon::prelude::*;

/// Elements per task.
const CHUNK: usize = 1 << 13;

/// Add one view to how strongly the views so far pull at N Gaussians in the image: `sums` of the norms, in loss per
/// half image, and in how many `views` each was visible, both `[N]`. `gradient`: of the projected means in pixels, [N, 2],
/// which counts where the radii, [N, 2], are not 0; `half`: half the sides of the image, in pixels.
///
/// # Errors
/// Names the array whose length does not fit.
pub fn add_pulls(
    sums: &mut [f32],
    views: &mut [f32],
    gradient: &[f32],
    radii: &[i32],
    half: [f32; 2],
) -> Result<(), Error> {
    let n = sums.len();
    check_len("views", views, n)?;
    check_len("gradient", gradient, 2 * n)?;
    check_len("radii", radii, 2 * n)?;
    sums.par_chunks_mut(CHUNK)
        .zip(views.par_chunks_mut(CHUNK))
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
        add_pulls(&mut sums, &mut views, &gradient, &radii, [252.0, 189.0]).unwrap();
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
        let name = |views: usize, gradient: usize, radii: usize| {
            let (mut sums, mut views) = ([0.0; 3], vec![0.0; views]);
            let (gradient, radii) = (vec![0.0; gradient], vec![1; radii]);
            let added = add_pulls(&mut sums, &mut views, &gradient, &radii, [1.0; 2]);
            added.unwrap_err().name().to_owned()
        };
        assert_eq!(name(3, 5, 6), "gradient");
        assert_eq!(name(3, 6, 4), "radii");
        assert_eq!(name(0, 6, 6), "views");
    }
}
