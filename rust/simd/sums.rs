//! Sums over lanes whose bits do not depend on the width of the vectors.
//!
//! Lanes are summed in 64 bytes of them: one vector at AVX-512, two at AVX2, four at the others. So each level adds
//! the same numbers in the same order, and levels that round products and sums alike have the same bits.

use super::Lanes;
use crate::simd::Real;
use fearless_simd::{Simd, SimdBase};
use std::ops::Add;

/// Most vectors that a sum needs.
pub const MAX_PARTS: usize = 4;

/// Vectors of `T` that a sum needs.
#[inline(always)]
pub const fn parts<S: Simd, T: Real>() -> usize {
    64 / (<Lanes<T, S> as SimdBase<S>>::LEN * size_of::<T>())
}

/// Add halves until one is left, as `reduce_sum` of one wide vector begins. The number of parts is a power of 2.
#[inline(always)]
pub fn fold<V: Copy + Add<Output = V>>(parts: &mut [V]) -> V {
    let mut n = parts.len();
    while n > 1 {
        n /= 2;
        for k in 0..n {
            parts[k] = parts[k] + parts[k + n];
        }
    }
    parts[0]
}
