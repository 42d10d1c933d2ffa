//! The pairs of a Gaussian and a tile that it reaches, and what the kernels read of each.

use super::{
    NAME,
    spans::{Reach, tile_spans},
};
use crate::{
    accuracy_knobs::Spans,
    constants::{TILE, TILE_BLOCKS},
    error::Error,
    memory,
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
    /// In the tile around `center`.
    #[inline(always)]
    fn new(splat: &Splat, gaussian: u32, center: [f64; 2]) -> Self {
        let [s, m, t] = splat.factors;
        let (s, t) = (UNIT * s, UNIT * t);
        let (x, y) = (splat.mean[0] - center[0], splat.mean[1] - center[1]);
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

/// The tiles that a range of consecutive Gaussians reach, in their order.
#[derive(Debug)]
pub(crate) struct Chunk {
    /// First Gaussian.
    pub begin: usize,
    /// End of the range.
    pub end: usize,
    pub reaches: Vec<Reach>,
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
        match self.begins.get(tile..tile + 2) {
            Some(&[begin, end]) => begin as usize..end as usize,
            _ => 0..0,
        }
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
    /// The most that there may be.
    pub limit: u64,
}

/// Pairs that a chunk counts before it adds them to those of the others.
const REPORT: u64 = 1 << 14;

/// Bytes that a pair takes at most while the lists are made: as part of its chunk and of its tile's list, with an
/// index for each block.
pub(super) const fn pair_bytes<T>(channels: usize) -> u64 {
    let both = size_of::<Record<T>>() + channels * size_of::<T>();
    let of_chunk = size_of::<Reach>() + size_of::<u32>();
    let of_list = size_of::<u32>() + size_of::<u16>() + TILE_BLOCKS * size_of::<u32>();
    (2 * both + of_chunk + of_list) as u64
}

impl<T: Real> Source<'_, T> {
    /// The tiles that the Gaussians `range` reach, and their pairs; not all of the tiles and none of the pairs if those
    /// of all chunks so far are too many. The chunk's `starts` are counts.
    #[inline(always)]
    pub fn chunk<S: Simd>(&self, simd: S, range: Range<usize>) -> Result<(Chunk, Pairs<T>), Error> {
        let mut reaches = memory::with_capacity(range.len(), NAME)?;
        let exact = self.projection.knobs.spans == Spans::Ellipse;
        let mut fresh = 0;
        let mut too_many = self.add(0);
        for i in range.clone() {
            let splat = &self.projection.splats[i];
            let [x0, x1, y0, y1] = splat.tiles;
            let count = usize::from(x1 - x0) * usize::from(y1 - y0);
            let reach = |x, y| Reach {
                gaussian: i as u32,
                x,
                y,
            };
            if count <= 2 {
                // As most have, and those without any that are culled: two are written, and as many kept. No processor
                // foresees a branch for their number.
                memory::reserve(&mut reaches, 2, NAME)?;
                let (len, right) = (reaches.len() + count, u16::from(x1 - x0 > 1));
                reaches.push(reach(x0, y0));
                reaches.push(reach(x0 + right, y0 + (1 - right)));
                reaches.truncate(len);
                fresh += count as u64;
            } else {
                tile_spans(simd, splat, exact, |y, x0, x1| {
                    fresh += u64::from(x1 - x0);
                    if fresh >= REPORT {
                        too_many |= self.add(std::mem::take(&mut fresh));
                    }
                    if !too_many {
                        reaches.extend((x0..x1).map(|x| reach(x, y)));
                    }
                });
            }
            if fresh >= REPORT {
                too_many |= self.add(std::mem::take(&mut fresh));
            }
            if too_many {
                break;
            }
        }
        too_many |= self.add(fresh);
        let mut starts = memory::filled(0u32, self.tiles_x * self.tiles_y, NAME)?;
        for reach in &reaches {
            starts[reach.tile(self.tiles_x)] += 1;
        }
        let pairs = self.pairs(if too_many { &[] } else { &reaches }, &starts)?;
        let chunk = Chunk {
            begin: range.start,
            end: range.end,
            reaches,
            starts,
        };
        Ok((chunk, pairs))
    }

    /// Count more pairs. Whether there are too many.
    fn add(&self, more: u64) -> bool {
        self.total.fetch_add(more, Ordering::Relaxed) + more > self.limit
    }

    #[inline(always)]
    fn pairs(&self, reaches: &[Reach], counts: &[u32]) -> Result<Pairs<T>, Error> {
        let d = self.channels;
        let mut begins = memory::with_capacity(counts.len() + 1, NAME)?;
        let mut sum = 0usize;
        for count in counts {
            begins.push(sum as u32);
            sum += *count as usize;
        }
        begins.push(sum as u32);
        if reaches.is_empty() {
            sum = 0;
        }
        let mut next = memory::with_capacity(begins.len(), NAME)?;
        next.extend_from_slice(&begins);
        // Zeros first: they bring the lines into cache one after the other, which is faster than to wait for each one.
        let mut depths = memory::filled(0, sum, NAME)?;
        let mut records = memory::filled(Record::default(), sum, NAME)?;
        let mut colors = memory::filled(T::ZERO, sum * d, NAME)?;
        let middle = |k: u16| (usize::from(k) * TILE + TILE / 2) as f64;
        for reach in reaches {
            let i = reach.gaussian as usize;
            let splat = &self.projection.splats[i];
            let slot = &mut next[reach.tile(self.tiles_x)];
            let at = *slot as usize;
            *slot += 1;
            depths[at] = (self.projection.depths[i] as f32).to_bits();
            records[at] = Record::new(splat, i as u32, [middle(reach.x), middle(reach.y)]);
            copy_color(
                &mut colors[at * d..(at + 1) * d],
                &self.colors[i * d..(i + 1) * d],
            );
        }
        Ok(Pairs {
            begins,
            depths,
            records,
            colors,
        })
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
