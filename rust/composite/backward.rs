//! Vector-Jacobian product of compositing.

use super::{CompositeInput, Composited, for_alpha, for_vectors};
use crate::{
    constants::{BLOCK_PIXELS, TILE_BLOCKS, TILE_PIXELS},
    error::{Error, check_len},
    fresh::Fresh,
    kernel::{self, ABSOLUTE, Adjoint, Grid, LAYER, MOMENTS, Pixels, Sums, UNIT},
    project::Splat,
    real::{Lanes, Real},
    tiles::Chunk,
    tuning::EXP2_DEGREE,
    work::Work,
};
use fearless_simd::{Level, Simd, SimdBase, dispatch};
use rayon::prelude::*;
use std::hint::black_box;

/// Call a function for the number of channels: the common ones are compiled for it.
macro_rules! for_channels {
    ($channels:expr, $function:ident, $simd:expr, $types:ty, ($($argument:expr),*)) => {
        match $channels {
            3 => $function::<_, $types, 3>($simd, $($argument),*),
            4 => $function::<_, $types, 4>($simd, $($argument),*),
            _ => $function::<_, $types, 0>($simd, $($argument),*),
        }
    };
}

/// Cotangents of the compositor's outputs.
#[derive(Debug, Clone, Copy)]
pub struct CompositeCotangents<'a, T> {
    /// Of the image, [H, W, channels].
    pub image: &'a [T],
    /// Of the alphas, [H, W].
    pub alphas: Option<&'a [T]>,
}

/// Which gradients [`backward()`] is to compute.
#[derive(Debug, Clone, Copy, Default)]
pub struct Wanted {
    /// Those with respect to what the projection computed.
    pub geometry: bool,
    /// With them, the sums of the absolute gradients.
    pub absolute: bool,
    /// Of the colours.
    pub colors: bool,
    /// Of the background.
    pub background: bool,
}

/// Gradients of the compositor's inputs; empty where not wanted.
#[derive(Debug, Default)]
pub struct CompositeGrads<T> {
    /// Of `means2d`, [N, 2].
    pub means2d: Vec<T>,
    /// Whitened gradient of the 2D covariance, [N, 3]; see `geometry.rs`.
    pub whitened: Vec<T>,
    /// Of `opacities`, `[N]`.
    pub opacities: Vec<T>,
    /// Sum over the pixels of the absolute gradient of `means2d`, [N, 2].
    pub absolute: Vec<T>,
    /// Of `colors`, [N, channels].
    pub colors: Vec<T>,
    /// Of `background`, `[channels]`.
    pub background: Vec<T>,
    /// Counts.
    pub work: Work,
}

/// VJP of [`forward()`](super::forward()). Tiles and blocks whose pixels have no cotangent that is not 0 are left out.
///
/// # Errors
/// When the length of an array does not fit.
pub fn backward<T: Real>(
    input: &CompositeInput<T>,
    composited: &Composited<T>,
    v: &CompositeCotangents<T>,
    wanted: Wanted,
) -> Result<CompositeGrads<T>, Error> {
    input.check()?;
    let (channels, tiles) = (input.channels(), input.tiles);
    check_len("v_render_colors", v.image, input.pixels() * channels)?;
    if let Some(alphas) = v.alphas {
        check_len("v_render_alphas", alphas, input.pixels())?;
    }
    let background = if wanted.background {
        background_vjp(input, composited, v)
    } else {
        Vec::new()
    };
    let columns = Columns {
        absolute: wanted.geometry && wanted.absolute,
        channels,
    };
    if !wanted.geometry && !wanted.colors {
        return Ok(CompositeGrads {
            background,
            ..CompositeGrads::default()
        });
    }
    let grid = Grid::new();
    let level = Level::new();
    let degree = input.projection.tuning.exp2_degree;
    let (pair_grads, work): (Vec<_>, Vec<_>) = (0..tiles.lists.len())
        .into_par_iter()
        .map_init(
            || Scratch {
                v_colors: vec![[T::ZERO; TILE_PIXELS]; channels],
                layers: Vec::new(),
            },
            |scratch, tile| {
                dispatch!(level, simd => for_alpha!(
                    channels, degree, backward_tile, simd, T, (input, composited, v, &grid, tile, columns, scratch)
                ))
            },
        )
        .unzip();
    Ok(CompositeGrads {
        background,
        work: work.into_iter().fold(Work::default(), Work::plus),
        ..gather(input, &pair_grads, columns, wanted)
    })
}

