//! `cargo bench --bench training`: the parts of a step beside the rasterizer, 504 x 378, f32, all threads: the loss, an
//! exposure, the operators, cells of JPEG, a sweep of depths, the sum of several views and Adam.

mod table;

use criterion::{BenchmarkId, Criterion};
use hqgs_training::{
    adam::{self, AdamArrays, AdamOptions, AdamStep, Selection},
    exposure::{Photograph, Sizes, Warp},
    jpeg_cells,
    loss::{self, Images, LossOptions, LossScratch},
    separable::{Dense, Separable},
    stereo::{self, Other, Photo},
    views::{self, ViewColors, ViewRows},
};
use std::time::Duration;

const WIDTH: usize = 504;
const HEIGHT: usize = 378;
const PIXELS: usize = WIDTH * HEIGHT;
const MARGIN: usize = 8;

/// Numbers between 0 and 1.
fn wave(n: usize, step: f32) -> Vec<f32> {
    (0..n)
        .map(|i| 0.5 + 0.5 * (i as f32 * step).sin())
        .collect()
}

fn losses(c: &mut Criterion) {
    let (render, floats) = (wave(3 * PIXELS, 0.37), wave(3 * PIXELS, 0.11));
    let bytes: Vec<u8> = floats.iter().map(|x| (255.0 * x) as u8).collect();
    let (mut grad, mut scratch) = (vec![0.0; 3 * PIXELS], LossScratch::default());
    let images = Images {
        render: &render[..],
        target: &bytes[..],
        mask: None,
        size: [HEIGHT, WIDTH, 3],
    };
    let mut group = c.benchmark_group("loss");
    for (name, lambda) in [("L1", 0.0), ("L1 and D-SSIM", 0.2)] {
        let options = LossOptions { lambda, knee: 0.0 };
        group.bench_function(name, |b| {
            b.iter(|| {
                let out = Some(&mut grad[..]);
                loss::photometric(images, &options, out, &mut scratch).expect("right lengths")
            });
        });
    }
    group.finish();
}

/// Five samples of a hand that shakes.
fn exposures(c: &mut Criterion) {
    let sizes = Sizes {
        size: [HEIGHT, WIDTH],
        margin: MARGIN,
    };
    let image = wave(3 * (HEIGHT + 2 * MARGIN) * (WIDTH + 2 * MARGIN), 0.01);
    let near = wave(PIXELS, 0.001);
    let warps: Vec<Warp> = (0..5)
        .map(|k| {
            let mut warp = [0.0; 12];
            (warp[2], warp[6], warp[3]) = (f64::from(k) * 0.8 - 1.6, f64::from(k) * 0.3, 0.5);
            warp
        })
        .collect();
    let take = || Photograph::take(sizes, &image, &near, &warps, [1.0; 3]).expect("right lengths");
    let mut group = c.benchmark_group("exposure");
    group.bench_function("forward", |b| b.iter(take));
    let (taken, v_photo) = (take(), wave(3 * PIXELS, 0.23));
    group.bench_function("backward", |b| {
        b.iter(|| taken.backward(&v_photo).expect("right lengths"));
    });
    group.finish();
}

/// A band of weights around the diagonal, for the middle of `scale` pixels.
fn blur(from: usize, scale: usize, reach: usize) -> Vec<f64> {
    let to = from / scale;
    let mut weights = vec![0.0; to * from];
    for row in 0..to {
        let middle = row * scale + scale / 2;
        for column in middle.saturating_sub(reach)..from.min(middle + reach + 1) {
            weights[row * from + column] = 1.0 / (2 * reach + 1) as f64;
        }
    }
    weights
}

fn operators(c: &mut Criterion) {
    let image = wave(3 * PIXELS, 0.37);
    let mut group = c.benchmark_group("operators");
    for (name, scale, reach) in [("blur of 13 px", 1, 6), ("half the size", 2, 3)] {
        let (rows, columns) = (blur(HEIGHT, scale, reach), blur(WIDTH, scale, reach));
        let dense = |weights, width: usize| Dense {
            weights,
            height: width / scale,
            width,
        };
        let (there, back) =
            Separable::<f32>::pair(dense(&rows, HEIGHT), dense(&columns, WIDTH), None)
                .expect("matrices");
        group.bench_function(name, |b| {
            b.iter(|| {
                there
                    .apply(&image, &[HEIGHT, WIDTH, 3])
                    .expect("right shape")
            });
        });
        let small = wave(3 * (HEIGHT / scale) * (WIDTH / scale), 0.7);
        group.bench_function(format!("{name}, transposed"), |b| {
            let shape = [HEIGHT / scale, WIDTH / scale, 3];
            b.iter(|| back.apply(&small, &shape).expect("right shape"));
        });
    }
    let (x, centres, widths) = (image.clone(), wave(3 * PIXELS, 0.2), vec![0.1; 3 * PIXELS]);
    let mut grad = vec![0.0; x.len()];
    group.bench_function("cells of JPEG", |b| {
        b.iter(|| {
            jpeg_cells::distance(&x, &centres, &widths, 1.0, Some(&mut grad))
                .expect("right lengths")
        });
    });
    group.finish();
}

