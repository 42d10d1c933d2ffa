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
}

impl Default for AccuracyKnobs {
    fn default() -> Self {
        Self {
            alpha_min: ALPHA_MIN,
            transmittance_min: TRANSMITTANCE_MIN,
            spans: Spans::default(),
            skip_blocks: true,
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
        Ok(())
    }
}
