//! The fast path against direct 11 x 11 sums in f64, and what must hold exactly.

use super::{
    band::{C1, C2, SIGMA},
    *,
};
use crate::{at_each_level, noise};
use hqgs::{Level, internals::simd::at_level, levels};

/// The textbook formula with direct 11 x 11 sums: (L1, SSIM).
fn reference(x: &[f64], y: &[f64], mask: Option<&[u8]>, [h, w, c]: [usize; 3]) -> (f64, f64) {
    let counts = |pixel: usize| mask.is_none_or(|m| m[pixel] != 0);
    let x: Vec<f64> = (0..h * w * c)
        .map(|i| if counts(i / c) { x[i] } else { y[i] })
        .collect();
    let tap = |k: isize| (-((k * k) as f64) / (2.0 * SIGMA * SIGMA)).exp();
    let total: f64 = (-5..=5).map(tap).sum();
    let mut ssim = 0.0;
    for (i, j, k) in (0..h * w * c).map(|i| (i / (w * c), i / c % w, i % c)) {
        let mut m = [0.0; 5];
        for (di, dj) in (-5..=5).flat_map(|di| (-5..=5).map(move |dj| (di, dj))) {
            let (r, s) = (i as isize + di, j as isize + dj);
            if (0..h as isize).contains(&r) && (0..w as isize).contains(&s) {
                let at = (r as usize * w + s as usize) * c + k;
                let weight = tap(di) * tap(dj) / (total * total);
                let (x, y) = (x[at], y[at]);
                for (m, v) in m.iter_mut().zip([x, y, x * x, y * y, x * y]) {
                    *m += weight * v;
                }
            }
        }
        let [x, y, xx, yy, xy] = m;
        ssim += (2.0 * x * y + C1) / (x * x + y * y + C1) * (2.0 * (xy - x * y) + C2)
            / (xx - x * x + yy - y * y + C2);
    }
    let counted = (0..h * w).filter(|&p| counts(p)).count() * c;
    let l1 = x.iter().zip(y).map(|(x, y)| (x - y).abs()).sum::<f64>() / counted.max(1) as f64;
    (l1, ssim / (h * w * c) as f64)
}

fn photo(seed: u64, n: usize) -> Vec<u8> {
    noise(seed, n)
        .into_iter()
        .map(|v| (v * 256.0) as u8)
        .collect()
}

fn cast<T: Real>(x: &[f64]) -> Vec<T> {
    x.iter().map(|&v| T::from_f64(v)).collect()
}

fn unit(y: &[u8]) -> Vec<f64> {
    y.iter().map(|&v| f64::from(v) / 255.0).collect()
}

fn images<'a, T, Y>(
    render: &'a [T],
    target: &'a [Y],
    mask: Option<&'a [u8]>,
    size: [usize; 3],
) -> Images<'a, T, Y> {
    Images {
        render,
        target,
        mask,
        size,
    }
}

fn loss<T: Real>(
    level: Level,
    x: &[T],
    y: &[u8],
    mask: Option<&[u8]>,
    size: [usize; 3],
    lambda: f64,
) -> (Photometric, Vec<T>) {
    let mut grad = vec![T::from_f64(7.0); x.len()];
    let mut scratch = LossScratch::default();
    let (out, s) = (Some(&mut grad[..]), &mut scratch);
    let (images, options) = (images(x, y, mask, size), LossOptions { lambda, knee: 0.0 });
    let value = at_level(level, || photometric(images, &options, out, s)).unwrap();
    let alone = at_level(level, || photometric(images, &options, None, s)).unwrap();
    assert!(
        value == alone || value.loss.is_nan(),
        "{value:?} with the gradient, {alone:?} without"
    );
    (value, grad)
}

const SIZES: [[usize; 3]; 7] = [
    [1, 1, 3],
    [1, 40, 3],
    [40, 1, 3],
    [7, 5, 3],
    [33, 17, 3],
    [12, 9, 1],
    [70, 6, 4],
];

#[test]
fn agrees_with_the_textbook_formula() {
    at_each_level(check_formula);
}

