//! What trades accuracy for time. Every caller wants the defaults, whose reasons are in `constants.rs`; the
//! benchmark of error against run time measures the others.

use crate::{
    constants::{ALPHA_MIN, TRANSMITTANCE_MIN},
    error::Error,
};

/// Which tiles a Gaussian is sorted into.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Spans {
    /// Those that its support reaches, row of tiles by row.
    #[default]
    Ellipse,
    /// Those of the support's bounding box.
    Box,
    /// Those of a square of three standard deviations along the longer axis, as in the original 3DGS. It cuts
    /// off what an opaque Gaussian has beyond them.
    Square,
}

/// The knobs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AccuracyKnobs {
    /// Smallest alpha that is blended.
    pub alpha_min: f64,
    /// Compositing stops at this transmittance.
    pub transmittance_min: f64,
    /// Which tiles a Gaussian is sorted into.
    pub spans: Spans,
    /// Leave out the blocks of a tile that a Gaussian does not reach.
    pub skip_blocks: bool,
    /// Degree of the polynomial of 2^x, 3 to 6; used for three channels in f32 alone.
    pub exp2_degree: usize,
}

/// Degree of the polynomial of 2^x in f32: the first whose error is far below a rounding of f32.
pub const EXP2_DEGREE: usize = 6;

impl Default for AccuracyKnobs {
    fn default() -> Self {
        Self {
            alpha_min: ALPHA_MIN,
            transmittance_min: TRANSMITTANCE_MIN,
            spans: Spans::default(),
            skip_blocks: true,
            exp2_degree: EXP2_DEGREE,
        }
    }
}

impl AccuracyKnobs {
    /// Check the ranges.
    ///
    /// # Errors
    /// Names the first knob that is out of its range.
    pub fn check(&self) -> Result<(), Error> {
        let alpha_min = self.alpha_min;
        if !(1e-15..1.0).contains(&alpha_min) {
            let got = format!("must be in [1e-15, 1), got {alpha_min}");
            return Err(Error::new("alpha_min", got));
        }
        let transmittance_min = self.transmittance_min;
        if !(0.0..1.0).contains(&transmittance_min) {
            let got = format!("must be in [0, 1), got {transmittance_min}");
            return Err(Error::new("transmittance_min", got));
        }
        let degree = self.exp2_degree;
        if !(3..=EXP2_DEGREE).contains(&degree) {
            let got = format!("must be 3 to {EXP2_DEGREE}, got {degree}");
            return Err(Error::new("exp2_degree", got));
        }
        Ok(())
    }
}
