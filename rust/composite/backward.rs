//! Vector-Jacobian product of compositing.

use super::{
    CompositeInput, Composited, TOGETHER, for_channels, for_count,
    gather::{PairLayout, gather},
    kernel::{self, Adjoint, Grid, Layer, Pixels, Sums},
};
use crate::{
    constants::{BLOCK, BLOCK_PIXELS, TILE_BLOCKS, TILE_PIXELS},
    error::{Error, check_len},
    memory::{self, OfThreads},
    simd::{Real, groups::Column, sums},
    tiles::List,
    uninit::prefetch_all,
};
use fearless_simd::{Simd, dispatch};
use rayon::prelude::*;

/// What an error calls the buffers of this file.
const NAME: &str = "gradients";

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
}

/// VJP of [`forward()`](super::forward()). Tiles and blocks whose pixels have no cotangent that is not 0 are left
/// out. The input is that of `forward`, which made `composited`.
///
/// # Errors
/// When the length of an array does not fit.
pub fn backward<T: Real>(
    input: &CompositeInput<T>,
    composited: &Composited<T>,
    v: &CompositeCotangents<T>,
    wanted: Wanted,
) -> Result<CompositeGrads<T>, Error> {
    let (channels, tiles) = (input.channels(), input.tiles);
    check_len("v.image", v.image, input.pixels() * channels)?;
    if let Some(background) = input.background {
        check_len("background", background, channels)?;
    }
    if let Some(alphas) = v.alphas {
        check_len("v.alphas", alphas, input.pixels())?;
    }
    let background = if wanted.background {
        background_vjp(input, composited, v)?
    } else {
        Vec::new()
    };
    let layout = PairLayout {
        absolute: wanted.geometry && wanted.absolute,
        channels,
    };
    if !wanted.geometry && !wanted.colors {
        return Ok(CompositeGrads {
            background,
            ..CompositeGrads::default()
        });
    }
    let (grid, scratch) = (Grid::new(), OfThreads::<Scratch<T>>::default());
    let count = tiles.lists.len();
    let mut pair_grads = memory::filled(Vec::new(), count, NAME)?;
    pair_grads
        .par_iter_mut()
        .enumerate()
        .with_max_len(TOGETHER)
        .try_for_each(|(tile, grads)| -> Result<(), Error> {
            *grads = scratch.with(|scratch| {
                backward_tile(input, composited, v, &grid, tile, layout, scratch)
            })?;
            Ok(())
        })?;
    let gradients = gather(input, &pair_grads, layout, wanted)?;
    pair_grads.into_par_iter().for_each(drop); // to free them takes a while, too
    Ok(CompositeGrads {
        background,
        ..gradients
    })
}

/// Buffers of one thread, reused from tile to tile.
#[derive(Default)]
struct Scratch<T: Real> {
    adjoint: Adjoint<T>,
    /// What `kernel::replay` stores.
    layers: Vec<Layer<T>>,
}

/// Gradients of a tile's pairs, by index; empty if all are zero. Each of the three steps
/// is compiled by itself: together they are too much for what the compiler keeps in registers.
fn backward_tile<T: Real>(
    input: &CompositeInput<T>,
    composited: &Composited<T>,
    v: &CompositeCotangents<T>,
    grid: &Grid<T>,
    tile: usize,
    layout: PairLayout,
    scratch: &mut Scratch<T>,
) -> Result<Vec<T>, Error> {
    let list = &input.tiles.lists[tile];
    if list.records.is_empty() {
        return Ok(Vec::new());
    }
    let (channels, level) = (layout.channels, input.projection.level.token);
    let Scratch { adjoint, layers } = scratch;
    adjoint.make_room(channels)?;
    let wanted = dispatch!(level, simd => for_channels!(
        channels, read_cotangents, simd, T, (input, v, tile, adjoint)
    ));
    // What the layers of a block without a cotangent contribute is 0.
    let mut depths = composited.depths[tile];
    for (block, depth) in depths.iter_mut().enumerate() {
        if wanted >> block & 1 == 0 {
            *depth = 0;
        }
    }
    if wanted == 0 {
        return Ok(Vec::new());
    }
    if let Some(next) = input.tiles.lists.get(tile + 1) {
        next.prefetch();
        for (_, pixel, n) in input.runs(tile + 1) {
            prefetch_all(&v.image[pixel * channels..(pixel + n) * channels]);
        }
    }
    let begins = dispatch!(level, simd => replay_blocks::<_, T>(
        simd, input, grid, tile, &depths, adjoint, layers
    ))?;
    let replayed = Replayed {
        list,
        grid,
        layout,
        begins,
        adjoint,
        layers,
    };
    dispatch!(level, simd => for_channels!(channels, unblend_tile, simd, T, (&replayed)))
}

