//! The EWA projection of a group of Gaussians, one per SIMD lane, and its vector-Jacobian product. In f64,
//! whatever the input type: it costs little here, and nothing after it can repair a lost digit.
//!
//! The covariance is kept in factors, so that nothing cancels for needles and discs (the naive
//! determinant `ac - b^2` in f32 is wrong by a factor of 7 for 10,000 : 1):
//!
//! - `cov2d = A A^T + eps I` with `A = J W R S` (2 x 3) of rows `a1`, `a2`, so
//!   `det = |a1 x a2|^2 + eps (|a1|^2 + |a2|^2) + eps^2`, a sum of positive terms;
//! - the 2 x 2 minors of `J W R` are `n = R^T cof(W) (J1 x J2)` with `J1 x J2 = f1 f2 (x/z, y/z, 1)`: no
//!   difference of products, whose digits are lost when the rows of `A` are nearly parallel;
//! - `conic = L L^T`, so `sigma = (u^2 + v^2) / 2` with `u = s (dx - m dy)`, `v = t dy`,
//!   `s = sqrt(c / det)`, `m = b / c`, `t = 1 / sqrt(c)`: never negative;
//! - the gradient of the covariance arrives as its whitened form `E` (`d cov2d = L E L^T`), whose entries
//!   are of order 1 for any anisotropy. It meets the whitened rows `B = L^T A`. The first is
//!   `s (a1 - m a2)`, where a long needle leaves only one part in (length / width)^2 of `a1`; with the minors,
//!   `c (j1 - m j2) = eps j1 + (S^2 j2) x n` for the rows `j1`, `j2` of `J W R`.
//!
//! Lanes that turn out invalid are computed to the end and ignored.

