//! `cargo bench`: the stages of the rasterizer at three sizes, 504 x 378, degree 3, f32, all threads, for a
//! cloud and for a room as a trained scene looks like.

mod synthetic;
mod table;

use criterion::{BenchmarkId, Criterion};
use hqgs::{
    Error, Real,
    internals::{
        composite::{self, CompositeCotangents, CompositeInput},
        project::{self, ProjectCotangents, Projected, RenderOptions},
        scene::{self, Colors, Harmonics},
    },
};
use std::time::Duration;
use synthetic::Synthetic;

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
    let options = RenderOptions::default();
    let project = || {
        project::forward(
            &gaussians,
            Colors::Harmonics(harmonics),
            &s.camera,
            &options,
            true,
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
    let pixels = s.camera.width() * s.camera.height();
    let composite =
        || composite::forward(&projection, &colors, 3, &s.camera, None).expect("few pairs");
    group.bench_function(BenchmarkId::new("bin and composite", n), |b| {
        b.iter(composite);
    });
    let view = composite();
    let input = CompositeInput {
        projection: &projection,
        tiles: &view.tiles,
        camera: &s.camera,
        background: None,
    };
    println!("{name}, {n} Gaussians: {:?}", view.work);
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

fn main() {
    let settings = Criterion::default()
        .warm_up_time(Duration::from_secs(1))
        .measurement_time(Duration::from_secs(3));
    table::run(settings, &[cloud, room]);
}
