//! Front-to-back compositing of binned splats, forward and VJP, tile by tile in parallel.

use crate::{
    camera::Camera,
    constants::{BLOCK_PIXELS, TILE, TILE_BLOCKS, TILE_PIXELS},
    error::{Error, check_len},
    kernel::{self, ABSOLUTE, Adjoint, Grid, Layers, MOMENTS, Pixels, UNIT},
    project::Projection,
    real::Real,
    tiles::{Chunk, Tiles, split},
};
use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;

/// Everything that both passes read.
#[derive(Debug, Clone, Copy)]
pub struct CompositeInput<'a, T> {
    /// Projected Gaussians.
    pub projection: &'a Projection,
    /// Their tile lists.
    pub tiles: &'a Tiles<T>,
    /// Image size.
    pub camera: &'a Camera,
    /// Colour behind everything, [channels].
    pub background: Option<&'a [T]>,
}

impl<T: Real> CompositeInput<'_, T> {
    /// Check the lengths of the arrays.
    ///
    /// # Errors
    /// Names `backgrounds`.
    fn check(&self) -> Result<(), Error> {
        self.background
            .map_or(Ok(()), |b| check_len("backgrounds", b, self.channels()))
    }

    fn channels(&self) -> usize {
        self.tiles.channels
    }

    fn pixels(&self) -> usize {
        self.camera.width * self.camera.height
    }

    /// The image's pixels in tile `tile`: (index in block order, index in the image).
    fn tile_pixels(&self, tile: usize) -> impl Iterator<Item = (usize, usize)> + use<'_, T> {
        let (top, left) = (
            tile / self.tiles.columns * TILE,
            tile % self.tiles.columns * TILE,
        );
        let (width, height) = (self.camera.width, self.camera.height);
        (0..TILE_PIXELS).filter_map(move |p| {
            let (row, column) = kernel::position(p);
            let (y, x) = (top + row, left + column);
            (y < height && x < width).then_some((p, y * width + x))
        })
    }
}

/// What the backward pass replays.
#[derive(Debug, Default)]
pub struct Composited<T> {
    /// For each record the blocks in which it changed a pixel.
    hits: Vec<u16>,
    /// Transmittance after the last layer, tile by tile in block order.
    transmittance: Vec<T>,
}

/// Counts of the work done, for reports and tests.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Work {
    /// (Gaussian, tile) pairs.
    pub pairs: u64,
    /// Blocks evaluated by the forward pass.
    pub blocks: u64,
    /// Blocks in which a pixel changed: what the backward pass evaluates.
    pub hit_blocks: u64,
}

/// Call a kernel for the number of channels: the common ones are compiled for it.
macro_rules! for_channels {
    ($channels:expr, $function:ident, $simd:expr, $types:ty, ($($argument:expr),*)) => {
        match $channels {
            3 => $function::<_, $types, 3>($simd, $($argument),*),
            4 => $function::<_, $types, 4>($simd, $($argument),*),
            _ => $function::<_, $types, 0>($simd, $($argument),*),
        }
    };
}

/// Composite all tiles into `image` [H, W, channels] and `alphas` [H, W].
///
/// # Errors
/// When the length of an array does not fit; nothing is written then.
pub fn forward<T: Real>(
    input: &CompositeInput<T>,
    image: &mut [T],
    alphas: &mut [T],
) -> Result<(Composited<T>, Work), Error> {
    input.check()?;
    check_len("render_colors", image, input.pixels() * input.channels())?;
    check_len("render_alphas", alphas, input.pixels())?;
    let (tiles, channels) = (input.tiles, input.channels());
    let count = tiles.columns * tiles.rows;
    let mut hits = vec![0u16; tiles.pairs()];
    let mut transmittance = vec![T::ZERO; count * TILE_PIXELS];
    let mut colors = vec![[T::ZERO; TILE_PIXELS]; count * channels];
    let grid = Grid::new();
    let level = Level::new();
    let jobs: Vec<_> = split(&mut hits, tiles.lengths())
        .into_iter()
        .zip(transmittance.chunks_mut(TILE_PIXELS))
        .zip(colors.chunks_mut(channels))
        .enumerate()
        .collect();
    let work = jobs
        .into_par_iter()
        .map(|(tile, ((hits, transmittance), colors))| {
            let Ok(transmittance) = transmittance.try_into() else {
                unreachable!("chunks of a tile")
            };
            dispatch!(level, simd => for_channels!(
                channels, forward_tile, simd, T, (input, &grid, tile, hits, transmittance, colors)
            ))
        })
        .reduce(Work::default, |a, b| Work {
            pairs: a.pairs + b.pairs,
            blocks: a.blocks + b.blocks,
            hit_blocks: a.hit_blocks + b.hit_blocks,
        });
    let width = input.camera.width;
    image
        .par_chunks_mut(TILE * width * channels)
        .zip(alphas.par_chunks_mut(TILE * width))
        .enumerate()
        .for_each(|(row, (image, alphas))| {
            let base = row * TILE * width;
            for tile in row * tiles.columns..(row + 1) * tiles.columns {
                let t = &transmittance[tile * TILE_PIXELS..(tile + 1) * TILE_PIXELS];
                let colors = &colors[tile * channels..(tile + 1) * channels];
                for (p, pixel) in input.tile_pixels(tile) {
                    let pixel = pixel - base;
                    alphas[pixel] = T::from_f64(1.0 - t[p].to_f64());
                    let out = &mut image[pixel * channels..(pixel + 1) * channels];
                    for (c, (o, color)) in out.iter_mut().zip(colors).enumerate() {
                        let behind = input.background.map_or(0.0, |b| b[c].to_f64());
                        *o = T::from_f64(color[p].to_f64() + t[p].to_f64() * behind);
                    }
                }
            }
        });
    Ok((
        Composited {
            hits,
            transmittance,
        },
        work,
    ))
}

