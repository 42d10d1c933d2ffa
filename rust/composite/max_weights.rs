//! The largest blending weight of each Gaussian: how much it matters to the pixel that it matters to most.
//!
//! The weight of a Gaussian in a pixel is its alpha times the transmittance in front of it, the factor of its
//! colour in the image. The kernel decides as the compositor does, and evaluates no colour.

use super::{
    CompositeInput, for_vectors,
    kernel::{Decision, Grid, Layers, STRIDE, load, width},
};
use crate::{
    constants::{BLOCK_PIXELS, TILE_BLOCKS, TILE_PIXELS},
    error::{Error, check_len},
    memory,
    simd::{Lanes, Real},
};
use fearless_simd::{Select, Simd, SimdBase, dispatch};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// The largest weight of each Gaussian over the pixels of an image, `[N]`; 0 for one that no pixel blends.
///
/// `mask` [H, W] is not 0 in the pixels that count; None: all of them. The tile lists need no channels, and the
/// background plays no part. A maximum is the same in any
/// order, so that the bits depend on no number of threads.
///
/// # Errors
/// When the length of the mask does not fit, or there is no memory for the weights.
pub fn max_weights<T: Real>(
    input: &CompositeInput<T>,
    mask: Option<&[u8]>,
) -> Result<Vec<T>, Error> {
    input.check()?;
    if let Some(mask) = mask {
        check_len("mask", mask, input.pixels())?;
    }
    let n = input.projection.splats.len();
    // The bits of a number that is not negative are ordered as the number is.
    let mut most = memory::with_capacity(n, "weights")?;
    let zeros = (0..n).into_par_iter().map(|_| AtomicU64::new(0));
    zeros.collect_into_vec(&mut most);
    let grid = Grid::new();
    let level = input.projection.level.token;
    (0..input.tiles.lists.len())
        .into_par_iter()
        .try_for_each_init(Vec::new, |lanes, tile| {
            dispatch!(level, simd => weigh_tile(simd, input, &grid, mask, tile, lanes, &most))
        })?;
    let mut weights = memory::with_capacity(n, "weights")?;
    most.into_par_iter()
        .map(|bits| T::from_f64(f64::from_bits(bits.into_inner())))
        .collect_into_vec(&mut weights);
    Ok(weights)
}

/// Raise `most` to the weights of one tile. `lanes` is a buffer.
#[inline(always)]
fn weigh_tile<S: Simd, T: Real>(
    simd: S,
    input: &CompositeInput<T>,
    grid: &Grid<T>,
    mask: Option<&[u8]>,
    tile: usize,
    lanes: &mut Vec<T>,
    most: &[AtomicU64],
) -> Result<(), Error> {
    let list = &input.tiles.lists[tile];
    if list.records.is_empty() {
        return Ok(());
    }
    // A pixel that does not count is finished before it begins, as one outside the image.
    let mut open = [T::ZERO; TILE_PIXELS];
    for (p, pixel, n) in input.runs(tile) {
        for k in 0..n {
            if mask.is_none_or(|mask| mask[pixel + k] != 0) {
                open[p + k] = T::ONE;
            }
        }
    }
    lanes.clear();
    let len = list.records.len() * width::<S, T>();
    memory::resize(lanes, len, T::ZERO, "weights")?;
    for block in 0..TILE_BLOCKS {
        let open = &open[block * BLOCK_PIXELS..(block + 1) * BLOCK_PIXELS];
        if open.iter().all(|x| *x == T::ZERO) {
            continue;
        }
        let layers = input.layers(list, block);
        for_vectors!(S, T, V => weigh::<S, T, V>(simd, grid, block, layers, open, lanes));
    }
    for (record, lanes) in list.records.iter().zip(lanes.chunks_exact(width::<S, T>())) {
        let mut weight = 0.0f64;
        for lane in lanes {
            weight = weight.max(lane.to_f64());
        }
        let most = &most[record.gaussian as usize];
        if weight.to_bits() > most.load(Ordering::Relaxed) {
            most.fetch_max(weight.to_bits(), Ordering::Relaxed);
        }
    }
    Ok(())
}

