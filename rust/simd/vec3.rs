//! Small vectors of SIMD lanes: each lane is one Gaussian.

use super::{Wide, splat};
use fearless_simd::{Select, Simd, SimdBase};
use std::ops::{Add, Mul, Sub};

/// Three numbers per lane.
#[derive(Clone, Copy)]
pub struct V3<V> {
    /// Along x.
    pub x: V,
    /// Along y.
    pub y: V,
    /// Along z.
    pub z: V,
}

/// What lanes can do without knowing their instruction set.
pub trait Number: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {}

impl<V: Copy + Add<Output = V> + Sub<Output = V> + Mul<Output = V>> Number for V {}

impl<V: Number> V3<V> {
    /// From its parts.
    #[inline(always)]
    pub fn new(x: V, y: V, z: V) -> Self {
        Self { x, y, z }
    }

    /// The scalar product.
    #[inline(always)]
    pub fn dot(self, o: Self) -> V {
        self.x * o.x + self.y * o.y + self.z * o.z
    }

    /// The vector product.
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
pub struct M3<V>(pub [V3<V>; 3]);

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

/// The same numbers in each lane.
#[inline(always)]
pub fn splat3<S: Simd>(simd: S, v: glam::DVec3) -> V3<Wide<S>> {
    V3::new(splat(simd, v.x), splat(simd, v.y), splat(simd, v.z))
}