/// Fill `adjoint` with the cotangents of a tile. Returns the blocks with one that is not 0: bit b for block b.
#[inline(always)]
fn read_cotangents<S: Simd, T: Real, const D: usize>(
    simd: S,
    input: &CompositeInput<T>,
    v: &CompositeCotangents<T>,
    tile: usize,
    adjoint: &mut Adjoint<T>,
) -> u16 {
    let channels = if D > 0 { D } else { input.channels() };
    adjoint.clear();
    let mut wanted = 0u16;
    for (p, pixel, n) in input.runs(tile) {
        adjoint.transmittance[p..p + n].fill(T::ONE);
        let image = &v.image[pixel * channels..(pixel + n) * channels];
        let v_colors = &mut adjoint.v_colors[..channels];
        if n == BLOCK {
            // Most are whole: all of their pixels at once.
            read_run::<T, D>(p, &image[..BLOCK * channels], v_colors);
        } else {
            read_run::<T, D>(p, image, v_colors);
        }
        if input.background.is_some() || v.alphas.is_some() {
            // Behind the last layer: the background, and the alpha, which is 1 - T.
            let mut sums = [-0.0; BLOCK]; // adds nothing to any number
            if let Some(alphas) = v.alphas {
                for (sum, v_alpha) in sums.iter_mut().zip(&alphas[pixel..pixel + n]) {
                    *sum = -v_alpha.to_f64();
                    wanted |= u16::from(*v_alpha != T::ZERO) << (p / BLOCK_PIXELS);
                }
            }
            for (v_color, b) in v_colors.iter().zip(input.background.unwrap_or(&[])) {
                for (sum, v) in sums.iter_mut().zip(&v_color[p..p + BLOCK]) {
                    *sum += v.to_f64() * b.to_f64();
                }
            }
            for (behind, sum) in adjoint.behind[p..p + n].iter_mut().zip(sums) {
                *behind = T::from_f64(sum);
            }
        }
    }
    for block in 0..TILE_BLOCKS {
        let any = for_count!(kernel::vectors::<S, T>(), V => kernel::any_nonzero::<S, T, V>(simd, block, &adjoint.v_colors[..channels]));
        wanted |= u16::from(any) << block;
    }
    wanted
}

/// Cotangents of neighbouring pixels, from `p` on in block order.
#[inline(always)]
fn read_run<T: Real, const D: usize>(p: usize, image: &[T], v_colors: &mut [Pixels<T>]) {
    let channels = if D > 0 { D } else { v_colors.len() };
    let n = image.len() / channels.max(1);
    for (c, v_color) in v_colors[..channels].iter_mut().enumerate() {
        for (k, v_color) in v_color[p..p + n].iter_mut().enumerate() {
            *v_color = image[k * channels + c];
        }
    }
}

/// Block by block its first `depths` layers once more, one after the other in `layers`. Returns the begin of each
/// block there, and the end.
#[inline(always)]
fn replay_blocks<S: Simd, T: Real>(
    simd: S,
    input: &CompositeInput<T>,
    grid: &Grid<T>,
    tile: usize,
    depths: &[u32; TILE_BLOCKS],
    adjoint: &Adjoint<T>,
    layers: &mut Vec<Layer<T>>,
) -> Result<[usize; TILE_BLOCKS + 1], Error> {
    let total = depths.iter().sum::<u32>() as usize;
    if layers.len() < total {
        memory::resize(layers, total, [Column::ZERO; 2], NAME)?;
    }
    let list = &input.tiles.lists[tile];
    let mut begins = [0; TILE_BLOCKS + 1];
    for block in 0..TILE_BLOCKS {
        let (begin, depth) = (begins[block], depths[block] as usize);
        let end = begin + depth;
        let mut seen = input.layers(list, block);
        seen.list = &seen.list[..depth];
        let out = &mut layers[begin..end];
        for_count!(kernel::vectors::<S, T>(), V => kernel::replay::<S, T, V>(simd, grid, block, seen, adjoint, out));
        begins[block + 1] = end;
    }
    Ok(begins)
}

