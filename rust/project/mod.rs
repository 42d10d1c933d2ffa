//! Projection of all Gaussians into one camera, forward and VJP: geometry, culling, spherical harmonics.

mod backward;
mod camera_lanes;
mod colors;
mod forward;
mod geometry;
pub mod sh;
mod splats;

pub use backward::{COTANGENTS, GaussianGrads, ProjectCotangents, Wanted, backward};
pub use colors::Shading;
pub use forward::{Projected, forward};

use crate::{
    accuracy_knobs::AccuracyKnobs,
    constants::{EPS2D, FAR_PLANE, NEAR_PLANE},
    error::Error,
    scene::Gaussians,
    simd::{
        Level, Real, Wide,
        groups::{self, Column, GROUP, wide3},
        lanes,
        math::exp,
        splat,
    },
};
use camera_lanes::CameraLanes;
use fearless_simd::{Simd, SimdBase};
use geometry::Geometry;

/// Options of the projection; the defaults are gsplat's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RenderOptions {
    /// Gaussians nearer than this are culled.
    pub near_plane: f64,
    /// Gaussians farther than this are culled.
    pub far_plane: f64,
    /// Gaussians whose two radii are at most this many pixels are culled.
    pub radius_clip: f64,
    /// Low-pass filter, px^2.
    pub eps2d: f64,
    /// Scale the opacity so that the low-pass does not brighten small Gaussians.
    pub antialiased: bool,
    /// Keep what the gradients need of the harmonics.
    pub differentiable: bool,
    /// Scales and opacities come as training holds them, as logarithms and logits: exp and the sigmoid are taken first,
    /// and the gradients are of what is given.
    pub activate: bool,
    /// What trades accuracy for time, in this and the later stages.
    #[doc(hidden)]
    pub knobs: AccuracyKnobs,
    /// Vector instructions of this and the later stages; None: those of the process.
    #[doc(hidden)]
    pub level: Option<Level>,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            near_plane: NEAR_PLANE,
            far_plane: FAR_PLANE,
            radius_clip: 0.0,
            eps2d: EPS2D,
            antialiased: false,
            differentiable: true,
            activate: false,
            knobs: AccuracyKnobs::default(),
            level: None,
        }
    }
}

impl RenderOptions {
    /// Check the ranges.
    ///
    /// # Errors
    /// Names the first option that is out of its range.
    pub fn check(&self) -> Result<(), Error> {
        for (name, value) in [
            ("eps2d", self.eps2d),
            ("near_plane", self.near_plane),
            ("radius_clip", self.radius_clip),
        ] {
            if !(value >= 0.0 && value.is_finite()) {
                let message = format!("must be finite and not negative, got {value}");
                return Err(Error::new(name, message));
            }
        }
        let (near, far) = (self.near_plane, self.far_plane);
        if far.is_nan() || far <= near {
            let message = format!("must be larger than near_plane {near}, got {far}");
            return Err(Error::new("far_plane", message));
        }
        self.knobs.check()
    }
}

/// One projected Gaussian as the compositor reads it: 64 bytes, one cache line.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub struct Splat {
    /// Centre, pixels. f64, because f32 would shift small Gaussians visibly: half an ulp at 500 px is 1.5e-5 px.
    pub mean: [f64; 2],
    /// Factors (s, m, t) of the conic; see `geometry.rs`.
    pub factors: [f64; 3],
    /// Opacity, compensated if antialiased; 0 for a culled Gaussian.
    pub opacity: f64,
    /// Radius of the support in standard deviations, with the slack.
    pub reach: f32,
    /// Tiles that its bounding box touches: x begin, x end, y begin, y end.
    pub tiles: [u16; 4],
    /// Fills the cache line, so that no byte of it is without a value.
    pub(crate) rest: u32,
}

impl Splat {
    /// Whether it was kept by the projection.
    pub fn visible(&self) -> bool {
        self.opacity > 0.0
    }

    /// Alpha at (x, y) by the definition, for the tests.
    #[cfg(test)]
    pub fn alpha(&self, x: f64, y: f64) -> f64 {
        let [s, m, t] = self.factors;
        let (dx, dy) = (x - self.mean[0], y - self.mean[1]);
        let (u, v) = (s * (dx - m * dy), t * dy);
        (self.opacity * (-0.5 * (u * u + v * v)).exp()).min(0.99)
    }
}

/// What the later stages need of the projection of N Gaussians.
#[derive(Debug)]
pub struct Projection {
    /// All N Gaussians, culled ones included.
    pub splats: Vec<Splat>,
    /// View-space depth, `[N]`; 0 where culled.
    pub depths: Vec<f64>,
    /// Those of the options.
    pub knobs: AccuracyKnobs,
    /// Vector instructions.
    pub level: Level,
}

/// How many of n are in each chunk of `chunk` of them.
fn chunks(n: usize, chunk: usize) -> impl Iterator<Item = usize> + Clone {
    (0..n.div_ceil(chunk)).map(move |c| chunk.min(n - c * chunk))
}

/// The lanes of a mask of f64.
pub(crate) type Mask<S> = <Wide<S> as SimdBase<S>>::Mask;

/// The geometry of a group of Gaussians, or the gradients of it, one column per number.
struct Columns<T> {
    means: [Column<T>; 3],
    quats: [Column<T>; 4],
    scales: [Column<T>; 3],
    opacities: Column<T>,
}

impl<T: Real> Columns<T> {
    const ZERO: Self = Self {
        means: [Column::ZERO; 3],
        quats: [Column::ZERO; 4],
        scales: [Column::ZERO; 3],
        opacities: Column::ZERO,
    };

    #[inline(always)]
    fn read<S: Simd>(&mut self, simd: S, g: &Gaussians<T>, first: usize, activate: bool) {
        groups::read(simd, g.means, first, &mut self.means);
        groups::read(simd, g.quats, first, &mut self.quats);
        groups::read(simd, g.scales, first, &mut self.scales);
        self.opacities.load(g.opacities, first);
        if activate {
            for at in (0..GROUP).step_by(lanes::<S>()) {
                for scale in &mut self.scales {
                    let logarithm = scale.wide(simd, at);
                    scale.round(simd, at, exp(simd, logarithm));
                }
                let logit = self.opacities.wide(simd, at);
                let one = splat(simd, 1.0);
                self.opacities
                    .round(simd, at, one / (one + exp(simd, -logit)));
            }
        }
    }

    /// The geometry of the Gaussians `at..` of the group.
    #[inline(always)]
    fn geometry<S: Simd>(&self, simd: S, at: usize, camera: &CameraLanes<S>) -> Geometry<S> {
        let quat = [
            self.quats[0].wide(simd, at),
            self.quats[1].wide(simd, at),
            self.quats[2].wide(simd, at),
            self.quats[3].wide(simd, at),
        ];
        Geometry::new::<T>(
            simd,
            wide3(simd, &self.means, at),
            quat,
            wide3(simd, &self.scales, at),
            camera,
        )
    }
}

/// The lanes of a group in a bit set, as 1 or 0.
#[inline(always)]
pub(crate) fn lanes_in<S: Simd>(simd: S, set: u16, at: usize) -> Mask<S> {
    let mut ones = [0.0; GROUP];
    for (lane, one) in ones.iter_mut().enumerate() {
        *one = f64::from(set >> lane & 1);
    }
    Wide::<S>::from_slice(simd, &ones[at..at + lanes::<S>()]).simd_gt(splat(simd, 0.0))
}
