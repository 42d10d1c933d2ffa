//! The inner loops of compositing: one Gaussian against the 4 x 4 pixel blocks of one tile.
//!
//! A tile keeps its pixels block by block (`block * 16 + row in block * 4 + column in block`), so that a
//! block is one or a few SIMD vectors. A block goes through its own list of Gaussians with its pixels in
//! registers. A finished pixel has transmittance 0.

mod blend;
mod unblend;

pub(super) use blend::blend;
pub(super) use unblend::{ABSOLUTE, Adjoint, Layer, MOMENTS, Sums, any_nonzero, replay};

use crate::{
    constants::{ALPHA_MAX, BLOCK, BLOCK_PIXELS, BLOCKS_PER_SIDE, TILE, TILE_PIXELS},
    simd::{Lanes, Real},
    tiles::Record,
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

/// One value for each pixel of a tile, block by block.
pub(super) type Pixels<T> = [T; TILE_PIXELS];

/// Lanes of a vector of `T`.
#[inline(always)]
pub(super) const fn width<S: Simd, T: Real>() -> usize {
    <Lanes<T, S> as SimdBase<S>>::LEN
}

/// Vectors of a block.
pub(super) const fn vectors<S: Simd, T: Real>() -> usize {
    BLOCK_PIXELS / width::<S, T>()
}

/// (row, column) in the tile of pixel `p` in block order.
pub(super) const fn position(p: usize) -> (usize, usize) {
    let (block, inner) = (p / BLOCK_PIXELS, p % BLOCK_PIXELS);
    (
        block / BLOCKS_PER_SIDE * BLOCK + inner / BLOCK,
        block % BLOCKS_PER_SIDE * BLOCK + inner % BLOCK,
    )
}

/// Coordinates that do not depend on the Gaussian, relative to the tile's centre.
#[repr(C, align(64))]
pub(super) struct Grid<T> {
    /// Pixel centres.
    x: Pixels<T>,
    y: Pixels<T>,
}

impl<T: Real> Grid<T> {
    pub fn new() -> Self {
        let half = (TILE / 2) as f64;
        let pixel = |k: usize| T::from_f64(k as f64 + 0.5 - half);
        Self {
            x: std::array::from_fn(|p| pixel(position(p).1)),
            y: std::array::from_fn(|p| pixel(position(p).0)),
        }
    }

    /// The pixel centres of a block, as V vectors each.
    #[inline(always)]
    pub fn block<S: Simd, const V: usize>(&self, simd: S, block: usize) -> [[Lanes<T, S>; V]; 2] {
        let at = block * BLOCK_PIXELS;
        [load(simd, &self.x[at..]), load(simd, &self.y[at..])]
    }
}

/// A [`Record`] in vectors.
pub(super) struct RecordLanes<S: Simd, T: Real> {
    u0: Lanes<T, S>,
    v0: Lanes<T, S>,
    s: Lanes<T, S>,
    n: Lanes<T, S>,
    t: Lanes<T, S>,
}

impl<S: Simd, T: Real> RecordLanes<S, T> {
    #[inline(always)]
    pub fn new(simd: S, g: &Record<T>) -> Self {
        let splat = |x: T| Lanes::<T, S>::splat(simd, x);
        Self {
            u0: splat(g.u0),
            v0: splat(g.v0),
            s: splat(g.s),
            n: splat(g.n),
            t: splat(g.t),
        }
    }

    /// (u, v) at the pixels (x, y).
    #[inline(always)]
    fn position(&self, x: Lanes<T, S>, y: Lanes<T, S>) -> (Lanes<T, S>, Lanes<T, S>) {
        (
            self.s.mul_add(x, self.n.mul_add(y, self.u0)),
            self.t.mul_add(y, self.v0),
        )
    }
}

/// A block's pixels of `data`, as V vectors.
#[inline(always)]
pub(super) fn load<S: Simd, T: Real, const V: usize>(simd: S, data: &[T]) -> [Lanes<T, S>; V] {
    let mut out = [Lanes::<T, S>::splat(simd, T::ZERO); V];
    for (j, out) in out.iter_mut().enumerate() {
        *out = Lanes::<T, S>::from_slice(simd, &data[j * width::<S, T>()..][..width::<S, T>()]);
    }
    out
}

/// The other way round.
#[inline(always)]
pub(super) fn store<S: Simd, T: Real, const V: usize>(data: &mut [T], vectors: [Lanes<T, S>; V]) {
    for (j, vector) in vectors.into_iter().enumerate() {
        vector.store_slice(&mut data[j * width::<S, T>()..][..width::<S, T>()]);
    }
}

/// The Gaussians of one block, front to back.
#[derive(Clone, Copy)]
pub(super) struct Layers<'a, T> {
    /// Indices into `records`.
    pub list: &'a [u32],
    /// Of the whole tile.
    pub records: &'a [Record<T>],
    /// Colours of the records, [records, channels].
    pub colors: &'a [T],
    /// Colour behind the last layer.
    pub background: Option<&'a [T]>,
    pub channels: usize,
    /// Smallest alpha that is blended.
    pub floor: T,
    /// Transmittance at which a pixel is finished.
    pub least: T,
}

