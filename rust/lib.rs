//! A fast, deterministic CPU rasterizer for 3D Gaussian Splatting, with exact gradients.
//!
//! The modules in the order of the pipeline:
//!
//! 1. [`scene`]: Gaussians and cameras, what comes in;
//! 2. [`project`]: Gaussians become splats, their harmonics colours;
//! 3. [`tiles`]: splats are sorted into the tiles that they reach, front to back;
//! 4. [`composite`]: the splats of each tile are blended into pixels;
//! 5. [`training`]: the loss of the picture, and the step of the optimizer.
//!
//! [`render`] is the whole way of one image, there and back. Each stage has its forward function and its
//! vector-Jacobian product side by side, works on borrowed slices in f32 or f64, and gives the same bits for any
//! number of threads.

pub mod composite;
pub mod project;
pub mod render;
pub mod scene;
pub mod tiles;
pub mod training;

pub mod accuracy_knobs;
pub mod constants;
pub mod counts;
pub mod error;
mod memory;
pub mod simd;
pub mod threads;
mod uninit;

pub use error::Error;
