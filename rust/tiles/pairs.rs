//! The pairs of a Gaussian and a tile that it reaches, and what the kernels read of each.

use super::spans::{Span, tile_spans};
use crate::{
    accuracy_knobs::Spans,
    constants::{MAX_PAIRS, TILE},
    project::{Projection, Splat},
    simd::Real,
};
use fearless_simd::Simd;
use std::{
    ops::Range,
    sync::atomic::{AtomicU64, Ordering},
};

/// A Gaussian as one tile sees it: `alpha = opacity 2^-(u^2 + v^2)` with `u = u0 + s x + n y`,
/// `v = v0 + t y` and (x, y) relative to the tile's centre. u0 and v0 are computed in f64 before they are
/// rounded, so that nothing cancels in f32, however long the Gaussian is.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(32))]
pub(crate) struct Record<T> {
    pub u0: T,
    pub v0: T,
    pub s: T,
    pub n: T,
    pub t: T,
    pub opacity: T,
    /// Radius of the support in (u, v).
    pub reach: T,
    /// Index of the Gaussian.
    pub gaussian: u32,
}

/// `sqrt(log2(e) / 2)`: with it `2^-(u^2 + v^2) = exp(-sigma)`.
pub(crate) const UNIT: f64 = 0.849_321_800_288_019_1;

impl<T: Real> Record<T> {
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

/// The spans of a range of consecutive Gaussians, in their order.
#[derive(Debug)]
pub(crate) struct Chunk {
    /// First Gaussian.
    pub begin: usize,
    /// End of the range.
    pub end: usize,
    pub spans: Vec<Span>,
    /// For each tile the place, by index among the tile's records, of this chunk's first one.
    pub starts: Vec<u32>,
}

/// The pairs of one chunk, tile by tile and in a tile by index. A chunk is so small that they are written
/// in cache, wherever its Gaussians lie.
pub(super) struct Pairs<T> {
    /// Begin of each tile, and the end.
    begins: Vec<u32>,
    /// Bits of the depth as f32: positive floats order like their bits.
    pub depths: Vec<u32>,
    pub records: Vec<Record<T>>,
    /// [pairs, channels]
    pub colors: Vec<T>,
}

impl<T> Pairs<T> {
    pub fn tile(&self, tile: usize) -> Range<usize> {
        self.begins[tile] as usize..self.begins[tile + 1] as usize
    }
}

/// What the chunks are made from.
pub(super) struct Source<'a, T> {
    pub projection: &'a Projection,
    pub colors: &'a [T],
    pub channels: usize,
    pub tiles_x: usize,
    pub tiles_y: usize,
    /// Pairs so far.
    pub total: AtomicU64,
}

impl<T: Real> Source<'_, T> {
    /// The spans of the Gaussians `range`, and their pairs; not the pairs if they are too many. The chunk's
    /// `starts` are counts.
    #[inline(always)]
    pub fn chunk<S: Simd>(&self, _: S, range: Range<usize>) -> (Chunk, Pairs<T>) {
        let mut spans = Vec::with_capacity(range.len());
        let mut counts = vec![0u32; self.tiles_x * self.tiles_y];
        let exact = self.projection.knobs.spans == Spans::Ellipse;
        for i in range.clone() {
            let splat = &self.projection.splats[i];
            if splat.visible() {
                tile_spans(splat, exact, |row, x0, x1| {
                    let span = Span {
                        gaussian: i as u32,
                        row: row as u16,
                        begin: x0 as u16,
                        end: x1 as u16,
                    };
                    for count in &mut counts[span.tiles(self.tiles_x)] {
                        *count += 1;
                    }
                    spans.push(span);
                });
            }
        }
        let total: u64 = spans
            .iter()
            .map(|span| u64::from(span.end - span.begin))
            .sum();
        let chunk = Chunk {
            begin: range.start,
            end: range.end,
            spans,
            starts: counts,
        };
        let before = self.total.fetch_add(total, Ordering::Relaxed);
        let spans = if before + total <= MAX_PAIRS {
            &chunk.spans[..]
        } else {
            &[]
        };
        let pairs = self.pairs(spans, &chunk.starts);
        (chunk, pairs)
    }

    #[inline(always)]
    fn pairs(&self, spans: &[Span], counts: &[u32]) -> Pairs<T> {
        let d = self.channels;
        let mut begins = Vec::with_capacity(counts.len() + 1);
        let mut sum = 0usize;
        for count in counts {
            begins.push(sum as u32);
            sum += *count as usize;
        }
        begins.push(sum as u32);
        if spans.is_empty() {
            sum = 0;
        }
        let mut next = begins.clone();
        let mut depths = vec![0; sum];
        let mut records = vec![Record::default(); sum];
        let mut colors = vec![T::ZERO; sum * d];
        let middle = |k: usize| (k * TILE + TILE / 2) as f64;
        for span in spans {
            let i = span.gaussian as usize;
            let splat = &self.projection.splats[i];
            let depth = (self.projection.depths[i] as f32).to_bits();
            let color = &self.colors[i * d..(i + 1) * d];
            for x in span.begin..span.end {
                let slot = &mut next[usize::from(span.row) * self.tiles_x + usize::from(x)];
                let at = *slot as usize;
                *slot += 1;
                let center = [middle(usize::from(x)), middle(usize::from(span.row))];
                depths[at] = depth;
                records[at] = Record::new(splat, span.gaussian, center);
                copy_color(&mut colors[at * d..(at + 1) * d], color);
            }
        }
        Pairs {
            begins,
            depths,
            records,
            colors,
        }
    }
}

/// Three channels are worth their own path: a call to copy a dozen bytes costs more than the copy.
#[inline(always)]
pub(super) fn copy_color<T: Copy>(out: &mut [T], color: &[T]) {
    match (out, color) {
        ([r, g, b], &[x, y, z]) => (*r, *g, *b) = (x, y, z),
        (out, color) => out.copy_from_slice(color),
    }
}