fn check_formula(level: Level) {
    for (seed, size) in SIZES.into_iter().enumerate() {
        let n = size.iter().product();
        let (x, y) = (noise(seed as u64, n), photo(seed as u64 + 50, n));
        let mask: Vec<u8> = noise(9, n / size[2])
            .iter()
            .map(|&v| u8::from(v > 0.3))
            .collect();
        for mask in [None, Some(&mask[..])] {
            let (l1, ssim) = reference(&x, &unit(&y), mask, size);
            let (got, _) = loss(level, &x, &y, mask, size, 0.3);
            assert!((got.l1 - l1).abs() < 1e-14, "{size:?} {} {l1}", got.l1);
            assert!(
                (got.ssim.unwrap() - ssim).abs() < 1e-13,
                "{size:?} {got:?} {ssim}"
            );
            assert!((got.loss - (0.7 * l1 + 0.3 * (1.0 - ssim))).abs() < 1e-13);
            let (got, _) = loss(level, &cast::<f32>(&x), &y, mask, size, 0.3);
            assert!(
                (got.loss - (0.7 * l1 + 0.3 * (1.0 - ssim))).abs() < 1e-6,
                "{size:?} {got:?}"
            );
        }
    }
}

#[test]
fn gradient_agrees_with_finite_differences_of_the_textbook_formula() {
    at_each_level(check_differences);
}

fn check_differences(level: Level) {
    for (seed, size) in SIZES.into_iter().enumerate().take(6) {
        let n = size.iter().product();
        let (mut x, y) = (noise(seed as u64 + 7, n), photo(seed as u64 + 70, n));
        let mask: Vec<u8> = noise(3, n / size[2])
            .iter()
            .map(|&v| u8::from(v > 0.3))
            .collect();
        for mask in [None, Some(&mask[..])] {
            let (_, grad) = loss(level, &x, &y, mask, size, 0.4);
            let value = |x: &[f64]| {
                let (l1, ssim) = reference(x, &unit(&y), mask, size);
                0.6 * l1 + 0.4 * (1.0 - ssim)
            };
            for i in (0..n).step_by(1 + n / 40) {
                let (h, centre) = (1e-5, x[i]);
                x[i] = centre + h;
                let above = value(&x);
                x[i] = centre - h;
                let below = value(&x);
                x[i] = centre;
                let expected = (above - below) / (2.0 * h);
                let error = (grad[i] - expected).abs();
                assert!(
                    error < 1e-6 / n as f64 + 2e-10,
                    "{size:?} {i}: {} {expected}",
                    grad[i]
                );
            }
        }
    }
}

/// f32 against f64 on images with little texture and little error, where variances cancel most.
#[test]
fn f32_keeps_its_digits() {
    at_each_level(check_digits);
}

fn check_digits(level: Level) {
    let size = [40, 37, 3];
    let n = size.iter().product();
    for (gray, amplitude) in [
        (128u8, 0.5),
        (0, 0.01),
        (255, 0.01),
        (128, 0.01),
        (250, 0.001),
    ] {
        let y: Vec<u8> = photo(1, n)
            .iter()
            .map(|&v| if v > 250 { gray ^ 1 } else { gray })
            .collect();
        let x: Vec<f64> = unit(&y)
            .iter()
            .zip(noise(2, n))
            .map(|(y, e)| y + amplitude * (e - 0.5))
            .collect();
        let x: Vec<f32> = cast(&x);
        let (fine, fine_grad) = loss(
            level,
            &cast::<f64>(&x.iter().map(|&v| v.into()).collect::<Vec<_>>()),
            &y,
            None,
            size,
            1.0,
        );
        let (coarse, coarse_grad) = loss(level, &x, &y, None, size, 1.0);
        let relative = (coarse.loss / fine.loss - 1.0).abs();
        assert!(
            relative < 2e-5,
            "gray {gray}, noise {amplitude}: loss off by {relative:e}"
        );
        let norm = |g: &mut dyn Iterator<Item = f64>| g.map(|v| v * v).sum::<f64>().sqrt();
        let off = norm(
            &mut fine_grad
                .iter()
                .zip(&coarse_grad)
                .map(|(a, &b)| a - f64::from(b)),
        );
        let off = off / norm(&mut fine_grad.iter().copied());
        assert!(
            off < 5e-5,
            "gray {gray}, noise {amplitude}: gradient off by {off:e}"
        );
    }
}

#[test]
fn equal_images_have_no_loss_and_no_gradient() {
    at_each_level(check_equal);
}

fn check_equal(level: Level) {
    for gray in [0u8, 255, 77] {
        let y = vec![gray; 20 * 13 * 3];
        let x: Vec<f32> = y.iter().map(|&v| Sample::<f32>::value(v)).collect();
        let (value, grad) = loss(level, &x, &y, None, [20, 13, 3], 0.2);
        assert_eq!(
            value,
            Photometric {
                loss: 0.0,
                l1: 0.0,
                ssim: Some(1.0)
            }
        );
        assert!(grad.iter().all(|&g| g == 0.0));
    }
}

#[test]
fn black_against_white_is_the_worst() {
    at_each_level(check_worst);
}

