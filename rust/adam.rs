//! Adam (Kingma and Ba 2015) in place, operation by operation as `torch.optim.Adam` does it.
//!
//! Each element depends on itself alone and no product is fused with a sum, so that the bits depend neither on
//! the number of threads nor on the machine.

use crate::{
    error::{Error, check_len},
    real::{Lanes, Real},
};
use fearless_simd::{Level, Simd, SimdBase, SimdFloat, dispatch};
use rayon::prelude::*;

/// Elements per task: four arrays of this size fit in the second-level cache.
const CHUNK: usize = 1 << 14;
/// At least the lanes of any vector.
const MAX_LANES: usize = 16;

/// The settings of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamOptions {
    /// Learning rate.
    pub lr: f64,
    /// Decay of the first moment, in [0, 1).
    pub beta1: f64,
    /// Decay of the second moment, in [0, 1).
    pub beta2: f64,
    /// Added to the square root of the second moment.
    pub eps: f64,
}

/// One array of parameters with its gradient and its moments, all of the same length.
#[derive(Debug)]
pub struct AdamArrays<'a, T> {
    /// The parameters.
    pub param: &'a mut [T],
    /// Their gradient.
    pub grad: &'a [T],
    /// First moment.
    pub exp_avg: &'a mut [T],
    /// Second moment.
    pub exp_avg_sq: &'a mut [T],
}

/// What a step updates; everything else is left as it is, moments included.
#[derive(Debug, Clone, Copy)]
pub struct Selection<'a> {
    /// Rows whose number here is 0 are left out, [N] for arrays of N rows (the selective Adam of Taming 3DGS,
    /// Mallick et al. 2024). None: none.
    pub visible: Option<&'a [u8]>,
    /// Numbers of a row.
    pub width: usize,
    /// How many of them are updated, the first ones.
    pub used: usize,
}

impl Selection<'_> {
    /// Everything.
    pub const ALL: Self = Self {
        visible: None,
        width: 1,
        used: 1,
    };

    /// Check it against arrays of `n` numbers.
    fn check(&self, n: usize) -> Result<(), Error> {
        let Self {
            visible,
            width,
            used,
        } = *self;
        if width == 0 || used > width || !n.is_multiple_of(width) {
            return Err(Error::new(
                "used",
                format!("cannot update {used} of {width} numbers a row of {n} elements"),
            ));
        }
        if let Some(got) = visible.map(<[u8]>::len).filter(|got| got * width != n) {
            return Err(Error::shape(
                "visible",
                "[N] for arrays of N rows",
                format!("{got} for {n} elements in rows of {width}"),
            ));
        }
        Ok(())
    }
}

/// The factors of a step, in the type of the parameters.
#[derive(Clone, Copy)]
struct Factors<T> {
    lerp: T,
    beta2: T,
    one_minus_beta2: T,
    negative_step: T,
    bias2_sqrt: T,
    eps: T,
}

/// Make step number `step` (from 1) of what is selected.
///
/// # Errors
/// Names the array whose length does not match, or the setting out of its range.
pub fn step<T: Real>(
    arrays: AdamArrays<'_, T>,
    step: u64,
    options: &AdamOptions,
    selection: &Selection,
) -> Result<(), Error> {
    let AdamArrays {
        param,
        grad,
        exp_avg,
        exp_avg_sq,
    } = arrays;
    let factors = options.factors(step)?;
    let n = param.len();
    check_len("grad", grad, n)?;
    check_len("exp_avg", exp_avg, n)?;
    check_len("exp_avg_sq", exp_avg_sq, n)?;
    if n == 0 {
        return Ok(());
    }
    selection.check(n)?;
    let Selection {
        visible,
        width,
        used,
    } = *selection;
    let chunk = (CHUNK / width).max(1) * width;
    let level = Level::new();
    param
        .par_chunks_mut(chunk)
        .zip(exp_avg.par_chunks_mut(chunk))
        .zip(exp_avg_sq.par_chunks_mut(chunk))
        .zip(grad.par_chunks(chunk))
        .enumerate()
        .for_each(|(i, (((param, m), v), grad))| {
            let Some(visible) = visible else {
                return dispatch!(level, simd => update_rows(simd, &factors, param, m, v, grad, width, used));
            };
            let first = i * chunk / width;
            let mut at = 0;
            for run in
                visible[first..first + param.len() / width].chunk_by(|a, b| (*a != 0) == (*b != 0))
            {
                let part = at..at + run.len() * width;
                at = part.end;
                if run[0] != 0 {
                    let (param, m, v) = (
                        &mut param[part.clone()],
                        &mut m[part.clone()],
                        &mut v[part.clone()],
                    );
                    let grad = &grad[part];
                    dispatch!(level, simd => update_rows(simd, &factors, param, m, v, grad, width, used));
                }
            }
        });
    Ok(())
}

