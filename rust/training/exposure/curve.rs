//! The curve of sRGB (IEC 61966-2-1) from values to linear light and back, and its slopes.
//!
//! Above 1 the power goes on, below 0 the straight line.

use hqgs::internals::simd::Real;
use std::{
    ops::{Add, AddAssign, Div, Mul, MulAssign, Sub},
    sync::OnceLock,
};

const STEPS: usize = 4096;
const KNEE_VALUE: f64 = 0.04045;
const KNEE_LIGHT: f64 = 0.003_130_8;
const POWER: f64 = 2.4;
const SHIFT: f64 = 0.055;

/// Values between 0 and 1 for f32, by linear interpolation: light is off by less than 3e-7 of white, values by less
/// than 1e-6.
#[derive(Debug)]
pub struct Tables {
    /// The light of `i / STEPS`.
    light: Vec<f32>,
    /// The value of the light `(i / STEPS)^2`: by its root, since the slope at 0 is steep.
    value: Vec<f32>,
}

/// The tables, made at their first use.
pub fn tables() -> &'static Tables {
    static TABLES: OnceLock<Tables> = OnceLock::new();
    TABLES.get_or_init(|| {
        let at = |i: usize| i as f64 / STEPS as f64;
        Tables {
            light: (0..=STEPS + 1).map(|i| light(at(i)) as f32).collect(),
            value: (0..=STEPS + 1)
                .map(|i| value(at(i) * at(i)) as f32)
                .collect(),
        }
    })
}

fn light(value: f64) -> f64 {
    if value <= KNEE_VALUE {
        value / 12.92
    } else {
        ((value + SHIFT) / (1.0 + SHIFT)).powf(POWER)
    }
}

fn value(light: f64) -> f64 {
    if light <= KNEE_LIGHT {
        12.92 * light
    } else {
        (1.0 + SHIFT) * light.powf(1.0 / POWER) - SHIFT
    }
}

#[inline(always)]
fn interpolate(table: &[f32], at: f32) -> f32 {
    let x = at * STEPS as f32;
    let i = (x as usize).min(STEPS);
    let f = x - i as f32;
    table[i] + f * (table[i + 1] - table[i])
}

/// A scalar that light is counted in.
pub trait Light:
    Real
    + Copy
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + AddAssign
    + MulAssign
{
    /// Of a value, white at 1.
    fn to_light(self, tables: &Tables) -> Self;
    /// The value of this light.
    fn to_value(self, tables: &Tables) -> Self;
    /// Largest integer that is not above it, as an index, with `0 <= self`; and what is left.
    fn split(self) -> (usize, Self);

    /// Slope of [`Self::to_light`] at `self`, whose light is `light`.
    #[inline(always)]
    fn light_slope(self, light: Self) -> Self {
        if self <= Self::from_f64(KNEE_VALUE) {
            Self::from_f64(1.0 / 12.92)
        } else {
            Self::from_f64(POWER) * light / (self + Self::from_f64(SHIFT))
        }
    }

    /// Slope of [`Self::to_value`] at `self`, whose value is `value`.
    #[inline(always)]
    fn value_slope(self, value: Self) -> Self {
        if self <= Self::from_f64(KNEE_LIGHT) {
            Self::from_f64(12.92)
        } else {
            (value + Self::from_f64(SHIFT)) / (Self::from_f64(POWER) * self)
        }
    }
}

impl Light for f32 {
    #[inline(always)]
    fn to_light(self, tables: &Tables) -> Self {
        if (0.0..=1.0).contains(&self) {
            interpolate(&tables.light, self)
        } else {
            light(f64::from(self)) as Self
        }
    }

    #[inline(always)]
    fn to_value(self, tables: &Tables) -> Self {
        if (0.0..=1.0).contains(&self) {
            interpolate(&tables.value, self.sqrt())
        } else {
            value(f64::from(self)) as Self
        }
    }

    #[inline(always)]
    fn split(self) -> (usize, Self) {
        let i = self as usize;
        (i, self - i as Self)
    }
}

impl Light for f64 {
    fn to_light(self, _: &Tables) -> Self {
        light(self)
    }

    fn to_value(self, _: &Tables) -> Self {
        value(self)
    }

    #[inline(always)]
    fn split(self) -> (usize, Self) {
        let i = self as usize;
        (i, self - i as Self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_as_exact_as_stated() {
        let tables = tables();
        for i in 0..=100_000 {
            let x = f64::from(i) / 100_000.0;
            assert!(
                (f64::from((x as f32).to_light(tables)) - light(x)).abs() < 3e-7,
                "{x}"
            );
            assert!(
                (f64::from((x as f32).to_value(tables)) - value(x)).abs() < 1e-6,
                "{x}"
            );
        }
    }

    #[test]
    fn one_is_the_inverse_of_the_other() {
        for i in -20..=300 {
            let x = f64::from(i) / 100.0;
            assert!((value(light(x)) - x).abs() < 1e-7, "{x}"); // the standard's two pieces meet so well
        }
    }

    #[test]
    fn slopes_are_those_of_the_curves() {
        let (tables, h) = (tables(), 1e-6);
        for x in [-0.2, 0.01, 0.3, 0.9, 1.4] {
            let (y, z) = (light(x), value(x));
            let expected = (light(x + h) - light(x - h)) / (2.0 * h);
            assert!(
                (x.light_slope(x.to_light(tables)) - expected).abs() < 1e-8,
                "{x} {y}"
            );
            let expected = (value(x + h) - value(x - h)) / (2.0 * h);
            assert!((x.value_slope(z) - expected).abs() < 1e-8, "{x}");
        }
    }
}
