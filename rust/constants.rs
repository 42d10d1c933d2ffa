//! Every constant of the rasterizer, with its reason. `docs/conventions.md` shows where each is used.

/// Smallest alpha that is blended: half of an 8-bit step would be 1/510; the field uses 1/255.
pub const ALPHA_MIN: f64 = 1.0 / 255.0;

/// Largest alpha: keeps `1 - alpha` away from 0, so that no layer hides everything behind it exactly.
pub const ALPHA_MAX: f64 = 0.99;

/// Compositing stops before the layer that would bring the transmittance to this value or below. The field
/// uses 1e-4, which is what two capped layers leave, (1 - 0.99)^2: rounding would decide about the second one.
pub const TRANSMITTANCE_MIN: f64 = 0.999e-4;

/// Default 2D low-pass filter, added to the diagonal of the projected covariance, px^2.
pub const EPS2D: f64 = 0.3;

/// Default near plane, scene units (gsplat's value).
pub const NEAR_PLANE: f64 = 0.01;

/// Default far plane, scene units (gsplat's value).
pub const FAR_PLANE: f64 = 1e10;

/// The Jacobian is evaluated at most this many half fields of view outside the image (1.3 x in total, as in
/// the original): beyond it the linearisation of the perspective division is useless.
pub const FOV_MARGIN: f64 = 0.3;

/// A quaternion whose squared norm is below this has no direction; the Gaussian is culled.
pub const QUAT_NORM2_MIN: f64 = 1e-12;

/// The conic's factors must be below this to be used in single precision without overflow of their squares.
pub const FACTOR_MAX: f64 = 1e15;

/// Side of a tile in pixels. Tiles are the unit of parallel work and of the depth-ordered lists.
pub const TILE: usize = 16;

/// Side of a block in pixels. Blocks are the unit of SIMD work: one block is one AVX-512 vector of f32.
pub const BLOCK: usize = 4;

/// Pixels per block.
pub const BLOCK_PIXELS: usize = BLOCK * BLOCK;

/// Blocks along one side of a tile.
pub const BLOCKS_PER_SIDE: usize = TILE / BLOCK;

/// Blocks per tile; a set of blocks is a `u16`.
pub const TILE_BLOCKS: usize = BLOCKS_PER_SIDE * BLOCKS_PER_SIDE;

/// Pixels per tile.
pub const TILE_PIXELS: usize = TILE * TILE;

/// Slack on the radius of the support, in standard deviations per unit of the conic's factors. The tests of
/// tiles and blocks must keep each pixel that the single-precision kernel would blend, so that the tile
/// size never changes a pixel. 16 px x 4 roundings x 2^-24 is 4e-6.
pub const SUPPORT_SLACK: f64 = 8e-6;

/// Gaussians per unit of parallel work in the projection. Fixed, so that sums over Gaussians (the gradient
/// of the camera) are added in the same order for any number of threads.
pub const PROJECT_CHUNK: usize = 1024;

/// Most bytes of the (Gaussian, tile) pairs of one view. How many pairs these are follows from the size of a pair.
pub const MAX_PAIR_BYTES: u64 = 24 << 30;

/// Most (Gaussian, tile) pairs of one view, however small: all could lie in one tile, whose blocks count in u32.
pub const MAX_PAIRS: u64 = u32::MAX as u64 / TILE_BLOCKS as u64;
