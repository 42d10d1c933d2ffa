//! The pinhole camera and the gradient of its pose.

use crate::{constants::FOV_MARGIN, error::Error};
use glam::{DMat3, DVec2, DVec3};

/// A pinhole camera in the OpenCV frame (x right, y down, z forward), pixel centres at +0.5.
#[derive(Debug, Clone, Copy)]
pub struct Camera {
    /// World to camera, linear part.
    pub(crate) rotation: DMat3,
    /// World to camera, translation.
    pub(crate) translation: DVec3,
    /// Camera centre in the world, `-rotation^-1 translation`.
    pub(crate) center: DVec3,
    /// Focal lengths, pixels.
    pub(crate) focal: DVec2,
    /// Principal point, pixels.
    pub(crate) principal: DVec2,
    /// Image width, pixels.
    pub(crate) width: usize,
    /// Image height, pixels.
    pub(crate) height: usize,
    /// Smallest `(x/z, y/z)` at which the Jacobian is evaluated.
    pub(crate) ratio_min: DVec2,
    /// Largest `(x/z, y/z)` at which the Jacobian is evaluated.
    pub(crate) ratio_max: DVec2,
}

impl Camera {
    /// A camera from a row-major 4 x 4 world-to-camera matrix and a row-major 3 x 3 intrinsic matrix in pixels.
    ///
    /// # Errors
    /// When a number is not finite, a focal length is not positive, the skew is not 0, the last row of
    /// `viewmat` is not (0, 0, 0, 1), its linear part is singular, or the image is empty.
    pub fn new(
        viewmat: &[f64; 16],
        k: &[f64; 9],
        width: usize,
        height: usize,
    ) -> Result<Self, Error> {
        if width == 0 || height == 0 {
            return Err(Error::new(
                "width, height",
                format!("must be positive, got {width} x {height}"),
            ));
        }
        // 2^15 tiles per side keep tile coordinates in i16 and pixel indices in f32 exact.
        if width > 1 << 19 || height > 1 << 19 {
            return Err(Error::new(
                "width, height",
                format!("must be at most {}, got {width} x {height}", 1 << 19),
            ));
        }
        // A transposed matrix shows in its last row; finite differences may still move it a little.
        let last_row = viewmat[12..].iter().zip([0.0, 0.0, 0.0, 1.0]);
        if !viewmat.iter().all(|x| x.is_finite())
            || last_row.into_iter().any(|(x, e)| (x - e).abs() > 1e-4)
        {
            return Err(Error::new(
                "viewmat",
                format!("must be finite with last row (0, 0, 0, 1), got {viewmat:?}"),
            ));
        }
        let focal = DVec2::new(k[0], k[4]);
        if !k.iter().all(|x| x.is_finite()) || focal.min_element() <= 0.0 {
            return Err(Error::new(
                "k",
                format!("must be finite with positive focal lengths, got {k:?}"),
            ));
        }
        if k[1] != 0.0 || k[3] != 0.0 || k[6..] != [0.0, 0.0, 1.0] {
            return Err(Error::new(
                "k",
                format!("must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k:?}"),
            ));
        }
        let v = viewmat;
        let rotation =
            DMat3::from_cols_array(&[v[0], v[4], v[8], v[1], v[5], v[9], v[2], v[6], v[10]]);
        let translation = DVec3::new(v[3], v[7], v[11]);
        let center = -(rotation.inverse() * translation);
        if !center.is_finite() {
            return Err(Error::new(
                "viewmat",
                format!("the rotation must be invertible, got {viewmat:?}"),
            ));
        }
        let principal = DVec2::new(k[2], k[5]);
        let size = DVec2::new(width as f64, height as f64);
        let margin = FOV_MARGIN * 0.5 * size / focal;
        Ok(Self {
            rotation,
            translation,
            center,
            focal,
            principal,
            width,
            height,
            ratio_min: -(principal / focal + margin),
            ratio_max: (size - principal) / focal + margin,
        })
    }

    /// A camera at the origin that looks along z, `focal` pixels from the middle of its image.
    ///
    /// # Errors
    /// As for [`Self::new`].
    pub fn at_origin(focal: f64, width: usize, height: usize) -> Result<Self, Error> {
        let viewmat = [
            1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0,
        ];
        let [x, y] = [width, height].map(|side| 0.5 * side as f64);
        let k = [focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0];
        Self::new(&viewmat, &k, width, height)
    }

    /// Image width, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Image height, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Row-major 4 x 4 world-to-camera matrix.
    pub fn viewmat(&self) -> [f64; 16] {
        let mut m = [0.0; 16];
        for i in 0..3 {
            let row = self.rotation.row(i).to_array();
            m[4 * i..4 * i + 3].copy_from_slice(&row);
            m[4 * i + 3] = self.translation[i];
        }
        m[15] = 1.0;
        m
    }

    /// Row-major 3 x 3 intrinsic matrix, pixels.
    pub fn k(&self) -> [f64; 9] {
        let (f, c) = (self.focal, self.principal);
        [f.x, 0.0, c.x, 0.0, f.y, c.y, 0.0, 0.0, 1.0]
    }
}

/// Gradient of a loss with respect to a camera's pose; sums over Gaussians in a fixed order.
#[derive(Debug, Clone, Copy, Default)]
pub struct CameraGrad {
    /// With respect to `rotation`.
    pub rotation: DMat3,
    /// With respect to `translation`.
    pub translation: DVec3,
    /// With respect to `center`, as a free variable.
    pub center: DVec3,
}

impl CameraGrad {
    /// The zero gradient.
    pub const ZERO: Self = Self {
        rotation: DMat3::ZERO,
        translation: DVec3::ZERO,
        center: DVec3::ZERO,
    };

    /// Add another gradient.
    pub fn add(&mut self, other: &Self) {
        self.rotation += other.rotation;
        self.translation += other.translation;
        self.center += other.center;
    }

    /// Row-major 4 x 4 gradient of the view matrix: with `center = -rotation^-1 translation`,
    /// `d center = -rotation^-1 (d translation + d rotation center)`.
    pub fn viewmat(&self, camera: &Camera) -> [f64; 16] {
        let back = camera.rotation.inverse().transpose() * self.center;
        let r = self.rotation
            - DMat3::from_cols_array_2d(&camera.center.to_array().map(|c| (back * c).to_array()));
        let t = self.translation - back;
        let row = |i: usize| [r.col(0)[i], r.col(1)[i], r.col(2)[i], t[i]];
        let mut m = [0.0; 16];
        for i in 0..3 {
            m[4 * i..4 * i + 4].copy_from_slice(&row(i));
        }
        m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_matrices_come_back_and_the_centre_is_where_they_put_it() {
        // A turn by 90 degrees about z, and away from the origin.
        let viewmat = [
            0.0, -1.0, 0.0, 3.0, 1.0, 0.0, 0.0, -2.0, 0.0, 0.0, 1.0, 5.0, 0.0, 0.0, 0.0, 1.0,
        ];
        let k = [50.0, 0.0, 20.5, 0.0, 60.0, 15.5, 0.0, 0.0, 1.0];
        let camera = Camera::new(&viewmat, &k, 40, 30).unwrap();
        assert_eq!(camera.viewmat(), viewmat);
        assert_eq!(camera.k(), k);
        assert_eq!((camera.width(), camera.height()), (40, 30));
        let c = camera.center.to_array();
        for row in viewmat[..12].chunks_exact(4) {
            let seen: f64 = row[..3].iter().zip(&c).map(|(r, c)| r * c).sum();
            assert!((seen + row[3]).abs() < 1e-15);
        }
    }
}