impl AdamOptions {
    fn factors<T: Real>(&self, step: u64) -> Result<Factors<T>, Error> {
        let &Self {
            lr,
            beta1,
            beta2,
            eps,
        } = self;
        let ranges = [
            ("step", step as f64, step >= 1, "at least 1"),
            (
                "lr",
                lr,
                lr >= 0.0 && lr.is_finite(),
                "finite and not negative",
            ),
            ("beta1", beta1, (0.0..1.0).contains(&beta1), "in [0, 1)"),
            ("beta2", beta2, (0.0..1.0).contains(&beta2), "in [0, 1)"),
            (
                "eps",
                eps,
                eps >= 0.0 && eps.is_finite(),
                "finite and not negative",
            ),
        ];
        if let Some((name, value, _, range)) = ranges.iter().find(|r| !r.2) {
            return Err(Error::new(*name, format!("must be {range}, got {value}")));
        }
        let bias = |beta: f64| 1.0 - beta.powf(step as f64);
        Ok(Factors {
            lerp: T::from_f64(1.0 - beta1),
            beta2: T::from_f64(beta2),
            one_minus_beta2: T::from_f64(1.0 - beta2),
            negative_step: T::from_f64(-lr / bias(beta1)),
            bias2_sqrt: T::from_f64(bias(beta2).sqrt()),
            eps: T::from_f64(eps),
        })
    }
}

/// The first `used` numbers of each row.
#[inline(always)]
fn update_rows<T: Real, S: Simd>(
    simd: S,
    factors: &Factors<T>,
    param: &mut [T],
    exp_avg: &mut [T],
    exp_avg_sq: &mut [T],
    grad: &[T],
    width: usize,
    used: usize,
) {
    if used == width {
        return update(simd, factors, param, exp_avg, exp_avg_sq, grad);
    }
    for row in (0..param.len()).step_by(width) {
        let row = row..row + used;
        update(
            simd,
            factors,
            &mut param[row.clone()],
            &mut exp_avg[row.clone()],
            &mut exp_avg_sq[row.clone()],
            &grad[row],
        );
    }
}

#[inline(always)]
fn update<T: Real, S: Simd>(
    simd: S,
    factors: &Factors<T>,
    param: &mut [T],
    exp_avg: &mut [T],
    exp_avg_sq: &mut [T],
    grad: &[T],
) {
    let lanes = Lanes::<T, S>::LEN;
    let mut params = param.chunks_exact_mut(lanes);
    let mut means = exp_avg.chunks_exact_mut(lanes);
    let mut squares = exp_avg_sq.chunks_exact_mut(lanes);
    let grads = grad.chunks_exact(lanes);
    let last = grads.remainder();
    for (((p, m), v), g) in (&mut params).zip(&mut means).zip(&mut squares).zip(grads) {
        update_lanes(simd, factors, p, m, v, g);
    }
    if !last.is_empty() {
        // The rest goes through the same operations in a vector filled up with zeros.
        let rest = [
            params.into_remainder(),
            means.into_remainder(),
            squares.into_remainder(),
        ];
        let mut full = [[T::ZERO; MAX_LANES]; 4];
        for (full, rest) in full.iter_mut().zip([&*rest[0], &*rest[1], &*rest[2], last]) {
            full[..rest.len()].copy_from_slice(rest);
        }
        let [p, m, v, g] = full.each_mut().map(|full| &mut full[..lanes]);
        update_lanes(simd, factors, p, m, v, g);
        for (rest, full) in rest.into_iter().zip(&full) {
            rest.copy_from_slice(&full[..rest.len()]);
        }
    }
}

