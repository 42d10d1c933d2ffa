//! A fast, deterministic CPU rasterizer for 3D Gaussian Splatting, with exact gradients.
//!
//! [`render::forward`] renders [`scene::Gaussians`] into a [`scene::Camera`], with colours from spherical harmonics
//! or as any number of channels. [`render::backward`] gives the gradients of a loss with respect to each of the
//! inputs, the camera's pose included. Arrays are row-major slices of f32 or f64; the bits of the results depend on no
//! number of threads. The threads are those of rayon's current pool.
//!
//! ```
//! use hqgs::{render, scene};
//!
//! # fn main() -> Result<(), hqgs::Error> {
//! let camera = scene::Camera::at_origin(30.0, 32, 24)?;
//! // One red Gaussian in front of it, a little to the right.
//! let gaussians = scene::Gaussians::<f32> {
//!     means: &[0.1, 0.0, 4.0],
//!     quats: &[1.0, 0.0, 0.0, 0.0],
//!     scales: &[0.4, 0.4, 0.4],
//!     opacities: &[0.8],
//! };
//! let red = scene::Colors::Channels(&[1.0, 0.0, 0.0], 3);
//! let white = [1.0; 3];
//! let rendered = render::forward(gaussians, red, Some(&white), &camera, &Default::default())?;
//! let pixel = 12 * 32 + 16;
//! assert!(rendered.alphas[pixel] > 0.7);
//! assert!(rendered.image[3 * pixel] > 0.99 && rendered.image[3 * pixel + 1] < 0.3);
//!
//! // The gradient of this pixel's green: less of it with a larger opacity, and with a Gaussian more to the left.
//! let mut v_image = vec![0.0; rendered.image.len()];
//! v_image[3 * pixel + 1] = 1.0;
//! let v = render::Cotangents { image: &v_image, alphas: None };
//! let gradients = render::backward(&rendered, &v, render::Wanted::ALL)?;
//! assert!(gradients.opacities[0] < -0.9);
//! assert!(gradients.means[0] > 0.0);
//! # Ok(())
//! # }
//! ```
//!
//! The crate `hqgs-training` has the usual loss on pictures and Adam; its example `fit_image` fits Gaussians to a
//! picture.
//!
//! # The pipeline
//! The modules in its order, of which a caller needs the first and the last:
//!
//! 1. [`scene`]: Gaussians and cameras, what comes in;
//! 2. `project`: Gaussians become splats, their harmonics colours;
//! 3. `tiles`: splats are sorted into the tiles that they reach, front to back;
//! 4. `composite`: the splats of each tile are blended into pixels.
//!
//! [`render`] is the whole way of one image, there and back. Each stage has its forward function and its
//! vector-Jacobian product side by side.
//!
//! The stages are for the crate `hqgs-training`, the Python binding and the benchmarks, which need them one by one: they are in `internals`,
//! which is not documented and may change in any version.

mod composite;
mod project;
pub mod render;
pub mod scene;
mod tiles;

mod accuracy_knobs;
mod constants;
mod error;
mod memory;
mod simd;
mod uninit;

pub use error::Error;
pub use simd::{Level, Real, level, levels};

/// The stages, for the other crates, the benchmarks and the tests of this repository alone.
#[doc(hidden)]
pub mod internals {
    pub use crate::{Error, error::check_len};

    macro_rules! expose {
        ($($module:ident),*) => { $(pub mod $module { pub use crate::$module::*; })* };
    }
    expose!(
        accuracy_knobs,
        composite,
        constants,
        memory,
        project,
        simd,
        tiles,
        uninit
    );

    pub mod scene {
        pub use crate::scene::{camera::CameraGrad, *};
    }
}