#[inline(always)]
fn forward_tile<S: Simd, T: Real, const D: usize>(
    simd: S,
    input: &CompositeInput<T>,
    grid: &Grid<T>,
    tile: usize,
    hits: &mut [u16],
    transmittance: &mut Pixels<T>,
    colors: &mut [Pixels<T>],
) -> Work {
    for (p, _) in input.tile_pixels(tile) {
        transmittance[p] = T::ONE;
    }
    let mut alive = 0u16;
    for block in 0..TILE_BLOCKS {
        let pixels = &transmittance[block * BLOCK_PIXELS..(block + 1) * BLOCK_PIXELS];
        alive |= u16::from(pixels.contains(&T::ONE)) << block;
    }
    let mut finished = [T::ZERO; TILE_PIXELS];
    let mut layers = Layers {
        transmittance,
        finished: &mut finished,
        alive,
    };
    let list = input.tiles.tile(tile);
    let channels = input.channels();
    let mut work = Work {
        pairs: hits.len() as u64,
        ..Work::default()
    };
    let pairs = list.records.iter().zip(list.colors.chunks_exact(channels));
    for ((local, color), hit) in pairs.zip(hits) {
        let mask = kernel::reached(simd, local, grid) & layers.alive;
        if mask == 0 {
            continue;
        }
        *hit = kernel::blend::<S, T, D>(simd, grid, local, color, mask, &mut layers, colors);
        work.blocks += u64::from(mask.count_ones());
        work.hit_blocks += u64::from(hit.count_ones());
        if layers.alive == 0 {
            break;
        }
    }
    for (t, finished) in transmittance.iter_mut().zip(finished) {
        if finished > T::ZERO {
            *t = finished;
        }
    }
    work
}

/// Cotangents of the compositor's outputs.
#[derive(Debug, Clone, Copy)]
pub struct CompositeCotangents<'a, T> {
    /// Of the image, [H, W, channels].
    pub image: &'a [T],
    /// Of the alphas, [H, W].
    pub alphas: Option<&'a [T]>,
}

/// Gradients of the compositor's inputs, all [N, ...], zeroed by the caller. `None` is not computed.
#[derive(Debug, Default)]
pub struct CompositeGrads<'a, T> {
    /// Gradients of the geometry.
    pub geometry: Option<GeometryGrads<'a, T>>,
    /// Of `colors`, [N, channels].
    pub colors: Option<&'a mut [T]>,
    /// Of `background`, [channels].
    pub background: Option<&'a mut [T]>,
}

/// Gradients with respect to what the projection computed.
#[derive(Debug)]
pub struct GeometryGrads<'a, T> {
    /// Of `means2d`, [N, 2].
    pub means2d: &'a mut [T],
    /// Whitened gradient of the 2D covariance, [N, 3]; see `geometry.rs`.
    pub whitened: &'a mut [T],
    /// Of `opacities`, [N].
    pub opacities: &'a mut [T],
    /// Sum over the pixels of the absolute gradient of `means2d`, [N, 2].
    pub absolute: Option<&'a mut [T]>,
}

