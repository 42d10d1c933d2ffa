//! Splats of a group of Gaussians: culling, and what the compositor reads.

use super::{
    Columns, RenderOptions, Splat, camera_lanes::CameraLanes, colors::direction, geometry::Geometry,
};
use crate::{
    constants::{FACTOR_MAX, SUPPORT_SLACK, TILE},
    scene::Camera,
    simd::{
        Real, Wide,
        groups::{Column, GROUP},
        lanes,
        math::ln,
        splat as splat_lanes,
        vec3::splat3,
    },
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

/// Splats of a group, a column per number. The numbers of culled ones are of no meaning.
pub(super) struct SplatGroup {
    pub mean: [Column<f64>; 2],
    factors: [Column<f64>; 3],
    pub opacity: Column<f64>,
    reach: Column<f64>,
    /// x begin, x end, y begin, y end.
    tiles: [Column<f64>; 4],
    pub radii: [Column<f64>; 2],
    pub depth: Column<f64>,
    pub conic: [Column<f64>; 3],
    /// Unit vectors from the camera centre.
    pub direction: [Column<f64>; 3],
}

impl SplatGroup {
    pub const ZERO: Self = Self {
        mean: [Column::ZERO; 2],
        factors: [Column::ZERO; 3],
        opacity: Column::ZERO,
        reach: Column::ZERO,
        tiles: [Column::ZERO; 4],
        radii: [Column::ZERO; 2],
        depth: Column::ZERO,
        conic: [Column::ZERO; 3],
        direction: [Column::ZERO; 3],
    };

    /// Project a group; returns which are kept, their colours aside.
    #[inline(always)]
    pub fn project<S: Simd, T: Real>(
        &mut self,
        simd: S,
        inputs: &Columns<T>,
        camera: &Camera,
        camera_lanes: &CameraLanes<S>,
        options: &RenderOptions,
        directed: bool,
    ) -> u16 {
        let center = splat3(simd, camera.center);
        let mut keep = 0u16;
        for at in (0..GROUP).step_by(lanes::<S>()) {
            let g = inputs.geometry(simd, at, camera_lanes);
            let mut opacity = inputs.opacities.wide(simd, at);
            if options.antialiased {
                opacity *= g.compensation();
            }
            let kept = self.fill(simd, at, &g, opacity, camera, camera_lanes, options);
            keep |= (kept as u16) << at;
            if directed {
                let (d, _) = direction(simd, g.mean, center);
                self.direction[0].set(simd, at, d.x);
                self.direction[1].set(simd, at, d.y);
                self.direction[2].set(simd, at, d.z);
            }
        }
        keep
    }

    /// Pack the Gaussians `at..`; returns which are kept.
    #[inline(always)]
    fn fill<S: Simd>(
        &mut self,
        simd: S,
        at: usize,
        g: &Geometry<S>,
        opacity: Wide<S>,
        camera: &Camera,
        camera_lanes: &CameraLanes<S>,
        o: &RenderOptions,
    ) -> u64 {
        let (zero, infinity) = (splat_lanes(simd, 0.0), splat_lanes(simd, f64::INFINITY));
        let mean = g.mean2d(camera_lanes);
        let sigma = g.sigma();
        let conic = g.conic();
        let floor = o.knobs.alpha_min;
        let opaque = opacity.simd_ge(splat_lanes(simd, floor)) & opacity.simd_lt(infinity);
        let radius = (ln(simd, opacity * (1.0 / floor)).max(zero) * 2.0).sqrt();
        let [s, m, t] = g.factors;
        let stiffness = s * (m.abs() + 1.0) + t;
        let reach = radius + (stiffness + 1.0) * SUPPORT_SLACK;
        let mut keep = g.valid & opaque & stiffness.simd_lt(splat_lanes(simd, FACTOR_MAX));
        let mut largest = zero;
        let size = [camera.width as f64, camera.height as f64];
        for k in 0..2 {
            let radii = (radius * sigma[k]).ceil();
            keep = keep
                & (mean[k] + radii).simd_gt(zero)
                & (mean[k] - radii).simd_lt(splat_lanes(simd, size[k]));
            largest = largest.max(radii);
            // Tiles whose pixel centres lie within `mean +- extent`, clipped to the image.
            let extent = reach * sigma[k];
            let first = (mean[k] - extent - 0.5).ceil().max(zero);
            let last = (mean[k] + extent - 0.5)
                .floor()
                .min(splat_lanes(simd, size[k] - 1.0));
            let some = first.simd_le(last);
            let tile = 1.0 / TILE as f64;
            self.tiles[2 * k].set(simd, at, some.select((first * tile).floor(), zero));
            self.tiles[2 * k + 1].set(simd, at, some.select((last * tile).floor() + 1.0, zero));
            self.radii[k].set(simd, at, radii);
            self.mean[k].set(simd, at, mean[k]);
        }
        keep &= largest.simd_gt(splat_lanes(simd, o.radius_clip));
        for (column, x) in self.factors.iter_mut().zip(&g.factors) {
            column.set(simd, at, *x);
        }
        for (column, x) in self.conic.iter_mut().zip(&conic) {
            column.set(simd, at, *x);
        }
        self.opacity.set(simd, at, opacity);
        self.reach.set(simd, at, reach);
        self.depth.set(simd, at, g.p.z);
        keep.to_bitmask()
    }

    /// One Gaussian as the compositor reads it.
    #[inline(always)]
    pub fn splat(&self, i: usize) -> Splat {
        Splat {
            mean: [self.mean[0].0[i], self.mean[1].0[i]],
            factors: [
                self.factors[0].0[i],
                self.factors[1].0[i],
                self.factors[2].0[i],
            ],
            opacity: self.opacity.0[i],
            // f32 rounds to nearest: the slack is far larger than half an ulp of any radius below 10.
            reach: self.reach.0[i] as f32,
            tiles: [
                self.tiles[0].0[i] as u16,
                self.tiles[1].0[i] as u16,
                self.tiles[2].0[i] as u16,
                self.tiles[3].0[i] as u16,
            ],
            rest: 0,
        }
    }
}
