//! Compositing, forward.

use super::{CompositeInput, Composited, for_alpha, for_vectors};
use crate::{
    constants::{BLOCK_PIXELS, TILE, TILE_BLOCKS, TILE_PIXELS},
    error::Error,
    fresh::Fresh,
    kernel::{self, Grid, Pixels},
    real::{Lanes, Real},
    tuning::EXP2_DEGREE,
    work::Work,
};
use fearless_simd::{Level, Simd, SimdBase, dispatch};
use rayon::prelude::*;
use std::iter::repeat_n;

/// One view.
#[derive(Debug)]
pub struct Image<T> {
    /// [H, W, channels]
    pub image: Vec<T>,
    /// [H, W]
    pub alphas: Vec<T>,
    /// For the backward pass.
    pub composited: Composited<T>,
    /// Counts.
    pub work: Work,
}

/// Composite all tiles.
///
/// # Errors
/// When the length of an array does not fit.
pub fn forward<T: Real>(input: &CompositeInput<T>) -> Result<Image<T>, Error> {
    input.check()?;
    let (tiles, channels) = (input.tiles, input.channels());
    let count = tiles.columns * tiles.rows;
    let mut depths = vec![[0; TILE_BLOCKS]; count];
    let mut transmittance = Fresh::new(count * TILE_PIXELS);
    let mut colors = Fresh::new(count * channels);
    let grid = Grid::new();
    let level = Level::new();
    let degree = input.projection.tuning.exp2_degree;
    let work = depths
        .par_iter_mut()
        .zip(transmittance.cut(repeat_n(TILE_PIXELS, count)))
        .zip(colors.cut(repeat_n(channels, count)))
        .enumerate()
        .map(|(tile, ((depths, transmittance), colors))| {
            let transmittance = transmittance.fill(T::ZERO);
            let colors = colors.fill([T::ZERO; TILE_PIXELS]);
            dispatch!(level, simd => for_alpha!(
                channels, degree, forward_tile, simd, T, (input, &grid, tile, depths, transmittance, colors)
            ))
        })
        .reduce(Work::default, Work::plus);
    let (transmittance, colors) = (transmittance.finish(), colors.finish());
    let (width, height) = (input.camera.width, input.camera.height);
    let (mut image, mut alphas) = (
        Fresh::new(width * height * channels),
        Fresh::new(width * height),
    );
    let pixels = (0..tiles.rows).map(|row| TILE.min(height - row * TILE) * width);
    image
        .cut(pixels.clone().map(|n| n * channels))
        .into_par_iter()
        .zip(alphas.cut(pixels))
        .enumerate()
        .for_each(|(row, (image, alphas))| {
            let (image, alphas) = (image.fill(T::ZERO), alphas.fill(T::ZERO));
            let base = row * TILE * width;
            for tile in row * tiles.columns..(row + 1) * tiles.columns {
                let t = &transmittance[tile * TILE_PIXELS..(tile + 1) * TILE_PIXELS];
                let colors = &colors[tile * channels..(tile + 1) * channels];
                for (p, pixel, n) in input.runs(tile) {
                    let pixel = pixel - base;
                    for (alpha, t) in alphas[pixel..pixel + n].iter_mut().zip(&t[p..p + n]) {
                        *alpha = T::from_f64(1.0 - t.to_f64());
                    }
                    let out = &mut image[pixel * channels..(pixel + n) * channels];
                    for (c, color) in colors.iter().enumerate() {
                        for (k, color) in color[p..p + n].iter().enumerate() {
                            out[k * channels + c] = *color;
                        }
                    }
                }
            }
        });
    Ok(Image {
        image: image.finish(),
        alphas: alphas.finish(),
        composited: Composited {
            depths,
            transmittance,
        },
        work: Work {
            channels: channels as u64,
            ..work
        },
    })
}

#[inline(always)]
fn forward_tile<S: Simd, T: Real, const D: usize, const E: usize>(
    simd: S,
    input: &CompositeInput<T>,
    grid: &Grid<T>,
    tile: usize,
    depths: &mut [u32; TILE_BLOCKS],
    transmittance: &mut [T],
    colors: &mut [Pixels<T>],
) -> Work {
    let list = &input.tiles.lists[tile];
    list.fetch();
    let mut work = Work {
        tiles: u64::from(!list.records.is_empty()),
        pairs: list.records.len() as u64,
        ..Work::default()
    };
    for (p, _, n) in input.runs(tile) {
        transmittance[p..p + n].fill(T::ONE);
    }
    for (block, depth) in depths.iter_mut().enumerate() {
        let pixels = &mut transmittance[block * BLOCK_PIXELS..(block + 1) * BLOCK_PIXELS];
        let layers = input.layers(tile, block);
        let blended = for_vectors!(simd: S, T, D, E, blend(grid, block, layers, pixels, colors));
        *depth = blended.layers as u32;
        work.blocks += blended.layers as u64;
        work.changed_blocks += blended.changed;
        work.blended += blended.pixels;
    }
    work
}