/// VJP of [`forward`].
///
/// # Errors
/// When the length of an array does not fit; nothing is written then.
pub fn backward<T: Real>(
    input: &CompositeInput<T>,
    composited: &Composited<T>,
    v: &CompositeCotangents<T>,
    grads: CompositeGrads<T>,
) -> Result<(), Error> {
    input.check()?;
    let (n, channels, tiles) = (input.projection.splats.len(), input.channels(), input.tiles);
    check_len("v_render_colors", v.image, input.pixels() * channels)?;
    if let Some(alphas) = v.alphas {
        check_len("v_render_alphas", alphas, input.pixels())?;
    }
    if let Some(background) = grads.background {
        check_len("v_backgrounds", background, channels)?;
        background_vjp(input, composited, v, background);
    }
    if grads.geometry.is_none() && grads.colors.is_none() {
        return Ok(());
    }
    let absolute = grads
        .geometry
        .as_ref()
        .is_some_and(|g| g.absolute.is_some());
    let columns = Columns {
        geometry: grads.geometry.is_some(),
        absolute,
        channels,
    };
    let row = columns.row();
    let mut pair_grads = vec![T::ZERO; tiles.pairs() * row];
    let grid = Grid::new();
    let level = Level::new();
    let jobs: Vec<_> = split(&mut pair_grads, tiles.lengths().map(|n| n * row))
        .into_iter()
        .enumerate()
        .collect();
    jobs.into_par_iter().for_each_init(
        || Scratch { v_colors: vec![[T::ZERO; TILE_PIXELS]; channels], layers: Vec::new() },
        |scratch, (tile, out)| {
            dispatch!(level, simd => for_channels!(
                channels, backward_tile, simd, T, (input, composited, v, &grid, tile, columns, scratch, out)
            ));
        },
    );
    gather(input, &pair_grads, columns, n, grads.geometry, grads.colors)
}

/// Layout of one pair's gradients.
#[derive(Debug, Clone, Copy)]
struct Columns {
    geometry: bool,
    absolute: bool,
    channels: usize,
}

impl Columns {
    const fn colors(self) -> usize {
        MOMENTS + if self.absolute { ABSOLUTE } else { 0 }
    }

    const fn row(self) -> usize {
        self.colors() + self.channels
    }
}

/// Buffers of one thread, reused from tile to tile.
struct Scratch<T> {
    /// Cotangents of a tile's pixels, by channel.
    v_colors: Vec<Pixels<T>>,
    /// What `kernel::replay` stores.
    layers: Vec<T>,
}

#[inline(always)]
fn backward_tile<S: Simd, T: Real, const D: usize>(
    simd: S,
    input: &CompositeInput<T>,
    composited: &Composited<T>,
    v: &CompositeCotangents<T>,
    grid: &Grid<T>,
    tile: usize,
    columns: Columns,
    scratch: &mut Scratch<T>,
    out: &mut [T],
) {
    let channels = columns.channels;
    let mut transmittance = [T::ZERO; TILE_PIXELS];
    let mut behind = [T::ZERO; TILE_PIXELS];
    scratch.v_colors.iter_mut().for_each(|c| c.fill(T::ZERO));
    let mut any = false;
    for (p, pixel) in input.tile_pixels(tile) {
        transmittance[p] = T::ONE;
        // Behind the last layer: the background, and the alpha, which is 1 - T.
        let v_alpha = v.alphas.map_or(0.0, |a| a[pixel].to_f64());
        any |= v_alpha != 0.0;
        let mut sum = -v_alpha;
        for (c, v_color) in scratch.v_colors.iter_mut().enumerate() {
            let v_c = v.image[pixel * channels + c];
            any |= v_c != T::ZERO;
            v_color[p] = v_c;
            sum += v_c.to_f64() * input.background.map_or(0.0, |b| b[c].to_f64());
        }
        behind[p] = T::from_f64(sum);
    }
    if !any {
        return; // the gradients are already zero
    }
    let list = input.tiles.tile(tile);
    let hits = &composited.hits[input.tiles.offsets[tile]..][..list.records.len()];
    let size = |hit: u16| hit.count_ones() as usize * kernel::LAYER;
    scratch
        .layers
        .resize(hits.iter().map(|&hit| size(hit)).sum(), T::ZERO);
    let mut rest = &mut scratch.layers[..];
    for (local, &hit) in list.records.iter().zip(hits) {
        let (layer, tail) = rest.split_at_mut(size(hit));
        rest = tail;
        kernel::replay(simd, grid, local, hit, &mut transmittance, layer);
    }
    let mut adjoint = Adjoint {
        behind: &mut behind,
        v_colors: &scratch.v_colors,
        geometry: columns.geometry,
        absolute: columns.absolute,
    };
    let mut rest = &scratch.layers[..];
    let colors = list.colors.chunks_exact(channels);
    for (((local, color), &hit), &place) in list
        .records
        .iter()
        .zip(colors)
        .zip(hits)
        .zip(list.places)
        .rev()
    {
        if hit != 0 {
            let (head, layers) = rest.split_at(rest.len() - size(hit));
            rest = head;
            let out = &mut out[place as usize * columns.row()..][..columns.row()];
            kernel::unblend::<S, T, D>(simd, grid, local, color, hit, layers, &mut adjoint, out);
        }
    }
}

