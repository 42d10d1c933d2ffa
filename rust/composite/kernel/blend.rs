//! A block in the forward pass.

use super::{Decision, Grid, Layers, Pixels, RecordLanes, STRIDE, load, store, width};
use crate::{
    constants::BLOCK_PIXELS,
    simd::{Lanes, Real},
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

/// Counts of one block.
#[derive(Default)]
pub struct Blended {
    /// Layers evaluated.
    pub layers: usize,
    /// Layers that changed a pixel.
    pub changed: u64,
    /// Pairs of a layer and a pixel that were blended.
    pub pixels: u64,
}

/// Blend the layers over one block (V vectors). `transmittance` is 1 inside the image and 0 outside before,
/// and what the last layer leaves after. The colours go to `colors[channel]`, block by block.
#[inline(always)]
pub fn blend<S: Simd, T: Real, const D: usize, const V: usize>(
    simd: S,
    grid: &Grid<T>,
    block: usize,
    layers: Layers<T>,
    transmittance: &mut [T],
    colors: &mut [Pixels<T>],
) -> Blended {
    let splat = |x: T| Lanes::<T, S>::splat(simd, x);
    let channels = if D > 0 { D } else { layers.channels };
    let at = block * BLOCK_PIXELS;
    let [x, y] = grid.block::<S, V>(simd, block);
    let decision = Decision::new(simd, &layers);
    let zero = splat(T::ZERO);
    // What the last layer leaves, and the same with 0 where the pixel is finished.
    let mut after = load::<S, T, V>(simd, transmittance);
    let mut open = after;
    let mut sums = [[zero; V]; D];
    let mut counts = Blended::default();
    for part in layers.list.chunks(STRIDE) {
        for &k in part {
            let k = k as usize;
            let record = RecordLanes::<S, T>::new(simd, &layers.records[k]);
            let rgb = &layers.colors[k * channels..(k + 1) * channels];
            let mut changed = 0;
            for j in 0..V {
                let alpha = record.alpha(simd, x[j], y[j]);
                let met = decision.meet(alpha, open[j]);
                let weight = met.blended.select(open[j] * alpha, zero);
                for (c, color) in rgb.iter().enumerate() {
                    if D > 0 {
                        sums[c][j] = weight.mul_add(splat(*color), sums[c][j]);
                    } else {
                        let out = &mut colors[c][at + j * width::<S, T>()..][..width::<S, T>()];
                        weight
                            .mul_add(splat(*color), Lanes::<T, S>::from_slice(simd, out))
                            .store_slice(out);
                    }
                }
                after[j] = met.blended.select(met.behind, after[j]);
                open[j] = met.open;
                let bits = met.blended.to_bitmask().count_ones();
                changed |= bits;
                counts.pixels += u64::from(bits);
            }
            counts.changed += u64::from(changed != 0);
        }
        counts.layers += part.len();
        if decision.finished(&open) {
            break;
        }
    }
    store::<S, T, V>(transmittance, after);
    for (c, color) in colors[..channels].iter_mut().enumerate() {
        let mut sum = if D > 0 {
            sums[c]
        } else {
            load::<S, T, V>(simd, &color[at..])
        };
        if let Some(background) = layers.background {
            for j in 0..V {
                sum[j] = after[j].mul_add(splat(background[c]), sum[j]);
            }
        }
        store::<S, T, V>(&mut color[at..], sum);
    }
    counts
}