use super::{
    Mask,
    camera_lanes::{CameraGradLanes, CameraLanes},
};
use crate::{
    constants::QUAT_NORM2_MIN,
    simd::{
        Real, Wide, splat,
        vec3::{M3, V3},
    },
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

/// What projection computes; the VJP computes it again instead of storing it.
pub(crate) struct Geometry<S: Simd> {
    pub mean: V3<Wide<S>>,
    /// w, x, y, z, as given.
    quat: [Wide<S>; 4],
    /// One over its squared norm.
    inverse_norm2: Wide<S>,
    scale: V3<Wide<S>>,
    rotation: M3<Wide<S>>,
    /// Centre in the camera frame.
    pub p: V3<Wide<S>>,
    rz: Wide<S>,
    /// Focal lengths over depth.
    f: [Wide<S>; 2],
    /// `(x/z, y/z)`, clamped for the Jacobian.
    ratio: [Wide<S>; 2],
    /// 1 where the ratio is free, 0 where it is clamped.
    free: [Wide<S>; 2],
    /// Rows of `J W`.
    jw: [V3<Wide<S>>; 2],
    /// Rows of `J W R`, before the scales.
    axes: [V3<Wide<S>>; 2],
    /// Rows of `A = J W R S`.
    rows: [V3<Wide<S>>; 2],
    /// Minors of `J W R` over the focal lengths over depth.
    minors: V3<Wide<S>>,
    /// Covariance entry xx, low-pass included.
    a: Wide<S>,
    /// Covariance entry xy.
    b: Wide<S>,
    /// Covariance entry yy, low-pass included.
    c: Wide<S>,
    det_raw: Wide<S>,
    /// One over the determinant, low-pass included.
    inverse_det: Wide<S>,
    /// Factors (s, m, t) of the conic.
    pub factors: [Wide<S>; 3],
    /// Inside the depth range, with a rotation, and finite.
    pub valid: Mask<S>,
}

/// Cotangents of the projection.
pub(crate) struct Cotangent<S: Simd> {
    pub mean2d: [Wide<S>; 2],
    /// Whitened gradient of the covariance: E_uu, E_uv, E_vv.
    pub whitened: V3<Wide<S>>,
    pub depth: Wide<S>,
}

/// Gradient of the geometry.
pub(crate) struct GeometryGrad<S: Simd> {
    pub mean: V3<Wide<S>>,
    /// w, x, y, z.
    pub quat: [Wide<S>; 4],
    pub scale: V3<Wide<S>>,
}

impl<S: Simd> GeometryGrad<S> {
    #[inline(always)]
    pub fn zero(simd: S) -> Self {
        let zero = splat(simd, 0.0);
        Self {
            mean: V3::new(zero, zero, zero),
            quat: [zero; 4],
            scale: V3::new(zero, zero, zero),
        }
    }
}

/// Rotation matrix of a quaternion; `k` is 2 over its squared norm.
#[inline(always)]
fn rotation_matrix<S: Simd>(simd: S, [w, x, y, z]: [Wide<S>; 4], k: Wide<S>) -> M3<Wide<S>> {
    let one = splat(simd, 1.0);
    let (kx, ky, kz) = (k * x, k * y, k * z);
    let (xx, yy, zz) = (kx * x, ky * y, kz * z);
    let (xy, xz, yz) = (kx * y, kx * z, ky * z);
    let (wx, wy, wz) = (kx * w, ky * w, kz * w);
    M3([
        V3::new(one - (yy + zz), xy - wz, xz + wy),
        V3::new(xy + wz, one - (xx + zz), yz - wx),
        V3::new(xz - wy, yz + wx, one - (xx + yy)),
    ])
}

/// A whitened gradient E times two rows.
#[inline(always)]
fn times_whitened<S: Simd>(e: &V3<Wide<S>>, rows: &[V3<Wide<S>>; 2]) -> [V3<Wide<S>>; 2] {
    let (euu, euv, evv) = (e.x, e.y, e.z);
    [
        rows[0].by(euu) + rows[1].by(euv),
        rows[0].by(euv) + rows[1].by(evv),
    ]
}

impl<S: Simd> Geometry<S> {
    /// Project Gaussians of type T. Each test of `valid` is written so that NaN fails it.
    #[inline(always)]
    pub fn new<T: Real>(
        simd: S,
        mean: V3<Wide<S>>,
        quat: [Wide<S>; 4],
        scale: V3<Wide<S>>,
        camera: &CameraLanes<S>,
    ) -> Self {
        let infinity = splat(simd, f64::INFINITY);
        let p = camera.point::<T>(mean);
        let norm2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
        let inverse_norm2 = splat(simd, 1.0) / norm2;
        let rotation = rotation_matrix(simd, quat, inverse_norm2 * 2.0);
        let rz = splat(simd, 1.0) / p.z;
        let ratios = [p.x * rz, p.y * rz];
        let ratio = [
            ratios[0].max(camera.ratio_min[0]).min(camera.ratio_max[0]),
            ratios[1].max(camera.ratio_min[1]).min(camera.ratio_max[1]),
        ];
        let (one, zero) = (splat(simd, 1.0), splat(simd, 0.0));
        let free = [
            ratio[0].simd_eq(ratios[0]).select(one, zero),
            ratio[1].simd_eq(ratios[1]).select(one, zero),
        ];
        let [w0, w1, w2] = camera.rotation.0;
        let f = [camera.focal[0] * rz, camera.focal[1] * rz];
        let jw = [
            (w0 - w2.by(ratio[0])).by(f[0]),
            (w1 - w2.by(ratio[1])).by(f[1]),
        ];
        let axes = [rotation.back(jw[0]), rotation.back(jw[1])];
        let rows = [axes[0].times(scale), axes[1].times(scale)];
        let (aa, cc) = (rows[0].dot(rows[0]), rows[1].dot(rows[1]));
        let b = rows[0].dot(rows[1]);
        let minors = rotation.back(camera.cofactors.back(V3::new(ratio[0], ratio[1], one)));
        let (across, down) = (scale.by(f[0]), scale.by(f[1]));
        let cross = V3::new(
            across.y * down.z * minors.x,
            across.z * down.x * minors.y,
            across.x * down.y * minors.z,
        );
        let det_raw = cross.dot(cross);
        let eps = camera.eps2d;
        let det = det_raw + eps * (aa + cc) + eps * eps;
        let (a, c) = (aa + eps, cc + eps);
        let valid = p.z.simd_ge(camera.near)
            & p.z.simd_le(camera.far)
            & p.z.simd_gt(splat(simd, 0.0))
            & norm2.simd_ge(splat(simd, QUAT_NORM2_MIN))
            & norm2.simd_lt(infinity)
            & det.simd_gt(splat(simd, 0.0))
            & det.simd_lt(infinity)
            & (p.x * p.y * b).abs().simd_lt(infinity);
        // Where an inverse overflows, so does a factor, and the Gaussian is culled.
        let (inverse_det, inverse_c) = (one / det, one / c);
        let factors = [(c * inverse_det).sqrt(), b * inverse_c, inverse_c.sqrt()];
        Self {
            mean,
            quat,
            inverse_norm2,
            scale,
            rotation,
            p,
            rz,
            f,
            ratio,
            free,
            jw,
            axes,
            rows,
            minors,
            a,
            b,
            c,
            det_raw,
            inverse_det,
            factors,
            valid,
        }
    }

    /// Centre in pixels.
    #[inline(always)]
    pub fn mean2d(&self, camera: &CameraLanes<S>) -> [Wide<S>; 2] {
        [
            self.f[0] * self.p.x + camera.principal[0],
            self.f[1] * self.p.y + camera.principal[1],
        ]
    }

    /// Inverse covariance, entries xx, xy, yy.
    #[inline(always)]
    pub fn conic(&self) -> [Wide<S>; 3] {
        [
            self.c * self.inverse_det,
            -self.b * self.inverse_det,
            self.a * self.inverse_det,
        ]
    }

    /// Standard deviations along x and y, pixels.
    #[inline(always)]
    pub fn sigma(&self) -> [Wide<S>; 2] {
        [self.a.sqrt(), self.c * self.factors[2]]
    }

    /// `sqrt(det(cov2d - eps I) / det(cov2d))`: keeps a Gaussian's total energy under the low-pass
    /// (Mip-Splatting, eq. 9).
    #[inline(always)]
    pub fn compensation(&self) -> Wide<S> {
        (self.det_raw * self.inverse_det).sqrt()
    }

    /// Vector-Jacobian product; the camera's part is added to `camera_grad` if there is one.
    #[inline(always)]
    pub fn vjp(
        &self,
        simd: S,
        v: &Cotangent<S>,
        camera: &CameraLanes<S>,
        camera_grad: Option<&mut CameraGradLanes<S>>,
    ) -> GeometryGrad<S> {
        let (zero, two) = (splat(simd, 0.0), splat(simd, 2.0));
        let [s, m, t] = self.factors;
        let white = self.whitened_axes(camera);
        let half = times_whitened::<S>(&v.whitened, &white);
        // d cov = L E L^T gives dA = 2 L E B and, along each scale, 2 s_k B_k^T E B_k without cancellation. The
        // scales come one at a time: the square of one may overflow.
        let half = [half[0].times(self.scale), half[1].times(self.scale)];
        let scale = (white[0].times(half[0]) + white[1].times(half[1])).by(two);
        let twice = self.scale.by(two);
        let v_axes = [
            twice.times(half[0]).by(s),
            twice.times(half[1].by(t) - half[0].by(s * m)),
        ];
        // axes_i = R^T jw_i
        let v_jw = [
            self.rotation.times(v_axes[0]),
            self.rotation.times(v_axes[1]),
        ];

        let [w0, w1, w2] = camera.rotation.0;
        // J and the scales stretch A alike: sum_i v_jw_i . jw_i = sum_k v_scale_k scale_k.
        let mut v_p = V3::new(
            self.f[0] * v.mean2d[0],
            self.f[1] * v.mean2d[1],
            v.depth
                - self.rz
                    * (self.f[0] * self.p.x * v.mean2d[0]
                        + self.f[1] * self.p.y * v.mean2d[1]
                        + scale.dot(self.scale)),
        );
        let v_ratio = [
            self.free[0] * self.f[0] * v_jw[0].dot(w2) * self.rz,
            self.free[1] * self.f[1] * v_jw[1].dot(w2) * self.rz,
        ];
        v_p.x -= v_ratio[0];
        v_p.y -= v_ratio[1];
        v_p.z += (v_ratio[0] * self.p.x + v_ratio[1] * self.p.y) * self.rz;

        if let Some(grad) = camera_grad {
            let jacobian = [
                v_jw[0].by(self.f[0]),
                v_jw[1].by(self.f[1]),
                v_jw[0].by(zero - self.f[0] * self.ratio[0])
                    - v_jw[1].by(self.f[1] * self.ratio[1]),
            ];
            let v_view = [v_p.x, v_p.y, v_p.z];
            for i in 0..3 {
                let g = self.mean.by(v_view[i]) + jacobian[i];
                grad.rotation[i] = grad.rotation[i] + g.only(self.valid, zero);
            }
            grad.translation = grad.translation + v_p.only(self.valid, zero);
        }
        GeometryGrad {
            mean: w0.by(v_p.x) + w1.by(v_p.y) + w2.by(v_p.z),
            quat: self.quat_vjp(simd, &v_axes),
            scale,
        }
    }

    /// Gradient of the covariance `R S S^T R^T` itself, entries xx, xy, xz, yy, yz, zz; those beside the diagonal
    /// stand for two. `d cov2d = L E L^T` gives `P^T E P` with `P = L^T J W`, here the whitened axes turned back
    /// by `R`: the scales are not divided by, and equal ones are like any others.
    #[inline(always)]
    pub fn covar_vjp(&self, whitened: &V3<Wide<S>>, camera: &CameraLanes<S>) -> [Wide<S>; 6] {
        let white = self.whitened_axes(camera);
        let [p, q] = [0, 1].map(|i| self.rotation.times(white[i]));
        let [u, v] = times_whitened::<S>(whitened, &[p, q]);
        [
            p.x * u.x + q.x * v.x,
            p.x * u.y + q.x * v.y + p.y * u.x + q.y * v.x,
            p.x * u.z + q.x * v.z + p.z * u.x + q.z * v.x,
            p.y * u.y + q.y * v.y,
            p.y * u.z + q.y * v.z + p.z * u.y + q.z * v.y,
            p.z * u.z + q.z * v.z,
        ]
    }

    /// Rows of `L^T J W R`. With the scales they are `B = L^T A`: `B B^T = I - eps L^T L`, and no term of an entry
    /// of B exceeds 1.
    #[inline(always)]
    fn whitened_axes(&self, camera: &CameraLanes<S>) -> [V3<Wide<S>>; 2] {
        let [s, _, t] = self.factors;
        let area = self.rows[1]
            .by(t)
            .times(self.scale)
            .cross(self.minors)
            .by(t * self.f[0])
            .by(self.f[1]);
        [
            (area + self.axes[0].by(camera.eps2d * t * t)).by(s),
            self.axes[1].by(t),
        ]
    }

    /// The whitened gradient of the covariance that stands for a gradient of the conic: `-L^T V L`.
    #[inline(always)]
    pub fn whiten_conic(&self, simd: S, v: V3<Wide<S>>) -> V3<Wide<S>> {
        let [s, m, t] = self.factors;
        // The conic's off-diagonal entry stands for two.
        let (va, vb, vc) = (v.x, v.y * 0.5, v.z);
        let zero = splat(simd, 0.0);
        V3::new(
            zero - s * s * (va - m * (vb + vb - m * vc)),
            zero - s * t * (vb - m * vc),
            zero - t * t * vc,
        )
    }

    /// The same for a gradient `v` of the compensation.
    ///
    /// `d comp = comp / 2 (d ln det_raw - d ln det)` gives `E = v comp / 2 ((B B^T)^-1 - I)`. With
    /// `B B^T = I - P`, `P = eps L^T L`, that is `v / (2 comp) (P - det(P) I)`, here without differences.
    #[inline(always)]
    pub fn whiten_compensation(&self, simd: S, camera: &CameraLanes<S>, v: Wide<S>) -> V3<Wide<S>> {
        let [s, m, t] = self.factors;
        let zero = splat(simd, 0.0);
        // A compensation near 0 is culled with its opacity, so that it is not 0 in a valid lane with a cotangent.
        let eps = camera.eps2d;
        let k = v
            .simd_eq(zero)
            .select(zero, v * eps / (self.compensation() * 2.0));
        let [aa, cc] = [0, 1].map(|i| self.rows[i].dot(self.rows[i]));
        V3::new(
            k * self.inverse_det * (cc + self.b * m),
            zero - k * s * m * t,
            k * self.inverse_det * t * t * (self.det_raw + eps * aa),
        )
    }

    /// Gradient of the quaternion, its normalisation included; `v_axes` is that of the rows of `J W R`.
    #[inline(always)]
    fn quat_vjp(&self, simd: S, v_axes: &[V3<Wide<S>>; 2]) -> [Wide<S>; 4] {
        let two = splat(simd, 2.0);
        // v_R = sum_i jw_i v_axes_i^T
        let [j0, j1] = self.jw;
        let r0 = v_axes[0].by(j0.x) + v_axes[1].by(j1.x);
        let r1 = v_axes[0].by(j0.y) + v_axes[1].by(j1.y);
        let r2 = v_axes[0].by(j0.z) + v_axes[1].by(j1.z);
        let inverse = self.inverse_norm2.sqrt();
        let [w, x, y, z] = [
            self.quat[0] * inverse,
            self.quat[1] * inverse,
            self.quat[2] * inverse,
            self.quat[3] * inverse,
        ];
        let (s01, s02, s12) = (r0.y + r1.x, r0.z + r2.x, r1.z + r2.y);
        let (d21, d02, d10) = (r2.y - r1.z, r0.z - r2.x, r1.x - r0.y);
        let g = [
            two * (x * d21 + y * d02 + z * d10),
            two * (y * s01 + z * s02 + w * d21 - two * x * (r1.y + r2.z)),
            two * (x * s01 + z * s12 + w * d02 - two * y * (r0.x + r2.z)),
            two * (x * s02 + y * s12 + w * d10 - two * z * (r0.x + r1.y)),
        ];
        let along = w * g[0] + x * g[1] + y * g[2] + z * g[3];
        [
            (g[0] - w * along) * inverse,
            (g[1] - x * along) * inverse,
            (g[2] - y * along) * inverse,
            (g[3] - z * along) * inverse,
        ]
    }
}
