//! The inner loops of compositing: one Gaussian against the 4 x 4 pixel blocks of one tile.
//!
//! A tile keeps its pixels block by block (`block * 16 + row in block * 4 + column in block`), so that a
//! block is one or a few SIMD vectors. For each Gaussian of the tile's list, `reached` finds the blocks
//! that its ellipse touches, 16 at once; only those are evaluated. A finished pixel has transmittance 0.

use crate::{
    constants::{
        ALPHA_MAX, ALPHA_MIN, BLOCK, BLOCK_PIXELS, BLOCKS_PER_SIDE, TILE, TILE_BLOCKS, TILE_PIXELS,
        TRANSMITTANCE_MIN,
    },
    project::Splat,
    real::{Lanes, Real},
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
    /// Centres of the blocks.
    block_x: [T; TILE_BLOCKS],
    block_y: [T; TILE_BLOCKS],
}

impl<T: Real> Grid<T> {
    pub fn new() -> Self {
        let half = (TILE / 2) as f64;
        let pixel = |k: usize| T::from_f64(k as f64 + 0.5 - half);
        let block = |k: usize| T::from_f64((k * BLOCK + BLOCK / 2) as f64 - half);
        Self {
            x: std::array::from_fn(|p| pixel(position(p).1)),
            y: std::array::from_fn(|p| pixel(position(p).0)),
            block_x: std::array::from_fn(|b| block(b % BLOCKS_PER_SIDE)),
            block_y: std::array::from_fn(|b| block(b / BLOCKS_PER_SIDE)),
        }
    }
}

/// A Gaussian as one tile sees it: `alpha = opacity 2^-(u^2 + v^2)` with `u = u0 + s x + n y`,
/// `v = v0 + t y` and (x, y) relative to the tile's centre. u0 and v0 are computed in f64 before they are
/// rounded, so that nothing cancels in f32, however long the Gaussian is.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Local<T> {
    pub u0: T,
    pub v0: T,
    pub s: T,
    pub n: T,
    pub t: T,
    pub opacity: T,
    /// Square of the support's radius in (u, v).
    limit: T,
    /// Centre, relative to the tile's centre.
    x: T,
    y: T,
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
        let reach = UNIT * f64::from(splat.reach);
        Self {
            u0: T::from_f64(s * (m * y - x)),
            v0: T::from_f64(-t * y),
            s: T::from_f64(s),
            n: T::from_f64(-s * m),
            t: T::from_f64(t),
            opacity: T::from_f64(splat.opacity),
            limit: T::from_f64(reach * reach),
            x: T::from_f64(x),
            y: T::from_f64(y),
            gaussian,
        }
    }
}

/// The blocks of which a pixel centre can lie in the support: bit b for block b.
///
/// Exact up to rounding: the minimum of the convex `u^2 + v^2` over the rectangle of a block's pixel
/// centres is on one of two lines, the vertical and the horizontal one nearest to the Gaussian's centre.
/// Written so that NaN (an overflow far outside) keeps the block.
#[inline(always)]
pub(crate) fn reached<S: Simd, T: Real>(simd: S, g: &Local<T>, grid: &Grid<T>) -> u16 {
    let splat = |x: T| Lanes::<T, S>::splat(simd, x);
    let half = splat(T::from_f64((BLOCK - 1) as f64 * 0.5));
    let (u0, v0, s, n, t) = (splat(g.u0), splat(g.v0), splat(g.s), splat(g.n), splat(g.t));
    let scale_y = splat(T::ONE) / n.mul_add(n, t * t);
    let scale_x = splat(T::ONE) / s;
    let (center_x, center_y, limit) = (splat(g.x), splat(g.y), splat(g.limit));
    let mut bits = 0;
    for i in (0..TILE_BLOCKS).step_by(width::<S, T>()) {
        let bx = Lanes::<T, S>::from_slice(simd, &grid.block_x[i..i + width::<S, T>()]);
        let by = Lanes::<T, S>::from_slice(simd, &grid.block_y[i..i + width::<S, T>()]);
        let (x_min, x_max) = (bx - half, bx + half);
        let (y_min, y_max) = (by - half, by + half);
        // On the vertical line nearest to the centre.
        let x = center_x.max(x_min).min(x_max);
        let u = s.mul_add(x, u0);
        let y = (splat(T::ZERO) - n.mul_add(u, t * v0)) * scale_y;
        let y = y.max(y_min).min(y_max);
        let (u, v) = (n.mul_add(y, u), t.mul_add(y, v0));
        let vertical = u.mul_add(u, v * v);
        // On the horizontal line nearest to the centre.
        let y = center_y.max(y_min).min(y_max);
        let (u, v) = (n.mul_add(y, u0), t.mul_add(y, v0));
        let x = (splat(T::ZERO) - u * scale_x).max(x_min).min(x_max);
        let u = s.mul_add(x, u);
        let horizontal = u.mul_add(u, v * v);
        let outside = vertical.simd_gt(limit) & horizontal.simd_gt(limit);
        bits |= (!outside).to_bitmask() << i;
    }
    bits as u16
}

