//! Tile lists: which Gaussians reach which tile, front to back.
//!
//! Everything runs in the order of the Gaussians' indices, so that memory is read and written as streams: a
//! tile's records lie in index order, and a small sort per tile, in cache, gives their depth order. The
//! backward pass walks the same pairs with one cursor per tile to sum each Gaussian's gradients, without an
//! inverse index and in a fixed order.

mod block_masks;
mod lists;
mod pairs;
mod spans;

pub(crate) use lists::{List, Scratch};
pub(crate) use pairs::{Chunk, Record, UNIT};
pub(crate) use spans::Reach;

use crate::{
    constants::{MAX_PAIR_BYTES, MAX_PAIRS, TILE},
    error::Error,
    memory::{self, OfThreads},
    project::Projection,
    scene::Camera,
    simd::Real,
};
use fearless_simd::dispatch;
use pairs::{Pairs, Source, pair_bytes};
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

/// What an error calls the buffers of this folder.
const NAME: &str = "tile lists";

/// Gaussians per chunk where there are many.
const CHUNK: usize = 8192;

/// Bin the visible Gaussians into tiles, with the colours [N, channels] that they carry; there may be no
/// channels where only weights are asked for.
///
/// # Errors
/// When the (Gaussian, tile) pairs could take more than [`MAX_PAIR_BYTES`] or are more than [`MAX_PAIRS`], or there
/// is no memory for them.
pub fn bin<T: Real>(
    projection: &Projection,
    colors: &[T],
    channels: usize,
    camera: &Camera,
) -> Result<Tiles<T>, Error> {
    let (mut tiles, pairs) = scattered(projection, colors, channels, camera)?;
    let count = tiles.tiles_x * tiles.tiles_y;
    let mut lists = memory::with_capacity(count, NAME)?;
    lists.resize_with(count, List::default);
    let scratch = OfThreads::<Scratch<T>>::default();
    lists
        .par_iter_mut()
        .enumerate()
        .try_for_each(|(tile, list)| {
            scratch.with(|scratch| pairs.list(projection, channels, tile, scratch, list))
        })?;
    tiles.lists = lists;
    Ok(tiles)
}

/// The pairs of all chunks, not yet collected tile by tile.
pub(crate) struct Scattered<T>(Vec<Pairs<T>>);

impl<T: Real> Scattered<T> {
    /// Make `list` that of a tile.
    pub(crate) fn list(
        &self,
        projection: &Projection,
        channels: usize,
        tile: usize,
        scratch: &mut Scratch<T>,
        list: &mut List<T>,
    ) -> Result<(), Error> {
        dispatch!(projection.level.token, simd => lists::collect(
            simd, projection, &self.0, channels, tile, scratch, list
        ))
    }
}

/// [`bin`] up to the lists, which are still to be made of the pairs.
///
/// # Errors
/// As for [`bin`].
pub(crate) fn scattered<T: Real>(
    projection: &Projection,
    colors: &[T],
    channels: usize,
    camera: &Camera,
) -> Result<(Tiles<T>, Scattered<T>), Error> {
    let limit = (MAX_PAIR_BYTES / pair_bytes::<T>(channels)).min(MAX_PAIRS);
    scatter(projection, colors, channels, camera, limit)
}

