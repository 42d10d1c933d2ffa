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
    /// Nearest value of this type.
    fn from_f64(x: f64) -> Self;
    /// Nearest finite value of this type; NaN stays NaN.
    fn saturating(x: f64) -> Self;
    /// The value as f64, exactly.
    fn to_f64(self) -> f64;
    /// `2^x` for `x <= 0`, lane by lane. Relative error at most 1.2e-7 (f32), 3e-16 (f64) down to the
    /// smallest normal number; below it the result is that number, which every caller cuts off.
    fn exp2<S: Simd>(simd: S, x: Lanes<Self, S>) -> Lanes<Self, S>;
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
    fn exp2<S: Simd>(simd: S, x: Lanes<Self, S>) -> Lanes<Self, S> {
        exp2!(simd, x, -126.0, 12_582_912.0, 23u32, EXP2_F32)
    }
}

impl Real for f64 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;

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
    fn exp2<S: Simd>(simd: S, x: Lanes<Self, S>) -> Lanes<Self, S> {
        exp2!(simd, x, -1022.0, 6_755_399_441_055_744.0, 52u32, EXP2_F64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fearless_simd::{Level, dispatch};

    fn worst_error<T: Real>() -> f64 {
        fn run<S: Simd, T: Real>(simd: S) -> f64 {
            (0..20_000)
                .map(|i| {
                    let x = T::from_f64(-f64::from(i) * 0.0037);
                    let y = T::exp2(simd, Lanes::<T, S>::splat(simd, x))[0].to_f64();
                    (y / x.to_f64().exp2() - 1.0).abs()
                })
                .fold(0.0, f64::max)
        }
        dispatch!(Level::new(), simd => run::<_, T>(simd))
    }

    #[test]
    fn exp2_is_as_accurate_as_stated() {
        assert!(worst_error::<f32>() < 1.2e-7, "{}", worst_error::<f32>());
        assert!(worst_error::<f64>() < 3e-16, "{}", worst_error::<f64>());
    }
}
