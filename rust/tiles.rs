//! Depth order and tile lists: one stable sort of the visible Gaussians, then counting into tiles in that
//! order, so that each tile's list is sorted without a sort of its own.

use crate::{
    camera::Camera,
    constants::{MAX_PAIRS, TILE},
    error::Error,
    project::{Projection, Splat},
};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// For each tile the Gaussians whose support reaches one of its pixel centres, front to back.
#[derive(Debug, Default)]
pub struct Tiles {
    /// Tiles per row.
    pub columns: usize,
    /// Tiles per column.
    pub rows: usize,
    /// Begin of each tile's list in `entries`, row-major, and the total at the end.
    pub offsets: Vec<usize>,
    /// Gaussians, tile by tile, by (depth, index).
    entries: Vec<AtomicU32>,
    /// For the pairs Gaussian by Gaussian, where they lie in `entries`.
    positions: Vec<AtomicU32>,
    /// For each Gaussian the begin and end of its pairs in `positions`.
    slots: Vec<[u32; 2]>,
}

impl Tiles {
    /// Number of (Gaussian, tile) pairs.
    pub fn pairs(&self) -> usize {
        self.entries.len()
    }

    /// The Gaussians of tile `tile`, front to back.
    pub fn entries(&self, tile: usize) -> impl Iterator<Item = usize> {
        self.entries[self.offsets[tile]..self.offsets[tile + 1]].iter().map(|e| e.load(Relaxed) as usize)
    }

    /// Where the pairs of Gaussian `i` lie in the tile-major order, in ascending tile order.
    pub fn positions(&self, i: usize) -> impl Iterator<Item = usize> {
        let [begin, end] = self.slots[i];
        self.positions[begin as usize..end as usize].iter().map(|p| p.load(Relaxed) as usize)
    }
}

/// The visible Gaussians by (depth, index).
pub fn depth_order(projection: &Projection) -> Vec<u32> {
    let depths = &projection.depths;
    let mut keys: Vec<u64> = projection
        .splats
        .iter()
        .zip(depths)
        .enumerate()
        .filter(|(_, (s, _))| s.visible())
        // Positive floats order like their bits. The sort is on 32 bits; ties are ordered below.
        .map(|(i, (_, d))| u64::from((*d as f32).to_bits()) << 32 | i as u64)
        .collect();
    radix_sort(&mut keys);
    let index = |key: u64| key as u32;
    let mut begin = 0;
    while begin < keys.len() {
        let mut end = begin + 1;
        while end < keys.len() && keys[end] >> 32 == keys[begin] >> 32 {
            end += 1;
        }
        if end - begin > 1 {
            // Equal as f32: order by the exact depth; the sort is stable, so ties stay by index.
            keys[begin..end].sort_by(|a, b| {
                depths[index(*a) as usize].total_cmp(&depths[index(*b) as usize])
            });
        }
        begin = end;
    }
    keys.into_iter().map(index).collect()
}

/// Stable least-significant-digit radix sort by the upper 32 bits, 11 bits a pass.
fn radix_sort(keys: &mut Vec<u64>) {
    const BITS: u32 = 11;
    const BUCKETS: usize = 1 << BITS;
    let mut histograms = [[0usize; BUCKETS]; 3];
    let digit = |key: u64, pass: u32| (key >> (32 + BITS * pass)) as usize & (BUCKETS - 1);
    for &key in keys.iter() {
        for (pass, histogram) in histograms.iter_mut().enumerate() {
            histogram[digit(key, pass as u32)] += 1;
        }
    }
    let mut other = vec![0u64; keys.len()];
    for (pass, histogram) in histograms.iter_mut().enumerate() {
        if histogram.contains(&keys.len()) {
            continue; // one digit for all
        }
        let mut sum = 0;
        for count in histogram.iter_mut() {
            sum += std::mem::replace(count, sum);
        }
        for &key in keys.iter() {
            let slot = &mut histogram[digit(key, pass as u32)];
            other[*slot] = key;
            *slot += 1;
        }
        std::mem::swap(keys, &mut other);
    }
}

