//! What training needs beyond the image: losses on pictures with their gradients, and the optimizer.

pub mod adam;
pub(crate) mod exposure;
pub(crate) mod jpeg_cells;
pub mod loss;
pub(crate) mod rows;
pub(crate) mod separable;