/// Raise `largest` to the weights of the layers in one block (V vectors): for each record of the tile as many
/// numbers as a vector has lanes, whose maximum is the record's. `transmittance` is 1 in the pixels that count,
/// 0 in the others.
#[inline(always)]
fn weigh<S: Simd, T: Real, const V: usize>(
    simd: S,
    grid: &Grid<T>,
    block: usize,
    layers: Layers<T>,
    transmittance: &[T],
    largest: &mut [T],
) {
    let pixels = grid.block::<S, V>(simd, block);
    let decision = Decision::new(simd, &layers);
    let zero = Lanes::<T, S>::splat(simd, T::ZERO);
    let mut open = load::<S, T, V>(simd, transmittance);
    for part in layers.list.chunks(STRIDE) {
        for &k in part {
            let [alpha] = layers.alphas(simd, &[k], pixels);
            let k = k as usize;
            let out = &mut largest[k * width::<S, T>()..(k + 1) * width::<S, T>()];
            let mut most = Lanes::<T, S>::from_slice(simd, out);
            for j in 0..V {
                let met = decision.meet(alpha[j], open[j]);
                most = most.max(met.blended.select(open[j] * alpha[j], zero));
                open[j] = met.open;
            }
            most.store_slice(out);
        }
        if decision.finished(&open) {
            break;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        project::{self, Projection, RenderOptions},
        scene::{Colors, synthetic::Synthetic},
        simd::{Level, at_each_level},
        tiles::{self, Tiles},
    };
    use rayon::ThreadPoolBuilder;

    fn binned<T: Real>(level: Level, s: &Synthetic<T>) -> (Projection, Tiles<T>) {
        let none = Colors::Channels(&[], 0);
        let options = RenderOptions {
            level: Some(level),
            ..RenderOptions::default()
        };
        let projected = project::forward(&s.gaussians(), none, &s.camera, &options).unwrap();
        let projection = projected.projection;
        let tiles = tiles::bin(&projection, &[], 0, &s.camera).unwrap();
        (projection, tiles)
    }

    fn weights<T: Real>(
        level: Level,
        s: &Synthetic<T>,
        mask: Option<&[u8]>,
    ) -> Result<Vec<T>, Error> {
        let (projection, tiles) = binned(level, s);
        let input = CompositeInput {
            projection: &projection,
            tiles: &tiles,
            camera: &s.camera,
            background: None,
        };
        max_weights(&input, mask)
    }

    /// By the definition: every Gaussian at every pixel, in depth order.
    fn brute_force(level: Level, s: &Synthetic<f64>, mask: Option<&[u8]>) -> Vec<f64> {
        let (projection, _) = binned(level, s);
        let mut order: Vec<usize> = (0..s.opacities.len())
            .filter(|&i| projection.splats[i].visible())
            .collect();
        order.sort_by(|&a, &b| projection.depths[a].total_cmp(&projection.depths[b]));
        let mut most = vec![0.0f64; s.opacities.len()];
        for pixel in 0..s.camera.width * s.camera.height {
            if mask.is_some_and(|mask| mask[pixel] == 0) {
                continue;
            }
            let (x, y) = (pixel % s.camera.width, pixel / s.camera.width);
            let mut t = 1.0;
            for &i in &order {
                let alpha = projection.splats[i].alpha(x as f64 + 0.5, y as f64 + 0.5);
                if alpha < 1.0 / 255.0 {
                    continue;
                }
                if t * (1.0 - alpha) <= 0.999e-4 {
                    break;
                }
                most[i] = most[i].max(t * alpha);
                t *= 1.0 - alpha;
            }
        }
        most
    }

    #[test]
    fn weights_follow_the_definition() {
        at_each_level(check_weights);
    }

    fn check_weights(level: Level) {
        for (seed, width, height) in [(1, 70, 45), (2, 16, 16), (3, 1, 37), (4, 129, 5)] {
            let s = Synthetic::<f64>::new(800, width, height, seed).unwrap();
            let some: Vec<u8> = (0..width * height)
                .map(|i| [255, 0, 0][i * 7 % 11 / 4])
                .collect();
            for mask in [None, Some(&some[..])] {
                let expected = brute_force(level, &s, mask);
                assert!(expected.iter().any(|w| *w > 0.1));
                for (i, (a, b)) in weights(level, &s, mask)
                    .unwrap()
                    .iter()
                    .zip(&expected)
                    .enumerate()
                {
                    assert!((a - b).abs() < 1e-13, "seed {seed}, {i}: {a}, not {b}");
                }
            }
        }
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        let s = Synthetic::<f32>::new(5000, 150, 97, 1).unwrap();
        let run = |level, threads| {
            let pool = ThreadPoolBuilder::new().num_threads(threads);
            pool.build()
                .unwrap()
                .install(|| weights(level, &s, None).unwrap())
        };
        at_each_level(|level| {
            let one = run(level, 1);
            for threads in [2, 3, 7] {
                assert!(run(level, threads) == one, "{threads} threads");
            }
        });
    }

    #[test]
    fn no_gaussians_and_no_pixels_that_count() {
        at_each_level(check_nothing);
    }

    fn check_nothing(level: Level) {
        let empty = Synthetic::<f32>::new(0, 20, 20, 1).unwrap();
        assert!(weights(level, &empty, None).unwrap().is_empty());
        let s = Synthetic::<f32>::new(50, 20, 20, 1).unwrap();
        let none = weights(level, &s, Some(&[0; 400])).unwrap();
        assert!(none.len() == 50 && none.iter().all(|w| *w == 0.0));
        let error = weights(level, &s, Some(&[1; 399])).unwrap_err();
        assert_eq!(error.name(), "mask");
    }
}
