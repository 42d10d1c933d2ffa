//! Which tiles a Gaussian reaches.

use crate::{constants::TILE, project::Splat};
use std::ops::Range;

/// A run of tiles in one row that one Gaussian reaches.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Span {
    pub gaussian: u32,
    pub row: u16,
    pub begin: u16,
    pub end: u16,
}

impl Span {
    pub fn tiles(&self, tiles_x: usize) -> Range<usize> {
        let row = usize::from(self.row) * tiles_x;
        row + usize::from(self.begin)..row + usize::from(self.end)
    }
}

/// Call `f(tile row, first tile column, end tile column)` for the tiles that the support reaches: exactly
/// those rows of tiles whose band of pixel centres meets the ellipse, each with the ellipse's extent in it; or
/// without `exact` for all tiles of the splat's box.
///
/// Counting and filling both go through here, so that they cannot disagree.
#[inline(always)]
pub(super) fn tile_spans(splat: &Splat, exact: bool, mut f: impl FnMut(usize, usize, usize)) {
    let [x0, x1, y0, y1] = splat.tiles.map(usize::from);
    if !exact || x1 - x0 <= 1 || y1 - y0 <= 1 {
        (y0..y1).for_each(|y| f(y, x0, x1));
        return;
    }
    let [s, m, t] = splat.factors;
    let reach = f64::from(splat.reach);
    let height = reach / t;
    // The rightmost point of the ellipse lies at dy = top, the leftmost at -top. The right border is
    // concave in dy and the left one convex, so in a band each is extreme at the dy nearest to its top.
    let top = reach * m / (t * t * (1.0 / (s * s) + m * m / (t * t)).sqrt());
    let half = |dy: f64| ((reach * reach - t * t * dy * dy).max(0.0)).sqrt() / s;
    for y in y0..y1 {
        let first = (y * TILE) as f64 + 0.5 - splat.mean[1];
        let low = first.max(-height);
        let high = (first + (TILE - 1) as f64).min(height);
        if low > high {
            continue;
        }
        let (dy_right, dy_left) = (top.clamp(low, high), (-top).clamp(low, high));
        let right = splat.mean[0] + m * dy_right + half(dy_right);
        let left = splat.mean[0] + m * dy_left - half(dy_left);
        let first = (left - 0.5).ceil().max(0.0);
        let last = (right - 0.5).floor();
        if first <= last {
            let begin = (first as usize / TILE).max(x0);
            let end = (last as usize / TILE + 1).min(x1);
            if begin < end {
                f(y, begin, end);
            }
        }
    }
}
