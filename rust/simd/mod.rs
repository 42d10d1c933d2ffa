//! Vectors of the machine's own width: scalars and their lanes, functions, small matrices, groups of Gaussians.

pub mod groups;
mod level;
pub mod math;
mod scalar;
pub mod sums;
pub mod vec3;

use fearless_simd::{Simd, SimdBase};
#[cfg(test)]
pub(crate) use level::at_each_level;
pub use level::{Level, at_level, level, levels};
pub use scalar::{Lanes, Real};

/// f64 lanes: the projection is computed in f64 for either input type.
pub type Wide<S> = Lanes<f64, S>;

/// The same number in each lane.
///
/// A function, as all SIMD code here: what sits in a closure that is passed on (to `map`, say) may not be
/// inlined into the dispatched function, and then runs without its instruction set, many times slower.
#[inline(always)]
pub fn splat<S: Simd>(simd: S, x: f64) -> Wide<S> {
    Wide::<S>::splat(simd, x)
}

/// Number of f64 lanes.
#[inline(always)]
pub const fn lanes<S: Simd>() -> usize {
    <Wide<S> as SimdBase<S>>::LEN
}
