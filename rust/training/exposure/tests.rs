use super::*;
use crate::at_each_level;
use hqgs::{internals::simd::at_level, levels};
use rayon::ThreadPoolBuilder;

const SIZES: Sizes = Sizes {
    size: [21, 18],
    margin: 3,
};

fn numbers<T: Light>(n: usize, k: f64, low: f64, high: f64) -> Vec<T> {
    (0..n)
        .map(|i| T::from_f64(low + (high - low) * (0.5 + 0.5 * (k + i as f64 * 0.7).sin())))
        .collect()
}

/// Small turns and moves, one of which leaves the render at a border.
fn warps() -> Vec<Warp> {
    (0..4)
        .map(|k| {
            let mut warp = [0.0; 12];
            for (i, (value, scale)) in warp
                .iter_mut()
                .zip([
                    0.01, 0.02, 1.5, 2.0, 0.02, 0.01, 2.5, 2.0, 1e-4, 1e-4, 1e-3, 1e-2,
                ])
                .enumerate()
            {
                *value = scale * (f64::from(k) * 1.3 + i as f64).sin();
            }
            warp
        })
        .collect()
}

struct Case<T> {
    image: Vec<T>,
    nearness: Vec<T>,
    v: Vec<T>,
}

fn case<T: Light>() -> Case<T> {
    let [h, w] = SIZES.render_size();
    Case {
        image: numbers(h * w * 3, 0.0, -0.05, 1.1),
        nearness: numbers(SIZES.pixels(), 1.0, 0.1, 0.6),
        v: numbers(SIZES.pixels() * 3, 2.0, -1.0, 1.0),
    }
}

const GAINS: [f64; 3] = [0.8, 1.0, 1.3];

fn loss(image: &[f64], near: &[f64], warps: &[Warp], gains: [f64; 3], v: &[f64]) -> f64 {
    let taken = Photograph::take(SIZES, image, near, warps, gains).unwrap();
    taken.photo.iter().zip(v).map(|(p, v)| p * v).sum()
}

/// The same by its definition, pixel by pixel.
fn plain(case: &Case<f64>, warps: &[Warp], gains: [f64; 3]) -> Vec<f64> {
    let (tables, [h, w]) = (tables(), SIZES.render_size());
    let light = |j: usize, i: usize, c: usize| case.image[(j * w + i) * 3 + c].to_light(tables);
    let mut photo = Vec::new();
    for row in 0..SIZES.size[0] {
        for column in 0..SIZES.size[1] {
            for (c, gain) in gains.iter().enumerate() {
                let mut sum = 0.0;
                for m in warps {
                    let (x, y) = (column as f64 + 0.5, row as f64 + 0.5);
                    let n = case.nearness[row * SIZES.size[1] + column];
                    let e = |r: usize| m[r] * x + m[r + 1] * y + m[r + 2] + m[r + 3] * n;
                    let (u, v, s) = (x + e(0), y + e(4), 1.0 + e(8));
                    let at = |u: f64, side: usize| {
                        (u / s + SIZES.margin as f64 - 0.5).clamp(0.0, (side - 1) as f64)
                    };
                    let (u, v) = (at(u, w), at(v, h));
                    let (i, j) = ((u as usize).min(w - 2), (v as usize).min(h - 2));
                    let (f, g) = (u - i as f64, v - j as f64);
                    sum += (1.0 - g) * ((1.0 - f) * light(j, i, c) + f * light(j, i + 1, c))
                        + g * ((1.0 - f) * light(j + 1, i, c) + f * light(j + 1, i + 1, c));
                }
                photo.push((gain * sum / warps.len() as f64).to_value(tables));
            }
        }
    }
    photo
}

#[test]
fn is_the_mean_of_the_warped_light() {
    let case = case::<f64>();
    let taken = Photograph::take(SIZES, &case.image, &case.nearness, &warps(), GAINS).unwrap();
    for (got, expected) in taken.photo.iter().zip(plain(&case, &warps(), GAINS)) {
        assert!((got - expected).abs() < 1e-12);
    }
}

#[test]
fn without_warps_it_is_the_middle_of_the_render() {
    let (case, [_, w]) = (case::<f32>(), SIZES.render_size());
    let taken = Photograph::take(SIZES, &case.image, &[], &[], [1.0; 3]).unwrap();
    let still = Photograph::take(SIZES, &case.image, &[], &[[0.0; 12]], [1.0; 3]).unwrap();
    for (i, got) in taken.photo.iter().enumerate() {
        let (row, at) = (i / (SIZES.size[1] * 3), i % (SIZES.size[1] * 3));
        let expected = case.image[(row + SIZES.margin) * w * 3 + SIZES.margin * 3 + at];
        assert!((got - expected).abs() < 1e-6, "{got} {expected}");
        assert!((still.photo[i] - got).abs() < 1e-6);
    }
}