/// 2,000 pixels of one photo in four others.
fn depths(c: &mut Criterion) {
    let grey = wave(PIXELS, 0.05);
    let picture = Photo {
        size: [HEIGHT, WIDTH],
        grey: &grey,
    };
    let others: Vec<_> = (0..4)
        .map(|k| {
            let mut map = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0.];
            map[3] = f64::from(k) * 12.0 - 18.0;
            Other { picture, map }
        })
        .collect();
    let pixels: Vec<_> = (0..2000)
        .map(|k| {
            [
                50.5 + f64::from(k % 50) * 8.0,
                40.5 + f64::from(k / 50) * 7.0,
            ]
        })
        .collect();
    let ranges = vec![[0.5, 4.0]; pixels.len()];
    c.bench_function("depths", |b| {
        b.iter(|| stereo::depths(picture, &others, &pixels, &ranges, 2).expect("right lengths"));
    });
}

/// Four views of 100,000 Gaussians, of which each shows half.
fn views(c: &mut Criterion) {
    const N: usize = 100_000;
    let (means, colors) = (wave(3 * N, 0.3), wave(3 * N / 2, 0.7));
    let shown: Vec<Vec<i32>> = (0..4)
        .map(|k| (0..N as i32 / 2).map(|i| 2 * i + k % 2).collect())
        .collect();
    let low = wave(12 * N / 2, 0.9);
    let (mut high, mut sums) = (vec![0.0; 45 * N], vec![0.0; 12 * N]);
    let mut group = c.benchmark_group("views");
    group.bench_function("rows", |b| {
        let views: Vec<_> = shown
            .iter()
            .map(|rows| ViewRows { rows, values: &low })
            .collect();
        b.iter(|| views::add(&views, &mut sums, 12, 0.25).expect("right lengths"));
    });
    group.bench_function("harmonics", |b| {
        let views: Vec<_> = shown
            .iter()
            .map(|rows| ViewColors {
                colors: ViewRows {
                    rows,
                    values: &colors,
                },
                center: [0.0, 0.0, -3.0],
                degree: 3,
            })
            .collect();
        b.iter(|| views::add_harmonics(&views, &means, &mut high, 0.25).expect("right lengths"));
    });
    group.finish();
}

/// One step on all parameters of N Gaussians, 59 numbers each, in one array.
fn optimizer(c: &mut Criterion) {
    const NUMBERS: usize = 59;
    let options = AdamOptions::new(1e-3);
    let mut group = c.benchmark_group("adam");
    for n in [10_000, 100_000] {
        let wave =
            |step: f32| -> Vec<f32> { (0..n * NUMBERS).map(|i| (i as f32 * step).sin()).collect() };
        let (mut param, grad) = (wave(0.37), wave(0.73));
        let (mut exp_avg, mut exp_avg_sq) = (vec![0f32; n * NUMBERS], vec![0f32; n * NUMBERS]);
        let mut step = 0;
        group.bench_function(BenchmarkId::from_parameter(n), |b| {
            b.iter(|| {
                step += 1;
                let arrays = AdamArrays {
                    param: &mut param,
                    grad: &grad,
                    exp_avg: &mut exp_avg,
                    exp_avg_sq: &mut exp_avg_sq,
                };
                adam::steps(vec![AdamStep {
                    arrays,
                    step,
                    options,
                    selection: Selection::ALL,
                }])
                .expect("right lengths");
            });
        });
    }
    group.finish();
}

fn main() {
    let settings = Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_secs(1))
        .measurement_time(Duration::from_secs(3));
    let benches = [losses, exposures, operators, depths, views, optimizer];
    table::run(settings, &benches);
}
