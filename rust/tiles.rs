//! Tile lists: which Gaussians reach which tile, front to back.
//!
//! Everything runs in the order of the Gaussians' indices, so that memory is read and written as streams: a
//! tile's records lie in index order, and a small sort per tile, in cache, gives their depth order. The
//! backward pass walks the same spans with one cursor per tile to sum each Gaussian's gradients, without an
//! inverse index and in a fixed order.

use crate::{
    camera::Camera,
    constants::{MAX_PAIRS, TILE},
    error::Error,
    kernel::Local,
    project::{Projection, Splat},
    real::Real,
};
use rayon::prelude::*;

/// A run of tiles in one row that one Gaussian reaches.
#[derive(Debug, Clone, Copy)]
struct Span {
    gaussian: u32,
    row: u16,
    begin: u16,
    end: u16,
}

/// The spans of a range of consecutive Gaussians.
#[derive(Debug)]
pub(crate) struct Chunk {
    /// First Gaussian.
    pub begin: usize,
    /// End of the range.
    pub end: usize,
    /// By (Gaussian, row).
    spans: Vec<Span>,
    /// The same spans by (row, Gaussian): indices into `spans`.
    by_row: Vec<u32>,
    /// Begin of each row in `by_row`, and the end.
    row_begins: Vec<u32>,
    /// For each tile where this chunk's records begin, in the order of all records.
    starts: Vec<u32>,
}

impl Chunk {
    /// Call `f(gaussian, position of its record)` for each pair: by Gaussian, then by tile.
    pub fn pairs(&self, columns: usize, mut f: impl FnMut(usize, usize)) {
        let mut next = self.starts.clone();
        for span in &self.spans {
            let row = usize::from(span.row) * columns;
            for position in &mut next[row + usize::from(span.begin)..row + usize::from(span.end)] {
                f(span.gaussian as usize, *position as usize);
                *position += 1;
            }
        }
    }
}

/// For each tile the Gaussians whose support reaches one of its pixel centres.
#[derive(Debug, Default)]
pub struct Tiles<T> {
    /// Tiles per row.
    pub columns: usize,
    /// Tiles per column.
    pub rows: usize,
    /// Begin of each tile's records, row-major, and the total at the end.
    pub offsets: Vec<usize>,
    /// What the kernels need of each pair; in a tile by (depth, index), so that they read a stream.
    pub(crate) records: Vec<Local<T>>,
    /// Colours of the records, [pairs, channels].
    pub(crate) colors: Vec<T>,
    /// Number of channels.
    pub(crate) channels: usize,
    /// For each record its place by index among the tile's records.
    places: Vec<u32>,
    pub(crate) chunks: Vec<Chunk>,
}

/// One tile's part of [`Tiles`].
pub(crate) struct Tile<'a, T> {
    pub records: &'a [Local<T>],
    pub colors: &'a [T],
    pub places: &'a [u32],
}

impl<T> Tiles<T> {
    /// Number of (Gaussian, tile) pairs.
    pub fn pairs(&self) -> usize {
        self.places.len()
    }

    /// Number of pairs of each tile.
    pub fn lengths(&self) -> impl Iterator<Item = usize> {
        self.offsets.windows(2).map(|w| w[1] - w[0])
    }

    pub(crate) fn tile(&self, tile: usize) -> Tile<'_, T> {
        let range = self.offsets[tile]..self.offsets[tile + 1];
        Tile {
            records: &self.records[range.clone()],
            colors: &self.colors[range.start * self.channels..range.end * self.channels],
            places: &self.places[range],
        }
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
) -> (Chunk, u64) {
    let mut spans = Vec::with_capacity(end - begin);
    let mut counts = vec![0u32; columns * rows];
    let mut row_begins = vec![0u32; rows + 1];
    let mut pairs = 0;
    for i in begin..end {
        let splat = &projection.splats[i];
        if !splat.visible() {
            continue;
        }
        tile_spans(splat, |row, x0, x1| {
            spans.push(Span {
                gaussian: i as u32,
                row: row as u16,
                begin: x0 as u16,
                end: x1 as u16,
            });
            row_begins[row + 1] += 1;
            counts[row * columns + x0..row * columns + x1]
                .iter_mut()
                .for_each(|n| *n += 1);
            pairs += (x1 - x0) as u64;
        });
    }
    for row in 0..rows {
        row_begins[row + 1] += row_begins[row];
    }
    let mut next = row_begins.clone();
    let mut by_row = vec![0u32; spans.len()];
    for (k, span) in spans.iter().enumerate() {
        let slot = &mut next[usize::from(span.row)];
        by_row[*slot as usize] = k as u32;
        *slot += 1;
    }
    (
        Chunk {
            begin,
            end,
            spans,
            by_row,
            row_begins,
            starts: counts,
        },
        pairs,
    )
}

