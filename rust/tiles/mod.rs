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
    memory,
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

/// What an error calls the buffers of this folder.
const NAME: &str = "tile lists";

/// Gaussians per chunk where there are many.
const CHUNK: usize = 8192;

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

/// The most pairs of one view that carry so many channels.
pub(crate) fn most_pairs<T>(channels: usize) -> u64 {
    (MAX_PAIR_BYTES / pair_bytes::<T>(channels)).min(MAX_PAIRS)
}

/// Find the tiles that the visible Gaussians reach, with the colours [N, channels] that they carry; there may be no
/// channels where only weights are asked for. The lists are still to be made of the pairs.
///
/// # Errors
/// When there are more than `limit` pairs, or no memory for them.
pub(crate) fn scatter<T: Real>(
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
        let (tiles, bytes) = (tiles_x * tiles_y, limit * pair_bytes::<T>(channels));
        let message = format!(
            "{n} Gaussians reach more than {limit} times one of the {tiles} tiles of the image; so many pairs take up \
             to {bytes} bytes; use fewer or smaller Gaussians, a smaller image or float32"
        );
        return Err(Error::new("means", message));
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
        let scatter = |limit| scatter::<f32>(&projection, &[], 0, &s.camera, limit);
        let reached = |tiles: &Tiles<f32>| -> u64 {
            let reached = tiles.chunks.iter().map(|chunk| chunk.reaches.len() as u64);
            reached.sum()
        };
        let pairs = reached(&scatter(u64::MAX).unwrap().0);
        assert!(pairs > 20_000); // of several chunks
        for threads in [1, 3] {
            let pool = ThreadPoolBuilder::new().num_threads(threads);
            pool.build().unwrap().install(|| {
                assert_eq!(reached(&scatter(pairs).unwrap().0), pairs);
                for limit in [pairs - 1, pairs / 2, 0] {
                    let message = scatter(limit).map(|_| ()).unwrap_err().to_string();
                    let expected = format!(
                        "means: 9000 Gaussians reach more than {limit} times one of the 247 tiles"
                    );
                    assert!(message.starts_with(&expected), "{message}");
                    let bytes = limit * pair_bytes::<f32>(0);
                    assert!(
                        message.contains(&format!("up to {bytes} bytes")),
                        "{message}"
                    );
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