fn check_worst(level: Level) {
    let (value, grad) = loss(
        level,
        &vec![0.0f64; 30 * 30],
        &[255; 30 * 30],
        None,
        [30, 30, 1],
        0.2,
    );
    assert_eq!(value.l1, 1.0);
    assert!(value.ssim.unwrap() < 0.1);
    assert!(grad.iter().all(|&g| g < 0.0));
}

#[test]
fn lambda_0_is_l1_alone_and_lambda_1_ssim_alone() {
    at_each_level(check_lambda);
}

fn check_lambda(level: Level) {
    let (x, y) = (noise(1, 60), photo(2, 60));
    let (value, grad) = loss(level, &x, &y, None, [4, 5, 3], 0.0);
    assert_eq!((value.loss, value.ssim), (value.l1, None));
    assert!(
        grad.iter()
            .zip(&x)
            .zip(unit(&y))
            .all(|((&g, &x), y)| g == (x - y).signum() / 60.0)
    );
    let (value, _) = loss(level, &x, &y, None, [4, 5, 3], 1.0);
    assert!((value.loss - (1.0 - value.ssim.unwrap())).abs() < 1e-15);
}

#[test]
fn masked_pixels_do_not_count() {
    at_each_level(check_mask);
}

fn check_mask(level: Level) {
    let size @ [h, w, c] = [16, 11, 3];
    let (mut x, y) = (noise(1, h * w * c), photo(2, h * w * c));
    let mut mask = vec![1; h * w];
    mask[5] = 0;
    let expected = loss(level, &x, &y, Some(&mask), size, 0.5);
    assert_eq!(expected.1[5 * c..6 * c], [0.0; 3]);
    x[5 * c] = f64::NAN;
    assert_eq!(loss(level, &x, &y, Some(&mask), size, 0.5), expected);
    let nothing = loss(level, &x, &y, Some(&vec![0; h * w]), size, 0.5);
    assert_eq!(
        nothing,
        (
            Photometric {
                loss: 0.0,
                l1: 0.0,
                ssim: Some(1.0)
            },
            vec![0.0; h * w * c]
        )
    );
}

#[test]
fn nan_and_infinity_give_a_nan_or_infinite_loss() {
    at_each_level(check_not_finite);
}

fn check_not_finite(level: Level) {
    for (bad, at) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY]
        .into_iter()
        .zip([0, 700, 33 * 17 * 3 - 1])
    {
        let (mut x, y) = (cast::<f32>(&noise(1, 33 * 17 * 3)), photo(2, 33 * 17 * 3));
        x[at] = bad;
        for lambda in [0.0, 0.2] {
            let (value, _) = loss(level, &x, &y, None, [33, 17, 3], lambda);
            assert!(!value.loss.is_finite(), "{bad} at {at}: {value:?}");
        }
    }
}

#[test]
fn same_bits_for_any_number_of_threads() {
    at_each_level(check_threads);
}

fn check_threads(level: Level) {
    let size = [131, 23, 3];
    let n = size.iter().product();
    let (x, y) = (cast::<f32>(&noise(1, n)), photo(2, n));
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let (value, grad) = pool.install(|| loss(level, &x, &y, None, size, 0.2));
        (
            value.loss.to_bits(),
            value.l1.to_bits(),
            grad.iter().map(|g| g.to_bits()).collect::<Vec<_>>(),
        )
    };
    let one = run(1);
    assert!(one == run(2) && one == run(3));
}

#[test]
fn each_level_agrees_with_the_best() {
    let [height, width, channels] = [33, 17, 3];
    let n = height * width * channels;
    let (x, y) = (noise(1, n), photo(2, n));
    let images = images(&x, &y, None, [height, width, channels]);
    let plan = Plan {
        ssim: true,
        knee: 0.0,
        l1_scale: 0.5,
        ssim_scale: 0.5,
    };
    let at = |level| {
        let mut grad = vec![0.0; n];
        let mut scratch = LossScratch::default();
        let sums = at_level(level, || run(images, plan, Some(&mut grad), &mut scratch));
        (sums.unwrap(), grad)
    };
    let best = at(levels()[0]);
    at_each_level(|level| {
        let other = at(level);
        assert!((best.0.l1 - other.0.l1).abs() < 1e-10);
        assert!((best.0.dissimilarity - other.0.dissimilarity).abs() < 1e-10);
        assert!(
            best.1
                .iter()
                .zip(&other.1)
                .all(|(a, b)| (a - b).abs() < 1e-12)
        );
        if level.is_fused() == levels()[0].is_fused() {
            assert!(best.0.dissimilarity == other.0.dissimilarity && best.1 == other.1);
        }
    });
}

