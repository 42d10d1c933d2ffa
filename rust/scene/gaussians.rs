//! Borrowed views of the arrays that describe Gaussians.

use crate::{
    error::{Error, check_len},
    project::sh,
    simd::Real,
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
    /// Opacities, `[N]`.
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

/// Spherical harmonics of N Gaussians, K coefficients per channel.
#[derive(Debug, Clone, Copy)]
pub struct Harmonics<'a, T> {
    /// All coefficients, [N, K, 3]; with `rest` the constant ones alone, [N, 1, 3].
    pub coefficients: &'a [T],
    /// The coefficients of degree 1 and more, [N, K - 1, 3], where they are kept apart.
    pub rest: Option<&'a [T]>,
    /// K.
    pub stored: usize,
    /// The highest degree in use, 0..=3; coefficients above it are neither read nor differentiated.
    pub degree: usize,
}

impl<T: Real> Harmonics<'_, T> {
    /// Numbers per Gaussian in `coefficients` and in `rest`.
    pub fn rows(&self) -> (usize, usize) {
        if self.rest.is_some() {
            (3, 3 * self.stored.saturating_sub(1))
        } else {
            (self.stored.saturating_mul(3), 0)
        }
    }

    /// Check the number of coefficients and the degree.
    ///
    /// # Errors
    /// Names `degree` or `colors`.
    pub fn check(&self, n: usize) -> Result<(), Error> {
        if self.degree > sh::MAX_DEGREE {
            return Err(Error::new(
                "degree",
                format!("must be 0..=3, got {}", self.degree),
            ));
        }
        if self.stored < sh::count(self.degree) {
            let needed = sh::count(self.degree);
            return Err(Error::shape(
                "colors",
                format!("[N, K >= {needed}, 3] for degree {}", self.degree),
                format!("K = {}", self.stored),
            ));
        }
        let (row, rest_row) = self.rows();
        check_len("colors", self.coefficients, n.saturating_mul(row))?;
        self.rest.map_or(Ok(()), |rest| {
            check_len("colors", rest, n.saturating_mul(rest_row))
        })
    }
}

/// Where the colours of N Gaussians come from.
#[derive(Debug, Clone, Copy)]
pub enum Colors<'a, T> {
    /// Spherical harmonics, evaluated by the projection.
    Harmonics(Harmonics<'a, T>),
    /// [N, channels], given. The projection only culls what is not finite.
    Channels(&'a [T], usize),
}

impl<T: Real> Colors<'_, T> {
    /// Channels of the image.
    pub fn channels(&self) -> usize {
        match *self {
            Self::Harmonics(_) => 3,
            Self::Channels(_, channels) => channels,
        }
    }

    /// Check that they are those of `n` Gaussians.
    ///
    /// # Errors
    /// Names `degree` or `colors`.
    pub fn check(&self, n: usize) -> Result<(), Error> {
        match self {
            Self::Harmonics(harmonics) => harmonics.check(n),
            Self::Channels(data, channels) => {
                check_len("colors", data, n.saturating_mul(*channels))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_coefficients_that_cannot_be_are_refused() {
        let mut harmonics = Harmonics {
            coefficients: &[0.0f32; 6],
            rest: Some(&[]),
            stored: 0,
            degree: 0,
        };
        assert_eq!(harmonics.rows(), (3, 0));
        assert_eq!(harmonics.check(2).unwrap_err().name(), "colors");
        // As many as wrap around to the two that there are.
        harmonics.rest = None;
        harmonics.stored = usize::MAX / 6 + 2;
        assert_eq!(harmonics.check(2).unwrap_err().name(), "colors");
    }
}
