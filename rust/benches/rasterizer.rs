//! `cargo bench`: the stages of the rasterizer at three sizes, 504 x 378, degree 3, f32, all threads, for a
//! cloud and for a room as a trained scene looks like; and Adam on as many Gaussians.

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use hqgs::internals::{
    composite::{self, CompositeCotangents, CompositeInput},
    project::{self, ProjectCotangents, ProjectOptions, Projected},
    scene::{Colors, Harmonics, synthetic::Synthetic},
    tiles,
    training::adam::{self, AdamArrays, AdamOptions, Selection},
};
use std::time::Duration;

const SIZES: [usize; 3] = [10_000, 100_000, 500_000];
const WIDTH: usize = 504;
const HEIGHT: usize = 378;

fn cloud(c: &mut Criterion) {
    for n in SIZES {
        let scene = Synthetic::new(n, WIDTH, HEIGHT, 1234).expect("a valid camera");
        stages(c, "rasterizer", &scene);
    }
}

fn room(c: &mut Criterion) {
    for n in SIZES {
        let scene = Synthetic::room(n, WIDTH, HEIGHT, 1234).expect("a valid camera");
        stages(c, "rasterizer, room", &scene);
    }
}

fn stages(c: &mut Criterion, name: &str, s: &Synthetic<f32>) {
    let n = s.opacities.len();
    let gaussians = s.gaussians();
    let harmonics = Harmonics {
        coefficients: &s.harmonics,
        rest: None,
        stored: 16,
        degree: 3,
    };
    let options = ProjectOptions::default();
    let project = || {
        project::forward(
            &gaussians,
            Colors::Harmonics(&harmonics),
            &s.camera,
            &options,
        )
        .expect("right lengths")
    };
    let mut group = c.benchmark_group(name);
    group.sample_size(20);
    group.bench_function(BenchmarkId::new("project", n), |b| {
        b.iter(project);
    });
    let Projected {
        projection,
        colors,
        shading,
        ..
    } = project();
    group.bench_function(BenchmarkId::new("bin and order", n), |b| {
        b.iter(|| tiles::bin(&projection, &colors, 3, &s.camera).expect("few pairs"));
    });
    let tiles = tiles::bin(&projection, &colors, 3, &s.camera).expect("few pairs");
    let input = CompositeInput {
        projection: &projection,
        tiles: &tiles,
        camera: &s.camera,
        background: None,
    };
    let pixels = s.camera.width() * s.camera.height();
    group.bench_function(BenchmarkId::new("composite", n), |b| {
        b.iter(|| composite::forward(&input).expect("right lengths"));
    });
    let view = composite::forward(&input).expect("right lengths");
    println!("{name}, {n} Gaussians: {:?}", view.counts);
    let v_image: Vec<f32> = (0..3 * pixels).map(|i| (i as f32 * 0.37).sin()).collect();
    let v = CompositeCotangents {
        image: &v_image,
        alphas: None,
    };
    let wanted = composite::Wanted {
        geometry: true,
        colors: true,
        ..composite::Wanted::default()
    };
    let backward =
        || composite::backward(&input, &view.composited, &v, wanted).expect("right lengths");
    group.bench_function(BenchmarkId::new("composite backward", n), |b| {
        b.iter(backward);
    });
    let grads = backward();
    let cotangents = ProjectCotangents {
        means2d: Some(&grads.means2d),
        whitened: Some(&grads.whitened),
        opacities: Some(&grads.opacities),
        depths: None,
        conics: None,
        colors: Some(&grads.colors),
    };
    let wanted = project::Wanted {
        means: true,
        quats: true,
        scales: true,
        opacities: true,
        harmonics: true,
        ..project::Wanted::default()
    };
    let (camera, shading) = (&s.camera, shading.as_ref());
    group.bench_function(BenchmarkId::new("project backward", n), |b| {
        b.iter(|| {
            project::backward(
                &gaussians,
                shading,
                camera,
                &options,
                &projection,
                &cotangents,
                wanted,
            )
            .expect("right lengths")
        });
    });
    group.finish();
}

/// One step on all parameters of N Gaussians, 59 numbers each, in one array; and with a mask in which two of
/// three are visible, as they come in a scene that is sorted in no way.
fn optimizer(c: &mut Criterion) {
    const NUMBERS: usize = 59;
    let options = AdamOptions {
        lr: 1e-3,
        beta1: 0.9,
        beta2: 0.999,
        eps: 1e-15,
    };
    for n in SIZES {
        let wave =
            |step: f32| -> Vec<f32> { (0..n * NUMBERS).map(|i| (i as f32 * step).sin()).collect() };
        let (mut param, grad) = (wave(0.37), wave(0.73));
        let (mut exp_avg, mut exp_avg_sq) = (vec![0f32; n * NUMBERS], vec![0f32; n * NUMBERS]);
        let hash = |i: usize| (i as u32).wrapping_mul(0x9e37_79b9) >> 16;
        let visible: Vec<u8> = (0..n).map(|i| u8::from(hash(i) % 3 != 0)).collect();
        let mut group = c.benchmark_group("adam");
        group.sample_size(20);
        for (name, visible) in [("all", None), ("visible", Some(&visible[..]))] {
            let mut step = 0;
            let selection = Selection {
                visible,
                width: NUMBERS,
                used: NUMBERS,
            };
            group.bench_function(BenchmarkId::new(name, n), |b| {
                b.iter(|| {
                    step += 1;
                    let arrays = AdamArrays {
                        param: &mut param,
                        grad: &grad,
                        exp_avg: &mut exp_avg,
                        exp_avg_sq: &mut exp_avg_sq,
                    };
                    adam::step(arrays, step, &options, &selection).expect("right lengths");
                });
            });
        }
        group.finish();
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .warm_up_time(Duration::from_secs(1))
        .measurement_time(Duration::from_secs(3));
    targets = cloud, room, optimizer
}
criterion_main!(benches);
