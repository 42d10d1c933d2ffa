//! The inner loops of compositing: one Gaussian against the 4 x 4 pixel blocks of one tile.
//!
//! A tile keeps its pixels block by block (`block * 16 + row in block * 4 + column in block`), so that a
//! block is one or a few SIMD vectors. `reached` finds for each block the Gaussians that touch it, one per
//! lane. A block then goes through its own list with its pixels in registers. A finished pixel has
//! transmittance 0.

use crate::{
    constants::{ALPHA_MAX, BLOCK, BLOCK_PIXELS, BLOCKS_PER_SIDE, TILE, TILE_BLOCKS, TILE_PIXELS},
    project::Splat,
    real::{Lanes, Real},
    tuning::EXP2_DEGREE,
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

/// One value for each pixel of a tile, block by block.
pub(crate) type Pixels<T> = [T; TILE_PIXELS];

/// Lanes of a vector of `T`.
#[inline(always)]
const fn width<S: Simd, T: Real>() -> usize {
    <Lanes<T, S> as SimdBase<S>>::LEN
}

/// (row, column) in the tile of pixel `p` in block order.
pub(crate) const fn position(p: usize) -> (usize, usize) {
    let (block, inner) = (p / BLOCK_PIXELS, p % BLOCK_PIXELS);
    (
        block / BLOCKS_PER_SIDE * BLOCK + inner / BLOCK,
        block % BLOCKS_PER_SIDE * BLOCK + inner % BLOCK,
    )
}

/// Coordinates that do not depend on the Gaussian, relative to the tile's centre.
pub(crate) struct Grid<T> {
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
}

/// A Gaussian as one tile sees it: `alpha = opacity 2^-(u^2 + v^2)` with `u = u0 + s x + n y`,
/// `v = v0 + t y` and (x, y) relative to the tile's centre. u0 and v0 are computed in f64 before they are
/// rounded, so that nothing cancels in f32, however long the Gaussian is.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(32))]
pub(crate) struct Local<T> {
    pub u0: T,
    pub v0: T,
    pub s: T,
    pub n: T,
    pub t: T,
    pub opacity: T,
    /// Radius of the support in (u, v).
    reach: T,
    /// Index of the Gaussian.
    pub gaussian: u32,
}

/// `sqrt(log2(e) / 2)`: with it `2^-(u^2 + v^2) = exp(-sigma)`.
pub(crate) const UNIT: f64 = 0.849_321_800_288_019_1;

impl<T: Real> Local<T> {
    #[inline(always)]
    pub fn new(splat: &Splat, gaussian: u32, center: [f64; 2]) -> Self {
        let [s, m, t] = splat.factors;
        let (x, y) = (splat.mean[0] - center[0], splat.mean[1] - center[1]);
        let (s, t) = (UNIT * s, UNIT * t);
        Self {
            u0: T::from_f64(s * (m * y - x)),
            v0: T::from_f64(-t * y),
            s: T::from_f64(s),
            n: T::from_f64(-s * m),
            t: T::from_f64(t),
            opacity: T::from_f64(splat.opacity),
            reach: T::from_f64(UNIT * f64::from(splat.reach)),
            gaussian,
        }
    }
}

/// Gaussians side by side in `Shapes`: the most lanes of f32 that a vector has.
const GROUP: usize = 16;

/// What the test of the blocks reads, one Gaussian per lane: u0, v0, s, n, t and the radius of the support
/// in (u, v). In f32 for either type: `SUPPORT_SLACK` covers its rounding.
#[derive(Default)]
pub(crate) struct Shapes(Vec<[[f32; GROUP]; 6]>);

impl Shapes {
    /// Make room for `n` Gaussians.
    pub fn resize(&mut self, n: usize) {
        self.0.resize(n.div_ceil(GROUP), [[0.0; GROUP]; 6]);
    }

    #[inline(always)]
    pub fn set<T: Real>(&mut self, k: usize, g: &Local<T>) {
        let group = &mut self.0[k / GROUP];
        for (row, value) in group.iter_mut().zip([g.u0, g.v0, g.s, g.n, g.t, g.reach]) {
            row[k % GROUP] = value.to_f64() as f32;
        }
    }
}

/// For each of `count` Gaussians the blocks of which a pixel centre can lie in the support (bit b for block
/// b), and for each block the Gaussians, in order.
///
/// Row of blocks by row, the extent of the ellipse in the band of the row's pixel centres. The right border
/// is concave in y and the left one convex, so in a band each is extreme at the y nearest to its top.
/// Exact up to rounding. Written so that NaN (an overflow far outside) keeps the block.
#[inline(always)]
pub(crate) fn reached<S: Simd>(
    simd: S,
    shapes: &Shapes,
    count: usize,
    masks: &mut Vec<u16>,
    lists: &mut [Vec<u32>; TILE_BLOCKS],
) {
    let lanes = S::f32s::LEN;
    let splat = |x: f32| S::f32s::splat(simd, x);
    let (zero, one) = (splat(0.0), splat(1.0));
    for list in lists.iter_mut() {
        list.resize(count.next_multiple_of(lanes) + lanes, 0);
    }
    let mut lengths = [0; TILE_BLOCKS];
    let ramp = S::u32s::from_fn(simd, |lane| lane as u32);
    let end = S::u32s::splat(simd, count as u32);
    let half = (TILE / 2) as f32;
    masks.resize(count.next_multiple_of(lanes), 0);
    for first in (0..count).step_by(lanes) {
        let group = &shapes.0[first / GROUP];
        let at = first % GROUP..first % GROUP + lanes;
        let load = |k: usize| S::f32s::from_slice(simd, &group[k][at.clone()]);
        let (u0, v0, s, n, t) = (load(0), load(1), load(2), load(3), load(4));
        let reach = load(5);
        let limit = reach * reach;
        let inverse = one / s;
        // The rightmost point of the ellipse lies at v = -top, the leftmost at v = top.
        let top = reach * n / n.mul_add(n, t * t).sqrt();
        let (y_right, y_left) = ((zero - top - v0) / t, (top - v0) / t);
        let index = ramp + S::u32s::splat(simd, first as u32);
        let valid = index.simd_lt(end);
        let mut bits = zero;
        for row in 0..BLOCKS_PER_SIDE {
            let low = (row * BLOCK) as f32 + 0.5 - half;
            let (low, high) = (splat(low), splat(low + (BLOCK - 1) as f32));
            let y = y_right.max(low).min(high);
            let v = t.mul_add(y, v0);
            let width = limit - v * v;
            let mut outside = width.simd_lt(zero);
            let right = (width.max(zero).sqrt() - n.mul_add(y, u0)) * inverse;
            let y = y_left.max(low).min(high);
            let v = t.mul_add(y, v0);
            let width = limit - v * v;
            outside &= width.simd_lt(zero);
            let left = (zero - width.max(zero).sqrt() - n.mul_add(y, u0)) * inverse;
            for column in 0..BLOCKS_PER_SIDE {
                let block = row * BLOCKS_PER_SIDE + column;
                let low = (column * BLOCK) as f32 + 0.5 - half;
                let (low, high) = (splat(low), splat(low + (BLOCK - 1) as f32));
                let inside = valid & !(outside | right.simd_lt(low) | left.simd_gt(high));
                bits += inside.select(splat((1u32 << block) as f32), zero);
                let length = &mut lengths[block];
                index
                    .compress(inside)
                    .store_slice(&mut lists[block][*length..*length + lanes]);
                *length += inside.to_bitmask().count_ones() as usize;
            }
        }
        for (mask, bits) in masks[first..].iter_mut().zip(bits.as_slice()) {
            *mask = *bits as u16;
        }
    }
    masks.truncate(count);
    for (list, length) in lists.iter_mut().zip(lengths) {
        list.truncate(length);
    }
}

/// The result of `reached` if every Gaussian reached every block.
pub(crate) fn all_blocks(count: usize, masks: &mut Vec<u16>, lists: &mut [Vec<u32>; TILE_BLOCKS]) {
    masks.resize(count, u16::MAX);
    for list in lists.iter_mut() {
        list.clear();
        list.extend(0..count as u32);
    }
}

/// `Local` in vectors.
struct Wide<S: Simd, T: Real> {
    u0: Lanes<T, S>,
    v0: Lanes<T, S>,
    s: Lanes<T, S>,
    n: Lanes<T, S>,
    t: Lanes<T, S>,
    opacity: Lanes<T, S>,
}

impl<S: Simd, T: Real> Wide<S, T> {
    #[inline(always)]
    fn new(simd: S, g: &Local<T>) -> Self {
        let splat = |x: T| Lanes::<T, S>::splat(simd, x);
        Self {
            u0: splat(g.u0),
            v0: splat(g.v0),
            s: splat(g.s),
            n: splat(g.n),
            t: splat(g.t),
            opacity: splat(g.opacity),
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

    /// alpha at the pixels (x, y): the one function that both passes use. E: degree of the power of 2.
    #[inline(always)]
    fn alpha<const E: usize>(&self, simd: S, x: Lanes<T, S>, y: Lanes<T, S>) -> Lanes<T, S> {
        let (u, v) = self.position(x, y);
        let power = u.mul_add(u, v * v);
        let alpha =
            self.opacity * T::exp2::<S, E>(simd, Lanes::<T, S>::splat(simd, T::ZERO) - power);
        alpha.min(Lanes::<T, S>::splat(simd, T::from_f64(ALPHA_MAX)))
    }
}

/// A block's pixels of `data`, as V vectors.
#[inline(always)]
fn load<S: Simd, T: Real, const V: usize>(simd: S, data: &[T]) -> [Lanes<T, S>; V] {
    let mut out = [Lanes::<T, S>::splat(simd, T::ZERO); V];
    for (j, out) in out.iter_mut().enumerate() {
        *out = Lanes::<T, S>::from_slice(simd, &data[j * width::<S, T>()..][..width::<S, T>()]);
    }
    out
}

/// The other way round.
#[inline(always)]
fn store<S: Simd, T: Real, const V: usize>(data: &mut [T], vectors: [Lanes<T, S>; V]) {
    for (j, vector) in vectors.into_iter().enumerate() {
        vector.store_slice(&mut data[j * width::<S, T>()..][..width::<S, T>()]);
    }
}

/// The Gaussians of one block, front to back.
#[derive(Clone, Copy)]
pub(crate) struct Layers<'a, T> {
    /// Indices into `records`.
    pub list: &'a [u32],
    /// Of the whole tile.
    pub records: &'a [Local<T>],
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

/// Counts of one block.
#[derive(Default)]
pub(crate) struct Blended {
    /// Layers evaluated.
    pub layers: usize,
    /// Layers that changed a pixel.
    pub changed: u64,
    /// Pairs of a layer and a pixel that were blended.
    pub pixels: u64,
}

/// Layers between two tests whether all pixels are finished.
const STRIDE: usize = 4;

/// Blend the layers over one block (V vectors). `transmittance` is 1 inside the image and 0 outside before,
/// and what the last layer leaves after. The colours go to `colors[channel]`, block by block.
#[inline(always)]
pub(crate) fn blend<S: Simd, T: Real, const D: usize, const E: usize, const V: usize>(
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
    let (x, y) = (
        load::<S, T, V>(simd, &grid.x[at..]),
        load::<S, T, V>(simd, &grid.y[at..]),
    );
    let floor = splat(layers.floor);
    let (least, one, zero) = (splat(layers.least), splat(T::ONE), splat(T::ZERO));
    // What the last layer leaves, and the same with 0 where the pixel is finished.
    let mut after = load::<S, T, V>(simd, transmittance);
    let mut open = after;
    let mut sums = [[zero; V]; D];
    let mut counts = Blended::default();
    for part in layers.list.chunks(STRIDE) {
        for &k in part {
            let k = k as usize;
            let wide = Wide::<S, T>::new(simd, &layers.records[k]);
            let rgb = &layers.colors[k * channels..(k + 1) * channels];
            let mut changed = 0;
            for j in 0..V {
                let alpha = wide.alpha::<E>(simd, x[j], y[j]);
                let opaque = alpha.simd_ge(floor);
                let next = open[j] * (one - alpha);
                let blended = opaque & next.simd_gt(least);
                let weight = blended.select(open[j] * alpha, zero);
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
                after[j] = blended.select(next, after[j]);
                // An opaque lane that does not blend is finished.
                open[j] = opaque.select(blended.select(next, zero), open[j]);
                let bits = blended.to_bitmask().count_ones();
                changed |= bits;
                counts.pixels += u64::from(bits);
            }
            counts.changed += u64::from(changed != 0);
        }
        counts.layers += part.len();
        let mut unfinished = 0;
        for open in open {
            unfinished |= open.simd_gt(zero).to_bitmask();
        }
        if unfinished == 0 {
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

/// Raise `largest` to the weights of the layers in one block (V vectors): for each record of the tile as many
/// numbers as a vector has lanes, whose maximum is the record's. `transmittance` is 1 in the pixels that count,
/// 0 in the others. Decides as `blend` does.
#[inline(always)]
pub(crate) fn weigh<S: Simd, T: Real, const V: usize>(
    simd: S,
    grid: &Grid<T>,
    block: usize,
    layers: Layers<T>,
    transmittance: &[T],
    largest: &mut [T],
) {
    let splat = |x: T| Lanes::<T, S>::splat(simd, x);
    let at = block * BLOCK_PIXELS;
    let (x, y) = (
        load::<S, T, V>(simd, &grid.x[at..]),
        load::<S, T, V>(simd, &grid.y[at..]),
    );
    let (floor, least) = (splat(layers.floor), splat(layers.least));
    let (one, zero) = (splat(T::ONE), splat(T::ZERO));
    let mut open = load::<S, T, V>(simd, transmittance);
    for part in layers.list.chunks(STRIDE) {
        for &k in part {
            let k = k as usize;
            let wide = Wide::<S, T>::new(simd, &layers.records[k]);
            let out = &mut largest[k * width::<S, T>()..(k + 1) * width::<S, T>()];
            let mut most = Lanes::<T, S>::from_slice(simd, out);
            for j in 0..V {
                let alpha = wide.alpha::<EXP2_DEGREE>(simd, x[j], y[j]);
                let opaque = alpha.simd_ge(floor);
                let next = open[j] * (one - alpha);
                let blended = opaque & next.simd_gt(least);
                most = most.max(blended.select(open[j] * alpha, zero));
                open[j] = opaque.select(blended.select(next, zero), open[j]);
            }
            most.store_slice(out);
        }
        let mut unfinished = 0;
        for open in open {
            unfinished |= open.simd_gt(zero).to_bitmask();
        }
        if unfinished == 0 {
            break;
        }
    }
}

/// Sums over the pixels of a tile for one Gaussian; the order of the fields is the order in memory.
/// With w the gradient of the loss with respect to sigma: w, w u, w v, w u^2, w u v, w v^2.
pub(crate) const MOMENTS: usize = 6;

/// |d loss / d mean2d| summed pixel by pixel, x and y, where asked for.
pub(crate) const ABSOLUTE: usize = 2;

/// Numbers that `unblend` stores per layer of a block.
pub(crate) const LAYER: usize = 2 * BLOCK_PIXELS;

/// One block in the backward pass.
pub(crate) struct Adjoint<'a, T> {
    /// 1 inside the image, 0 outside.
    pub transmittance: &'a [T],
    /// `sum_c v_c color_c` of all that lies behind the last layer, as seen through full transmittance.
    pub behind: &'a [T],
    /// Cotangent of each channel, of the whole tile.
    pub v_colors: &'a [Pixels<T>],
}

/// Gradients of the layers of one block (V vectors). For each layer `out` receives w, the gradient with
/// respect to sigma, and the weight of its colour.
///
/// Front to back once more for transmittance and alpha of each layer, then back to front. There `behind` is
/// a convex combination, `alpha q + (1 - alpha) behind`: nothing is divided, nothing cancels, however deep
/// the layer.
#[inline(always)]
pub(crate) fn unblend<S: Simd, T: Real, const D: usize, const E: usize, const V: usize>(
    simd: S,
    grid: &Grid<T>,
    block: usize,
    layers: Layers<T>,
    adjoint: &Adjoint<T>,
    out: &mut [T],
) {
    let splat = |x: T| Lanes::<T, S>::splat(simd, x);
    let channels = if D > 0 { D } else { layers.channels };
    let at = block * BLOCK_PIXELS;
    let (x, y) = (
        load::<S, T, V>(simd, &grid.x[at..]),
        load::<S, T, V>(simd, &grid.y[at..]),
    );
    let (cap, floor) = (splat(T::from_f64(ALPHA_MAX)), splat(layers.floor));
    let (least, one, zero) = (splat(layers.least), splat(T::ONE), splat(T::ZERO));
    let mut open = load::<S, T, V>(simd, adjoint.transmittance);
    for (&k, out) in layers.list.iter().zip(out.chunks_exact_mut(LAYER)) {
        let wide = Wide::<S, T>::new(simd, &layers.records[k as usize]);
        let (mut before, mut alphas) = (open, [zero; V]);
        for j in 0..V {
            let alpha = wide.alpha::<E>(simd, x[j], y[j]);
            let opaque = alpha.simd_ge(floor);
            let next = open[j] * (one - alpha);
            let blended = opaque & next.simd_gt(least);
            before[j] = open[j];
            alphas[j] = blended.select(alpha, zero);
            open[j] = opaque.select(blended.select(next, zero), open[j]);
        }
        store::<S, T, V>(out, before);
        store::<S, T, V>(&mut out[BLOCK_PIXELS..], alphas);
    }
    let mut behind = load::<S, T, V>(simd, adjoint.behind);
    let mut v_colors = [[zero; V]; D];
    for (v, color) in v_colors.iter_mut().zip(adjoint.v_colors) {
        *v = load::<S, T, V>(simd, &color[at..]);
    }
    for (&k, out) in layers.list.iter().zip(out.chunks_exact_mut(LAYER)).rev() {
        let k = k as usize;
        let rgb = &layers.colors[k * channels..(k + 1) * channels];
        let before = load::<S, T, V>(simd, out);
        let alpha = load::<S, T, V>(simd, &out[BLOCK_PIXELS..]);
        let (mut ws, mut weights) = ([zero; V], [zero; V]);
        for j in 0..V {
            let weight = before[j] * alpha[j];
            let mut q = zero;
            for (c, color) in rgb.iter().enumerate() {
                let v = if D > 0 {
                    v_colors[c][j]
                } else {
                    let v = &adjoint.v_colors[c][at + j * width::<S, T>()..];
                    Lanes::<T, S>::from_slice(simd, &v[..width::<S, T>()])
                };
                q = v.mul_add(splat(*color), q);
            }
            let difference = q - behind[j];
            // d loss / d alpha = T (q - behind); d alpha / d sigma = -alpha, 0 under the cap.
            ws[j] = alpha[j].simd_lt(cap).select(weight * (behind[j] - q), zero);
            behind[j] = alpha[j].mul_add(difference, behind[j]);
            weights[j] = weight;
        }
        store::<S, T, V>(out, ws);
        store::<S, T, V>(&mut out[BLOCK_PIXELS..], weights);
    }
}

/// Running sums of one Gaussian over its blocks.
pub(crate) struct Sums<S: Simd, T: Real> {
    wide: Wide<S, T>,
    /// The moments, the colours (at most 4 channels), the absolute gradients.
    lanes: [Lanes<T, S>; MOMENTS + 4 + ABSOLUTE],
}

impl<S: Simd, T: Real> Sums<S, T> {
    #[inline(always)]
    pub fn new(simd: S, g: &Local<T>) -> Self {
        Self {
            wide: Wide::new(simd, g),
            lanes: [Lanes::<T, S>::splat(simd, T::ZERO); MOMENTS + 4 + ABSOLUTE],
        }
    }

    /// Add one block of what `unblend` stored. With D = 0 the gradient of the colour goes straight to `out`.
    #[inline(always)]
    pub fn add<const D: usize>(
        &mut self,
        simd: S,
        grid: &Grid<T>,
        block: usize,
        layer: &[T],
        v_colors: &[Pixels<T>],
        absolute: bool,
        out: &mut [T],
    ) {
        let (ws, weights) = layer.split_at(BLOCK_PIXELS);
        for i in (0..BLOCK_PIXELS).step_by(width::<S, T>()) {
            let at = block * BLOCK_PIXELS + i..block * BLOCK_PIXELS + i + width::<S, T>();
            let w = Lanes::<T, S>::from_slice(simd, &ws[i..i + width::<S, T>()]);
            let weight = Lanes::<T, S>::from_slice(simd, &weights[i..i + width::<S, T>()]);
            let x = Lanes::<T, S>::from_slice(simd, &grid.x[at.clone()]);
            let y = Lanes::<T, S>::from_slice(simd, &grid.y[at.clone()]);
            let (u, v) = self.wide.position(x, y);
            let (wu, wv) = (w * u, w * v);
            let lanes = &mut self.lanes;
            lanes[0] += w;
            lanes[1] += wu;
            lanes[2] += wv;
            lanes[3] = wu.mul_add(u, lanes[3]);
            lanes[4] = wu.mul_add(v, lanes[4]);
            lanes[5] = wv.mul_add(v, lanes[5]);
            if D > 0 {
                for (c, v) in v_colors[..D].iter().enumerate() {
                    let v = Lanes::<T, S>::from_slice(simd, &v[at.clone()]);
                    lanes[MOMENTS + c] = weight.mul_add(v, lanes[MOMENTS + c]);
                }
            } else {
                for (c, v) in v_colors.iter().enumerate() {
                    let v = Lanes::<T, S>::from_slice(simd, &v[at.clone()]);
                    out[MOMENTS + c] += (weight * v).reduce_sum();
                }
            }
            if absolute {
                lanes[MOMENTS + D] += wu.abs();
                lanes[MOMENTS + D + 1] += self.wide.n.mul_add(wu, self.wide.t * wv).abs();
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
        let (mut lanes, mut vectors) = (width::<S, T>(), count);
        while lanes > 1 {
            for k in 0..vectors.div_ceil(2) {
                let (a, b) = (self.lanes[2 * k], self.lanes[(2 * k + 1).min(vectors - 1)]);
                self.lanes[k] = a.unzip_low(b) + a.unzip_high(b);
            }
            vectors = vectors.div_ceil(2);
            lanes /= 2;
        }
        for k in 0..count {
            let sum = self.lanes[k / width::<S, T>()].as_slice()[k % width::<S, T>()];
            // Without compiled channels the colours lie between the moments and the absolute gradients.
            let place = if D == 0 && k >= MOMENTS {
                out.len() - count + k
            } else {
                k
            };
            out[place] = sum;
        }
    }
}
