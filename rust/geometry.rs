//! The EWA projection of one Gaussian and its vector-Jacobian product, in f64 whatever the input type.
//!
//! The covariance is kept in factors, so that nothing cancels for needles and discs (the naive
//! determinant `ac - b^2` in f32 is wrong by a factor of 7 for 10,000 : 1):
//!
//! - `cov2d = A A^T + eps I` with `A = J W R S` (2 x 3), so
//!   `det = |a1 x a2|^2 + eps (|a1|^2 + |a2|^2) + eps^2`, a sum of positive terms;
//! - `conic = L L^T`, so `sigma = (u^2 + v^2) / 2` with `u = s (dx - m dy)`, `v = t dy`,
//!   `s = sqrt(c / det)`, `m = b / c`, `t = 1 / sqrt(c)`: never negative;
//! - the gradient of the covariance arrives as its whitened form `E` (`d cov2d = L E L^T`), whose entries
//!   are of order 1 for any anisotropy.

use crate::{
    camera::{Camera, CameraGrad, outer},
    constants::QUAT_NORM2_MIN,
};
use glam::{DMat3, DVec2, DVec3, DVec4};

/// What projection computes for one Gaussian; the VJP computes it again instead of storing it.
pub(crate) struct Geometry {
    mean: DVec3,
    /// Unit quaternion, stored (x, y, z, w).
    quat: DVec4,
    quat_norm: f64,
    scale: DVec3,
    rotation: DMat3,
    /// Centre in the camera frame.
    pub p: DVec3,
    /// `(x/z, y/z)`, clamped for the Jacobian.
    ratio: DVec2,
    clamped: [bool; 2],
    /// Rows of `J W`.
    jw: [DVec3; 2],
    /// Rows of `J W R`, before the scales.
    axes: [DVec3; 2],
    /// Rows of `A = J W R S`.
    rows: [DVec3; 2],
    /// Covariance entry xx, low-pass included.
    pub a: f64,
    /// Covariance entry xy.
    pub b: f64,
    /// Covariance entry yy, low-pass included.
    pub c: f64,
    det_raw: f64,
    det: f64,
}

/// Cotangents of one projected Gaussian.
#[derive(Default)]
pub(crate) struct Cotangent {
    pub mean2d: DVec2,
    /// Whitened gradient of the covariance: E_uu, E_uv, E_vv.
    pub whitened: [f64; 3],
    pub depth: f64,
    pub conic: [f64; 3],
    /// With respect to the compensation factor of the opacity.
    pub compensation: f64,
}

/// Gradient of one Gaussian's geometry.
pub(crate) struct GeometryGrad {
    pub mean: DVec3,
    /// w, x, y, z.
    pub quat: [f64; 4],
    pub scale: DVec3,
}

/// Rotation matrix of a unit quaternion stored (x, y, z, w).
fn rotation_matrix(q: DVec4) -> DMat3 {
    let (x, y, z, w) = (q.x, q.y, q.z, q.w);
    DMat3::from_cols(
        DVec3::new(
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y + w * z),
            2.0 * (x * z - w * y),
        ),
        DVec3::new(
            2.0 * (x * y - w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z + w * x),
        ),
        DVec3::new(
            2.0 * (x * z + w * y),
            2.0 * (y * z - w * x),
            1.0 - 2.0 * (x * x + y * y),
        ),
    )
}

