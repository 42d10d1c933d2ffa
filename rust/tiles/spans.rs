//! Which tiles a Gaussian reaches.

use crate::{
    constants::TILE,
    project::Splat,
    simd::{Wide, lanes, splat as wide},
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

/// A Gaussian and a tile that it reaches.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Reach {
    pub gaussian: u32,
    /// Column of the tile.
    pub x: u16,
    /// Row of the tile.
    pub y: u16,
}

impl Reach {
    pub fn tile(&self, tiles_x: usize) -> usize {
        usize::from(self.y) * tiles_x + usize::from(self.x)
    }
}

/// Call `f(tile row, first tile column, end tile column)` for the tiles that the support reaches: exactly
/// those rows of tiles whose band of pixel centres meets the ellipse, each with the ellipse's extent in it; or
/// without `exact` for all tiles of the splat's box.
#[inline(always)]
pub(super) fn tile_spans<S: Simd>(
    simd: S,
    splat: &Splat,
    exact: bool,
    mut f: impl FnMut(u16, u16, u16),
) {
    let [x0, x1, y0, y1] = splat.tiles;
    let [s, m, t] = splat.factors;
    let reach = f64::from(splat.reach);
    // The rightmost point of the ellipse lies at dy = top, the leftmost at -top. The right border is
    // concave in dy and the left one convex, so in a band each is extreme at the dy nearest to its top.
    let root = (t * t + s * m * (s * m)).sqrt();
    let height = reach / (t * root);
    let (height, top) = (height * root, height * s * m);
    if !exact || x1 - x0 <= 1 || y1 - y0 <= 1 || !(height + top).is_finite() {
        (y0..y1).for_each(|y| f(y, x0, x1));
        return;
    }
    let zero = wide(simd, 0.0);
    let (height, top, t) = (wide(simd, height), wide(simd, top), wide(simd, t));
    let ramp = Wide::<S>::from_fn(simd, |lane| lane as f64);
    for row in (y0..y1).step_by(lanes::<S>()) {
        let first = (ramp + f64::from(row)) * TILE as f64 + (0.5 - splat.mean[1]);
        let low = first.max(zero - height);
        let high = (first + (TILE - 1) as f64).min(height);
        let (right, left) = (top.max(low).min(high), (zero - top).max(low).min(high));
        let half = |dy: Wide<S>| {
            let v = t * dy;
            (wide(simd, reach * reach) - v * v).max(zero).sqrt() / s
        };
        let last = right * m + half(right) + (splat.mean[0] - 0.5);
        let first = left * m - half(left) + (splat.mean[0] - 0.5);
        let (first, last) = (first.ceil().max(zero), last.floor());
        let none = low.simd_gt(high) | first.simd_gt(last);
        let begin = (first / TILE as f64).floor().max(wide(simd, x0.into()));
        let end = ((last / TILE as f64).floor() + 1.0).min(wide(simd, x1.into()));
        let end = none.select(zero, end);
        for y in row..y1.min(row + lanes::<S>() as u16) {
            let lane = usize::from(y - row);
            if begin[lane] < end[lane] {
                f(y, begin[lane] as u16, end[lane] as u16);
            }
        }
    }
}