/// Layout of one pair's gradients: moments, colours, absolute gradients.
#[derive(Debug, Clone, Copy)]
struct Columns {
    absolute: bool,
    channels: usize,
}

impl Columns {
    const fn row(self) -> usize {
        MOMENTS + self.channels + if self.absolute { ABSOLUTE } else { 0 }
    }
}

/// Buffers of one thread, reused from tile to tile.
struct Scratch<T> {
    /// Cotangents of a tile's pixels, by channel.
    v_colors: Vec<Pixels<T>>,
    /// What `kernel::unblend` stores.
    layers: Vec<T>,
}

/// Gradients of a tile's pairs, by index, and the work that they took; empty if all are zero.
#[inline(always)]
fn backward_tile<S: Simd, T: Real, const D: usize, const E: usize>(
    simd: S,
    input: &CompositeInput<T>,
    composited: &Composited<T>,
    v: &CompositeCotangents<T>,
    grid: &Grid<T>,
    tile: usize,
    columns: Columns,
    scratch: &mut Scratch<T>,
) -> (Vec<T>, Work) {
    let mut work = Work::default();
    let list = &input.tiles.lists[tile];
    if list.records.is_empty() {
        return (Vec::new(), work);
    }
    let channels = if D > 0 { D } else { columns.channels };
    let mut transmittance = [T::ZERO; TILE_PIXELS];
    let mut behind = [T::ZERO; TILE_PIXELS];
    scratch.v_colors.iter_mut().for_each(|c| c.fill(T::ZERO));
    // The blocks with a cotangent that is not 0: bit b for block b.
    let mut wanted = 0u16;
    for (p, pixel, n) in input.runs(tile) {
        transmittance[p..p + n].fill(T::ONE);
        let mut any = false;
        let image = &v.image[pixel * channels..(pixel + n) * channels];
        for (c, v_color) in scratch.v_colors[..channels].iter_mut().enumerate() {
            for (k, v_color) in v_color[p..p + n].iter_mut().enumerate() {
                *v_color = image[k * channels + c];
                any |= *v_color != T::ZERO;
            }
        }
        if input.background.is_some() || v.alphas.is_some() {
            // Behind the last layer: the background, and the alpha, which is 1 - T.
            for k in 0..n {
                let v_alpha = v.alphas.map_or(0.0, |a| a[pixel + k].to_f64());
                any |= v_alpha != 0.0;
                let mut sum = -v_alpha;
                for (v_color, b) in scratch.v_colors.iter().zip(input.background.unwrap_or(&[])) {
                    sum += v_color[p + k].to_f64() * b.to_f64();
                }
                behind[p + k] = T::from_f64(sum);
            }
        }
        wanted |= u16::from(any) << (p / BLOCK_PIXELS);
        work.alpha_cotangents += if v.alphas.is_some() { n as u64 } else { 0 };
    }
    // Block by block: what each layer contributes. Where there is no cotangent, that is 0.
    let mut depths = composited.depths[tile];
    for (block, depth) in depths.iter_mut().enumerate() {
        if wanted >> block & 1 == 0 {
            work.skipped_blocks += u64::from(std::mem::take(depth));
        }
    }
    let total: u32 = depths.iter().sum();
    work.backward_blocks = u64::from(total);
    if wanted == 0 {
        work.skipped_tiles = 1;
        return (Vec::new(), work);
    }
    work.backward_tiles = 1;
    list.fetch();
    if scratch.layers.len() < total as usize * LAYER {
        scratch.layers.resize(total as usize * LAYER, T::ZERO);
    }
    let mut next = [0; TILE_BLOCKS];
    let mut ends = [0; TILE_BLOCKS];
    let mut sum = 0;
    for block in 0..TILE_BLOCKS {
        let depth = depths[block] as usize;
        let mut layers = input.layers(tile, block);
        layers.list = &layers.list[..depth];
        let pixels = block * BLOCK_PIXELS..(block + 1) * BLOCK_PIXELS;
        let adjoint = Adjoint {
            transmittance: &transmittance[pixels.clone()],
            behind: &behind[pixels],
            v_colors: &scratch.v_colors,
        };
        let out = &mut scratch.layers[sum * LAYER..(sum + depth) * LAYER];
        for_vectors!(simd: S, T, D, E, unblend(grid, block, layers, &adjoint, out));
        next[block] = sum;
        sum += depth;
        ends[block] = sum;
    }
    // Gaussian by Gaussian: the sums over its blocks.
    let row = columns.row();
    let mut out = vec![T::ZERO; list.records.len() * row];
    for ((local, &mask), &place) in list.records.iter().zip(&list.masks).zip(&list.places) {
        let mut sums = Sums::<S, T>::new(simd, local);
        let out = &mut out[place as usize * row..(place as usize + 1) * row];
        let mut rest = mask;
        while rest != 0 {
            let block = rest.trailing_zeros() as usize % TILE_BLOCKS;
            rest &= rest - 1;
            let k = next[block];
            if k < ends[block] {
                next[block] = k + 1;
                let layer = &scratch.layers[k * LAYER..(k + 1) * LAYER];
                let v_colors = &scratch.v_colors;
                sums.add::<D>(simd, grid, block, layer, v_colors, columns.absolute, out);
            }
        }
        sums.finish::<D>(columns.absolute, out);
    }
    (out, work)
}