impl<T: Real> Layers<'_, T> {
    /// alpha of N layers at the pixels (x, y) of a block: the one function that all passes use. Step by step for all
    /// of them, since a processor that computes one after the other mostly waits.
    #[inline(always)]
    pub fn alphas<S: Simd, const N: usize, const V: usize>(
        &self,
        simd: S,
        layers: &[u32; N],
        [x, y]: [[Lanes<T, S>; V]; 2],
    ) -> [[Lanes<T, S>; V]; N] {
        let cap = Lanes::<T, S>::splat(simd, T::from_f64(ALPHA_MAX));
        let records = layers.map(|k| &self.records[k as usize]);
        let mut powers = [[cap; V]; N];
        for (powers, record) in powers.iter_mut().zip(records) {
            let record = RecordLanes::<S, T>::new(simd, record);
            for ((power, x), y) in powers.iter_mut().zip(x).zip(y) {
                let (u, v) = record.position(x, y);
                *power = (-u).mul_add(u, -(v * v));
            }
        }
        T::exp2(simd, &mut powers);
        for (powers, record) in powers.iter_mut().zip(records) {
            let opacity = Lanes::<T, S>::splat(simd, record.opacity);
            for power in powers {
                *power = (opacity * *power).min(cap);
            }
        }
        powers
    }
}

/// Layers between two tests whether all pixels are finished.
pub(super) const STRIDE: usize = 4;

/// What decides whether a pixel blends a layer, in vectors.
pub(super) struct Decision<S: Simd, T: Real> {
    /// Smallest alpha that is blended.
    floor: Lanes<T, S>,
    /// Transmittance at which a pixel is finished.
    least: Lanes<T, S>,
    /// -0, which adds nothing to any number. (To choose between a number and 0 takes two steps with AVX2.)
    nothing: Lanes<T, S>,
}

/// What becomes of pixels that meet a layer.
pub(super) struct Met<S: Simd, T: Real> {
    /// Its alpha, 0 where that is too small.
    pub alpha: Lanes<T, S>,
    /// The pixels that are open behind it; the others do not blend it.
    pub blended: <Lanes<T, S> as SimdBase<S>>::Mask,
    /// Transmittance behind the layer, where it is blended.
    pub behind: Lanes<T, S>,
    /// What the next layer meets: the transmittance, `least` where the pixel is finished.
    pub open: Lanes<T, S>,
}

impl<S: Simd, T: Real> Decision<S, T> {
    #[inline(always)]
    pub fn new(simd: S, layers: &Layers<T>) -> Self {
        Self {
            floor: Lanes::<T, S>::splat(simd, layers.floor),
            least: Lanes::<T, S>::splat(simd, layers.least),
            nothing: Lanes::<T, S>::splat(simd, -T::ZERO),
        }
    }

    /// Pixels of transmittance `open` meet a layer. Both passes and the largest weights decide here, so that
    /// they cannot disagree.
    #[inline(always)]
    pub fn meet(&self, alpha: Lanes<T, S>, open: Lanes<T, S>) -> Met<S, T> {
        // From layer to layer a product and a maximum depend on each other, and no more. No alpha is below 0, so that
        // what was `least` or below stays there, and the pixel finished.
        let alpha = alpha.simd_ge(self.floor).select(alpha, self.nothing);
        let behind = alpha.mul_add(-open, open);
        Met {
            alpha,
            blended: behind.simd_gt(self.least),
            behind,
            open: behind.max(self.least),
        }
    }

    /// Whether no pixel is open any more.
    #[inline(always)]
    pub fn finished<const V: usize>(&self, open: &[Lanes<T, S>; V]) -> bool {
        let mut unfinished = 0;
        for open in open {
            unfinished |= open.simd_gt(self.least).to_bitmask();
        }
        unfinished == 0
    }
}
