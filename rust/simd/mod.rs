//! Vectors of the machine's own width: scalars and their lanes, functions, small matrices, groups of Gaussians.

pub(crate) mod groups;
pub(crate) mod math;
mod scalar;
pub(crate) mod vec3;

use fearless_simd::{Level, Simd, SimdBase};
pub use scalar::{Lanes, Real};

/// The vector instructions that the crate uses on this CPU; results may differ by rounding between them.
pub fn level_name() -> &'static str {
    match Level::new() {
        #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
        Level::Avx512(_) => "AVX-512",
        #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
        Level::Avx2(_) => "AVX2",
        #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
        Level::Sse4_2(_) => "SSE4.2",
        #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
        Level::Sse2(_) => "SSE2",
        #[cfg(target_arch = "aarch64")]
        Level::Neon(_) => "NEON",
        _ => "none",
    }
}

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