impl Geometry {
    /// Project; `None` when the Gaussian is outside the depth range, has no rotation, or is not finite.
    /// Each guard is written so that NaN fails it.
    #[inline]
    pub fn new(
        mean: DVec3,
        quat_wxyz: [f64; 4],
        scale: DVec3,
        camera: &Camera,
        near: f64,
        far: f64,
        eps2d: f64,
    ) -> Option<Self> {
        let p = camera.rotation * mean + camera.translation;
        if !(p.z >= near && p.z <= far && p.z > 0.0) {
            return None;
        }
        let q = DVec4::new(quat_wxyz[1], quat_wxyz[2], quat_wxyz[3], quat_wxyz[0]);
        let norm2 = q.length_squared();
        if !(norm2 >= QUAT_NORM2_MIN && norm2.is_finite()) {
            return None;
        }
        let quat_norm = norm2.sqrt();
        let quat = q / quat_norm;
        let rotation = rotation_matrix(quat);
        let rz = 1.0 / p.z;
        let free = DVec2::new(p.x * rz, p.y * rz);
        let ratio = free.clamp(camera.ratio_min, camera.ratio_max);
        let clamped = [ratio.x != free.x, ratio.y != free.y];
        let w = &camera.rotation;
        let (w0, w1, w2) = (w.row(0), w.row(1), w.row(2));
        let jw = [
            (w0 - ratio.x * w2) * (camera.focal.x * rz),
            (w1 - ratio.y * w2) * (camera.focal.y * rz),
        ];
        let back = rotation.transpose();
        let axes = [back * jw[0], back * jw[1]];
        let rows = [axes[0] * scale, axes[1] * scale];
        let (aa, cc) = (rows[0].length_squared(), rows[1].length_squared());
        let b = rows[0].dot(rows[1]);
        let det_raw = rows[0].cross(rows[1]).length_squared();
        let det = det_raw + eps2d * (aa + cc) + eps2d * eps2d;
        if !(det > 0.0 && det.is_finite() && (p.x * p.y * b).is_finite()) {
            return None;
        }
        let (a, c) = (aa + eps2d, cc + eps2d);
        Some(Self {
            mean,
            quat,
            quat_norm,
            scale,
            rotation,
            p,
            ratio,
            clamped,
            jw,
            axes,
            rows,
            a,
            b,
            c,
            det_raw,
            det,
        })
    }

    /// Centre in pixels.
    pub fn mean2d(&self, camera: &Camera) -> DVec2 {
        camera.focal * DVec2::new(self.p.x, self.p.y) / self.p.z + camera.principal
    }

    /// Inverse covariance, entries xx, xy, yy.
    pub fn conic(&self) -> [f64; 3] {
        [self.c / self.det, -self.b / self.det, self.a / self.det]
    }

    /// Factors (s, m, t) of the conic; see the head of this file.
    pub fn factors(&self) -> (f64, f64, f64) {
        (
            (self.c / self.det).sqrt(),
            self.b / self.c,
            1.0 / self.c.sqrt(),
        )
    }

    /// `sqrt(det(cov2d - eps I) / det(cov2d))`: keeps a Gaussian's total energy under the low-pass
    /// (Mip-Splatting, eq. 9).
    pub fn compensation(&self) -> f64 {
        (self.det_raw / self.det).sqrt()
    }

    /// Vector-Jacobian product; the camera's part is added to `camera_grad`.
    #[inline]
    pub fn vjp(
        &self,
        v: &Cotangent,
        camera: &Camera,
        camera_grad: &mut CameraGrad,
    ) -> GeometryGrad {
        let (s, m, t) = self.factors();
        let [euu, euv, evv] = v.whitened;
        // Whitened rows: B = L^T A, on the unscaled axes.
        let white = [(self.axes[0] - m * self.axes[1]) * s, self.axes[1] * t];
        let half = [
            white[0] * euu + white[1] * euv,
            white[0] * euv + white[1] * evv,
        ];
        // d cov = L E L^T gives dA = 2 L E B and, along each scale, 2 s_k B_k^T E B_k without cancellation.
        let mut scale = 2.0 * self.scale * (white[0] * half[0] + white[1] * half[1]);
        let scale2 = self.scale * self.scale;
        let mut v_axes = [
            2.0 * s * scale2 * half[0],
            2.0 * scale2 * (t * half[1] - s * m * half[0]),
        ];
        if v.compensation != 0.0 || v.conic != [0.0; 3] {
            let direct = self.covariance_cotangent(v);
            let v_rows = [
                2.0 * (direct[0] * self.rows[0] + direct[1] * self.rows[1]),
                2.0 * (direct[1] * self.rows[0] + direct[2] * self.rows[1]),
            ];
            scale += v_rows[0] * self.axes[0] + v_rows[1] * self.axes[1];
            v_axes[0] += v_rows[0] * self.scale;
            v_axes[1] += v_rows[1] * self.scale;
        }
        // axes_i = R^T jw_i
        let v_jw = [self.rotation * v_axes[0], self.rotation * v_axes[1]];
        let v_rotation = outer(self.jw[0], v_axes[0]) + outer(self.jw[1], v_axes[1]);

        let rz = 1.0 / self.p.z;
        let f = camera.focal * rz;
        let w2 = camera.rotation.row(2);
        let mut v_p = DVec3::new(
            f.x * v.mean2d.x,
            f.y * v.mean2d.y,
            v.depth
                - rz * (f.x * self.p.x * v.mean2d.x + f.y * self.p.y * v.mean2d.y)
                - rz * (v_jw[0].dot(self.jw[0]) + v_jw[1].dot(self.jw[1])),
        );
        for axis in 0..2 {
            if !self.clamped[axis] {
                let v_ratio = -f[axis] * v_jw[axis].dot(w2);
                v_p[axis] += v_ratio * rz;
                v_p.z -= v_ratio * self.p[axis] * rz * rz;
            }
        }
        let w_rows = [
            f.x * v_jw[0],
            f.y * v_jw[1],
            -(f.x * self.ratio.x * v_jw[0] + f.y * self.ratio.y * v_jw[1]),
        ];
        camera_grad.rotation +=
            outer(v_p, self.mean) + DMat3::from_cols(w_rows[0], w_rows[1], w_rows[2]).transpose();
        camera_grad.translation += v_p;
        GeometryGrad {
            mean: camera.rotation.transpose() * v_p,
            quat: self.quat_vjp(&v_rotation),
            scale,
        }
    }

