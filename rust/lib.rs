//! A CPU rasterizer for 3D Gaussian Splatting. Modules in pipeline order.
