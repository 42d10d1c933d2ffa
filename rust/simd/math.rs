//! Functions that the standard library has for numbers, lane by lane.

use super::{Lanes, Wide, splat};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

/// Coefficients of `2^f` on [-0.5, 0.5], constant term first: minimax in the relative error (1.9e-9).
const EXP2_F32: [f32; 7] = [
    1.0,
    std::f32::consts::LN_2, // to the last bit
    0.240_226_47,
    0.055_503_29,
    0.009_618_489,
    0.001_339_993_1,
    0.000_153_458_12,
];

/// Coefficients of `2^f` on [-0.5, 0.5]: Taylor series, `ln(2)^k / k!`, truncation error below 1e-17.
const EXP2_F64: [f64; 14] = {
    let mut c = [1.0; 14];
    let mut k = 1;
    while k < 14 {
        c[k] = c[k - 1] * std::f64::consts::LN_2 / k as f64;
        k += 1;
    }
    c
};

/// `2^x` of N times V vectors: round to the nearest integer by adding `magic` (1.5 x 2^mantissa bits), whose low bits then
/// hold that integer; evaluate the polynomial at the rest; add the integer to the exponent. Step by step for all of
/// them, so that the processor need not wait for one.
macro_rules! exp2 {
    ($T:ty, $simd:ident, $x:ident, $min:expr, $magic:expr, $bits:expr, $coefficients:expr) => {{
        let splat = |x: $T| Lanes::<$T, S>::splat($simd, x);
        let magic = splat($magic);
        let last = $coefficients.len() - 1;
        let mut shifted = [[magic; V]; N];
        let mut p = [[splat($coefficients[last]); V]; N];
        let x = $x.as_flattened_mut();
        for (x, shifted) in x.iter_mut().zip(shifted.as_flattened_mut()) {
            *x = x.max(splat($min));
            *shifted = *x + magic;
            *x -= *shifted - magic;
        }
        let mut k = last;
        while k > 0 {
            k -= 1;
            for (p, f) in p.as_flattened_mut().iter_mut().zip(x.iter()) {
                *p = p.mul_add(*f, splat($coefficients[k]));
            }
        }
        for ((x, p), shifted) in x
            .iter_mut()
            .zip(p.as_flattened())
            .zip(shifted.as_flattened())
        {
            *x = Lanes::<$T, S>::from_bits(p.to_bits() + (shifted.to_bits() << $bits));
        }
    }};
}

/// [`Real::exp2`](super::Real::exp2) in f32.
#[inline(always)]
pub(super) fn exp2_f32<S: Simd, const N: usize, const V: usize>(
    simd: S,
    x: &mut [[Lanes<f32, S>; V]; N],
) {
    exp2!(f32, simd, x, -126.0, 12_582_912.0, 23u32, EXP2_F32);
}

/// [`Real::exp2`](super::Real::exp2) in f64.
#[inline(always)]
pub(super) fn exp2_f64<S: Simd, const N: usize, const V: usize>(
    simd: S,
    x: &mut [[Lanes<f64, S>; V]; N],
) {
    const MAGIC: f64 = 6_755_399_441_055_744.0;
    exp2!(f64, simd, x, -1022.0, MAGIC, 52u32, EXP2_F64);
}

/// `e^x` with a relative error below (1 + |x|) 2e-16, and never less than the smallest normal number; NaN stays.
#[inline(always)]
pub(crate) fn exp<S: Simd>(simd: S, x: Wide<S>) -> Wide<S> {
    const LN_MAX: f64 = 709.782_712_893_384; // of the largest number
    let mut power = [[x.min(splat(simd, LN_MAX)) * std::f64::consts::LOG2_E]];
    exp2_f64(simd, &mut power);
    let finite = x
        .simd_le(splat(simd, LN_MAX))
        .select(power[0][0], splat(simd, f64::INFINITY));
    x.simd_eq(x).select(finite, x)
}