/// In whole cache lines: no vector lies in two.
#[repr(C, align(64))]
struct Lines<A>(A);

/// A tile whose blocks have been replayed.
struct Replayed<'a, T: Real> {
    list: &'a List<T>,
    grid: &'a Grid<T>,
    layout: PairLayout,
    /// Begin of each block in `layers`, and the end.
    begins: [usize; TILE_BLOCKS + 1],
    adjoint: &'a Adjoint<T>,
    layers: &'a [Layer<T>],
}

#[inline(always)]
fn unblend_tile<S: Simd, T: Real, const D: usize>(
    simd: S,
    tile: &Replayed<T>,
) -> Result<Vec<T>, Error> {
    for_count!(sums::parts::<S, T>(), P => unblend::<S, T, D, P>(simd, tile))
}

/// Gaussian by Gaussian, back to front, the sums over its blocks.
#[inline(always)]
fn unblend<S: Simd, T: Real, const D: usize, const P: usize>(
    simd: S,
    tile: &Replayed<T>,
) -> Result<Vec<T>, Error> {
    let &Replayed {
        list,
        grid,
        layout,
        ref begins,
        adjoint,
        layers,
    } = tile;
    let channels = if D > 0 { D } else { layout.channels };
    // Copies, which the compiler knows to lie apart from everything else.
    let mut behind = Lines(adjoint.behind);
    let mut v_colors = Lines([[T::ZERO; TILE_PIXELS]; D]);
    for (v_color, from) in v_colors.0.iter_mut().zip(&adjoint.v_colors) {
        *v_color = *from;
    }
    // Of each block the layers in front, of which the last ones may not have been reached.
    let mut left = [0; TILE_BLOCKS];
    for (left, ends) in left.iter_mut().zip(list.begins.windows(2)) {
        *left = (ends[1] - ends[0]) as usize;
    }
    let row = layout.row();
    let mut out = memory::filled(T::ZERO, list.records.len() * row, NAME)?;
    let pairs = list.records.iter().zip(&list.masks).zip(&list.places);
    for (k, ((record, &mask), &place)) in pairs.enumerate().rev() {
        let color = &list.colors[k * channels..(k + 1) * channels];
        let mut sums = Sums::<S, T, P>::new(simd, record, color);
        let out = &mut out[place as usize * row..(place as usize + 1) * row];
        let mut rest = mask;
        while rest != 0 {
            let block = rest.trailing_zeros() as usize % TILE_BLOCKS;
            rest &= rest - 1;
            left[block] -= 1;
            let k = begins[block] + left[block];
            if k < begins[block + 1] {
                let layer = &layers[k];
                let many = (color, &adjoint.v_colors[..]);
                sums.add::<D>(
                    simd,
                    grid,
                    block,
                    layer,
                    &mut behind.0,
                    &v_colors.0,
                    many,
                    layout.absolute,
                    out,
                );
            }
        }
        sums.finish::<D>(layout.absolute, out);
    }
    Ok(out)
}

/// Gradient of the background: the sum of transmittance times cotangent, tile by tile in order.
fn background_vjp<T: Real>(
    input: &CompositeInput<T>,
    composited: &Composited<T>,
    v: &CompositeCotangents<T>,
) -> Result<Vec<T>, Error> {
    let channels = input.channels();
    let mut parts = memory::filled(0.0, channels * input.tiles.lists.len(), NAME)?;
    composited
        .transmittance
        .par_chunks(TILE_PIXELS)
        .zip(parts.par_chunks_mut(channels.max(1)))
        .enumerate()
        .for_each(|(tile, (t, sums))| {
            for (p, pixel, n) in input.runs(tile) {
                for k in 0..n {
                    for (c, sum) in sums.iter_mut().enumerate() {
                        *sum += t[p + k].to_f64() * v.image[(pixel + k) * channels + c].to_f64();
                    }
                }
            }
        });
    let sum = |c: usize| parts.iter().skip(c).step_by(channels).sum();
    Ok((0..channels).map(|c| T::from_f64(sum(c))).collect())
}