/// `Local` in vectors, and the constants of the loop.
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

    /// (u, v) at pixels `at..`.
    #[inline(always)]
    fn position(&self, simd: S, grid: &Grid<T>, at: usize) -> (Lanes<T, S>, Lanes<T, S>) {
        let x = Lanes::<T, S>::from_slice(simd, &grid.x[at..at + width::<S, T>()]);
        let y = Lanes::<T, S>::from_slice(simd, &grid.y[at..at + width::<S, T>()]);
        (
            self.s.mul_add(x, self.n.mul_add(y, self.u0)),
            self.t.mul_add(y, self.v0),
        )
    }

    /// alpha before the cap at pixels `at..`: the one function that both passes use.
    #[inline(always)]
    fn alpha(&self, simd: S, grid: &Grid<T>, at: usize) -> Lanes<T, S> {
        let (u, v) = self.position(simd, grid, at);
        let power = u.mul_add(u, v * v);
        self.opacity * T::exp2(simd, Lanes::<T, S>::splat(simd, T::ZERO) - power)
    }
}

/// State of the pixels of one tile while it is composited front to back.
pub(crate) struct Layers<'a, T> {
    /// Transmittance; 0 once the pixel is finished (or lies outside the image).
    pub transmittance: &'a mut Pixels<T>,
    /// Transmittance at which a pixel was finished, else 0.
    pub finished: &'a mut Pixels<T>,
    /// Blocks with an unfinished pixel.
    pub alive: u16,
}

/// Blend one Gaussian over the blocks `mask`; the colour of channel c goes to `colors[c]`.
/// Returns the blocks in which it changed a pixel.
#[inline(always)]
pub(crate) fn blend<S: Simd, T: Real, const D: usize>(
    simd: S,
    grid: &Grid<T>,
    g: &Local<T>,
    rgb: &[T],
    mask: u16,
    layers: &mut Layers<T>,
    colors: &mut [Pixels<T>],
) -> u16 {
    let splat = |x: T| Lanes::<T, S>::splat(simd, x);
    let channels = if D > 0 { D } else { rgb.len() };
    let (rgb, colors) = (&rgb[..channels], &mut colors[..channels]);
    let wide = Wide::<S, T>::new(simd, g);
    let (cap, floor) = (splat(T::from_f64(ALPHA_MAX)), splat(T::from_f64(ALPHA_MIN)));
    let (least, one, zero) = (
        splat(T::from_f64(TRANSMITTANCE_MIN)),
        splat(T::ONE),
        splat(T::ZERO),
    );
    let mut rest = mask;
    let mut hits = 0;
    while rest != 0 {
        let block = rest.trailing_zeros() as usize % TILE_BLOCKS;
        rest &= rest - 1;
        let mut changed = 0;
        let mut stopped = false;
        for at in (block * BLOCK_PIXELS..(block + 1) * BLOCK_PIXELS).step_by(width::<S, T>()) {
            let alpha = wide.alpha(simd, grid, at);
            let alpha = alpha.min(cap);
            let opaque = alpha.simd_ge(floor);
            let t =
                Lanes::<T, S>::from_slice(simd, &layers.transmittance[at..at + width::<S, T>()]);
            let next = t * (one - alpha);
            let blended = opaque & next.simd_gt(least);
            let weight = blended.select(t * alpha, zero);
            for (c, color) in rgb.iter().zip(colors.iter_mut()) {
                let out = &mut color[at..at + width::<S, T>()];
                weight
                    .mul_add(splat(*c), Lanes::<T, S>::from_slice(simd, out))
                    .store_slice(out);
            }
            let mut next = blended.select(next, t);
            let bits = blended.to_bitmask();
            changed |= bits;
            if opaque.to_bitmask() != bits {
                let stop = opaque & !blended & t.simd_gt(zero);
                let bits = stop.to_bitmask();
                if bits != 0 {
                    let out = &mut layers.finished[at..at + width::<S, T>()];
                    stop.select(t, Lanes::<T, S>::from_slice(simd, out))
                        .store_slice(out);
                    next = stop.select(zero, next);
                    changed |= bits;
                    stopped = true;
                }
            }
            next.store_slice(&mut layers.transmittance[at..at + width::<S, T>()]);
        }
        hits |= u16::from(changed != 0) << block;
        if stopped {
            let pixels = &layers.transmittance[block * BLOCK_PIXELS..(block + 1) * BLOCK_PIXELS];
            if pixels.iter().all(|t| *t == T::ZERO) {
                layers.alive &= !(1 << block);
            }
        }
    }
    hits
}

