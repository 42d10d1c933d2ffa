//! Front-to-back compositing of binned splats, forward and VJP, tile by tile in parallel.

mod backward;
mod forward;
mod gather;
mod kernel;
mod picture;

pub use backward::{CompositeCotangents, CompositeGrads, Wanted, backward};
pub use forward::{Image, forward};
pub use picture::picture;

use crate::{
    constants::{BLOCK, TILE, TILE_BLOCKS, TILE_PIXELS},
    project::Projection,
    scene::Camera,
    simd::Real,
    tiles::{List, Tiles},
};
use kernel::Layers;

/// Everything that both passes read.
#[derive(Debug, Clone, Copy)]
pub struct CompositeInput<'a, T> {
    /// Projected Gaussians.
    pub projection: &'a Projection,
    /// Their tile lists.
    pub tiles: &'a Tiles<T>,
    /// Image size.
    pub camera: &'a Camera,
    /// Colour behind everything, `[channels]`.
    pub background: Option<&'a [T]>,
}

impl<T: Real> CompositeInput<'_, T> {
    fn channels(&self) -> usize {
        self.tiles.channels
    }

    fn pixels(&self) -> usize {
        self.camera.width * self.camera.height
    }

    /// What reaches one block of the tile of this list.
    fn layers<'a>(&'a self, list: &'a List<T>, block: usize) -> Layers<'a, T> {
        Layers {
            list: &list.blocks[list.begins[block] as usize..list.begins[block + 1] as usize],
            records: &list.records,
            colors: &list.colors,
            background: self.background,
            channels: self.channels(),
            floor: T::from_f64(self.projection.knobs.alpha_min),
            least: T::from_f64(self.projection.knobs.transmittance_min),
        }
    }

    /// The image's pixels in tile `tile`, up to four neighbours at a time: (index in block order, index in
    /// the image, number).
    #[inline(always)]
    fn runs(&self, tile: usize) -> impl Iterator<Item = (usize, usize, usize)> + use<T> {
        let (top, left) = (
            tile / self.tiles.tiles_x * TILE,
            tile % self.tiles.tiles_x * TILE,
        );
        let (width, height) = (self.camera.width, self.camera.height);
        (0..TILE_PIXELS).step_by(BLOCK).filter_map(move |p| {
            let (row, column) = kernel::position(p);
            let (y, x) = (top + row, left + column);
            (y < height && x < width).then(|| (p, y * width + x, BLOCK.min(width - x)))
        })
    }
}

/// What the backward pass replays.
#[derive(Debug, Default)]
pub struct Composited<T> {
    /// For each block of each tile how many of its layers were evaluated before it was finished.
    depths: Vec<[u32; TILE_BLOCKS]>,
    /// Transmittance after the last layer, tile by tile in block order.
    transmittance: Vec<T>,
}

/// The work of the forward pass: (Gaussian, tile) pairs, (Gaussian, block) pairs that were evaluated.
pub type Work = [u64; 2];

/// The sum of two.
pub fn plus(a: Work, b: Work) -> Work {
    std::array::from_fn(|k| a[k] + b[k])
}

/// Tiles that a thread takes at most at a time: what it has begun waits when its core is given to another process, and
/// at the end of the image for nobody else to help. 16 of them take 0.1 to 1 ms.
const TOGETHER: usize = 16;

/// Call a function for the number of channels, of which the common ones are compiled.
macro_rules! for_channels {
    ($channels:expr, $function:ident, $simd:expr, $T:ty, ($($argument:expr),*)) => {
        match $channels {
            3 => $function::<_, $T, 3>($simd, $($argument),*),
            4 => $function::<_, $T, 4>($simd, $($argument),*),
            _ => $function::<_, $T, 0>($simd, $($argument),*),
        }
    };
}

/// Call a kernel with a constant: 1, 2, 4 or 8, as `$count` has it.
///
/// The types decide in a constant of its own, so that the compiler never sees what no call reaches: each kernel costs it
/// seconds.
macro_rules! for_count {
    ($count:expr, $N:ident => $call:expr) => {
        match const { $count } {
            1 => for_count!(@ $N = 1, $call),
            2 => for_count!(@ $N = 2, $call),
            4 => for_count!(@ $N = 4, $call),
            8 => for_count!(@ $N = 8, $call),
            _ => unreachable!("vectors have 2 to 16 lanes"),
        }
    };
    (@ $N:ident = $count:literal, $call:expr) => {{
        const $N: usize = $count;
        $call
    }};
}

use {for_channels, for_count};