/// Call `f(tile row, first tile column, end tile column)` for the tiles that the support reaches: exactly
/// those rows of tiles whose band of pixel centres meets the ellipse, each with the ellipse's extent in it.
///
/// Counting and filling both go through here, so that they cannot disagree.
pub fn tile_spans(splat: &Splat, mut f: impl FnMut(usize, usize, usize)) {
    let [x0, x1, y0, y1] = splat.tiles.map(usize::from);
    if x1 - x0 <= 1 || y1 - y0 <= 1 {
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

/// Order the visible Gaussians and bin them into tiles.
///
/// # Errors
/// When there are more than [`MAX_PAIRS`] (Gaussian, tile) pairs.
pub fn bin(projection: &Projection, camera: &Camera) -> Result<Tiles, Error> {
    let order = depth_order(projection);
    let splats = &projection.splats;
    let (columns, rows) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
    let chunk = order.len().div_ceil(rayon::current_num_threads().min(16)).max(1);

    // Pairs per (chunk, tile), and per Gaussian.
    let counted: Vec<(Vec<u32>, Vec<u32>, u64)> = order
        .par_chunks(chunk)
        .map(|ids| {
            let mut per_tile = vec![0u32; columns * rows];
            let mut total = 0;
            let per_gaussian = ids
                .iter()
                .map(|&i| {
                    let mut pairs = 0;
                    tile_spans(&splats[i as usize], |y, x0, x1| {
                        pairs += (x1 - x0) as u32;
                        per_tile[y * columns + x0..y * columns + x1].iter_mut().for_each(|n| *n += 1);
                    });
                    total += u64::from(pairs);
                    pairs
                })
                .collect();
            (per_tile, per_gaussian, total)
        })
        .collect();
    let total: u64 = counted.iter().map(|c| c.2).sum();
    if total > MAX_PAIRS {
        return Err(Error::new(
            "means",
            format!(
                "{} visible Gaussians cover {total} (Gaussian, tile) pairs, more than {MAX_PAIRS}; \
                 use fewer or smaller Gaussians, or a smaller image",
                order.len()
            ),
        ));
    }

    // Where each (tile, chunk) begins: tile by tile, within a tile chunk by chunk, which is depth order.
    let mut offsets = Vec::with_capacity(columns * rows + 1);
    let mut starts: Vec<Vec<u32>> = counted.iter().map(|c| vec![0; c.0.len()]).collect();
    let mut sum = 0usize;
    for tile in 0..columns * rows {
        offsets.push(sum);
        for (start, (per_tile, ..)) in starts.iter_mut().zip(&counted) {
            start[tile] = sum as u32;
            sum += per_tile[tile] as usize;
        }
    }
    offsets.push(sum);
    let mut slots = vec![[0u32; 2]; splats.len()];
    let mut slot = 0;
    for (ids, (_, per_gaussian, _)) in order.chunks(chunk).zip(&counted) {
        for (&i, &pairs) in ids.iter().zip(per_gaussian) {
            slots[i as usize] = [slot, slot + pairs];
            slot += pairs;
        }
    }

    let make = |n: usize| (0..n).into_par_iter().map(|_| AtomicU32::new(0)).collect::<Vec<_>>();
    let (entries, positions) = (make(sum), make(sum));
    order.par_chunks(chunk).zip(starts).for_each(|(ids, mut next)| {
        for &i in ids {
            let mut slot = slots[i as usize][0] as usize;
            tile_spans(&splats[i as usize], |y, x0, x1| {
                for position in &mut next[y * columns + x0..y * columns + x1] {
                    entries[*position as usize].store(i, Relaxed);
                    positions[slot].store(*position, Relaxed);
                    *position += 1;
                    slot += 1;
                }
            });
        }
    });
    Ok(Tiles { columns, rows, offsets, entries, positions, slots })
}