/// Sum each Gaussian's pairs in tile order, and turn the moments into gradients.
fn gather<T: Real>(
    input: &CompositeInput<T>,
    pair_grads: &[Vec<T>],
    columns: Columns,
    wanted: Wanted,
) -> CompositeGrads<T> {
    let chunks = &input.tiles.chunks;
    let channels = columns.channels;
    let rows = [
        (wanted.geometry, 2),
        (wanted.geometry, 3),
        (wanted.geometry, 1),
        (columns.absolute, ABSOLUTE),
        (wanted.colors, channels),
    ]
    .map(|(wanted, row)| if wanted { row } else { 0 });
    let n = input.projection.splats.len();
    let mut arrays = rows.map(|row| Fresh::new(row * n));
    let cut = |array, row| Fresh::cut(array, chunks.iter().map(|c| (c.end - c.begin) * row));
    let [means2d, whitened, opacities, absolute, colors] = &mut arrays;
    let jobs: Vec<_> = chunks
        .iter()
        .zip(cut(means2d, rows[0]))
        .zip(cut(whitened, rows[1]))
        .zip(cut(opacities, rows[2]))
        .zip(cut(absolute, rows[3]))
        .zip(cut(colors, rows[4]))
        .collect();
    let level = Level::new();
    jobs.into_par_iter().for_each(
        |(((((chunk, means2d), whitened), opacities), absolute), colors)| {
            let out = Gather {
                chunk,
                means2d: means2d.fill(T::ZERO),
                whitened: whitened.fill(T::ZERO),
                opacities: opacities.fill(T::ZERO),
                absolute: absolute.fill(T::ZERO),
                colors: colors.fill(T::ZERO),
            };
            dispatch!(level, simd => for_channels!(
                channels, gather_chunk, simd, T, (input, pair_grads, columns, out)
            ));
        },
    );
    let [means2d, whitened, opacities, absolute, colors] = arrays.map(Fresh::finish);
    CompositeGrads {
        means2d,
        whitened,
        opacities,
        absolute,
        colors,
        ..CompositeGrads::default()
    }
}

/// The outputs of one chunk: empty where not wanted, zeros before.
struct Gather<'a, T> {
    chunk: &'a Chunk,
    means2d: &'a mut [T],
    whitened: &'a mut [T],
    opacities: &'a mut [T],
    absolute: &'a mut [T],
    colors: &'a mut [T],
}

impl<T: Real> Gather<'_, T> {
    /// Write the gradients of Gaussian `i` from the sums over its pairs.
    #[inline(always)]
    fn write(
        &mut self,
        i: usize,
        splat: &Splat,
        moments: &[f64],
        colors: &[f64],
        absolute: &[f64],
    ) {
        let i = i - self.chunk.begin;
        write(self.colors, i, colors);
        let [s, m, t] = splat.factors;
        // sigma = (u^2 + v^2) / 2 in standard deviations; the kernel's u and v are UNIT times that.
        let (wu, wv) = (moments[1] / UNIT, moments[2] / UNIT);
        write(self.means2d, i, &[-s * wu, s * m * wu - t * wv]);
        // d sigma = -1/2 (y^T d cov y) with y = L (u, v)
        let k = -0.5 / (UNIT * UNIT);
        let whitened = [k * moments[3], k * moments[4], k * moments[5]];
        write(self.whitened, i, &whitened);
        // sigma enters as opacity exp(-sigma)
        write(self.opacities, i, &[-moments[0] / splat.opacity]);
        let absolute = [s * absolute[0] / UNIT, absolute[1] / (UNIT * UNIT)];
        write(self.absolute, i, &absolute);
    }
}