/// Sum each Gaussian's pairs in tile order, and turn the moments into gradients.
fn gather<T: Real>(
    input: &CompositeInput<T>,
    pair_grads: &[T],
    columns: Columns,
    n: usize,
    geometry: Option<GeometryGrads<T>>,
    colors: Option<&mut [T]>,
) -> Result<(), Error> {
    let channels = columns.channels;
    let (mut means2d, mut whitened, mut opacities, mut absolute) = (None, None, None, None);
    if let Some(g) = geometry {
        check_len("v_means2d", g.means2d, 2 * n)?;
        check_len("v_whitened", g.whitened, 3 * n)?;
        check_len("v_opacities", g.opacities, n)?;
        (means2d, whitened, opacities, absolute) = (
            Some(g.means2d),
            Some(g.whitened),
            Some(g.opacities),
            g.absolute,
        );
    }
    if let Some(colors) = &colors {
        check_len("v_colors", colors, channels * n)?;
    }
    let chunks = &input.tiles.chunks;
    let jobs: Vec<_> = chunks
        .iter()
        .zip(rows(means2d, chunks, 2))
        .zip(rows(whitened, chunks, 3))
        .zip(rows(opacities, chunks, 1))
        .zip(rows(absolute, chunks, 2))
        .zip(rows(colors, chunks, channels))
        .collect();
    jobs.into_par_iter().for_each(
        |(((((chunk, mut means2d), mut whitened), mut opacities), mut absolute), mut colors)| {
            let mut sums = vec![0.0f64; columns.row()];
            let mut finish = |i: usize, sums: &[f64]| {
                let j = i - chunk.begin;
                let splat = &input.projection.splats[i];
                let write = |out: &mut Option<&mut [T]>, values: &[f64]| {
                    if let Some(out) = out {
                        for (o, v) in out[j * values.len()..].iter_mut().zip(values) {
                            *o = T::from_f64(*v);
                        }
                    }
                };
                write(&mut colors, &sums[columns.colors()..]);
                let [s, m, t] = splat.factors;
                // sigma = (u^2 + v^2) / 2 in standard deviations; the kernel's u and v are UNIT times that.
                let (wu, wv) = (sums[1] / UNIT, sums[2] / UNIT);
                write(&mut means2d, &[-s * wu, s * m * wu - t * wv]);
                // d sigma = -1/2 (y^T d cov y) with y = L (u, v)
                let k = -0.5 / (UNIT * UNIT);
                write(&mut whitened, &[k * sums[3], k * sums[4], k * sums[5]]);
                // sigma enters as opacity exp(-sigma)
                write(&mut opacities, &[-sums[0] / splat.opacity]);
                if columns.absolute {
                    write(
                        &mut absolute,
                        &[s * sums[MOMENTS] / UNIT, sums[MOMENTS + 1] / (UNIT * UNIT)],
                    );
                }
            };
            let mut current = None;
            chunk.pairs(input.tiles.columns, |i, position| {
                if let Some(last) = current.filter(|&last| last != i) {
                    finish(last, &sums);
                    sums.fill(0.0);
                }
                current = Some(i);
                let row = &pair_grads[position * columns.row()..][..columns.row()];
                sums.iter_mut().zip(row).for_each(|(s, g)| *s += g.to_f64());
            });
            if let Some(last) = current {
                finish(last, &sums);
            }
        },
    );
    Ok(())
}

/// Split an optional array of `row` numbers per Gaussian into the ranges of `chunks`.
fn rows<'a, T>(
    data: Option<&'a mut [T]>,
    chunks: &[Chunk],
    row: usize,
) -> Vec<Option<&'a mut [T]>> {
    match data {
        Some(d) => split(d, chunks.iter().map(|c| (c.end - c.begin) * row))
            .into_iter()
            .map(Some)
            .collect(),
        None => chunks.iter().map(|_| None).collect(),
    }
}

/// Gradient of the background: the sum of transmittance times cotangent, tile by tile in order.
fn background_vjp<T: Real>(
    input: &CompositeInput<T>,
    composited: &Composited<T>,
    v: &CompositeCotangents<T>,
    out: &mut [T],
) {
    let channels = input.channels();
    let parts: Vec<Vec<f64>> = composited
        .transmittance
        .par_chunks(TILE_PIXELS)
        .enumerate()
        .map(|(tile, t)| {
            let mut sums = vec![0.0; channels];
            for (p, pixel) in input.tile_pixels(tile) {
                for (c, sum) in sums.iter_mut().enumerate() {
                    *sum += t[p].to_f64() * v.image[pixel * channels + c].to_f64();
                }
            }
            sums
        })
        .collect();
    for (c, out) in out.iter_mut().enumerate() {
        *out = T::from_f64(parts.iter().map(|p| p[c]).sum());
    }
}
