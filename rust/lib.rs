//! A fast, deterministic CPU rasterizer for 3D Gaussian Splatting, with exact gradients.
//!
//! Modules in pipeline order: [`scene`] and [`camera`] describe the input, [`project`] turns Gaussians into
//! splats ([`sh`] gives their colours), [`tiles`] orders them and bins them, [`composite`] blends them.
//! Each stage has its forward function and its vector-Jacobian product side by side, works on borrowed
//! slices in f32 or f64, and gives the same bits for any number of threads.

pub mod adam;
pub mod camera;
pub mod cells;
mod columns;
pub mod composite;
pub mod constants;
pub mod error;
mod fresh;
mod geometry;
mod kernel;
mod lanes;
pub mod loss;
pub mod project;
#[cfg(feature = "python")]
mod python;
pub mod real;
pub mod render;
pub mod scene;
pub mod separable;
pub mod sh;
pub mod synthetic;
pub mod threads;
pub mod tiles;
pub mod tuning;
pub mod weights;
pub mod work;

pub use error::Error;
