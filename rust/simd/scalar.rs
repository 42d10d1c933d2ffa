//! The scalar types of the crate, f32 and f64, and what differs between them.

use super::math::{exp2_f32, exp2_f64};
use fearless_simd::{Simd, SimdFloatElement};

/// A vector of `T` of the machine's own width.
pub type Lanes<T, S> = <T as SimdFloatElement>::Native<S>;

mod sealed {
    /// What no other type is, and what the kernels ask of it.
    pub trait Scalar: fearless_simd::SimdFloatElement + crate::uninit::Plain + Default {}
    impl Scalar for f32 {}
    impl Scalar for f64 {}
}

/// f32 or f64, and no other type.
pub trait Real: sealed::Scalar + Send + Sync + 'static {
    /// Zero.
    const ZERO: Self;
    /// One.
    const ONE: Self;
    /// Whether this is f32.
    #[doc(hidden)]
    const SINGLE: bool;
    /// Nearest value of this type.
    fn from_f64(x: f64) -> Self;
    /// Nearest finite value of this type; NaN stays NaN.
    fn saturating(x: f64) -> Self;
    /// The value as f64, exactly.
    fn to_f64(self) -> f64;
    /// `2^x` of some vectors for `x <= 0`, lane by lane, in their place. Relative error at most 1.2e-7 (f32), 3e-16 (f64) down to the
    /// smallest normal number; below it the result is that number, which every caller cuts off.
    #[doc(hidden)]
    fn exp2<S: Simd, const N: usize, const V: usize>(simd: S, x: &mut [[Lanes<Self, S>; V]; N]);
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
    fn exp2<S: Simd, const N: usize, const V: usize>(simd: S, x: &mut [[Lanes<Self, S>; V]; N]) {
        exp2_f32(simd, x);
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
    fn exp2<S: Simd, const N: usize, const V: usize>(simd: S, x: &mut [[Lanes<Self, S>; V]; N]) {
        exp2_f64(simd, x);
    }
}