/// Sums over the pixels of a tile for one Gaussian; the order of the fields is the order in memory.
/// With w the gradient of the loss with respect to sigma: w, w u, w v, w u^2, w u v, w v^2.
pub(crate) const MOMENTS: usize = 6;

/// |d loss / d mean2d| summed pixel by pixel, x and y, where asked for.
pub(crate) const ABSOLUTE: usize = 2;

/// Replay one Gaussian over the blocks `mask` (those that `blend` reported), front to back, and store for
/// each the transmittance before it and its alpha (0 where it does not blend): one block of each in `out`.
#[inline(always)]
pub(crate) fn replay<S: Simd, T: Real>(
    simd: S,
    grid: &Grid<T>,
    g: &Local<T>,
    mask: u16,
    transmittance: &mut Pixels<T>,
    out: &mut [T],
) {
    let splat = |x: T| Lanes::<T, S>::splat(simd, x);
    let wide = Wide::<S, T>::new(simd, g);
    let (cap, floor) = (splat(T::from_f64(ALPHA_MAX)), splat(T::from_f64(ALPHA_MIN)));
    let (least, one, zero) = (
        splat(T::from_f64(TRANSMITTANCE_MIN)),
        splat(T::ONE),
        splat(T::ZERO),
    );
    let mut rest = mask;
    for out in out.chunks_exact_mut(LAYER) {
        let block = rest.trailing_zeros() as usize % TILE_BLOCKS;
        rest &= rest.wrapping_sub(1);
        for i in (0..BLOCK_PIXELS).step_by(width::<S, T>()) {
            let at = block * BLOCK_PIXELS + i;
            let alpha = wide.alpha(simd, grid, at);
            let alpha = alpha.min(cap);
            let opaque = alpha.simd_ge(floor);
            let state = &mut transmittance[at..at + width::<S, T>()];
            let t = Lanes::<T, S>::from_slice(simd, state);
            let next = t * (one - alpha);
            let blended = opaque & next.simd_gt(least);
            t.store_slice(&mut out[i..i + width::<S, T>()]);
            let stored = blended.select(alpha, zero);
            stored.store_slice(&mut out[BLOCK_PIXELS + i..BLOCK_PIXELS + i + width::<S, T>()]);
            // A lane that stops here is finished: transmittance 0.
            blended
                .select(next, opaque.select(zero, t))
                .store_slice(state);
        }
    }
}

/// Numbers that `replay` stores per block.
pub(crate) const LAYER: usize = 2 * BLOCK_PIXELS;

/// State of the backward pass of one tile.
pub(crate) struct Adjoint<'a, T> {
    /// `sum_c v_c color_c` of all that lies behind the current layer, as seen through full transmittance.
    /// Going back to front it is a convex combination, `alpha q + (1 - alpha) behind`: nothing is divided,
    /// nothing cancels, however deep the layer.
    pub behind: &'a mut Pixels<T>,
    /// Cotangent of each channel.
    pub v_colors: &'a [Pixels<T>],
    /// Whether gradients of the geometry and the opacity are wanted.
    pub geometry: bool,
    /// Whether the absolute gradients are wanted.
    pub absolute: bool,
}

