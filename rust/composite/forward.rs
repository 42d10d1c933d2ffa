//! Compositing, forward.

use super::{
    CompositeInput, Composited, TOGETHER, Work, for_channels, for_count,
    kernel::{self, Grid, Pixels},
    plus,
};
use crate::{
    constants::{BLOCK, BLOCK_PIXELS, TILE, TILE_BLOCKS, TILE_PIXELS},
    error::{Error, check_len},
    memory::{self, OfThreads},
    project::Projection,
    scene::Camera,
    simd::Real,
    tiles::{self, List, Scratch, Tiles},
    uninit::UninitVec,
};
use fearless_simd::{Simd, dispatch};
use rayon::prelude::*;
use std::{iter::repeat_n, time::Instant};

/// One view.
#[derive(Debug)]
pub struct Image<T> {
    /// [H, W, channels]
    pub image: Vec<T>,
    /// [H, W]
    pub alphas: Vec<T>,
    /// For the backward pass.
    pub tiles: Tiles<T>,
    /// For the backward pass.
    pub composited: Composited<T>,
    /// What it took.
    pub work: Work,
    /// Wall-clock seconds that the tile lists took. Each is blended as soon as it is made: of the time that all threads
    /// spent on lists, one thread's part.
    pub bin_seconds: f64,
}

/// Bin and composite all tiles, with the colours [N, channels] of the Gaussians, in front of `background`,
/// `[channels]`.
///
/// # Errors
/// As for `bin`, and when the length of the background does not fit.
pub fn forward<T: Real>(
    projection: &Projection,
    colors: &[T],
    channels: usize,
    camera: &Camera,
    background: Option<&[T]>,
) -> Result<Image<T>, Error> {
    background.map_or(Ok(()), |b| check_len("background", b, channels))?;
    let started = Instant::now();
    let (mut tiles, scattered) = tiles::scatter(
        projection,
        colors,
        channels,
        camera,
        tiles::most_pairs::<T>(channels),
    )?;
    let scattering = started.elapsed().as_secs_f64();
    let count = tiles.tiles_x * tiles.tiles_y;
    let mut lists = memory::with_capacity(count, "tile lists")?;
    lists.resize_with(count, List::default);
    let mut depths = memory::filled([0; TILE_BLOCKS], count, "image")?;
    let mut transmittance = UninitVec::new(count * TILE_PIXELS, "image")?;
    let mut painted = UninitVec::new(count * channels, "image")?;
    let (grid, scratch) = (Grid::new(), OfThreads::<Scratch<T>>::default());
    let level = projection.level.token;
    let input = CompositeInput {
        projection,
        tiles: &tiles,
        camera,
        background,
    };
    let (work, listing) = lists
        .par_iter_mut()
        .zip(&mut depths)
        .zip(transmittance.cut(repeat_n(TILE_PIXELS, count)))
        .zip(painted.cut(repeat_n(channels, count)))
        .enumerate()
        .with_max_len(TOGETHER)
        .map(|(tile, (((list, depths), transmittance), colors))| {
            let started = Instant::now();
            scratch.with(|scratch| scattered.list(projection, channels, tile, scratch, list))?;
            let listing = started.elapsed().as_secs_f64();
            let transmittance = transmittance.fill(T::ZERO);
            let colors = colors.fill([T::ZERO; TILE_PIXELS]);
            let work = dispatch!(level, simd => for_channels!(
                channels, forward_tile, simd, T, (&input, &grid, tile, list, depths, transmittance, colors)
            ));
            Ok((work, listing))
        })
        .try_reduce(Default::default, |(a, b), (c, d)| Ok((plus(a, c), b + d)))?;
    let (transmittance, painted) = (transmittance.finish(), painted.finish());
    let (image, alphas) = image_from_tiles(&input, &transmittance, &painted)?;
    tiles.lists = lists;
    Ok(Image {
        image,
        alphas,
        tiles,
        composited: Composited {
            depths,
            transmittance,
        },
        work,
        bin_seconds: scattering + listing / rayon::current_num_threads() as f64,
    })
}

