//! Counts of the work that was done, for reports and tests.
//!
//! They are by-products, always on: a few additions for each tile and group of Gaussians, and in the forward pass of
//! compositing for each layer of a block, where they take 2 to 4 % of its kernel.

macro_rules! counts {
    ($($(#[$doc:meta])* $name:ident,)*) => {
        /// The work of one or more stages; each stage fills in its own counts.
        #[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
        pub struct Counts {
            $($(#[$doc])* pub $name: u64,)*
        }

        impl Counts {
            /// The sum.
            #[must_use]
            pub fn plus(self, other: Self) -> Self {
                Self { $($name: self.$name + other.$name,)* }
            }

            /// All counts with their names.
            pub fn entries(&self) -> impl Iterator<Item = (&'static str, u64)> {
                [$((stringify!($name), self.$name),)*].into_iter()
            }
        }
    };
}

counts! {
    /// Gaussians that the projection was given, for each camera.
    gaussians,
    /// Those of them that it kept.
    projected,
    /// Spherical harmonics that were evaluated: (degree + 1)^2 for each Gaussian of a group with a kept one.
    harmonics,
    /// Gaussians of these groups whose colours' slopes were kept for the backward pass.
    slopes,
    /// Tiles with Gaussians.
    tiles,
    /// Channels composited, for each camera.
    channels,
    /// (Gaussian, tile) pairs.
    pairs,
    /// (Gaussian, block) pairs evaluated by the forward pass.
    blocks,
    /// Those in which a pixel changed.
    changed_blocks,
    /// (Gaussian, pixel) pairs that were blended.
    blended,
    /// Tiles with Gaussians that the backward pass replayed.
    backward_tiles,
    /// Those that it left out, because all cotangents of their pixels are 0.
    skipped_tiles,
    /// (Gaussian, block) pairs that the backward pass evaluated.
    backward_blocks,
    /// Those that it left out, because all cotangents of the block's pixels are 0.
    skipped_blocks,
    /// Pixels of tiles with Gaussians whose cotangent of alpha was read.
    alpha_cotangents,
    /// Gaussians that went through the VJP of the projection's geometry.
    backward_gaussians,
    /// Spherical harmonics that were differentiated.
    backward_harmonics,
}
