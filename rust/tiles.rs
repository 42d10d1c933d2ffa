//! Tile lists: which Gaussians reach which tile, front to back.
//!
//! Everything runs in the order of the Gaussians' indices, so that memory is read and written as streams: a
//! tile's records lie in index order, and a small sort per tile, in cache, gives their depth order. The
//! backward pass walks the same spans with one cursor per tile to sum each Gaussian's gradients, without an
//! inverse index and in a fixed order.

use crate::{
    camera::Camera,
    constants::{MAX_PAIRS, TILE, TILE_BLOCKS},
    error::Error,
    kernel::{self, Local, Shapes},
    project::{Projection, Splat},
    real::Real,
};
use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;
use std::ops::Range;

/// A run of tiles in one row that one Gaussian reaches.
#[derive(Debug, Clone, Copy)]
struct Span {
    gaussian: u32,
    row: u16,
    begin: u16,
    end: u16,
}

impl Span {
    fn tiles(&self, columns: usize) -> Range<usize> {
        let row = usize::from(self.row) * columns;
        row + usize::from(self.begin)..row + usize::from(self.end)
    }
}

/// The spans of a range of consecutive Gaussians, in their order.
#[derive(Debug)]
pub(crate) struct Chunk {
    /// First Gaussian.
    pub begin: usize,
    /// End of the range.
    pub end: usize,
    spans: Vec<Span>,
    /// Number of this chunk's pairs in each tile; once all chunks are known, their first place in the tile.
    starts: Vec<u32>,
    pairs: u64,
}

impl Chunk {
    /// Call `f(gaussian, tile, place)` for each pair: by Gaussian, then by tile.
    #[inline(always)]
    pub fn pairs(&self, columns: usize, mut f: impl FnMut(usize, usize, usize)) {
        let mut next = self.starts.clone();
        for span in &self.spans {
            let tiles = span.tiles(columns);
            let first = tiles.start;
            for (k, place) in next[tiles].iter_mut().enumerate() {
                f(span.gaussian as usize, first + k, *place as usize);
                *place += 1;
            }
        }
    }
}

/// The Gaussians whose support reaches a pixel centre of one tile.
#[derive(Debug, Default)]
pub(crate) struct List<T> {
    /// What the kernels need of each pair, by (depth, index), so that they read a stream.
    pub records: Vec<Local<T>>,
    /// Colours of the records, [pairs, channels].
    pub colors: Vec<T>,
    /// For each record its place by index among the tile's records.
    pub places: Vec<u32>,
    /// For each record the blocks that it reaches: bit b for block b.
    pub masks: Vec<u16>,
    /// For each block, one after the other, the records that reach it, front to back.
    pub blocks: Vec<u32>,
    /// Begin of each block in `blocks`, and the end.
    pub begins: [u32; TILE_BLOCKS + 1],
}

/// The tile lists of one view.
#[derive(Debug, Default)]
pub struct Tiles<T> {
    /// Tiles per row.
    pub columns: usize,
    /// Tiles per column.
    pub rows: usize,
    /// Row-major.
    pub(crate) lists: Vec<List<T>>,
    /// Number of channels.
    pub(crate) channels: usize,
    pub(crate) chunks: Vec<Chunk>,
}

impl<T> Tiles<T> {
    /// Number of (Gaussian, tile) pairs.
    pub fn pairs(&self) -> usize {
        self.lengths().sum()
    }