/// Split `data` into consecutive pieces of the given lengths.
pub(crate) fn split<T>(mut data: &mut [T], lengths: impl Iterator<Item = usize>) -> Vec<&mut [T]> {
    lengths
        .map(|n| {
            let (head, tail) = std::mem::take(&mut data).split_at_mut(n);
            data = tail;
            head
        })
        .collect()
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
    let (mut chunks, pairs): (Vec<_>, Vec<_>) = (0..n.div_ceil(size))
        .into_par_iter()
        .map(|k| find_spans(projection, k * size, n.min((k + 1) * size), columns, rows))
        .unzip();
    let total: u64 = pairs.iter().sum();
    if total > MAX_PAIRS {
        return Err(Error::new(
            "means",
            format!(
                "the Gaussians cover {total} (Gaussian, tile) pairs, more than {MAX_PAIRS}; \
                 use fewer or smaller Gaussians, or a smaller image"
            ),
        ));
    }
    // Counts to positions: tile by tile, within a tile chunk by chunk.
    let mut offsets = Vec::with_capacity(columns * rows + 1);
    let mut sum = 0;
    for tile in 0..columns * rows {
        offsets.push(sum as usize);
        for chunk in &mut chunks {
            sum += std::mem::replace(&mut chunk.starts[tile], sum);
        }
    }
    offsets.push(sum as usize);

    let mut records = vec![Local::default(); sum as usize];
    let mut pair_colors = vec![T::ZERO; sum as usize * channels];
    let mut places = vec![0u32; sum as usize];
    let row_lengths = || (0..rows).map(|y| offsets[(y + 1) * columns] - offsets[y * columns]);
    let jobs: Vec<_> = split(&mut records, row_lengths())
        .into_iter()
        .zip(split(&mut pair_colors, row_lengths().map(|n| n * channels)))
        .zip(split(&mut places, row_lengths()))
        .enumerate()
        .collect();
    let source = Source {
        projection,
        colors,
        channels,
        columns,
        chunks: &chunks,
        offsets: &offsets,
    };
    jobs.into_par_iter()
        .for_each(|(row, ((records, colors), places))| {
            source.fill_row(row, records, colors, places);
        });
    Ok(Tiles {
        columns,
        rows,
        offsets,
        records,
        colors: pair_colors,
        channels,
        places,
        chunks,
    })
}

/// What the rows are filled from.
struct Source<'a, T> {
    projection: &'a Projection,
    colors: &'a [T],
    channels: usize,
    columns: usize,
    chunks: &'a [Chunk],
    offsets: &'a [usize],
}

impl<T: Real> Source<'_, T> {
    /// Write the records, colours and places of one row of tiles.
    fn fill_row(&self, row: usize, records: &mut [Local<T>], colors: &mut [T], places: &mut [u32]) {
        let tiles = row * self.columns..(row + 1) * self.columns;
        let base = self.offsets[tiles.start];
        let d = self.channels;
        let middle = |k: usize| (k * TILE + TILE / 2) as f64;
        // By index first.
        let mut keys = vec![0u64; records.len()];
        let mut by_index = vec![Local::default(); records.len()];
        for chunk in self.chunks {
            let mut next = chunk.starts[tiles.clone()].to_vec();
            let spans =
                &chunk.by_row[chunk.row_begins[row] as usize..chunk.row_begins[row + 1] as usize];
            for span in spans.iter().map(|&k| &chunk.spans[k as usize]) {
                let i = span.gaussian as usize;
                let splat = &self.projection.splats[i];
                // Positive floats order like their bits; the low half keeps the order of the indices.
                let key = u64::from((self.projection.depths[i] as f32).to_bits()) << 32;
                let begin = usize::from(span.begin);
                for (x, next) in next[begin..usize::from(span.end)].iter_mut().enumerate() {
                    let x = begin + x;
                    let at = *next as usize - base;
                    *next += 1;
                    by_index[at] = Local::new(splat, span.gaussian, [middle(x), middle(row)]);
                    keys[at] = key | (at - (self.offsets[tiles.start + x] - base)) as u64;
                }
            }
        }
        for tile in tiles {
            let range = self.offsets[tile] - base..self.offsets[tile + 1] - base;
            let keys = &mut keys[range.clone()];
            let by_index = &by_index[range.clone()];
            let places = &mut places[range.clone()];
            keys.sort_unstable();
            for (place, key) in places.iter_mut().zip(keys.iter()) {
                *place = *key as u32;
            }
            self.order_ties(keys, by_index, places);
            let colors = &mut colors[range.start * d..range.end * d];
            for ((record, color), place) in records[range]
                .iter_mut()
                .zip(colors.chunks_exact_mut(d))
                .zip(places.iter())
            {
                *record = by_index[*place as usize];
                let i = record.gaussian as usize;
                color.copy_from_slice(&self.colors[i * d..(i + 1) * d]);
            }
        }
    }

    /// Depths that are equal as f32 are ordered by their exact values; the sort is stable, so that exactly
    /// equal ones stay in the order of their indices.
    fn order_ties(&self, keys: &[u64], records: &[Local<T>], order: &mut [u32]) {
        let depth = |o: &u32| self.projection.depths[records[*o as usize].gaussian as usize];
        let mut begin = 0;
        for run in keys.chunk_by(|a, b| a >> 32 == b >> 32) {
            if run.len() > 1 {
                order[begin..begin + run.len()].sort_by(|a, b| depth(a).total_cmp(&depth(b)));
            }
            begin += run.len();
        }
    }
}
