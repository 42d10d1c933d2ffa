//! What comes in: Gaussians and cameras.

pub(crate) mod camera;
mod gaussians;
#[cfg(test)]
#[path = "../benches/synthetic.rs"]
pub(crate) mod synthetic;

pub use camera::Camera;
pub(crate) use camera::CameraGrad;
pub use gaussians::{Colors, Gaussians, Harmonics};

#[cfg(test)]
mod tests;
