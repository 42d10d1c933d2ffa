//! The forward pass of a picture that is shown and forgotten.

use super::{
    CompositeInput, TOGETHER, for_channels,
    forward::forward_tile,
    kernel::{Grid, Pixels},
};
use crate::{
    constants::{TILE, TILE_BLOCKS, TILE_PIXELS},
    error::{Error, check_len},
    memory::{self, OfThreads},
    project::Projection,
    scene::Camera,
    simd::Real,
    tiles::{self, List, Scratch},
    uninit::UninitVec,
};
use fearless_simd::dispatch;
use rayon::prelude::*;

/// What an error calls the buffers of this file.
const NAME: &str = "image";

/// Bin and composite into 8 bits a channel, [H, W, channels], where 1 is 255: the image of [`forward()`](super::forward())
/// rounded, half to even. Each tile is blended while its list is in cache, and nothing of it is kept.
///
/// # Errors
/// As for `bin` and `forward`.
pub fn picture<T: Real>(
    projection: &Projection,
    colors: &[T],
    channels: usize,
    camera: &Camera,
    background: Option<&[T]>,
) -> Result<Vec<u8>, Error> {
    background.map_or(Ok(()), |b| check_len("background", b, channels))?;
    let (tiles, scattered) = tiles::scatter(
        projection,
        colors,
        channels,
        camera,
        tiles::most_pairs::<T>(channels),
    )?;
    let input = CompositeInput {
        projection,
        tiles: &tiles,
        camera,
        background,
    };
    let (grid, buffers) = (Grid::new(), OfThreads::<Buffers<T>>::default());
    let level = projection.level.token;
    let count = tiles.tiles_x * tiles.tiles_y;
    let bytes = TILE_PIXELS * channels;
    let mut painted = UninitVec::new(count * bytes, NAME)?;
    painted
        .cut(std::iter::repeat_n(bytes, count))
        .into_par_iter()
        .enumerate()
        .with_max_len(TOGETHER)
        .try_for_each(|(tile, out)| {
            buffers.with(|buffers| {
                let Buffers {
                    scratch,
                    list,
                    colors,
                    depths,
                } = buffers;
                scattered.list(projection, channels, tile, scratch, list)?;
                let mut transmittance = [T::ZERO; TILE_PIXELS];
                memory::resize(colors, channels, [T::ZERO; TILE_PIXELS], NAME)?;
                colors.as_flattened_mut().fill(T::ZERO);
                dispatch!(level, simd => for_channels!(
                    channels, forward_tile, simd, T, (&input, &grid, tile, list, depths, &mut transmittance, colors)
                ));
                let out = out.fill(0);
                for (p, pixel) in out.chunks_exact_mut(channels.max(1)).enumerate() {
                    for (byte, color) in pixel.iter_mut().zip(&*colors) {
                        *byte = byte_of(color[p]);
                    }
                }
                Ok(())
            })
        })?;
    rows_from_tiles(&input, &painted.finish())
}

/// Buffers of one thread, reused from tile to tile.
#[derive(Default)]
struct Buffers<T> {
    scratch: Scratch<T>,
    list: List<T>,
    colors: Vec<Pixels<T>>,
    depths: [u32; TILE_BLOCKS],
}

/// The nearest of 255 levels; NaN is 0.
#[inline(always)]
fn byte_of<T: Real>(value: T) -> u8 {
    (value * T::from_f64(255.0)).to_f64().round_ties_even() as u8 // saturates
}

/// The image of what the tiles hold in block order.
fn rows_from_tiles<T: Real>(input: &CompositeInput<T>, painted: &[u8]) -> Result<Vec<u8>, Error> {
    let (width, height, channels) = (input.camera.width, input.camera.height, input.channels());
    let bytes = TILE_PIXELS * channels;
    let mut image = UninitVec::new(width * height * channels, NAME)?;
    let rows = input.tiles.tiles_y;
    image
        .cut((0..rows).map(|row| TILE.min(height - row * TILE) * width * channels))
        .into_par_iter()
        .enumerate()
        .for_each(|(row, out)| {
            let (out, base) = (out.fill(0), row * TILE * width);
            for tile in row * input.tiles.tiles_x..(row + 1) * input.tiles.tiles_x {
                let painted = &painted[tile * bytes..(tile + 1) * bytes];
                for (p, pixel, n) in input.runs(tile) {
                    let at = (pixel - base) * channels;
                    out[at..at + n * channels]
                        .copy_from_slice(&painted[p * channels..(p + n) * channels]);
                }
            }
        });
    Ok(image.finish())
}
