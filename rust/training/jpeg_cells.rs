//! The distance of numbers to cells around given centres: what a quantised file leaves open costs nothing.

use fearless_simd::{Select, Simd, SimdBase, dispatch};
use hqgs::internals::{
    Error, check_len,
    simd::{
        self, Lanes, Real,
        sums::{MAX_PARTS, parts},
    },
};
use rayon::prelude::*;

/// Numbers whose distances are summed together: the order of the sums depends on nothing else.
const CHUNK: usize = 8192;

/// `scale` times the sum of `max(|x - centre| - width / 2, 0)`, and its gradient with respect to `x` if there
/// is a place for it; 0 within a cell and on its border. NaN gives NaN.
///
/// # Errors
/// Names the array whose length differs from that of `x`.
pub fn distance<T: Real>(
    x: &[T],
    centres: &[T],
    widths: &[T],
    scale: f64,
    grad: Option<&mut [T]>,
) -> Result<f64, Error> {
    check_len("centres", centres, x.len())?;
    check_len("widths", widths, x.len())?;
    let mut none = Vec::new();
    let (grad, wanted) = match grad {
        Some(grad) => {
            check_len("grad", grad, x.len())?;
            (grad, true)
        }
        None => (&mut none[..], false),
    };
    let mut sums = vec![0.0; x.len().div_ceil(CHUNK)];
    // One piece of the gradient for each chunk, empty where it is not wanted.
    let mut grads: Vec<&mut [T]> = grad.chunks_mut(CHUNK).collect();
    grads.resize_with(sums.len(), Default::default);
    let level = simd::level()?.token();
    sums.par_iter_mut()
        .zip(grads)
        .zip(x.par_chunks(CHUNK))
        .zip(centres.par_chunks(CHUNK))
        .zip(widths.par_chunks(CHUNK))
        .for_each(|((((sum, grad), x), centres), widths)| {
            let out = if wanted { Some(grad) } else { None };
            *sum = dispatch!(level, simd => chunk(simd, x, centres, widths, scale, out));
        });
    Ok(scale * sums.iter().sum::<f64>())
}

/// The sum over a chunk; its gradient to `grad`.
#[inline(always)]
fn chunk<S: Simd, T: Real>(
    simd: S,
    x: &[T],
    centres: &[T],
    widths: &[T],
    scale: f64,
    mut grad: Option<&mut [T]>,
) -> f64 {
    let n = Lanes::<T, S>::LEN;
    let splat = |x: f64| Lanes::<T, S>::splat(simd, T::from_f64(x));
    let (zero, half, up, down) = (splat(0.0), splat(0.5), splat(scale), splat(-scale));
    let mut sums = [splat(0.0); MAX_PARTS];
    for at in (0..x.len()).step_by(n) {
        let d = load(simd, x, at) - load(simd, centres, at);
        let outside = d.abs() - load(simd, widths, at) * half;
        let inside = outside.simd_le(zero);
        sums[at / n % parts::<S, T>()] += inside.select(zero, outside);
        if let Some(grad) = &mut grad {
            let slope = d.simd_lt(zero).select(down, up);
            let slope = inside.select(zero, slope);
            let end = x.len().min(at + n);
            if end == at + n {
                slope.store_slice(&mut grad[at..end]);
            } else {
                grad[at..end].copy_from_slice(&slope.as_slice()[..end - at]);
            }
        }
    }
    let lanes = sums[..parts::<S, T>()]
        .iter()
        .flat_map(|sum| sum.as_slice());
    lanes.map(|sum| sum.to_f64()).sum()
}

/// The vector at `at`; 0 beyond the end.
#[inline(always)]
fn load<S: Simd, T: Real>(simd: S, data: &[T], at: usize) -> Lanes<T, S> {
    let n = Lanes::<T, S>::LEN;
    if let Some(data) = data.get(at..at + n) {
        return Lanes::<T, S>::from_slice(simd, data);
    }
    let mut rest = [T::ZERO; 16];
    rest[..data.len() - at].copy_from_slice(&data[at..]);
    Lanes::<T, S>::from_slice(simd, &rest[..n])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::at_each_level;
    use hqgs::{Level, internals::simd::at_level, levels};
    use rayon::ThreadPoolBuilder;

    fn numbers<T: Real>(n: usize, k: f64) -> Vec<T> {
        (0..n)
            .map(|i| T::from_f64((k + i as f64 * 0.7).sin()))
            .collect()
    }

    fn check<T: Real + PartialEq + std::fmt::Debug>(level: Level, tolerance: f64) {
        for n in [1, 15, 16, 33, 3 * CHUNK + 5] {
            let (x, centres) = (numbers::<T>(n, 0.0), numbers::<T>(n, 2.0));
            let widths: Vec<T> = numbers::<T>(n, 1.0)
                .iter()
                .map(|w| T::from_f64(w.to_f64().abs()))
                .collect();
            let mut grad = vec![T::ONE; n];
            let value = at_level(level, || {
                distance(&x, &centres, &widths, 0.25, Some(&mut grad))
            })
            .unwrap();
            let mut expected = 0.0;
            for i in 0..n {
                let d = x[i].to_f64() - centres[i].to_f64();
                let outside = d.abs() - widths[i].to_f64() / 2.0;
                expected += 0.25 * outside.max(0.0);
                if outside.abs() > 1e-6 {
                    let slope = if outside > 0.0 {
                        0.25 * d.signum()
                    } else {
                        0.0
                    };
                    assert_eq!(grad[i].to_f64(), slope, "{i}");
                }
            }
            assert!((value - expected).abs() <= tolerance * expected, "{n}");
            let alone = at_level(level, || distance(&x, &centres, &widths, 0.25, None)).unwrap();
            assert_eq!(alone, value);
        }
    }

    #[test]
    fn is_the_distance_and_its_slope() {
        at_each_level(|level| {
            check::<f32>(level, 1e-5);
            check::<f64>(level, 1e-13);
        });
    }

    #[test]
    fn within_a_cell_and_on_its_border_nothing_is_asked() {
        at_each_level(check_border);
    }

    fn check_border(level: Level) {
        let (centres, widths) = ([0.0_f32; 4], [1.0; 4]);
        let mut grad = [1.0; 4];
        let value = at_level(level, || {
            distance(
                &[0.0, 0.5, -0.5, 0.4],
                &centres,
                &widths,
                1.0,
                Some(&mut grad),
            )
        });
        assert_eq!((value.unwrap(), grad), (0.0, [0.0; 4]));
        let x = [f32::NAN, 0.0, 0.0, 0.0];
        let value = at_level(level, || distance(&x, &centres, &widths, 1.0, None));
        assert!(value.unwrap().is_nan());
        assert_eq!(
            at_level(level, || distance(
                &[0.0; 4],
                &centres[1..],
                &widths,
                1.0,
                None
            ))
            .unwrap_err()
            .name(),
            "centres"
        );
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        let n = 5 * CHUNK + 7;
        let (x, centres, widths) = (numbers::<f32>(n, 0.0), numbers(n, 2.0), vec![0.1; n]);
        let run = |level, threads| {
            let pool = ThreadPoolBuilder::new().num_threads(threads).build();
            pool.unwrap().install(|| {
                let mut grad = vec![0.0; n];
                let value = at_level(level, || {
                    distance(&x, &centres, &widths, 0.3, Some(&mut grad))
                })
                .unwrap();
                (value, grad)
            })
        };
        // Nor any level: no product meets a sum.
        let best = run(levels()[0], 1);
        at_each_level(|level| assert!(run(level, 1) == best && run(level, 3) == best));
    }
}
