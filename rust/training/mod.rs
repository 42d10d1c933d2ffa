//! What training needs beyond the image: losses on pictures with their gradients, and the optimizer.

pub mod adam;
pub mod jpeg_cells;
pub mod loss;
pub mod separable;