    /// Gradient of the covariance (xx, xy, yy; symmetric) from the conic and the compensation.
    fn covariance_cotangent(&self, v: &Cotangent) -> [f64; 3] {
        let [qa, qb, qc] = self.conic();
        // The conic's off-diagonal entry stands for two.
        let (va, vb, vc) = (v.conic[0], 0.5 * v.conic[1], v.conic[2]);
        let left = [
            qa * va + qb * vb,
            qa * vb + qb * vc,
            qb * va + qc * vb,
            qb * vb + qc * vc,
        ];
        let mut g = [
            -(left[0] * qa + left[1] * qb),
            -(left[0] * qb + left[1] * qc),
            -(left[2] * qb + left[3] * qc),
        ];
        if v.compensation != 0.0 {
            // d comp = comp/2 (d ln det_raw - d ln det). A compensation near 0 is culled with its opacity,
            // so det_raw is not 0 here.
            let k = 0.5 * self.compensation() * v.compensation;
            let (a0, c0) = (self.rows[0].length_squared(), self.rows[1].length_squared());
            g[0] += k * (c0 / self.det_raw - qa);
            g[1] += k * (-self.b / self.det_raw - qb);
            g[2] += k * (a0 / self.det_raw - qc);
        }
        g
    }

    /// Gradient of the quaternion (w, x, y, z), its normalisation included.
    fn quat_vjp(&self, v: &DMat3) -> [f64; 4] {
        let at = |i: usize, j: usize| v.col(j)[i];
        let (x, y, z, w) = (self.quat.x, self.quat.y, self.quat.z, self.quat.w);
        let (s01, s02, s12) = (
            at(0, 1) + at(1, 0),
            at(0, 2) + at(2, 0),
            at(1, 2) + at(2, 1),
        );
        let (d21, d02, d10) = (
            at(2, 1) - at(1, 2),
            at(0, 2) - at(2, 0),
            at(1, 0) - at(0, 1),
        );
        let g = 2.0
            * DVec4::new(
                y * s01 + z * s02 + w * d21 - 2.0 * x * (at(1, 1) + at(2, 2)),
                x * s01 + z * s12 + w * d02 - 2.0 * y * (at(0, 0) + at(2, 2)),
                x * s02 + y * s12 + w * d10 - 2.0 * z * (at(0, 0) + at(1, 1)),
                x * d21 + y * d02 + z * d10,
            );
        let g = (g - self.quat * self.quat.dot(g)) / self.quat_norm;
        [g.w, g.x, g.y, g.z]
    }
}
