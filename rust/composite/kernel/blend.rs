//! A block in the forward pass.

use super::{Decision, Grid, Layers, Pixels, STRIDE, load, store, width};
use crate::{
    constants::BLOCK_PIXELS,
    simd::{Lanes, Real},
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

/// The pixels of a block (V vectors) on their way through its layers.
struct Way<S: Simd, T: Real, const D: usize, const V: usize> {
    /// What the last layer leaves, and the same with `least` where the pixel is finished.
    after: [Lanes<T, S>; V],
    open: [Lanes<T, S>; V],
    /// Colours so far.
    sums: [[Lanes<T, S>; V]; D],
}

impl<S: Simd, T: Real, const D: usize, const V: usize> Way<S, T, D, V> {
    /// Meet the layers of `part`, whose number is a multiple of N: N at a time, as many as fit into the registers.
    #[inline(always)]
    fn meet_all<const N: usize>(
        &mut self,
        simd: S,
        decision: &Decision<S, T>,
        layers: &Layers<T>,
        part: &[u32],
        pixels: [[Lanes<T, S>; V]; 2],
        colors: &mut [Pixels<T>],
        at: usize,
    ) {
        let channels = if D > 0 { D } else { layers.channels };
        for part in part.as_chunks::<N>().0 {
            for (alpha, &k) in layers.alphas(simd, part, pixels).into_iter().zip(part) {
                let rgb = &layers.colors[k as usize * channels..][..channels];
                self.meet(simd, decision, alpha, rgb, colors, at);
            }
        }
    }

    /// Meet one layer. With D = 0 the colours lie in `colors`, from `at` on.
    #[inline(always)]
    fn meet(
        &mut self,
        simd: S,
        decision: &Decision<S, T>,
        alpha: [Lanes<T, S>; V],
        rgb: &[T],
        colors: &mut [Pixels<T>],
        at: usize,
    ) {
        for j in 0..V {
            let met = decision.meet(alpha[j], self.open[j]);
            let weight = met
                .blended
                .select(self.open[j] * met.alpha, decision.nothing);
            for (c, color) in rgb.iter().enumerate() {
                let color = Lanes::<T, S>::splat(simd, *color);
                if D > 0 {
                    self.sums[c][j] = weight.mul_add(color, self.sums[c][j]);
                } else {
                    let out = &mut colors[c][at + j * width::<S, T>()..][..width::<S, T>()];
                    weight
                        .mul_add(color, Lanes::<T, S>::from_slice(simd, out))
                        .store_slice(out);
                }
            }
            self.after[j] = met.blended.select(met.behind, self.after[j]);
            self.open[j] = met.open;
        }
    }
}

/// Blend the layers over one block (V vectors). `transmittance` is 1 inside the image and 0 outside before,
/// and what the last layer leaves after. The colours go to `colors[channel]`, block by block. Returns the layers evaluated.
#[inline(always)]
pub fn blend<S: Simd, T: Real, const D: usize, const V: usize>(
    simd: S,
    grid: &Grid<T>,
    block: usize,
    layers: Layers<T>,
    transmittance: &mut [T],
    colors: &mut [Pixels<T>],
) -> usize {
    let channels = if D > 0 { D } else { layers.channels };
    let at = block * BLOCK_PIXELS;
    let pixels = grid.block::<S, V>(simd, block);
    let decision = Decision::new(simd, &layers);
    let zero = Lanes::<T, S>::splat(simd, T::ZERO);
    let before = load::<S, T, V>(simd, transmittance);
    let mut way = Way::<S, T, D, V> {
        after: before,
        open: before,
        sums: [[zero; V]; D],
    };
    let mut evaluated = 0;
    for part in layers.list.chunks(STRIDE) {
        match (part.len(), V) {
            (STRIDE, 1) => way.meet_all::<4>(simd, &decision, &layers, part, pixels, colors, at),
            (STRIDE, 2) => way.meet_all::<2>(simd, &decision, &layers, part, pixels, colors, at),
            _ => way.meet_all::<1>(simd, &decision, &layers, part, pixels, colors, at),
        }
        evaluated += part.len();
        if decision.finished(&way.open) {
            break;
        }
    }
    store::<S, T, V>(transmittance, way.after);
    for (c, color) in colors[..channels].iter_mut().enumerate() {
        let mut sum = if D > 0 {
            way.sums[c]
        } else {
            load::<S, T, V>(simd, &color[at..])
        };
        if let Some(background) = layers.background {
            let behind = Lanes::<T, S>::splat(simd, background[c]);
            for (sum, after) in sum.iter_mut().zip(way.after) {
                *sum = after.mul_add(behind, *sum);
            }
        }
        store::<S, T, V>(&mut color[at..], sum);
    }
    evaluated
}