#[inline(always)]
fn update_lanes<T: Real, S: Simd>(
    simd: S,
    factors: &Factors<T>,
    param: &mut [T],
    exp_avg: &mut [T],
    exp_avg_sq: &mut [T],
    grad: &[T],
) {
    let g = Lanes::<T, S>::from_slice(simd, grad);
    let m = Lanes::<T, S>::from_slice(simd, exp_avg);
    let v = Lanes::<T, S>::from_slice(simd, exp_avg_sq);
    let p = Lanes::<T, S>::from_slice(simd, param);
    let m = m + (g - m) * factors.lerp;
    let v = v * factors.beta2 + (g * factors.one_minus_beta2) * g;
    let denominator = v.sqrt() / factors.bias2_sqrt + factors.eps;
    let p = p + (m * factors.negative_step) / denominator;
    m.store_slice(exp_avg);
    v.store_slice(exp_avg_sq);
    p.store_slice(param);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// torch's formulas, one element at a time.
    macro_rules! reference {
        ($type:ty, $name:ident) => {
            fn $name(state: &mut [[$type; 3]], grad: &[$type], step: i32, o: &AdamOptions) {
                for ([p, m, v], &g) in state.iter_mut().zip(grad) {
                    *m += (g - *m) * (1.0 - o.beta1) as $type;
                    *v = *v * o.beta2 as $type + (1.0 - o.beta2) as $type * g * g;
                    let step_size = o.lr / (1.0 - o.beta1.powf(f64::from(step)));
                    let bias2_sqrt = (1.0 - o.beta2.powf(f64::from(step))).sqrt();
                    *p += -step_size as $type * *m
                        / (v.sqrt() / bias2_sqrt as $type + o.eps as $type);
                }
            }
        };
    }
    reference!(f32, reference_f32);
    reference!(f64, reference_f64);

    const OPTIONS: AdamOptions = AdamOptions {
        lr: 0.01,
        beta1: 0.9,
        beta2: 0.999,
        eps: 1e-15,
    };

    fn noise(seed: u64, n: usize) -> Vec<f64> {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let next = |_| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / (1u64 << 23) as f64 - 1.0
        };
        (0..n).map(next).collect()
    }

    /// param, exp_avg, exp_avg_sq after `steps` steps.
    fn run<T: Real>(n: usize, steps: u64, selection: &Selection) -> [Vec<T>; 3] {
        let param = noise(1, n).into_iter().map(T::from_f64).collect();
        let mut arrays = [param, vec![T::ZERO; n], vec![T::ZERO; n]];
        for at in 1..=steps {
            let [param, exp_avg, exp_avg_sq] = &mut arrays;
            let arrays = AdamArrays {
                param,
                grad: &grad(at, n),
                exp_avg,
                exp_avg_sq,
            };
            step(arrays, at, &OPTIONS, selection).unwrap();
        }
        arrays
    }

    fn grad<T: Real>(at: u64, n: usize) -> Vec<T> {
        let scale = 10f64.powi(at as i32 % 5 - 3);
        noise(at + 2, n)
            .into_iter()
            .map(|v| T::from_f64(v * scale))
            .collect()
    }

    macro_rules! check {
        ($type:ty, $reference:ident, $n:expr) => {
            let got = run::<$type>($n, 20, &Selection::ALL);
            let mut state: Vec<_> = noise(1, $n)
                .into_iter()
                .map(|p| [p as $type, 0.0, 0.0])
                .collect();
            for at in 1..=20 {
                $reference(&mut state, &grad(at, $n), at as i32, &OPTIONS);
            }
            for (i, expected) in state.iter().enumerate() {
                assert_eq!(
                    [got[0][i], got[1][i], got[2][i]],
                    *expected,
                    "element {i} of {}",
                    $n
                );
            }
        };
    }

    #[test]
    fn agrees_with_the_formulas_of_torch() {
        for n in [1, 15, 16, 17, 33, 40_003] {
            check!(f32, reference_f32, n);
            check!(f64, reference_f64, n);
        }
    }

    #[test]
    fn rows_that_are_not_visible_are_left_alone() {
        for width in [1, 3, 45] {
            let rows = 1000;
            let visible: Vec<u8> = noise(5, rows).iter().map(|&v| u8::from(v > 0.2)).collect();
            let [all, some, none] =
                [None, Some(&visible[..]), Some(&vec![0; rows][..])].map(|visible| {
                    let used = width;
                    let selection = Selection {
                        visible,
                        width,
                        used,
                    };
                    run::<f32>(rows * width, 3, &selection)
                });
            for k in 0..3 {
                for i in 0..rows * width {
                    let expected = if visible[i / width] != 0 { &all } else { &none };
                    assert_eq!(some[k][i], expected[k][i], "array {k}, element {i}");
                }
            }
            let start: Vec<f32> = noise(1, rows * width)
                .into_iter()
                .map(|v| v as f32)
                .collect();
            assert_eq!(
                none,
                [start, vec![0.0; rows * width], vec![0.0; rows * width]]
            );
        }
    }

    #[test]
    fn numbers_of_a_row_that_are_not_used_are_left_alone() {
        let (rows, width) = (1000, 45);
        let visible: Vec<u8> = noise(5, rows).iter().map(|&v| u8::from(v > 0.2)).collect();
        let all = run::<f32>(rows * width, 3, &Selection::ALL);
        for used in [0, 9, 24, 45] {
            for visible in [None, Some(&visible[..])] {
                let selection = Selection {
                    visible,
                    width,
                    used,
                };
                let some = run::<f32>(rows * width, 3, &selection);
                for (i, start) in noise(1, rows * width).into_iter().enumerate() {
                    let updated = i % width < used && visible.is_none_or(|v| v[i / width] != 0);
                    let expected = if updated {
                        all.each_ref().map(|a| a[i])
                    } else {
                        [start as f32, 0.0, 0.0]
                    };
                    assert_eq!(
                        some.each_ref().map(|a| a[i]),
                        expected,
                        "{used}, element {i}"
                    );
                }
            }
        }
    }

    #[test]
    fn same_bits_for_any_number_of_threads() {
        let at = |threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| run::<f32>(70_001, 3, &Selection::ALL))
                .map(|a| a.into_iter().map(f32::to_bits).collect::<Vec<_>>())
        };
        let one = at(1);
        assert!(one == at(2) && one == at(3));
    }

    #[test]
    fn wrong_input_is_named() {
        let call = |lengths: [usize; 4], at, options: AdamOptions, visible: Option<&[u8]>| {
            let [mut param, grad, mut exp_avg, mut exp_avg_sq] = lengths.map(|n| vec![1.0f32; n]);
            let arrays = AdamArrays {
                param: &mut param,
                grad: &grad,
                exp_avg: &mut exp_avg,
                exp_avg_sq: &mut exp_avg_sq,
            };
            let selection = Selection {
                visible,
                ..Selection::ALL
            };
            step(arrays, at, &options, &selection).map_err(|e| e.name)
        };
        let named = |name: &str| Err(name.to_owned());
        assert_eq!(call([6, 5, 6, 6], 1, OPTIONS, None), named("grad"));
        assert_eq!(call([6, 6, 5, 6], 1, OPTIONS, None), named("exp_avg"));
        assert_eq!(call([6, 6, 6, 5], 1, OPTIONS, None), named("exp_avg_sq"));
        assert_eq!(call([6; 4], 1, OPTIONS, Some(&[1; 4])), named("visible"));
        assert_eq!(call([6; 4], 1, OPTIONS, Some(&[])), named("visible"));
        assert_eq!(call([0; 4], 1, OPTIONS, Some(&[1; 4])), Ok(()));
        assert_eq!(call([0; 4], 1, OPTIONS, None), Ok(()));
        assert_eq!(call([6; 4], 0, OPTIONS, None), named("step"));
        assert_eq!(
            call(
                [6; 4],
                1,
                AdamOptions {
                    lr: f64::NAN,
                    ..OPTIONS
                },
                None
            ),
            named("lr")
        );
        assert_eq!(
            call(
                [6; 4],
                1,
                AdamOptions {
                    beta1: 1.0,
                    ..OPTIONS
                },
                None
            ),
            named("beta1")
        );
        assert_eq!(
            call(
                [6; 4],
                1,
                AdamOptions {
                    beta2: -0.1,
                    ..OPTIONS
                },
                None
            ),
            named("beta2")
        );
        assert_eq!(
            call(
                [6; 4],
                1,
                AdamOptions {
                    eps: -1.0,
                    ..OPTIONS
                },
                None
            ),
            named("eps")
        );
    }
}