/// Coefficients of `2 atanh(r) / r` in powers of `r^2`.
const ATANH: [f64; 11] = {
    let mut c = [2.0; 11];
    let mut k = 0;
    while k < 11 {
        c[k] /= (2 * k + 1) as f64;
        k += 1;
    }
    c
};

/// Natural logarithm of numbers in [1, inf), relative error below 1e-15; other lanes get anything.
#[inline(always)]
pub(crate) fn ln<S: Simd>(simd: S, x: Wide<S>) -> Wide<S> {
    const SQRT_HALF: u64 = 0x3fe6_a09e_667f_3bcd;
    const TWO_52: u64 = 0x4330_0000_0000_0000; // the bits of 2^52
    // x = 2^e m with m in [sqrt(1/2), sqrt(2)); ln m = 2 atanh((m - 1) / (m + 1)), truncated after r^21 (1e-18).
    let bits = x.to_bits();
    let e = (bits - SQRT_HALF) >> 52u32;
    let m = Wide::<S>::from_bits(bits - (e << 52u32));
    let e = Wide::<S>::from_bits(e + TWO_52) - f64::from_bits(TWO_52);
    let r = (m - 1.0) / (m + 1.0);
    let r2 = r * r;
    let mut p = splat(simd, ATANH[10]);
    for c in ATANH[..10].iter().rev() {
        p = p.mul_add(r2, splat(simd, *c));
    }
    e.mul_add(splat(simd, std::f64::consts::LN_2), p * r)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Level, Real, at_each_level};
    use fearless_simd::dispatch;

    fn worst_error<T: Real>(level: Level) -> f64 {
        fn run<S: Simd, T: Real>(simd: S) -> f64 {
            (0..20_000)
                .map(|i| {
                    let x = T::from_f64(-f64::from(i) * 0.0037);
                    let mut y = [[Lanes::<T, S>::splat(simd, x)]];
                    T::exp2(simd, &mut y);
                    (y[0][0][0].to_f64() / x.to_f64().exp2() - 1.0).abs()
                })
                .fold(0.0, f64::max)
        }
        dispatch!(level.token, simd => run::<_, T>(simd))
    }

    #[test]
    fn exp2_is_as_accurate_as_stated() {
        at_each_level(|level| {
            let errors = [worst_error::<f32>(level), worst_error::<f64>(level)];
            assert!(errors[0] < 1.2e-7 && errors[1] < 3e-16, "{errors:?}");
        });
    }

    #[inline(always)]
    fn exponential<S: Simd>(simd: S, x: f64) -> f64 {
        exp(simd, splat(simd, x))[0]
    }

    #[test]
    fn exponential_is_as_accurate_as_stated() {
        at_each_level(|level| {
            let exp = |x| dispatch!(level.token, simd => exponential(simd, x));
            for i in -70_000..70_900 {
                let x = f64::from(i) * 0.01;
                let error = (exp(x) / x.exp() - 1.0).abs();
                assert!(error < (1.0 + x.abs()) * 2e-16, "exp {x}: {error}");
            }
            assert!(exp(709.78).is_finite() && exp(-1e300) < 1e-307 && exp(f64::NAN).is_nan());
            assert_eq!([exp(709.79), exp(f64::INFINITY)], [f64::INFINITY; 2]);
        });
    }

    #[inline(always)]
    fn logarithm<S: Simd>(simd: S, x: f64) -> f64 {
        ln(simd, splat(simd, x))[0]
    }

    #[test]
    fn logarithm_is_as_accurate_as_stated() {
        at_each_level(|level| {
            for i in 0..200_000 {
                let x = 1.0 + (f64::from(i) * 1e-4).powi(3) / 30.0;
                let y = dispatch!(level.token, simd => logarithm(simd, x));
                assert!((y - x.ln()).abs() <= 1e-15 * x.ln(), "ln {x} = {y}");
            }
        });
    }
}