/// Row `i` of an output, if it is wanted.
#[inline(always)]
fn write<T: Real>(out: &mut [T], i: usize, values: &[f64]) {
    if !out.is_empty() {
        for (o, v) in out[i * values.len()..].iter_mut().zip(values) {
            *o = T::from_f64(*v);
        }
    }
}

/// Spans whose rows are looked up together.
const FETCH: usize = 64;

/// `gather` for one chunk of Gaussians.
#[inline(always)]
fn gather_chunk<S: Simd, T: Real, const D: usize>(
    _: S,
    input: &CompositeInput<T>,
    pair_grads: &[Vec<T>],
    columns: Columns,
    mut out: Gather<T>,
) {
    let channels = if D > 0 { D } else { columns.channels };
    let row = Columns {
        channels,
        ..columns
    }
    .row();
    let mut next = out.chunk.starts.clone();
    let zeros = vec![T::ZERO; row];
    let mut moments = [0.0; MOMENTS];
    let mut absolute = [0.0; ABSOLUTE];
    let mut colors = vec![0.0; channels];
    let mut current = None;
    let mut rows: Vec<&[T]> = Vec::new();
    for spans in out.chunk.spans.chunks(FETCH) {
        // A short loop that only looks the rows up: its many misses overlap.
        rows.clear();
        for span in spans {
            for tile in span.tiles(input.tiles.columns) {
                let place = next[tile] as usize;
                next[tile] += 1;
                let grads = pair_grads[tile]
                    .get(place * row..(place + 1) * row)
                    .unwrap_or(&zeros);
                black_box(grads[0]);
                black_box(grads[row - 1]);
                rows.push(grads);
            }
        }
        let mut rows = rows.iter();
        for span in spans {
            let i = span.gaussian as usize;
            if let Some(last) = current.filter(|&last| last != i) {
                let splat = &input.projection.splats[last];
                out.write(last, splat, &moments, &colors, &absolute);
                moments.fill(0.0);
                colors.fill(0.0);
                absolute.fill(0.0);
            }
            current = Some(i);
            for grads in rows.by_ref().take(span.tiles(input.tiles.columns).len()) {
                add(&mut moments, grads);
                add(&mut colors[..channels], &grads[MOMENTS..]);
                if columns.absolute {
                    add(&mut absolute, &grads[MOMENTS + channels..]);
                }
            }
        }
    }
    if let Some(last) = current {
        let splat = &input.projection.splats[last];
        out.write(last, splat, &moments, &colors, &absolute);
    }
}

#[inline(always)]
fn add<T: Real>(sums: &mut [f64], grads: &[T]) {
    let grads = &grads[..sums.len()];
    for (sum, grad) in sums.iter_mut().zip(grads) {
        *sum += grad.to_f64();
    }
}

/// Gradient of the background: the sum of transmittance times cotangent, tile by tile in order.
fn background_vjp<T: Real>(
    input: &CompositeInput<T>,
    composited: &Composited<T>,
    v: &CompositeCotangents<T>,
) -> Vec<T> {
    let channels = input.channels();
    let parts: Vec<Vec<f64>> = composited
        .transmittance
        .par_chunks(TILE_PIXELS)
        .enumerate()
        .map(|(tile, t)| {
            let mut sums = vec![0.0; channels];
            for (p, pixel, n) in input.runs(tile) {
                for k in 0..n {
                    for (c, sum) in sums.iter_mut().enumerate() {
                        *sum += t[p + k].to_f64() * v.image[(pixel + k) * channels + c].to_f64();
                    }
                }
            }
            sums
        })
        .collect();
    (0..channels)
        .map(|c| T::from_f64(parts.iter().map(|p| p[c]).sum()))
        .collect()
}