#[test]
fn gradients_are_those_of_differences() {
    let (case, warps, h) = (case::<f64>(), warps(), 1e-6);
    let taken = Photograph::take(SIZES, &case.image, &case.nearness, &warps, GAINS).unwrap();
    let v = taken.backward(&case.v).unwrap();
    let close = |got: f64, f: &dyn Fn(f64) -> f64, what: &str| {
        let expected = (f(h) - f(-h)) / (2.0 * h);
        let scale = expected.abs().max(1.0);
        assert!(
            (got - expected).abs() < 1e-5 * scale,
            "{what}: {got} {expected}"
        );
    };
    for i in (0..case.image.len()).step_by(7) {
        let moved = |h: f64| {
            let mut image = case.image.clone();
            image[i] += h;
            loss(&image, &case.nearness, &warps, GAINS, &case.v)
        };
        close(v.image[i], &moved, "image");
    }
    for k in 0..warps.len() {
        for i in 0..12 {
            let moved = |h: f64| {
                let mut warps = warps.clone();
                warps[k][i] += 1e-2 * h; // a pixel's border must not lie between
                100.0 * loss(&case.image, &case.nearness, &warps, GAINS, &case.v)
            };
            close(v.warps[k][i], &moved, "warps");
        }
    }
    for c in 0..3 {
        let moved = |h: f64| {
            let mut gains = GAINS;
            gains[c] += h;
            loss(&case.image, &case.nearness, &warps, gains, &case.v)
        };
        close(v.gains[c], &moved, "gains");
    }
}

#[test]
fn f32_is_near_f64() {
    at_each_level(|level| {
        let (single, double) = (case::<f32>(), case::<f64>());
        let a = at_level(level, || {
            Photograph::take(SIZES, &single.image, &single.nearness, &warps(), GAINS)
        });
        let b = Photograph::take(SIZES, &double.image, &double.nearness, &warps(), GAINS);
        let (a, b) = (a.unwrap(), b.unwrap());
        for (a, b) in a.photo.iter().zip(&b.photo) {
            assert!((f64::from(*a) - b).abs() < 1e-5);
        }
        let (a, b) = (
            at_level(level, || a.backward(&single.v)),
            b.backward(&double.v),
        );
        let (a, b) = (a.unwrap(), b.unwrap());
        for (a, b) in a.image.iter().zip(&b.image) {
            assert!((f64::from(*a) - b).abs() < 1e-3, "{a} {b}");
        }
        for (a, b) in a.warps.iter().flatten().zip(b.warps.iter().flatten()) {
            assert!((a - b).abs() < 1e-2 * b.abs().max(10.0), "{a} {b}");
        }
    });
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let case = case::<f32>();
    let run = |level, threads| {
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| {
            let taken = at_level(level, || {
                Photograph::take(SIZES, &case.image, &case.nearness, &warps(), GAINS)
            });
            let taken = taken.unwrap();
            let v = at_level(level, || taken.backward(&case.v)).unwrap();
            (taken.photo, v.image, v.warps, v.gains)
        })
    };
    let best = run(levels()[0], 1);
    assert!(run(levels()[0], 2) == best && run(levels()[0], 3) == best);
}

#[test]
fn extreme_warps_do_no_harm() {
    let case = case::<f32>();
    for value in [1e30, -1e30, -1.0, 1e5] {
        for i in 0..12 {
            let mut warp = [0.0; 12];
            warp[i] = value;
            let taken = Photograph::take(SIZES, &case.image, &case.nearness, &[warp], GAINS);
            let taken = taken.unwrap();
            assert!(taken.photo.iter().all(|x| x.is_finite()));
            taken.backward(&case.v).unwrap();
        }
    }
}

#[test]
fn wrong_arrays_are_named() {
    let case = case::<f32>();
    let name = |image: &[f32], near: &[f32], warps: &[Warp], gains| {
        Photograph::take(SIZES, image, near, warps, gains)
            .unwrap_err()
            .name()
            .to_owned()
    };
    assert_eq!(name(&case.image[1..], &[], &[], GAINS), "image");
    assert_eq!(
        name(&case.image, &case.nearness[1..], &[], GAINS),
        "nearness"
    );
    assert_eq!(
        name(&case.image, &vec![f32::NAN; SIZES.pixels()], &[], GAINS),
        "nearness"
    );
    assert_eq!(name(&case.image, &[], &[[f64::NAN; 12]], GAINS), "warps");
    assert_eq!(name(&case.image, &[], &[], [f64::INFINITY; 3]), "gains");
    let taken = Photograph::take(SIZES, &case.image, &[], &[], GAINS).unwrap();
    assert_eq!(taken.backward(&case.v[1..]).unwrap_err().name(), "v_photo");
}

#[test]
fn waves_of_bands_add_up_as_all_at_once() {
    // The second warp folds the picture over: every band may reach every row, so that each is a wave of its own.
    let sizes = Sizes {
        size: [70, 9],
        margin: 2,
    };
    let [h, w] = sizes.render_size();
    let image = numbers::<f64>(h * w * 3, 0.0, 0.0, 1.0);
    let v = numbers::<f64>(sizes.pixels() * 3, 2.0, -1.0, 1.0);
    let mut folded = [0.0; 12];
    folded[8] = -0.2;
    for warps in [warps(), vec![warps()[0], folded]] {
        let taken = Photograph::take(sizes, &image, &[], &warps, GAINS).unwrap();
        let all = taken.backward(&v).unwrap();
        // By its definition: the sum over what each band alone gives.
        let mut sum = vec![0.0; image.len()];
        for band in 0..70usize.div_ceil(BAND) {
            let rows = band * BAND * 9 * 3..v.len().min((band + 1) * BAND * 9 * 3);
            let mut alone = vec![0.0; v.len()];
            alone[rows.clone()].copy_from_slice(&v[rows]);
            for (sum, part) in sum.iter_mut().zip(taken.backward(&alone).unwrap().image) {
                *sum += part;
            }
        }
        for (a, b) in all.image.iter().zip(&sum) {
            assert!((a - b).abs() < 1e-12 * (1.0 + b.abs()), "{a} {b}");
        }
    }
}
