//! A block in the backward pass, and the sums over the blocks of a tile.

use super::{Decision, Grid, Layers, Pixels, RecordLanes, STRIDE, load, store, width};
use crate::{
    constants::{ALPHA_MAX, BLOCK_PIXELS, TILE_PIXELS},
    error::Error,
    memory,
    simd::{
        Lanes, Real,
        groups::{Column, GROUP},
        sums::fold,
    },
    tiles::Record,
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

/// Sums over the pixels of a tile for one Gaussian; the order of the fields is the order in memory.
/// With w the gradient of the loss with respect to sigma: w, w u, w v, w u^2, w u v, w v^2.
pub const MOMENTS: usize = 6;

/// |d loss / d mean2d| summed pixel by pixel, x and y, where asked for.
pub const ABSOLUTE: usize = 2;

/// What `replay` stores of a layer of a block, in whole cache lines: the transmittance in front of it, and its alpha.
pub type Layer<T> = [Column<T>; 2];
const _: () = assert!(GROUP == BLOCK_PIXELS);

/// One tile in the backward pass.
pub struct Adjoint<T> {
    /// 1 inside the image, 0 outside.
    pub transmittance: Pixels<T>,
    /// `sum_c v_c color_c` of all that lies behind the last layer, as seen through full transmittance.
    pub behind: Pixels<T>,
    /// Cotangent of each channel.
    pub v_colors: Vec<Pixels<T>>,
}

impl<T: Real> Default for Adjoint<T> {
    fn default() -> Self {
        Self {
            transmittance: [T::ZERO; TILE_PIXELS],
            behind: [T::ZERO; TILE_PIXELS],
            v_colors: Vec::new(),
        }
    }
}

impl<T: Real> Adjoint<T> {
    /// Make room for so many channels.
    pub fn make_room(&mut self, channels: usize) -> Result<(), Error> {
        memory::resize(
            &mut self.v_colors,
            channels,
            [T::ZERO; TILE_PIXELS],
            "gradients",
        )
    }

    /// Set everything to 0.
    #[inline(always)]
    pub fn clear(&mut self) {
        self.transmittance.fill(T::ZERO);
        self.behind.fill(T::ZERO);
        self.v_colors.as_flattened_mut().fill(T::ZERO);
    }
}

/// Whether a pixel of a block (V vectors) has a value that is not 0 in one of `data`.
#[inline(always)]
pub fn any_nonzero<S: Simd, T: Real, const V: usize>(
    simd: S,
    block: usize,
    data: &[Pixels<T>],
) -> bool {
    let zero = Lanes::<T, S>::splat(simd, T::ZERO);
    let mut none = zero.simd_eq(zero);
    for data in data {
        for x in load::<S, T, V>(simd, &data[block * BLOCK_PIXELS..]) {
            none &= x.simd_eq(zero);
        }
    }
    !none.all_true()
}

/// The layers of one block (V vectors), front to back once more: for each layer `out` receives the transmittance in
/// front of it and its alpha, 0 where it is not blended.
#[inline(always)]
pub fn replay<S: Simd, T: Real, const V: usize>(
    simd: S,
    grid: &Grid<T>,
    block: usize,
    layers: Layers<T>,
    adjoint: &Adjoint<T>,
    out: &mut [Layer<T>],
) {
    let pixels = grid.block::<S, V>(simd, block);
    let decision = Decision::new(simd, &layers);
    let mut open = load::<S, T, V>(simd, &adjoint.transmittance[block * BLOCK_PIXELS..]);
    let parts = layers.list.chunks(STRIDE).zip(out.chunks_mut(STRIDE));
    for (part, out) in parts {
        match (<&[u32; STRIDE]>::try_from(part), out) {
            (Ok(part), [a, b, c, d]) if V == 1 => {
                let alphas = layers.alphas(simd, part, pixels);
                keep(simd, &decision, alphas[0], &mut open, a);
                keep(simd, &decision, alphas[1], &mut open, b);
                keep(simd, &decision, alphas[2], &mut open, c);
                keep(simd, &decision, alphas[3], &mut open, d);
            }
            (Ok(part), [a, b, c, d]) if V == 2 => {
                let alphas = layers.alphas(simd, &[part[0], part[1]], pixels);
                keep(simd, &decision, alphas[0], &mut open, a);
                keep(simd, &decision, alphas[1], &mut open, b);
                let alphas = layers.alphas(simd, &[part[2], part[3]], pixels);
                keep(simd, &decision, alphas[0], &mut open, c);
                keep(simd, &decision, alphas[1], &mut open, d);
            }
            (_, out) => {
                for (&k, out) in part.iter().zip(out) {
                    let [alpha] = layers.alphas(simd, &[k], pixels);
                    keep(simd, &decision, alpha, &mut open, out);
                }
            }
        }
    }
}

/// Store what pixels of transmittance `open` see of a layer, and what is left of it.
#[inline(always)]
fn keep<S: Simd, T: Real, const V: usize>(
    simd: S,
    decision: &Decision<S, T>,
    alpha: [Lanes<T, S>; V],
    open: &mut [Lanes<T, S>; V],
    [front, layer]: &mut Layer<T>,
) {
    let zero = Lanes::<T, S>::splat(simd, T::ZERO);
    let mut alphas = [zero; V];
    store::<S, T, V>(&mut front.0, *open);
    for j in 0..V {
        let met = decision.meet(alpha[j], open[j]);
        alphas[j] = met.blended.select(met.alpha, decision.nothing);
        open[j] = met.open;
    }
    store::<S, T, V>(&mut layer.0, alphas);
}

/// Running sums of one Gaussian over its blocks, in P vectors each (`sums::parts`).
pub struct Sums<S: Simd, T: Real, const P: usize> {
    record: RecordLanes<S, T>,
    /// Of at most 4 channels.
    color: [Lanes<T, S>; 4],
    cap: Lanes<T, S>,
    /// The moments, the colours (at most 4 channels), the absolute gradients.
    lanes: [[Lanes<T, S>; P]; MOMENTS + 4 + ABSOLUTE],
}

impl<S: Simd, T: Real, const P: usize> Sums<S, T, P> {
    #[inline(always)]
    pub fn new(simd: S, g: &Record<T>, color: &[T]) -> Self {
        let splat = |x: T| Lanes::<T, S>::splat(simd, x);
        let mut wide = [splat(T::ZERO); 4];
        for (wide, color) in wide.iter_mut().zip(color) {
            *wide = splat(*color);
        }
        Self {
            record: RecordLanes::new(simd, g),
            color: wide,
            cap: splat(T::from_f64(ALPHA_MAX)),
            lanes: [[splat(T::ZERO); P]; MOMENTS + 4 + ABSOLUTE],
        }
    }

    /// Step in front of the Gaussian in one block, of which `replay` stored these two, and add its gradients there. The
    /// cotangents of the channels are `few`; with D = 0 the colour and they are `many`, and the gradient of the colour
    /// goes straight to `out`.
    ///
    /// `behind` is a convex combination, `alpha q + (1 - alpha) behind`: nothing is divided, nothing cancels, however
    /// deep the layer.
    #[inline(always)]
    pub fn add<const D: usize>(
        &mut self,
        simd: S,
        grid: &Grid<T>,
        block: usize,
        [before, alphas]: &Layer<T>,
        behind: &mut Pixels<T>,
        few: &[Pixels<T>; D],
        many: (&[T], &[Pixels<T>]),
        absolute: bool,
        out: &mut [T],
    ) {
        let n = width::<S, T>();
        let zero = Lanes::<T, S>::splat(simd, T::ZERO);
        let load = |from: &[T]| Lanes::<T, S>::from_slice(simd, &from[..n]);
        let (before, alphas) = (&before.0, &alphas.0);
        // Two loops, since all that one needs would not fit into the registers of AVX2.
        let (mut ws, mut weights) = ([T::ZERO; BLOCK_PIXELS], [T::ZERO; BLOCK_PIXELS]);
        for i in (0..BLOCK_PIXELS).step_by(n) {
            let at = block * BLOCK_PIXELS + i;
            let (alpha, last) = (load(&alphas[i..]), load(&behind[at..]));
            let weight = load(&before[i..]) * alpha;
            let mut q = zero;
            if D > 0 {
                for (v, color) in few.iter().zip(self.color) {
                    q = load(&v[at..]).mul_add(color, q);
                }
            } else {
                for (v, color) in many.1.iter().zip(many.0) {
                    q = load(&v[at..]).mul_add(Lanes::<T, S>::splat(simd, *color), q);
                }
            }
            // d loss / d alpha = T (q - behind); d alpha / d sigma = -alpha, 0 under the cap.
            let w = alpha.simd_lt(self.cap).select(weight * (last - q), zero);
            alpha
                .mul_add(q - last, last)
                .store_slice(&mut behind[at..at + n]);
            w.store_slice(&mut ws[i..i + n]);
            weight.store_slice(&mut weights[i..i + n]);
        }
        for i in (0..BLOCK_PIXELS).step_by(n) {
            let at = block * BLOCK_PIXELS + i;
            let (w, weight) = (load(&ws[i..]), load(&weights[i..]));
            let (u, v) = self
                .record
                .position(load(&grid.x[at..]), load(&grid.y[at..]));
            let (wu, wv) = (w * u, w * v);
            let (lanes, p) = (&mut self.lanes, i / n % P);
            lanes[0][p] += w;
            lanes[1][p] += wu;
            lanes[2][p] += wv;
            lanes[3][p] = wu.mul_add(u, lanes[3][p]);
            lanes[4][p] = wu.mul_add(v, lanes[4][p]);
            lanes[5][p] = wv.mul_add(v, lanes[5][p]);
            for (c, v) in few.iter().enumerate() {
                lanes[MOMENTS + c][p] = weight.mul_add(load(&v[at..]), lanes[MOMENTS + c][p]);
            }
            if absolute {
                lanes[MOMENTS + D][p] += wu.abs();
                let along_y = self.record.n.mul_add(wu, self.record.t * wv);
                lanes[MOMENTS + D + 1][p] += along_y.abs();
            }
        }
        if D == 0 {
            let at = block * BLOCK_PIXELS;
            for (out, v) in out[MOMENTS..].iter_mut().zip(many.1) {
                add_products::<S, T, P>(simd, &weights, &v[at..at + BLOCK_PIXELS], out);
            }
        }
    }

    /// Write the sums: moments, colours, absolute gradients.
    #[inline(always)]
    pub fn finish<const D: usize>(mut self, absolute: bool, out: &mut [T]) {
        if absolute {
            self.reduce::<D>(MOMENTS + D + ABSOLUTE, out);
        } else {
            self.reduce::<D>(MOMENTS + D, out);
        }
    }

    /// Sum the lanes of the first `count` vectors, all together: each step adds neighbours and halves the
    /// number of vectors.
    #[inline(always)]
    fn reduce<const D: usize>(&mut self, count: usize, out: &mut [T]) {
        let sums = self.lanes.as_flattened_mut();
        let (mut lanes, mut vectors) = (P * width::<S, T>(), P * count);
        while lanes > 1 {
            for k in 0..vectors.div_ceil(2) {
                let (a, b) = (sums[2 * k], sums[(2 * k + 1).min(vectors - 1)]);
                sums[k] = a.unzip_low(b) + a.unzip_high(b);
            }
            vectors = vectors.div_ceil(2);
            lanes /= 2;
        }
        // Through memory: numbers taken out of vectors one by one take longer.
        let mut stored = [T::ZERO; BLOCK_PIXELS];
        for (vector, stored) in sums.iter().zip(stored.chunks_exact_mut(width::<S, T>())) {
            vector.store_slice(stored);
        }
        // Without compiled channels the colours lie between the moments and the absolute gradients.
        let first = if D > 0 { count } else { MOMENTS };
        let at = out.len() + first - count;
        out[..first].copy_from_slice(&stored[..first]);
        out[at..].copy_from_slice(&stored[first..count]);
    }
}

/// Add the sum of the products of a block's weights and cotangents.
#[inline(always)]
fn add_products<S: Simd, T: Real, const P: usize>(
    simd: S,
    weights: &[T],
    v_colors: &[T],
    out: &mut T,
) {
    for i in (0..BLOCK_PIXELS).step_by(P * width::<S, T>()) {
        let weights = load::<S, T, P>(simd, &weights[i..]);
        let mut products = load::<S, T, P>(simd, &v_colors[i..]);
        for (product, weight) in products.iter_mut().zip(weights) {
            *product = weight * *product;
        }
        *out += fold(&mut products).reduce_sum();
    }
}