/// The same with at most `limit` pairs.
fn scatter<T: Real>(
    projection: &Projection,
    colors: &[T],
    channels: usize,
    camera: &Camera,
    limit: u64,
) -> Result<(Tiles<T>, Scattered<T>), Error> {
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
        limit,
    };
    let level = projection.level.token;
    let made: Vec<_> = (0..n.div_ceil(size))
        .into_par_iter()
        .with_max_len(1)
        .map(|k| {
            let range = k * size..n.min((k + 1) * size);
            dispatch!(level, simd => source.chunk(simd, range))
        })
        .collect::<Result<_, Error>>()?;
    let (mut chunks, pairs): (Vec<_>, Vec<_>) = made.into_iter().unzip();
    if source.total.into_inner() > limit {
        return Err(Error::TooManyPairs {
            gaussians: n as u64,
            tiles: (tiles_x * tiles_y) as u64,
            limit,
            bytes: limit * pair_bytes::<T>(channels),
        });
    }
    // Counts to places: in a tile chunk by chunk.
    let mut sums = memory::filled(0u32, tiles_x * tiles_y, NAME)?;
    for chunk in &mut chunks {
        for (start, sum) in chunk.starts.iter_mut().zip(&mut sums) {
            *sum += std::mem::replace(start, *sum);
        }
    }
    let tiles = Tiles {
        tiles_x,
        tiles_y,
        lists: Vec::new(),
        channels,
        chunks,
    };
    Ok((tiles, Scattered(pairs)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        project::{self, RenderOptions},
        scene::{Colors, synthetic::Synthetic},
    };
    use rayon::ThreadPoolBuilder;

    #[test]
    fn more_pairs_than_allowed_are_an_error_for_any_number_of_threads() {
        let s = Synthetic::<f32>::new(9000, 300, 200, 1).unwrap();
        let none = Colors::<f32>::Channels(&[], 0);
        let options = RenderOptions::default();
        let projected = project::forward(&s.gaussians(), none, &s.camera, &options, false).unwrap();
        let projection = projected.projection;
        let pairs = bin::<f32>(&projection, &[], 0, &s.camera).unwrap().pairs() as u64;
        assert!(pairs > 20_000); // of several chunks
        for threads in [1, 3] {
            let pool = ThreadPoolBuilder::new().num_threads(threads);
            pool.build().unwrap().install(|| {
                let scatter = |limit| scatter::<f32>(&projection, &[], 0, &s.camera, limit);
                let (tiles, _) = scatter(pairs).unwrap();
                let reached: usize = tiles.chunks.iter().map(|chunk| chunk.reaches.len()).sum();
                assert_eq!(reached as u64, pairs);
                for limit in [pairs - 1, pairs / 2, 0] {
                    let expected = Error::TooManyPairs {
                        gaussians: 9000,
                        tiles: 19 * 13,
                        limit,
                        bytes: limit * pair_bytes::<f32>(0),
                    };
                    assert_eq!(scatter(limit).map(|_| ()).unwrap_err(), expected);
                }
            });
        }
    }

    #[test]
    fn the_counting_stops_at_the_limit() {
        let s = Synthetic::<f32>::new(1000, 3000, 2000, 1).unwrap();
        let none = Colors::<f32>::Channels(&[], 0);
        let options = RenderOptions::default();
        let projected = project::forward(&s.gaussians(), none, &s.camera, &options, false).unwrap();
        let source = |limit| Source::<f32> {
            projection: &projected.projection,
            colors: &[],
            channels: 0,
            tiles_x: 188,
            tiles_y: 125,
            total: AtomicU64::new(0),
            limit,
        };
        let level = projected.projection.level.token;
        let spans = |limit| {
            let source = source(limit);
            let (chunk, pairs) = dispatch!(level, simd => source.chunk(simd, 0..1000)).unwrap();
            (
                chunk.reaches.len(),
                pairs.records.len(),
                source.total.into_inner(),
            )
        };
        let (all, records, total) = spans(u64::MAX);
        assert_eq!(records as u64, total);
        let (some, none, counted) = spans(total / 10);
        assert!(some < all / 4 && none == 0, "{some} of {all} tiles");
        assert!(
            total / 10 < counted && counted < total / 2,
            "{counted} of {total} pairs"
        );
    }

    #[test]
    fn the_blocks_of_one_tile_can_be_counted() {
        // Begin and end of each block's list lie in a u32, and all pairs may reach all blocks of one tile.
        assert!(MAX_PAIRS * crate::constants::TILE_BLOCKS as u64 <= u64::from(u32::MAX));
        assert!(pair_bytes::<f32>(3) < pair_bytes::<f64>(3));
    }
}
