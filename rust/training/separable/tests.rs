//! The operator against dense matrices, and what must hold exactly.

use super::*;
use crate::at_each_level;
use hqgs::{Level, internals::simd::at_level, levels};
use rayon::ThreadPoolBuilder;

/// A number in [-1, 1] for each (a, b).
fn noise(a: usize, b: usize) -> f64 {
    ((a as f64) * 12.9898 + (b as f64) * 78.233).sin()
}

/// A matrix [height, width] whose row y has `reach` weights around its place, none where `reach` is 0.
fn banded(height: usize, width: usize, reach: usize) -> Vec<f64> {
    let mut out = vec![0.0; height * width];
    for y in 0..height {
        let middle = y * width / height;
        for x in middle.saturating_sub(reach / 2)..width.min(middle + reach.div_ceil(2)) {
            out[y * width + x] = noise(y + 3, x);
        }
    }
    out
}

fn dense(weights: &[f64], height: usize, width: usize) -> Dense<'_> {
    Dense {
        weights,
        height,
        width,
    }
}

/// By the definition.
fn expected(
    image: &[f64],
    [h, w]: [usize; 2],
    c: usize,
    rows: Dense,
    columns: Dense,
    mix: Dense,
) -> Vec<f64> {
    let mut out = vec![0.0; rows.height * columns.height * mix.height];
    for (i, out) in out.iter_mut().enumerate() {
        let (y, x) = (
            i / (columns.height * mix.height),
            i / mix.height % columns.height,
        );
        let d = i % mix.height;
        for (k, value) in image.iter().enumerate().take(h * w * c) {
            let (a, b) = (k / (w * c), k / c % w);
            *out += rows.weights[y * h + a]
                * columns.weights[x * w + b]
                * mix.weights[d * c + k % c]
                * value;
        }
    }
    out
}

fn check<T: Real>(level: Level, tolerance: f64) {
    for (h, w, c, rows, columns, d, reach) in [
        (5, 7, 3, 9, 4, 0, 3),
        (1, 1, 1, 1, 1, 0, 1),
        (20, 3, 2, 37, 2, 0, 7),
        (33, 21, 3, 16, 40, 1, 40),
        (18, 19, 3, 17, 8, 2, 5),
        (4, 17, 1, 3, 1, 3, 0),
    ] {
        let image: Vec<f64> = (0..h * w * c).map(|i| noise(i, 1)).collect();
        let (m, k) = (banded(rows, h, reach), banded(columns, w, reach.max(1)));
        let mix: Vec<f64> = if d == 0 {
            (0..c * c).map(|i| f64::from(i % (c + 1) == 0)).collect()
        } else {
            (0..d * c).map(|i| noise(i, 2)).collect()
        };
        let mix = dense(&mix, if d == 0 { c } else { d }, c);
        let (m, k) = (dense(&m, rows, h), dense(&k, columns, w));
        let channels = (d > 0).then_some(mix);
        let (there, back) = Separable::<T>::pair(m, k, channels).unwrap();
        let typed: Vec<T> = image.iter().map(|x| T::from_f64(*x)).collect();
        let out = at_level(level, || there.apply(&typed, &[h, w, c])).unwrap();
        let right = expected(&image, [h, w], c, m, k, mix);
        assert_eq!(out.len(), right.len());
        for (a, b) in out.iter().zip(&right) {
            assert!((a.to_f64() - b).abs() < tolerance, "{} {b}", a.to_f64());
        }
        // <A x, y> = <x, A^T y>
        let y: Vec<T> = (0..out.len()).map(|i| T::from_f64(noise(i, 5))).collect();
        let v = at_level(level, || back.apply(&y, &[rows, columns, mix.height])).unwrap();
        let dot = |a: &[T], b: &[T]| -> f64 {
            a.iter().zip(b).map(|(a, b)| a.to_f64() * b.to_f64()).sum()
        };
        let (a, b) = (dot(&out, &y), dot(&typed, &v));
        assert!((a - b).abs() < 30.0 * tolerance, "{a} {b}");
    }
}

#[test]
fn is_the_product_with_dense_matrices() {
    at_each_level(|level| {
        check::<f64>(level, 1e-12);
        check::<f32>(level, 5e-6);
    });
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let (m, k) = (banded(67, 90, 9), banded(50, 80, 9));
    let (m, k) = (dense(&m, 67, 90), dense(&k, 50, 80));
    let (there, _) = Separable::<f32>::pair(m, k, None).unwrap();
    let image: Vec<f32> = (0..90 * 80 * 3).map(|i| noise(i, 7) as f32).collect();
    let run = |level, threads| {
        let pool = ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap()
            .install(|| at_level(level, || there.apply(&image, &[90, 80, 3])).unwrap())
    };
    at_each_level(|level| {
        let one = run(level, 1);
        assert!(run(level, 2) == one && run(level, 5) == one);
        if level.is_fused() == levels()[0].is_fused() {
            assert!(run(levels()[0], 1) == one);
        }
    });
}

#[test]
fn what_is_not_finite_stays_in_its_reach() {
    at_each_level(check_reach);
}

fn check_reach(level: Level) {
    let m = banded(30, 30, 5);
    let (there, _) = Separable::<f32>::pair(dense(&m, 30, 30), dense(&m, 30, 30), None).unwrap();
    for bad in [f32::NAN, f32::INFINITY] {
        let mut image = vec![1.0; 900];
        image[10 * 30 + 20] = bad;
        let out = at_level(level, || there.apply(&image, &[30, 30, 1])).unwrap();
        for (i, x) in out.iter().enumerate() {
            let reached = m[i / 30 * 30 + 10] != 0.0 && m[i % 30 * 30 + 20] != 0.0;
            assert_eq!(x.is_finite(), !reached, "{i}");
        }
    }
}

#[test]
fn wrong_shapes_are_named() {
    let m = [1.0; 6];
    let (there, _) = Separable::<f32>::pair(dense(&m, 2, 3), dense(&m, 3, 2), None).unwrap();
    for shape in [&[3, 2][..], &[2, 3, 1], &[3, 2, 0]] {
        let error = there.apply(&[0.0; 6], shape).unwrap_err();
        assert_eq!(error.name(), "image");
    }
    let empty = Separable::<f32>::pair(dense(&m, 2, 3), dense(&[], 0, 2), None);
    assert_eq!(empty.unwrap_err().name(), "columns");
}
