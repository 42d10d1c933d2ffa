//! What training of 3D Gaussian Splatting needs beside the rasterizer [`hqgs`].
//!
//! For any training: [`loss`], the usual loss on pictures with its gradient, and [`adam`]. How photos come about, each
//! with its gradient: [`exposure`] is a camera that moves while its shutter is open, [`separable`] blurs and shrinks,
//! [`jpeg_cells`] knows what a compressed file leaves open. [`views`] adds the gradients of several views,
//! [`growth`] gathers what densification goes by, and [`stereo`] finds where photos agree on a surface, for points to start from.
//!
//! Arrays are row-major slices, results the same bits for any number of threads, which are those of rayon's current
//! pool. `examples/fit_image.rs` fits Gaussians to a picture.

pub mod adam;
pub mod exposure;
pub mod growth;
pub mod jpeg_cells;
pub mod loss;
pub mod separable;
pub mod stereo;
pub mod views;

/// Run a test at each level of this CPU; what it prints tells at which one it failed.
#[cfg(test)]
fn at_each_level(test: impl Fn(hqgs::Level)) {
    for level in hqgs::levels() {
        println!("{}", level.name());
        test(level);
    }
}

/// Numbers in [0, 1) for the tests of what works on plain arrays.
#[cfg(test)]
fn noise(seed: u64, n: usize) -> Vec<f64> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let next = |_| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f64 / (1u64 << 24) as f64
    };
    (0..n).map(next).collect()
}