    /// Number of pairs of each tile.
    pub fn lengths(&self) -> impl Iterator<Item = usize> {
        self.lists.iter().map(|list| list.records.len())
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

/// The spans of the Gaussians `begin..end`, and the number of pairs of each tile.
fn find_spans(
    projection: &Projection,
    begin: usize,
    end: usize,
    columns: usize,
    rows: usize,
) -> Chunk {
    let mut spans = Vec::with_capacity(end - begin);
    let mut counts = vec![0u32; columns * rows];
    let mut pairs = 0;
    for (i, splat) in projection.splats[begin..end].iter().enumerate() {
        if !splat.visible() {
            continue;
        }
        tile_spans(splat, |row, x0, x1| {
            let span = Span {
                gaussian: (begin + i) as u32,
                row: row as u16,
                begin: x0 as u16,
                end: x1 as u16,
            };
            counts[span.tiles(columns)].iter_mut().for_each(|n| *n += 1);
            pairs += (x1 - x0) as u64;
            spans.push(span);
        });
    }
    Chunk {
        begin,
        end,
        spans,
        starts: counts,
        pairs,
    }
}

/// The pairs of one chunk, tile by tile and in a tile by index: (bits of the depth as f32, Gaussian).
struct Keys {
    keys: Vec<u64>,
    /// Begin of each tile in `keys`, and the end.
    begins: Vec<u32>,
}

impl Keys {
    /// Reads `chunk.starts` as counts.
    fn new(chunk: &Chunk, projection: &Projection, columns: usize) -> Self {
        let mut begins = Vec::with_capacity(chunk.starts.len() + 1);
        let mut sum = 0;
        for count in &chunk.starts {
            begins.push(sum);
            sum += count;
        }
        let mut next = begins.clone();
        begins.push(sum);
        let mut keys = vec![0; sum as usize];
        for span in &chunk.spans {
            // Positive floats order like their bits.
            let depth = (projection.depths[span.gaussian as usize] as f32).to_bits();
            let key = u64::from(depth) << 32 | u64::from(span.gaussian);
            for slot in &mut next[span.tiles(columns)] {
                keys[*slot as usize] = key;
                *slot += 1;
            }
        }
        Self { keys, begins }
    }

    fn tile(&self, tile: usize) -> &[u64] {
        &self.keys[self.begins[tile] as usize..self.begins[tile + 1] as usize]
    }
}

/// Bin the visible Gaussians into tiles, with the colours [N, channels] that they carry.
///
/// # Errors
/// When there are more than [`MAX_PAIRS`] (Gaussian, tile) pairs.
pub fn bin<T: Real>(
    projection: &Projection,
    colors: &[T],
    channels: usize,
    camera: &Camera,
) -> Result<Tiles<T>, Error> {
    let n = projection.splats.len();
    let (columns, rows) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
    // Several chunks per thread balance the load; the number of chunks changes no result.
    let size = n.div_ceil(4 * rayon::current_num_threads()).max(1024);
    let mut chunks: Vec<_> = (0..n.div_ceil(size))
        .into_par_iter()
        .map(|k| find_spans(projection, k * size, n.min((k + 1) * size), columns, rows))
        .collect();
    let total: u64 = chunks.iter().map(|chunk| chunk.pairs).sum();
    if total > MAX_PAIRS {
        return Err(Error::new(
            "means",
            format!(
                "the Gaussians cover {total} (Gaussian, tile) pairs, more than {MAX_PAIRS}; \
                 use fewer or smaller Gaussians, or a smaller image"
            ),
        ));
    }
    let keys: Vec<_> = chunks
        .par_iter()
        .map(|chunk| Keys::new(chunk, projection, columns))
        .collect();
    // Counts to places: in a tile chunk by chunk.
    let mut sums = vec![0u32; columns * rows];
    for chunk in &mut chunks {
        for (start, sum) in chunk.starts.iter_mut().zip(&mut sums) {
            *sum += std::mem::replace(start, *sum);
        }
    }
    let source = Source {
        projection,
        colors,
        channels,
        columns,
        keys: &keys,
    };
    let level = Level::new();
    let lists = (0..columns * rows)
        .into_par_iter()
        .map_init(
            Scratch::default,
            |scratch, tile| dispatch!(level, simd => source.list(simd, tile, scratch)),
        )
        .collect();
    Ok(Tiles {
        columns,
        rows,
        lists,
        channels,
        chunks,
    })
}

/// What the lists are made from.
struct Source<'a, T> {
    projection: &'a Projection,
    colors: &'a [T],
    channels: usize,
    columns: usize,
    keys: &'a [Keys],
}

/// Buffers of one thread, reused from tile to tile.
#[derive(Default)]
struct Scratch {
    keys: Vec<u64>,
    /// The tile's Gaussians by index.
    gaussians: Vec<u32>,
    shapes: Shapes,
    reached: [Vec<u32>; TILE_BLOCKS],
}

impl<T: Real> Source<'_, T> {
    #[inline(always)]
    fn list<S: Simd>(&self, simd: S, tile: usize, scratch: &mut Scratch) -> List<T> {
        let Scratch {
            keys,
            gaussians,
            shapes,
            reached,
        } = scratch;
        keys.clear();
        gaussians.clear();
        for chunk in self.keys {
            for key in chunk.tile(tile) {
                // The low half becomes the place by index.
                keys.push(key >> 32 << 32 | gaussians.len() as u64);
                gaussians.push(*key as u32);
            }
        }
        let n = keys.len();
        let mut list = List {
            records: Vec::with_capacity(n),
            colors: Vec::with_capacity(n * self.channels),
            places: Vec::with_capacity(n),
            ..List::default()
        };
        if n == 0 {
            return list;
        }
        keys.sort_unstable();
        for key in keys.iter() {
            list.places.push(*key as u32);
        }
        self.order_ties(keys, gaussians, &mut list.places);
        let middle = |k: usize| (k * TILE + TILE / 2) as f64;
        let center = [middle(tile % self.columns), middle(tile / self.columns)];
        shapes.resize(n);
        for (k, place) in list.places.iter().enumerate() {
            let gaussian = gaussians[*place as usize];
            let i = gaussian as usize;
            let splat = &self.projection.splats[i];
            list.records.push(shapes.set(k, splat, gaussian, center));
            let color = &self.colors[i * self.channels..(i + 1) * self.channels];
            if let &[r, g, b] = color {
                list.colors.extend([r, g, b]);
            } else {
                list.colors.extend_from_slice(color);
            }
        }
        kernel::reached(simd, shapes, n, &mut list.masks, reached);
        list.blocks = Vec::with_capacity(reached.iter().map(Vec::len).sum());
        for (begin, records) in list.begins[1..].iter_mut().zip(reached) {
            list.blocks.extend_from_slice(records);
            *begin = list.blocks.len() as u32;
        }
        list
    }

    /// Depths that are equal as f32 are ordered by their exact values; the sort is stable, so that exactly
    /// equal ones stay in the order of their indices.
    fn order_ties(&self, keys: &[u64], gaussians: &[u32], order: &mut [u32]) {
        let depth = |o: &u32| self.projection.depths[gaussians[*o as usize] as usize];
        let mut begin = 0;
        for run in keys.chunk_by(|a, b| a >> 32 == b >> 32) {
            if run.len() > 1 {
                order[begin..begin + run.len()].sort_by(|a, b| depth(a).total_cmp(&depth(b)));
            }
            begin += run.len();
        }
    }
}
