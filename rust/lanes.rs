//! Small vectors of SIMD lanes: each lane is one Gaussian.

use crate::real::Lanes;
use fearless_simd::{Select, Simd, SimdBase, SimdFloat};
use std::ops::{Add, Mul, Sub};

/// f64 lanes: the projection is computed in f64 for either input type.
pub(crate) type Wide<S> = Lanes<f64, S>;

/// The same number in each lane.
///
/// A function, as all SIMD code here: what sits in a closure that is passed on (to `map`, say) may not be
/// inlined into the dispatched function, and then runs without its instruction set, many times slower.
#[inline(always)]
pub(crate) fn splat<S: Simd>(simd: S, x: f64) -> Wide<S> {
    Wide::<S>::splat(simd, x)
}

/// Number of f64 lanes.
#[inline(always)]
pub(crate) const fn lanes<S: Simd>() -> usize {
    <Wide<S> as SimdBase<S>>::LEN
}

/// Three numbers per lane.
#[derive(Clone, Copy)]
pub(crate) struct V3<V> {
    pub x: V,
    pub y: V,
    pub z: V,
}

/// What lanes can do without knowing their instruction set.
pub(crate) trait Number:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>
{
}

impl<V: Copy + Add<Output = V> + Sub<Output = V> + Mul<Output = V>> Number for V {}

impl<V: Number> V3<V> {
    #[inline(always)]
    pub fn new(x: V, y: V, z: V) -> Self {
        Self { x, y, z }
    }

    #[inline(always)]
    pub fn dot(self, o: Self) -> V {
        self.x * o.x + self.y * o.y + self.z * o.z
    }

    #[inline(always)]
    pub fn cross(self, o: Self) -> Self {
        Self::new(
            self.y * o.z - self.z * o.y,
            self.z * o.x - self.x * o.z,
            self.x * o.y - self.y * o.x,
        )
    }

    /// Times one number.
    #[inline(always)]
    pub fn by(self, k: V) -> Self {
        Self::new(self.x * k, self.y * k, self.z * k)
    }

    /// The lanes of `mask`, 0 elsewhere.
    #[inline(always)]
    pub fn only<S: Simd>(self, mask: <V as SimdBase<S>>::Mask, zero: V) -> Self
    where
        V: SimdBase<S>,
    {
        Self::new(
            mask.select(self.x, zero),
            mask.select(self.y, zero),
            mask.select(self.z, zero),
        )
    }

    /// Element by element.
    #[inline(always)]
    pub fn times(self, o: Self) -> Self {
        Self::new(self.x * o.x, self.y * o.y, self.z * o.z)
    }
}

impl<V: Number> Add for V3<V> {
    type Output = Self;
    #[inline(always)]
    fn add(self, o: Self) -> Self {
        Self::new(self.x + o.x, self.y + o.y, self.z + o.z)
    }
}

impl<V: Number> Sub for V3<V> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, o: Self) -> Self {
        Self::new(self.x - o.x, self.y - o.y, self.z - o.z)
    }
}

/// A 3 x 3 matrix by rows.
#[derive(Clone, Copy)]
pub(crate) struct M3<V>(pub [V3<V>; 3]);

impl<V: Number> M3<V> {
    /// Matrix times column.
    #[inline(always)]
    pub fn times(&self, v: V3<V>) -> V3<V> {
        V3::new(self.0[0].dot(v), self.0[1].dot(v), self.0[2].dot(v))
    }

    /// Transpose times column.
    #[inline(always)]
    pub fn back(&self, v: V3<V>) -> V3<V> {
        self.0[0].by(v.x) + self.0[1].by(v.y) + self.0[2].by(v.z)
    }
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

/// The same numbers in each lane.
#[inline(always)]
pub(crate) fn splat3<S: Simd>(simd: S, v: glam::DVec3) -> V3<Wide<S>> {
    V3::new(splat(simd, v.x), splat(simd, v.y), splat(simd, v.z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use fearless_simd::{Level, dispatch};

    #[inline(always)]
    fn logarithm<S: Simd>(simd: S, x: f64) -> f64 {
        ln(simd, splat(simd, x))[0]
    }

    #[test]
    fn logarithm_is_as_accurate_as_stated() {
        for i in 0..200_000 {
            let x = 1.0 + (f64::from(i) * 1e-4).powi(3) / 30.0;
            let y = dispatch!(Level::new(), simd => logarithm(simd, x));
            assert!((y - x.ln()).abs() <= 1e-15 * x.ln(), "ln {x} = {y}");
        }
    }
}
