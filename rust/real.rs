//! The scalar types of the crate (f32 and f64) and the few SIMD operations that differ between them.

use fearless_simd::{Simd, SimdBase, SimdFloat, SimdFloatElement};

/// A vector of `T` of the machine's own width.
pub type Lanes<T, S> = <T as SimdFloatElement>::Native<S>;

/// f32 or f64.
pub trait Real: SimdFloatElement + Send + Sync + 'static {
    /// Zero.
    const ZERO: Self;
    /// One.
    const ONE: Self;
    /// Whether this is f32.
    const SINGLE: bool;
    /// Nearest value of this type.
    fn from_f64(x: f64) -> Self;
    /// Nearest finite value of this type; NaN stays NaN.
    fn saturating(x: f64) -> Self;
    /// The value as f64, exactly.
    fn to_f64(self) -> f64;
    /// `2^x` for `x <= 0`, lane by lane. Relative error at most 1.2e-7 (f32), 3e-16 (f64) down to the
    /// smallest normal number; below it the result is that number, which every caller cuts off. `DEGREE` is
    /// that of the polynomial; all but 3, 4 and 5, which f32 alone has, mean the one of this accuracy.
    fn exp2<S: Simd, const DEGREE: usize>(simd: S, x: Lanes<Self, S>) -> Lanes<Self, S>;
}

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

/// The same with fewer terms, to measure what they are worth: 7.5e-8, 2.6e-6 and 7.5e-5.
const EXP2_F32_5: [f32; 6] = [
    1.000_000_1,
    0.693_146_94,
    0.240_221_2,
    0.055_507_13,
    0.009_675_541,
    0.001_327_647_2,
];
const EXP2_F32_4: [f32; 5] = [
    0.999_999_3,
    0.693_121_8,
    0.240_247_44,
    0.055_917_86,
    0.009_570_102,
];
const EXP2_F32_3: [f32; 4] = [0.999_928_06, 0.693_260_97, 0.242_611_13, 0.055_171_67];

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

/// `2^x`: round to the nearest integer by adding `magic` (1.5 x 2^mantissa bits), whose low bits then hold
/// that integer; evaluate the polynomial at the rest; add the integer to the exponent.
macro_rules! exp2 {
    ($simd:ident, $x:ident, $min:expr, $magic:expr, $bits:expr, $coefficients:expr) => {{
        let x = $x.max(Lanes::<Self, S>::splat($simd, $min));
        let magic = Lanes::<Self, S>::splat($simd, $magic);
        let shifted = x + magic;
        let f = x - (shifted - magic);
        let mut p = Lanes::<Self, S>::splat($simd, $coefficients[$coefficients.len() - 1]);
        let mut k = $coefficients.len() - 1;
        while k > 0 {
            k -= 1;
            p = p.mul_add(f, Lanes::<Self, S>::splat($simd, $coefficients[k]));
        }
        Lanes::<Self, S>::from_bits(p.to_bits() + (shifted.to_bits() << $bits))
    }};
}

impl Real for f32 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    const SINGLE: bool = true;

    #[inline(always)]
    fn from_f64(x: f64) -> Self {
        x as Self
    }

    #[inline(always)]
    fn saturating(x: f64) -> Self {
        x.clamp(f64::from(Self::MIN), f64::from(Self::MAX)) as Self
    }

    #[inline(always)]
    fn to_f64(self) -> f64 {
        f64::from(self)
    }

    #[inline(always)]
    fn exp2<S: Simd, const DEGREE: usize>(simd: S, x: Lanes<Self, S>) -> Lanes<Self, S> {
        match DEGREE {
            3 => exp2!(simd, x, -126.0, 12_582_912.0, 23u32, EXP2_F32_3),
            4 => exp2!(simd, x, -126.0, 12_582_912.0, 23u32, EXP2_F32_4),
            5 => exp2!(simd, x, -126.0, 12_582_912.0, 23u32, EXP2_F32_5),
            _ => exp2!(simd, x, -126.0, 12_582_912.0, 23u32, EXP2_F32),
        }
    }
}

impl Real for f64 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    const SINGLE: bool = false;

    #[inline(always)]
    fn from_f64(x: f64) -> Self {
        x
    }

    #[inline(always)]
    fn saturating(x: f64) -> Self {
        x.clamp(Self::MIN, Self::MAX)
    }

    #[inline(always)]
    fn to_f64(self) -> f64 {
        self
    }

    #[inline(always)]
    fn exp2<S: Simd, const DEGREE: usize>(simd: S, x: Lanes<Self, S>) -> Lanes<Self, S> {
        exp2!(simd, x, -1022.0, 6_755_399_441_055_744.0, 52u32, EXP2_F64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fearless_simd::{Level, dispatch};

    fn worst_error<T: Real, const DEGREE: usize>() -> f64 {
        fn run<S: Simd, T: Real, const DEGREE: usize>(simd: S) -> f64 {
            (0..20_000)
                .map(|i| {
                    let x = T::from_f64(-f64::from(i) * 0.0037);
                    let y = T::exp2::<S, DEGREE>(simd, Lanes::<T, S>::splat(simd, x))[0].to_f64();
                    (y / x.to_f64().exp2() - 1.0).abs()
                })
                .fold(0.0, f64::max)
        }
        dispatch!(Level::new(), simd => run::<_, T, DEGREE>(simd))
    }

    #[test]
    fn exp2_is_as_accurate_as_stated() {
        let errors = [worst_error::<f32, 6>(), worst_error::<f64, 6>()];
        assert!(errors[0] < 1.2e-7 && errors[1] < 3e-16, "{errors:?}");
    }

    #[test]
    fn fewer_terms_have_the_error_of_their_polynomial() {
        // The relative errors of the polynomials, with the roundings for the first.
        for (error, expected) in [
            (worst_error::<f32, 5>(), 2.1e-7),
            (worst_error::<f32, 4>(), 2.7e-6),
            (worst_error::<f32, 3>(), 7.5e-5),
        ] {
            assert!(
                (error / expected - 1.0).abs() < 0.1,
                "{error:e}, not {expected:e}"
            );
        }
    }
}
