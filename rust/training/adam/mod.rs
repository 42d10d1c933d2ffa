//! Adam (Kingma and Ba 2015) in place, operation by operation as `torch.optim.Adam` does it.
//!
//! Each element depends on itself alone and no product is fused with a sum, so that the bits depend neither on
//! the number of threads nor on the machine.

use fearless_simd::{Simd, SimdBase, SimdFloat, dispatch};
use hqgs::internals::{
    Error, check_len,
    simd::{self, Lanes, Real},
};
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

impl AdamOptions {
    /// With the decays of the field, 0.9 and 0.999, and the 1e-15 that 3DGS adds.
    pub const fn new(lr: f64) -> Self {
        Self {
            lr,
            beta1: 0.9,
            beta2: 0.999,
            eps: 1e-15,
        }
    }
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
pub struct Selection {
    /// Numbers of a row.
    pub width: usize,
    /// How many of them are updated, the first ones.
    pub used: usize,
}

impl Selection {
    /// Everything.
    pub const ALL: Self = Self { width: 1, used: 1 };

    /// Check it against arrays of `n` numbers.
    fn check(&self, n: usize) -> Result<(), Error> {
        let Self { width, used } = *self;
        if width == 0 || used > width || !n.is_multiple_of(width) {
            return Err(Error::new(
                "used",
                format!("cannot update {used} of {width} numbers a row of {n} elements"),
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

/// A step of one array.
#[derive(Debug)]
pub struct AdamStep<'a, T> {
    /// What it moves.
    pub arrays: AdamArrays<'a, T>,
    /// Its number, from 1.
    pub step: u64,
    /// Its settings.
    pub options: AdamOptions,
    /// What of the array it moves.
    pub selection: Selection,
}

/// The steps of several arrays, shared out among the threads together.
///
/// # Errors
/// Names the array whose length does not match, or the setting out of its range; then none has been made.
pub fn steps<T: Real>(steps: Vec<AdamStep<'_, T>>) -> Result<(), Error> {
    let mut tasks: Vec<Task<'_, T>> = Vec::new();
    for step in steps {
        step.cut(&mut tasks)?;
    }
    let level = simd::level()?.token();
    tasks
        .into_par_iter()
        .with_max_len(1)
        .for_each(|(arrays, factors, width, used)| {
            dispatch!(level, simd => update_rows(simd, &factors, arrays, width, used));
        });
    Ok(())
}

/// Check several steps.
///
/// # Errors
/// As for [`steps`].
pub fn check<T: Real>(steps: &[AdamStep<'_, T>]) -> Result<(), Error> {
    steps.iter().try_for_each(|step| step.factors().map(|_| ()))
}

/// One task: what it moves, the factors, the numbers of a row and how many of them are moved.
type Task<'a, T> = (AdamArrays<'a, T>, Factors<T>, usize, usize);

impl<'a, T: Real> AdamStep<'a, T> {
    /// Its factors, if its arrays and settings fit.
    fn factors(&self) -> Result<Factors<T>, Error> {
        let factors = self.options.factors(self.step)?;
        let n = self.arrays.param.len();
        check_len("grad", self.arrays.grad, n)?;
        check_len("exp_avg", self.arrays.exp_avg, n)?;
        check_len("exp_avg_sq", self.arrays.exp_avg_sq, n)?;
        if n > 0 {
            self.selection.check(n)?;
        }
        Ok(factors)
    }

    /// Add the tasks that make it up.
    fn cut(self, tasks: &mut Vec<Task<'a, T>>) -> Result<(), Error> {
        let factors = self.factors()?;
        let AdamArrays {
            param,
            grad,
            exp_avg,
            exp_avg_sq,
        } = self.arrays;
        let Selection { width, used } = self.selection;
        if param.is_empty() {
            return Ok(());
        }
        let chunk = (CHUNK / width).max(1) * width;
        let chunks = param
            .chunks_mut(chunk)
            .zip(exp_avg.chunks_mut(chunk))
            .zip(exp_avg_sq.chunks_mut(chunk))
            .zip(grad.chunks(chunk));
        tasks.extend(chunks.map(|(((param, exp_avg), exp_avg_sq), grad)| {
            let arrays = AdamArrays {
                param,
                grad,
                exp_avg,
                exp_avg_sq,
            };
            (arrays, factors, width, used)
        }));
        Ok(())
    }
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
    arrays: AdamArrays<'_, T>,
    width: usize,
    used: usize,
) {
    let AdamArrays {
        param,
        grad,
        exp_avg,
        exp_avg_sq,
    } = arrays;
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
mod tests;
