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
    tuning::Spans,
};
use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;
use std::{
    hint::black_box,
    ops::Range,
    sync::atomic::{AtomicU64, Ordering},
};

/// A run of tiles in one row that one Gaussian reaches.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Span {
    pub gaussian: u32,
    row: u16,
    begin: u16,
    end: u16,
}

impl Span {
    pub fn tiles(&self, columns: usize) -> Range<usize> {
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
    pub spans: Vec<Span>,
    /// For each tile the place, by index among the tile's records, of this chunk's first one.
    pub starts: Vec<u32>,
}

/// The pairs of one chunk, tile by tile and in a tile by index. A chunk is so small that they are written
/// in cache, wherever its Gaussians lie.
struct Pairs<T> {
    /// Begin of each tile, and the end.
    begins: Vec<u32>,
    /// Bits of the depth as f32: positive floats order like their bits.
    depths: Vec<u32>,
    records: Vec<Local<T>>,
    /// [pairs, channels]
    colors: Vec<T>,
}

impl<T> Pairs<T> {
    fn tile(&self, tile: usize) -> Range<usize> {
        self.begins[tile] as usize..self.begins[tile + 1] as usize
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

impl<T: Copy> List<T> {
    /// Bring the records and colours into cache, before the blocks ask for them one by one.
    #[inline(always)]
    pub fn fetch(&self) {
        fetch(&self.records);
        fetch(&self.colors);
    }
}

/// Read one element of each cache line: in so short a loop many misses overlap.
#[inline(always)]
fn fetch<T: Copy>(data: &[T]) {
    for element in data.iter().step_by((64 / size_of::<T>()).max(1)) {
        black_box(*element);
    }
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
/// those rows of tiles whose band of pixel centres meets the ellipse, each with the ellipse's extent in it; or
/// without `exact` for all tiles of the splat's box.
///
/// Counting and filling both go through here, so that they cannot disagree.
#[inline(always)]
pub fn tile_spans(splat: &Splat, exact: bool, mut f: impl FnMut(usize, usize, usize)) {
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

/// Bin the visible Gaussians into tiles, with the colours [N, channels] that they carry; there may be no
/// channels where only weights are asked for.
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
    // Small chunks stay in cache and balance the load; their number changes no result.
    let size = n
        .div_ceil(4 * rayon::current_num_threads())
        .clamp(1024, CHUNK.max(8 * columns * rows));
    let source = Source {
        projection,
        colors,
        channels,
        columns,
        rows,
        total: AtomicU64::new(0),
    };
    let level = Level::new();
    let (mut chunks, pairs): (Vec<_>, Vec<_>) = (0..n.div_ceil(size))
        .into_par_iter()
        .map(|k| {
            let range = k * size..n.min((k + 1) * size);
            dispatch!(level, simd => source.chunk(simd, range))
        })
        .unzip();
    let total = source.total.into_inner();
    if total > MAX_PAIRS {
        return Err(Error::new(
            "means",
            format!(
                "the Gaussians cover {total} (Gaussian, tile) pairs, more than {MAX_PAIRS}; \
                 use fewer or smaller Gaussians, or a smaller image"
            ),
        ));
    }
    // Counts to places: in a tile chunk by chunk.
    let mut sums = vec![0u32; columns * rows];
    for chunk in &mut chunks {
        for (start, sum) in chunk.starts.iter_mut().zip(&mut sums) {
            *sum += std::mem::replace(start, *sum);
        }
    }
    let lists = (0..columns * rows)
        .into_par_iter()
        .map_init(Scratch::default, |scratch, tile| {
            dispatch!(level, simd => list(simd, projection, &pairs, channels, tile, scratch))
        })
        .collect();
    Ok(Tiles {
        columns,
        rows,
        lists,
        channels,
        chunks,
    })
}

/// Gaussians per chunk where there are many.
const CHUNK: usize = 8192;

/// What the chunks are made from.
struct Source<'a, T> {
    projection: &'a Projection,
    colors: &'a [T],
    channels: usize,
    columns: usize,
    rows: usize,
    /// Pairs so far.
    total: AtomicU64,
}

impl<T: Real> Source<'_, T> {
    /// The spans of the Gaussians `range`, and their pairs; not the pairs if they are too many. The chunk's
    /// `starts` are counts.
    #[inline(always)]
    fn chunk<S: Simd>(&self, _: S, range: Range<usize>) -> (Chunk, Pairs<T>) {
        let mut spans = Vec::with_capacity(range.len());
        let mut counts = vec![0u32; self.columns * self.rows];
        let exact = self.projection.tuning.spans == Spans::Ellipse;
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
                    for count in &mut counts[span.tiles(self.columns)] {
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
        let mut records = vec![Local::default(); sum];
        let mut colors = vec![T::ZERO; sum * d];
        let middle = |k: usize| (k * TILE + TILE / 2) as f64;
        for span in spans {
            let i = span.gaussian as usize;
            let splat = &self.projection.splats[i];
            let depth = (self.projection.depths[i] as f32).to_bits();
            let color = &self.colors[i * d..(i + 1) * d];
            for x in span.begin..span.end {
                let slot = &mut next[usize::from(span.row) * self.columns + usize::from(x)];
                let at = *slot as usize;
                *slot += 1;
                let center = [middle(usize::from(x)), middle(usize::from(span.row))];
                depths[at] = depth;
                records[at] = Local::new(splat, span.gaussian, center);
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
fn copy_color<T: Copy>(out: &mut [T], color: &[T]) {
    match (out, color) {
        ([r, g, b], &[x, y, z]) => (*r, *g, *b) = (x, y, z),
        (out, color) => out.copy_from_slice(color),
    }
}

/// Buffers of one thread, reused from tile to tile.
struct Scratch<T> {
    /// (bits of the depth as f32, place by index).
    keys: Vec<u64>,
    /// Records and colours by index.
    records: Vec<Local<T>>,
    colors: Vec<T>,
    shapes: Shapes,
    reached: [Vec<u32>; TILE_BLOCKS],
}

impl<T> Default for Scratch<T> {
    fn default() -> Self {
        Self {
            keys: Vec::new(),
            records: Vec::new(),
            colors: Vec::new(),
            shapes: Shapes::default(),
            reached: Default::default(),
        }
    }
}

/// Collect a tile's pairs and order them.
#[inline(always)]
fn list<S: Simd, T: Real>(
    simd: S,
    projection: &Projection,
    chunks: &[Pairs<T>],
    channels: usize,
    tile: usize,
    scratch: &mut Scratch<T>,
) -> List<T> {
    let Scratch {
        keys,
        records,
        colors,
        shapes,
        reached,
    } = scratch;
    keys.clear();
    records.clear();
    colors.clear();
    // The pieces are short, and the first line of each is a miss.
    for pairs in chunks {
        let range = pairs.tile(tile);
        fetch(&pairs.depths[range.clone()]);
        fetch(&pairs.records[range.clone()]);
        fetch(&pairs.colors[range.start * channels..range.end * channels]);
    }
    for pairs in chunks {
        let range = pairs.tile(tile);
        for depth in &pairs.depths[range.clone()] {
            keys.push(u64::from(*depth) << 32 | keys.len() as u64);
        }
        colors.extend_from_slice(&pairs.colors[range.start * channels..range.end * channels]);
        records.extend_from_slice(&pairs.records[range]);
    }
    let n = keys.len();
    let mut list = List {
        records: Vec::with_capacity(n),
        colors: vec![T::ZERO; n * channels],
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
    order_ties(projection, keys, records, &mut list.places);
    shapes.resize(n);
    for (k, place) in list.places.iter().enumerate() {
        let place = *place as usize;
        copy_color(
            &mut list.colors[k * channels..(k + 1) * channels],
            &colors[place * channels..(place + 1) * channels],
        );
        shapes.set(k, &records[place]);
        list.records.push(records[place]);
    }
    if projection.tuning.skip_blocks {
        kernel::reached(simd, shapes, n, &mut list.masks, reached);
    } else {
        kernel::all_blocks(n, &mut list.masks, reached);
    }
    list.blocks = Vec::with_capacity(reached.iter().map(Vec::len).sum());
    for (begin, records) in list.begins[1..].iter_mut().zip(reached) {
        list.blocks.extend_from_slice(records);
        *begin = list.blocks.len() as u32;
    }
    list
}

/// Depths that are equal as f32 are ordered by their exact values; the sort is stable, so that exactly
/// equal ones stay in the order of their indices.
fn order_ties<T>(projection: &Projection, keys: &[u64], records: &[Local<T>], order: &mut [u32]) {
    let depth = |o: &u32| projection.depths[records[*o as usize].gaussian as usize];
    let mut begin = 0;
    for run in keys.chunk_by(|a, b| a >> 32 == b >> 32) {
        if run.len() > 1 {
            order[begin..begin + run.len()].sort_by(|a, b| depth(a).total_cmp(&depth(b)));
        }
        begin += run.len();
    }
}
