//! Borrowed views of the arrays that describe Gaussians.

use crate::{
    error::{Error, check_len},
    real::Real,
    sh,
};

/// N Gaussians, all arrays row-major.
#[derive(Debug, Clone, Copy)]
pub struct Gaussians<'a, T> {
    /// Centres, [N, 3], world.
    pub means: &'a [T],
    /// Rotations, [N, 4], w x y z, any non-zero norm.
    pub quats: &'a [T],
    /// Standard deviations, [N, 3], world.
    pub scales: &'a [T],
    /// Opacities, [N].
    pub opacities: &'a [T],
}

impl<T: Real> Gaussians<'_, T> {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.opacities.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.opacities.is_empty()
    }

    /// Check that all arrays describe the same number of Gaussians.
    ///
    /// # Errors
    /// Names the first array whose length does not match.
    pub fn check(&self) -> Result<(), Error> {
        let n = self.len();
        check_len("means", self.means, 3 * n)?;
        check_len("quats", self.quats, 4 * n)?;
        check_len("scales", self.scales, 3 * n)
    }
}

/// Spherical harmonics of N Gaussians.
#[derive(Debug, Clone, Copy)]
pub struct Harmonics<'a, T> {
    /// Coefficients, [N, K, 3].
    pub coefficients: &'a [T],
    /// K, the number of coefficients stored per channel.
    pub stored: usize,
    /// The highest degree in use, 0..=3; coefficients above it are neither read nor differentiated.
    pub degree: usize,
}

impl<T: Real> Harmonics<'_, T> {
    /// Check the number of coefficients and the degree.
    ///
    /// # Errors
    /// Names `sh_degree` or `colors`.
    pub fn check(&self, n: usize) -> Result<(), Error> {
        if self.degree > sh::MAX_DEGREE {
            return Err(Error::new(
                "sh_degree",
                format!("must be 0..=3, got {}", self.degree),
            ));
        }
        if self.stored < sh::count(self.degree) {
            let needed = sh::count(self.degree);
            return Err(Error::shape(
                "colors",
                format!("[N, K >= {needed}, 3] for sh_degree {}", self.degree),
                format!("K = {}", self.stored),
            ));
        }
        check_len("colors", self.coefficients, n * self.stored * 3)
    }
}

/// Where the colours of N Gaussians come from.
#[derive(Debug, Clone, Copy)]
pub enum Colors<'a, T> {
    /// Spherical harmonics, evaluated by the projection.
    Harmonics(&'a Harmonics<'a, T>),
    /// [N, channels], given. The projection only culls what is not finite.
    Channels(&'a [T], usize),
}
