//! Seeded Gaussians for tests and benchmarks.

use crate::{
    Error, Real,
    scene::{Camera, Gaussians},
};
use glam::{DQuat, DVec3};
use std::f64::consts::PI;

/// Arrays of N Gaussians and a camera that sees them.
#[derive(Debug, Clone)]
pub struct Synthetic<T> {
    /// [N, 3]
    pub means: Vec<T>,
    /// [N, 4]
    pub quats: Vec<T>,
    /// [N, 3]
    pub scales: Vec<T>,
    /// `[N]`
    pub opacities: Vec<T>,
    /// [N, 16, 3]
    pub harmonics: Vec<T>,
    /// The camera.
    pub camera: Camera,
}

/// A 64-bit counter-based generator (SplitMix64): uniform in [0, 1).
struct Uniform(u64);

impl Uniform {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next()
    }
}

/// Focal length over image width.
const FOCAL: f64 = 0.8;

/// What the Gaussians of the room lie on.
#[derive(Debug, Clone, Copy)]
enum Surface {
    /// A corner and the two sides from it, at a right angle.
    Rectangle(DVec3, DVec3, DVec3),
    /// Centre and radius.
    Sphere(DVec3, f64),
}

impl Surface {
    /// Walls, floor and ceiling, and two spheres on the floor; y points down.
    fn room() -> [Self; 8] {
        let (low, high) = (DVec3::new(-2.0, -1.4, -1.0), DVec3::new(2.0, 1.4, 5.0));
        let [x, y, z] = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| axis * (high - low));
        let sphere = |x, z, radius| Self::Sphere(DVec3::new(x, high.y - radius, z), radius);
        [
            Self::Rectangle(low, x, y),
            Self::Rectangle(low, x, z),
            Self::Rectangle(low, y, z),
            Self::Rectangle(high, -x, -y),
            Self::Rectangle(high, -x, -z),
            Self::Rectangle(high, -y, -z),
            sphere(-0.7, 3.2, 0.7),
            sphere(0.8, 2.4, 0.5),
        ]
    }

    fn area(self) -> f64 {
        match self {
            Self::Rectangle(_, a, b) => a.length() * b.length(),
            Self::Sphere(_, radius) => 4.0 * PI * radius * radius,
        }
    }

    /// The point at (a, b) in [0, 1)^2, which uniform numbers spread evenly, and its normal.
    fn at(self, a: f64, b: f64) -> (DVec3, DVec3) {
        match self {
            Self::Rectangle(corner, x, y) => (corner + a * x + b * y, x.cross(y).normalize()),
            Self::Sphere(center, radius) => {
                let z = 2.0 * a - 1.0;
                let (sin, cos) = (2.0 * PI * b).sin_cos();
                let ring = (1.0 - z * z).sqrt();
                let normal = DVec3::new(ring * cos, ring * sin, z);
                (center + radius * normal, normal)
            }
        }
    }
}

impl<T: Real> Synthetic<T> {
    /// `n` Gaussians spread over the view of a `width` x `height` camera, depths 2..8, log-uniform radii that
    /// shrink with `n` so that about 40 of them blend per pixel, anisotropy up to 10.
    ///
    /// # Errors
    /// When the camera is invalid.
    pub fn new(n: usize, width: usize, height: usize, seed: u64) -> Result<Self, Error> {
        let mut u = Uniform(seed);
        let (w, h) = (width as f64, height as f64);
        let focal = FOCAL * w;
        let radius = (12.0 * w * h / (PI * n.max(1) as f64)).sqrt();
        let mut s = Self::empty(n, width, height)?;
        let real = T::from_f64;
        for _ in 0..n {
            let z = u.between(2.0, 8.0);
            let x = (u.between(-0.05, 1.05) - 0.5) * w * z / focal;
            let y = (u.between(-0.05, 1.05) - 0.5) * h * z / focal;
            s.means.extend([real(x), real(y), real(z)]);
            s.quats.extend((0..4).map(|_| real(u.between(-1.0, 1.0))));
            let size = radius * z / focal * u.between(-0.7, 0.7).exp();
            s.scales
                .extend((0..3).map(|_| real(size * u.between(-1.15, 1.15).exp())));
            s.opacities.push(real(u.between(0.02, 0.98)));
            s.harmonics
                .extend((0..48).map(|_| real(u.between(-0.3, 0.3))));
        }
        Ok(s)
    }

    /// `n` Gaussians as a trained scene holds them: on the surfaces of a room around the camera and of two
    /// spheres in it, evenly spread, as wide as their spacing and a tenth as thick. Most are nearly opaque,
    /// the others nearly clear. Behind the camera there are some, and behind the spheres.
    ///
    /// # Errors
    /// When the camera is invalid.
    pub fn room(n: usize, width: usize, height: usize, seed: u64) -> Result<Self, Error> {
        let mut u = Uniform(seed);
        let mut s = Self::empty(n, width, height)?;
        let surfaces = Surface::room();
        let areas = surfaces.map(|surface| surface.area());
        let total: f64 = areas.iter().sum();
        let spacing = (total / n.max(1) as f64).sqrt();
        let real = T::from_f64;
        for _ in 0..n {
            let mut at = u.between(0.0, total);
            let mut k = 0;
            while k + 1 < areas.len() && at >= areas[k] {
                at -= areas[k];
                k += 1;
            }
            let (point, normal) = surfaces[k].at(u.next(), u.next());
            // The third axis is the thin one.
            let turn = DQuat::from_rotation_arc(DVec3::Z, normal)
                * DQuat::from_rotation_z(u.between(-PI, PI));
            s.means.extend(point.to_array().map(real));
            s.quats.extend([turn.w, turn.x, turn.y, turn.z].map(real));
            s.scales
                .extend([1.0, 1.0, 0.1].map(|k| real(spacing * k * u.between(-0.5, 0.5).exp())));
            let (low, high) = if u.next() < 0.6 {
                (0.6, 0.99)
            } else {
                (0.02, 0.4)
            };
            s.opacities.push(real(u.between(low, high)));
            s.harmonics
                .extend((0..48).map(|_| real(u.between(-0.3, 0.3))));
        }
        Ok(s)
    }

    /// The camera of all scenes, and room for `n` Gaussians.
    fn empty(n: usize, width: usize, height: usize) -> Result<Self, Error> {
        let (w, h) = (width as f64, height as f64);
        let view = [
            1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, -0.2, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0,
        ];
        let focal = FOCAL * w;
        let k = [focal, 0.0, 0.5 * w, 0.0, focal, 0.5 * h, 0.0, 0.0, 1.0];
        Ok(Self {
            means: Vec::with_capacity(3 * n),
            quats: Vec::with_capacity(4 * n),
            scales: Vec::with_capacity(3 * n),
            opacities: Vec::with_capacity(n),
            harmonics: Vec::with_capacity(48 * n),
            camera: Camera::new(&view, &k, width, height)?,
        })
    }

    /// The Gaussians.
    pub fn gaussians(&self) -> Gaussians<'_, T> {
        Gaussians {
            means: &self.means,
            quats: &self.quats,
            scales: &self.scales,
            opacities: &self.opacities,
        }
    }
}
