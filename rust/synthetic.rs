//! Seeded Gaussians for tests and benchmarks.

use crate::{Error, camera::Camera, real::Real, scene::Gaussians};

/// Arrays of N Gaussians and a camera that sees them.
#[derive(Debug, Clone)]
pub struct Synthetic<T> {
    /// [N, 3]
    pub means: Vec<T>,
    /// [N, 4]
    pub quats: Vec<T>,
    /// [N, 3]
    pub scales: Vec<T>,
    /// [N]
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

impl<T: Real> Synthetic<T> {
    /// `n` Gaussians spread over the view of a `width` x `height` camera, depths 2..8, log-uniform radii that
    /// shrink with `n` so that about 40 of them blend per pixel, anisotropy up to 10.
    ///
    /// # Errors
    /// When the camera is invalid.
    pub fn new(n: usize, width: usize, height: usize, seed: u64) -> Result<Self, Error> {
        let mut u = Uniform(seed);
        let (w, h) = (width as f64, height as f64);
        let focal = 0.8 * w;
        let view = [
            1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, -0.2, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0,
        ];
        let k = [focal, 0.0, 0.5 * w, 0.0, focal, 0.5 * h, 0.0, 0.0, 1.0];
        let camera = Camera::new(&view, &k, width, height)?;
        let radius = (12.0 * w * h / (std::f64::consts::PI * n.max(1) as f64)).sqrt();
        let mut s = Self {
            means: Vec::with_capacity(3 * n),
            quats: Vec::with_capacity(4 * n),
            scales: Vec::with_capacity(3 * n),
            opacities: Vec::with_capacity(n),
            harmonics: Vec::with_capacity(48 * n),
            camera,
        };
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