/// Gradient of one Gaussian over the blocks `mask` from what `replay` stored for them in `layers`, into
/// `out`: the moments, the absolute gradients if asked for, and the gradient of its colour. Back to front.
#[inline(always)]
pub(crate) fn unblend<S: Simd, T: Real, const D: usize>(
    simd: S,
    grid: &Grid<T>,
    g: &Local<T>,
    rgb: &[T],
    mask: u16,
    layers: &[T],
    adjoint: &mut Adjoint<T>,
    out: &mut [T],
) {
    let splat = |x: T| Lanes::<T, S>::splat(simd, x);
    let channels = if D > 0 { D } else { rgb.len() };
    let (rgb, v_colors) = (&rgb[..channels], &adjoint.v_colors[..channels]);
    let wide = Wide::<S, T>::new(simd, g);
    let (cap, zero) = (splat(T::from_f64(ALPHA_MAX)), splat(T::ZERO));
    let mut moments = [zero; MOMENTS];
    let mut absolute = [zero; ABSOLUTE];
    let mut v_rgb = [zero; 4];
    let colors_at = MOMENTS + if adjoint.absolute { ABSOLUTE } else { 0 };
    if D == 0 {
        out[colors_at..].fill(T::ZERO);
    }
    let mut rest = mask;
    for layer in layers.chunks_exact(LAYER) {
        let block = rest.trailing_zeros() as usize % TILE_BLOCKS;
        rest &= rest.wrapping_sub(1);
        for i in (0..BLOCK_PIXELS).step_by(width::<S, T>()) {
            let at = block * BLOCK_PIXELS + i;
            let range = at..at + width::<S, T>();
            let t = Lanes::<T, S>::from_slice(simd, &layer[i..i + width::<S, T>()]);
            let alpha = &layer[BLOCK_PIXELS + i..BLOCK_PIXELS + i + width::<S, T>()];
            let alpha = Lanes::<T, S>::from_slice(simd, alpha);
            let weight = t * alpha;
            let mut q = zero;
            for (k, (c, v_color)) in rgb.iter().zip(v_colors).enumerate() {
                let v_c = Lanes::<T, S>::from_slice(simd, &v_color[range.clone()]);
                q = v_c.mul_add(splat(*c), q);
                if D > 0 {
                    v_rgb[k] = weight.mul_add(v_c, v_rgb[k]);
                } else {
                    out[colors_at + k] += sum(weight * v_c);
                }
            }
            if !adjoint.geometry {
                continue;
            }
            let state = &mut adjoint.behind[range];
            let behind = Lanes::<T, S>::from_slice(simd, state);
            let difference = q - behind;
            alpha.mul_add(difference, behind).store_slice(state);
            // d loss / d alpha = T (q - behind); d alpha / d sigma = -alpha, 0 under the cap.
            let w = alpha.simd_lt(cap).select(weight * (behind - q), zero);
            let (u, v) = wide.position(simd, grid, at);
            let (wu, wv) = (w * u, w * v);
            moments[0] += w;
            moments[1] += wu;
            moments[2] += wv;
            moments[3] = wu.mul_add(u, moments[3]);
            moments[4] = wu.mul_add(v, moments[4]);
            moments[5] = wv.mul_add(v, moments[5]);
            if adjoint.absolute {
                absolute[0] += wu.abs();
                absolute[1] += wide.n.mul_add(wu, wide.t * wv).abs();
            }
        }
    }
    for (o, m) in out.iter_mut().zip(moments) {
        *o = sum(m);
    }
    if adjoint.absolute {
        for (o, m) in out[MOMENTS..].iter_mut().zip(absolute) {
            *o = sum(m);
        }
    }
    if D > 0 {
        for (o, m) in out[colors_at..].iter_mut().zip(v_rgb) {
            *o = sum(m);
        }
    }
}

/// Sum of the lanes.
#[inline(always)]
fn sum<S: Simd, V: SimdFloat<S>>(v: V) -> V::Element {
    v.reduce_sum()
}
