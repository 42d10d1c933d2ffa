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
    let rgb = |k: u32| &layers.colors[k as usize * channels..(k as usize + 1) * channels];
    for part in layers.list.chunks(STRIDE) {
        match <&[u32; STRIDE]>::try_from(part) {
            Ok(part) if V == 1 => {
                let [a, b, c, d] = layers.alphas(simd, part, pixels);
                way.meet(simd, &decision, a, rgb(part[0]), colors, at);
                way.meet(simd, &decision, b, rgb(part[1]), colors, at);
                way.meet(simd, &decision, c, rgb(part[2]), colors, at);
                way.meet(simd, &decision, d, rgb(part[3]), colors, at);
            }
            Ok(part) if V == 2 => {
                let [a, b] = layers.alphas(simd, &[part[0], part[1]], pixels);
                way.meet(simd, &decision, a, rgb(part[0]), colors, at);
                way.meet(simd, &decision, b, rgb(part[1]), colors, at);
                let [a, b] = layers.alphas(simd, &[part[2], part[3]], pixels);
                way.meet(simd, &decision, a, rgb(part[2]), colors, at);
                way.meet(simd, &decision, b, rgb(part[3]), colors, at);
            }
            _ => {
                for &k in part {
                    let [alpha] = layers.alphas(simd, &[k], pixels);
                    way.meet(simd, &decision, alpha, rgb(k), colors, at);
                }
            }
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
