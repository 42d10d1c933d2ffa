//! Tile lists: which Gaussians reach which tile, front to back.
//!
//! Everything runs in the order of the Gaussians' indices, so that memory is read and written as streams: a
//! tile's records lie in index order, and a small sort per tile, in cache, gives their depth order. The
//! backward pass walks the same spans with one cursor per tile to sum each Gaussian's gradients, without an
//! inverse index and in a fixed order.

mod block_masks;
mod lists;
mod pairs;
mod spans;

pub(crate) use pairs::{Chunk, Record, UNIT};

use crate::{
    constants::{MAX_PAIRS, TILE},
    error::Error,
    project::Projection,
    scene::Camera,
    simd::Real,
};
use fearless_simd::dispatch;
use lists::{List, Scratch, list};
use pairs::Source;
use rayon::prelude::*;
use std::sync::atomic::AtomicU64;

/// The tile lists of one view.
#[derive(Debug, Default)]
pub struct Tiles<T> {
    /// Tiles per row.
    pub tiles_x: usize,
    /// Tiles per column.
    pub tiles_y: usize,
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

    /// Number of Gaussians that were binned, visible or not.
    pub(crate) fn gaussians(&self) -> usize {
        self.chunks.last().map_or(0, |chunk| chunk.end)
    }

    /// Number of pairs of each tile.
    pub fn lengths(&self) -> impl Iterator<Item = usize> {
        self.lists.iter().map(|list| list.records.len())
    }
}

/// Gaussians per chunk where there are many.
const CHUNK: usize = 8192;

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
    let (tiles_x, tiles_y) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
    // Small chunks stay in cache and balance the load; their number changes no result.
    let size = n
        .div_ceil(4 * rayon::current_num_threads())
        .clamp(1024, CHUNK.max(8 * tiles_x * tiles_y));
    let source = Source {
        projection,
        colors,
        channels,
        tiles_x,
        tiles_y,
        total: AtomicU64::new(0),
    };
    let level = projection.level.token;
    let (mut chunks, pairs): (Vec<_>, Vec<_>) = (0..n.div_ceil(size))
        .into_par_iter()
        .map(|k| {
            let range = k * size..n.min((k + 1) * size);
            dispatch!(level, simd => source.chunk(simd, range))
        })
        .unzip();
    let total = source.total.into_inner();
    if total > MAX_PAIRS {
        return Err(Error::TooManyPairs {
            pairs: total,
            limit: MAX_PAIRS,
        });
    }
    // Counts to places: in a tile chunk by chunk.
    let mut sums = vec![0u32; tiles_x * tiles_y];
    for chunk in &mut chunks {
        for (start, sum) in chunk.starts.iter_mut().zip(&mut sums) {
            *sum += std::mem::replace(start, *sum);
        }
    }
    let lists = (0..tiles_x * tiles_y)
        .into_par_iter()
        .map_init(Scratch::default, |scratch, tile| {
            dispatch!(level, simd => list(simd, projection, &pairs, channels, tile, scratch))
        })
        .collect();
    Ok(Tiles {
        tiles_x,
        tiles_y,
        lists,
        channels,
        chunks,
    })
}