#[test]
fn scratch_of_another_size_can_be_reused() {
    at_each_level(check_scratch);
}

fn check_scratch(level: Level) {
    let mut scratch = LossScratch::default();
    for size @ [h, w, c] in SIZES.into_iter().rev() {
        let (x, y) = (noise(1, h * w * c), photo(2, h * w * c));
        let got = at_level(level, || {
            photometric(
                images(&x, &y, None, size),
                &LossOptions::default(),
                None,
                &mut scratch,
            )
        })
        .unwrap();
        assert_eq!(got, loss(level, &x, &y, None, size, 0.2).0);
    }
}

#[test]
fn with_a_knee_small_differences_count_by_their_square() {
    at_each_level(check_knee);
}

fn check_knee(level: Level) {
    let size @ [h, w, c] = [33, 17, 3];
    let (x, y) = (noise(1, h * w * c), photo(2, h * w * c));
    let mask: Vec<u8> = noise(3, h * w).iter().map(|&v| (v > 0.3).into()).collect();
    let (counted, knee) = (mask.iter().filter(|&&m| m == 1).count() * c, 0.25);
    let counts = |i: usize| f64::from(mask[i / c]) / counted as f64;
    let difference: Vec<f64> = x.iter().zip(unit(&y)).map(|(x, y)| x - y).collect();
    let huber = difference.iter().enumerate().map(|(i, d)| {
        let d = d.abs();
        counts(i)
            * (if d < knee {
                d * d / (2.0 * knee)
            } else {
                d - knee / 2.0
            })
    });
    let mut scratch = LossScratch::default();
    let mut grad = vec![0.0; x.len()];
    let (y, m) = (&y[..], Some(&mask[..]));
    let images = images(&x, y, m, size);
    let options = LossOptions { lambda: 0.0, knee };
    let got = at_level(level, || {
        photometric(images, &options, Some(&mut grad), &mut scratch)
    })
    .unwrap();
    assert!((got.loss - huber.sum::<f64>()).abs() < 1e-14);
    for (i, (&g, &d)) in grad.iter().zip(&difference).enumerate() {
        assert!(
            (g - counts(i) * (d / knee).clamp(-1.0, 1.0)).abs() < 1e-15,
            "{i}"
        );
    }
    assert!(difference.iter().any(|d| d.abs() < knee) && difference.iter().any(|d| d.abs() > knee));
    let options = LossOptions { lambda: 0.4, knee };
    let both = at_level(level, || photometric(images, &options, None, &mut scratch)).unwrap();
    let plain = loss(level, &x, y, m, size, 0.4).0;
    assert_eq!(both.ssim, plain.ssim);
    assert!((both.loss - plain.loss - 0.6 * (got.loss - plain.l1)).abs() < 1e-14);
}

#[test]
fn wrong_input_is_named() {
    let mut scratch = LossScratch::default();
    let x = [0.0f32; 12];
    let mut call = |y: &[u8], mask: Option<&[u8]>, lambda, knee, shape: [usize; 3]| {
        let options = LossOptions { lambda, knee };
        photometric(images(&x, y, mask, shape), &options, None, &mut scratch)
            .unwrap_err()
            .name()
            .to_owned()
    };
    assert_eq!(call(&[0; 12], None, 0.2, 0.0, [2, 2, 4]), "render");
    assert_eq!(call(&[0; 12], None, 0.2, 0.0, [0, 2, 3]), "render");
    assert_eq!(call(&[0; 11], None, 0.2, 0.0, [2, 2, 3]), "target");
    assert_eq!(call(&[0; 12], Some(&[1; 3]), 0.2, 0.0, [2, 2, 3]), "mask");
    assert_eq!(call(&[0; 12], None, f64::NAN, 0.0, [2, 2, 3]), "lambda");
    for knee in [-0.1, f64::NAN, f64::INFINITY] {
        assert_eq!(call(&[0; 12], None, 0.2, knee, [2, 2, 3]), "knee");
    }
}

#[test]
fn sides_whose_product_wraps_around_are_refused() {
    let mut scratch = LossScratch::<f32>::default();
    let pixels = [0.5f32; 12];
    let (height, width) = (1 << 63, 2); // 0 pixels, or 4 with one row more
    for height in [height, height + 2] {
        let images = images(&pixels, &pixels, None, [height, width, 3]);
        let found = photometric(images, &LossOptions::default(), None, &mut scratch);
        assert_eq!(found.unwrap_err().name(), "render");
    }
}
