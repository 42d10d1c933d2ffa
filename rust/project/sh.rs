//! Real spherical harmonics of degree 0..3 in the basis order and signs of the original 3DGS, one direction
//! per SIMD lane.

use crate::simd::{Lanes, Real, vec3::V3};
use fearless_simd::{Simd, SimdBase};

/// Number of coefficients of all degrees up to `degree`.
pub const fn count(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// Highest degree that is implemented.
pub const MAX_DEGREE: usize = 3;

/// Coefficients of degree 3.
pub const MAX_COUNT: usize = count(MAX_DEGREE);

/// The function of degree 0.
pub const C0: f64 = 0.282_094_791_773_878_14; // sqrt(1 / 4 pi)
const C1: f64 = 0.488_602_511_902_919_9; // sqrt(3 / 4 pi)
const C2A: f64 = 1.092_548_430_592_079_2; // sqrt(15 / 4 pi)
const C2B: f64 = 0.315_391_565_252_520_05; // sqrt(5 / 16 pi)
const C2C: f64 = 0.546_274_215_296_039_6; // sqrt(15 / 16 pi)
const C3A: f64 = 0.590_043_589_926_643_5; // sqrt(35 / 32 pi)
const C3B: f64 = 2.890_611_442_640_554; // sqrt(105 / 4 pi)
const C3C: f64 = 0.457_045_799_464_465_8; // sqrt(21 / 32 pi)
const C3D: f64 = 0.373_176_332_590_115_4; // sqrt(7 / 16 pi)
const C3E: f64 = 1.445_305_721_320_277; // sqrt(105 / 16 pi)

/// Basis functions at the unit vector `d`; those above `degree` are 0.
#[inline(always)]
pub fn basis<S: Simd, T: Real>(
    simd: S,
    degree: usize,
    d: V3<Lanes<T, S>>,
) -> [Lanes<T, S>; MAX_COUNT] {
    let real = T::from_f64;
    let V3 { x, y, z } = d;
    let mut b = [Lanes::<T, S>::splat(simd, T::ZERO); MAX_COUNT];
    b[0] = Lanes::<T, S>::splat(simd, real(C0));
    if degree >= 1 {
        b[1] = y * real(-C1);
        b[2] = z * real(C1);
        b[3] = x * real(-C1);
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree >= 2 {
        b[4] = x * y * real(C2A);
        b[5] = y * z * real(-C2A);
        b[6] = (zz * real(2.0) - xx - yy) * real(C2B);
        b[7] = x * z * real(-C2A);
        b[8] = (xx - yy) * real(C2C);
    }
    if degree >= 3 {
        b[9] = y * (xx * real(3.0) - yy) * real(-C3A);
        b[10] = x * y * z * real(C3B);
        b[11] = y * (zz * real(4.0) - xx - yy) * real(-C3C);
        b[12] = z * (zz * real(2.0) - (xx + yy) * real(3.0)) * real(C3D);
        b[13] = x * (zz * real(4.0) - xx - yy) * real(-C3C);
        b[14] = z * (xx - yy) * real(C3E);
        b[15] = x * (xx - yy * real(3.0)) * real(-C3A);
    }
    b
}

/// Gradient of `sum_k weights[k] basis[k]` with respect to `d`, as three free variables.
#[inline(always)]
pub fn basis_vjp<S: Simd, T: Real>(
    simd: S,
    degree: usize,
    d: V3<Lanes<T, S>>,
    w: &[Lanes<T, S>; MAX_COUNT],
) -> V3<Lanes<T, S>> {
    let real = T::from_f64;
    let V3 { x, y, z } = d;
    let zero = Lanes::<T, S>::splat(simd, T::ZERO);
    let mut g = V3::new(zero, zero, zero);
    if degree >= 1 {
        g = V3::new(w[3] * real(-C1), w[1] * real(-C1), w[2] * real(C1));
    }
    if degree >= 2 {
        g.x += (y * w[4] - z * w[7]) * real(C2A) - x * w[6] * real(2.0 * C2B)
            + x * w[8] * real(2.0 * C2C);
        g.y += (x * w[4] - z * w[5]) * real(C2A)
            - y * w[6] * real(2.0 * C2B)
            - y * w[8] * real(2.0 * C2C);
        g.z += z * w[6] * real(4.0 * C2B) - (y * w[5] + x * w[7]) * real(C2A);
    }
    if degree >= 3 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        g.x += y * z * w[10] * real(C3B) - x * y * w[9] * real(6.0 * C3A)
            + x * y * w[11] * real(2.0 * C3C)
            - x * z * w[12] * real(6.0 * C3D)
            - (zz * real(4.0) - xx * real(3.0) - yy) * w[13] * real(C3C)
            + x * z * w[14] * real(2.0 * C3E)
            - (xx - yy) * w[15] * real(3.0 * C3A);
        g.y += x * z * w[10] * real(C3B)
            - (xx - yy) * w[9] * real(3.0 * C3A)
            - (zz * real(4.0) - xx - yy * real(3.0)) * w[11] * real(C3C)
            - y * z * w[12] * real(6.0 * C3D)
            + x * y * w[13] * real(2.0 * C3C)
            - y * z * w[14] * real(2.0 * C3E)
            + x * y * w[15] * real(6.0 * C3A);
        g.z += x * y * w[10] * real(C3B) - y * z * w[11] * real(8.0 * C3C)
            + (zz * real(6.0) - (xx + yy) * real(3.0)) * w[12] * real(C3D)
            - x * z * w[13] * real(8.0 * C3C)
            + (xx - yy) * w[14] * real(C3E);
    }
    g
}

#[cfg(test)]
mod tests {
    use super::{basis as lanes_basis, basis_vjp as lanes_vjp, *};
    use crate::simd::{Level, Wide, at_each_level, vec3::splat3};
    use fearless_simd::dispatch;
    use glam::DVec3;

    fn basis(level: Level, degree: usize, d: [f64; 3]) -> [f64; MAX_COUNT] {
        #[inline(always)]
        fn run<S: Simd>(simd: S, degree: usize, d: [f64; 3]) -> [f64; MAX_COUNT] {
            lanes_basis::<S, f64>(simd, degree, splat3(simd, DVec3::from(d))).map(|b| b[0])
        }
        dispatch!(level.token, simd => run(simd, degree, d))
    }

    fn basis_vjp(level: Level, degree: usize, d: [f64; 3], w: &[f64; MAX_COUNT]) -> [f64; 3] {
        #[inline(always)]
        fn run<S: Simd>(simd: S, degree: usize, d: [f64; 3], w: &[f64; MAX_COUNT]) -> [f64; 3] {
            let w = w.map(|w| Wide::<S>::splat(simd, w));
            let g = lanes_vjp::<S, f64>(simd, degree, splat3(simd, DVec3::from(d)), &w);
            [g.x[0], g.y[0], g.z[0]]
        }
        dispatch!(level.token, simd => run(simd, degree, d, w))
    }

    #[test]
    fn basis_is_orthonormal() {
        at_each_level(check_gram);
    }

    fn check_gram(level: Level) {
        // Gauss-Legendre would be exact; a fine midpoint rule in (z, phi) is enough to see a wrong constant.
        let (nz, np) = (400, 200);
        let mut gram = [[0.0; MAX_COUNT]; MAX_COUNT];
        for i in 0..nz {
            let z = (i as f64 + 0.5) / nz as f64 * 2.0 - 1.0;
            let r = (1.0 - z * z).sqrt();
            for j in 0..np {
                let phi = std::f64::consts::TAU * (j as f64 + 0.5) / np as f64;
                let b = basis(level, 3, [r * phi.cos(), r * phi.sin(), z]);
                for (row, bi) in gram.iter_mut().zip(b) {
                    for (g, bj) in row.iter_mut().zip(b) {
                        *g += bi * bj * 2.0 * std::f64::consts::TAU / (nz * np) as f64;
                    }
                }
            }
        }
        for (i, row) in gram.iter().enumerate() {
            for (j, g) in row.iter().enumerate() {
                let expected = f64::from(u8::from(i == j));
                assert!((g - expected).abs() < 1e-4, "<Y{i}, Y{j}> = {g}");
            }
        }
    }

    #[test]
    fn gradient_is_the_limit_of_differences() {
        at_each_level(check_gradient);
    }

    fn check_gradient(level: Level) {
        let p = [0.3, -0.8, 0.52];
        let w: [f64; MAX_COUNT] = std::array::from_fn(|k| (k as f64 * 1.7).sin());
        let value = |p| {
            basis(level, 3, p)
                .iter()
                .zip(w)
                .map(|(b, w)| b * w)
                .sum::<f64>()
        };
        let g = basis_vjp(level, 3, p, &w);
        for axis in 0..3 {
            let h = 1e-5;
            let (mut a, mut b) = (p, p);
            a[axis] += h;
            b[axis] -= h;
            let difference = (value(a) - value(b)) / (2.0 * h);
            assert!(
                (g[axis] - difference).abs() < 1e-9,
                "axis {axis}: {} vs {difference}",
                g[axis]
            );
        }
    }
}
