//! What comes in: Gaussians, cameras, and seeded scenes for tests and benchmarks.

pub(crate) mod camera;
mod gaussians;
pub(crate) mod synthetic;

pub use camera::Camera;
pub(crate) use camera::CameraGrad;
pub use gaussians::{Colors, Gaussians, Harmonics};
