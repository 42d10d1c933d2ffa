//! What comes in: Gaussians, cameras, and seeded scenes for tests and benchmarks.

mod camera;
mod gaussians;
pub(crate) mod synthetic;

pub use camera::{Camera, CameraGrad};
pub use gaussians::{Colors, Gaussians, Harmonics};