/// The image and its alphas from the tiles' transmittances and colours, which lie in block order.
fn image_from_tiles<T: Real>(
    input: &CompositeInput<T>,
    transmittance: &[T],
    colors: &[Pixels<T>],
) -> Result<(Vec<T>, Vec<T>), Error> {
    let (tiles, channels) = (input.tiles, input.channels());
    let (width, height) = (input.camera.width, input.camera.height);
    let pixels = width * height;
    let [mut image, mut alphas] = UninitVec::several([pixels * channels, pixels], "image")?;
    let pixels = (0..tiles.tiles_y).map(|row| TILE.min(height - row * TILE) * width);
    let level = input.projection.level.token;
    image
        .cut(pixels.clone().map(|n| n * channels))
        .into_par_iter()
        .zip(alphas.cut(pixels))
        .enumerate()
        .with_max_len(1)
        .for_each(|(row, (image, alphas))| {
            let out = (image.fill(T::ZERO), alphas.fill(T::ZERO));
            dispatch!(level, simd => for_channels!(
                channels, row_from_tiles, simd, T, (input, row, transmittance, colors, out)
            ));
        });
    Ok((image.finish(), alphas.finish()))
}

/// One row of tiles of [`image_from_tiles`].
#[inline(always)]
fn row_from_tiles<S: Simd, T: Real, const D: usize>(
    _: S,
    input: &CompositeInput<T>,
    row: usize,
    transmittance: &[T],
    colors: &[Pixels<T>],
    (image, alphas): (&mut [T], &mut [T]),
) {
    let channels = if D > 0 { D } else { input.channels() };
    let tiles_x = input.tiles.tiles_x;
    let base = row * TILE * input.camera.width;
    for tile in row * tiles_x..(row + 1) * tiles_x {
        let t = &transmittance[tile * TILE_PIXELS..(tile + 1) * TILE_PIXELS];
        let colors = &colors[tile * channels..(tile + 1) * channels];
        for (p, pixel, n) in input.runs(tile) {
            let pixel = pixel - base;
            let alphas = &mut alphas[pixel..pixel + n];
            let image = &mut image[pixel * channels..(pixel + n) * channels];
            // Most are whole: all of their pixels at once.
            if let Some(alphas) = alphas.first_chunk_mut::<BLOCK>() {
                write_run::<T, D>(p, t, colors, &mut image[..BLOCK * channels], alphas);
            } else {
                write_run::<T, D>(p, t, colors, image, alphas);
            }
        }
    }
}

/// Pixels `p..` of a tile, as many as there are alphas.
#[inline(always)]
fn write_run<T: Real, const D: usize>(
    p: usize,
    transmittance: &[T],
    colors: &[Pixels<T>],
    image: &mut [T],
    alphas: &mut [T],
) {
    let (n, channels) = (alphas.len(), if D > 0 { D } else { colors.len() });
    for (alpha, t) in alphas.iter_mut().zip(&transmittance[p..p + n]) {
        *alpha = T::from_f64(1.0 - t.to_f64());
    }
    for (c, color) in colors[..channels].iter().enumerate() {
        for (k, color) in color[p..p + n].iter().enumerate() {
            image[k * channels + c] = *color;
        }
    }
}

/// Composite one tile.
#[inline(always)]
pub(super) fn forward_tile<S: Simd, T: Real, const D: usize>(
    simd: S,
    input: &CompositeInput<T>,
    grid: &Grid<T>,
    tile: usize,
    list: &List<T>,
    depths: &mut [u32; TILE_BLOCKS],
    transmittance: &mut [T],
    colors: &mut [Pixels<T>],
) -> Work {
    let mut work = [list.records.len() as u64, 0];
    for (p, _, n) in input.runs(tile) {
        transmittance[p..p + n].fill(T::ONE);
    }
    for (block, depth) in depths.iter_mut().enumerate() {
        let pixels = &mut transmittance[block * BLOCK_PIXELS..(block + 1) * BLOCK_PIXELS];
        let layers = input.layers(list, block);
        let evaluated = for_count!(kernel::vectors::<S, T>(), V => kernel::blend::<S, T, D, V>(simd, grid, block, layers, pixels, colors));
        *depth = evaluated as u32;
        work[1] += evaluated as u64;
    }
    work
}
