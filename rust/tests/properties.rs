//! Properties of the whole path, projection to gradients, that hold for any input.
//!
//! `PROPTEST_CASES` and `PROPTEST_RNG_SEED` ask for more scenes or others than those of the fixed seed.

use hqgs::internals::{
    accuracy_knobs::{AccuracyKnobs, Spans},
    composite::{self, CompositeCotangents, CompositeInput},
    project::{self, ProjectCotangents, RenderOptions},
    scene::{Camera, Colors, Gaussians, Harmonics},
    simd::{Real, levels},
};
use proptest::{collection::vec, prelude::*, sample::select, test_runner::RngSeed};
use rayon::{ThreadPool, ThreadPoolBuilder};

const WIDTH: usize = 37;
const HEIGHT: usize = 21;
const STORED: usize = 16;

/// Gaussians and what they are seen with. Every number is one of T, kept as f64.
#[derive(Debug, Clone)]
struct Scene {
    means: Vec<[f64; 3]>,
    quats: Vec<[f64; 4]>,
    scales: Vec<[f64; 3]>,
    opacities: Vec<f64>,
    /// Three channels, or with `degree` the harmonics.
    colors: Vec<Vec<f64>>,
    degree: Option<usize>,
    background: [f64; 3],
    viewmat: [f64; 16],
    options: RenderOptions,
}

/// Image and gradients, per Gaussian.
#[derive(Debug, Clone, PartialEq)]
struct Output<T> {
    image: Vec<T>,
    alphas: Vec<T>,
    depths: Vec<f64>,
    gaussians: Vec<Row<T>>,
    background: Vec<T>,
    camera: [f64; 16],
}

/// What belongs to one Gaussian.
#[derive(Debug, Clone, PartialEq)]
struct Row<T> {
    radii: [i32; 2],
    means: Vec<T>,
    quats: Vec<T>,
    scales: Vec<T>,
    opacity: T,
    colors: Vec<T>,
}

impl<T: Real> Row<T> {
    fn numbers(&self) -> impl Iterator<Item = f64> {
        let parts = [&self.means, &self.quats, &self.scales, &self.colors];
        let all = parts.into_iter().flatten().map(|x| x.to_f64());
        all.chain([self.opacity.to_f64()])
    }
}

impl<T: Real> Output<T> {
    fn numbers(&self) -> impl Iterator<Item = f64> {
        let pixels = self.image.iter().chain(&self.alphas);
        let pixels = pixels.chain(&self.background).map(|x| x.to_f64());
        let rows = self.gaussians.iter().flat_map(Row::numbers);
        pixels.chain(rows).chain(self.camera)
    }
}

fn flat<T: Real, R: AsRef<[f64]>>(rows: &[R]) -> Vec<T> {
    let numbers = rows.iter().flat_map(|r| r.as_ref());
    numbers.map(|x| T::from_f64(*x)).collect()
}

impl Scene {
    fn len(&self) -> usize {
        self.opacities.len()
    }

    /// The Gaussians of `order`.
    fn take(&self, order: &[usize]) -> Self {
        fn pick<R: Clone>(rows: &[R], order: &[usize]) -> Vec<R> {
            order.iter().map(|i| rows[*i].clone()).collect()
        }
        Self {
            means: pick(&self.means, order),
            quats: pick(&self.quats, order),
            scales: pick(&self.scales, order),
            opacities: pick(&self.opacities, order),
            colors: pick(&self.colors, order),
            ..self.clone()
        }
    }

    /// Image, and gradients for fixed cotangents of everything that the rasterizer gives out.
    fn render<T: Real>(&self) -> Output<T> {
        let n = self.len();
        let camera = camera(&self.viewmat);
        let (means, quats, scales) = (
            flat::<T, _>(&self.means),
            flat::<T, _>(&self.quats),
            flat::<T, _>(&self.scales),
        );
        let (opacities, given) = (
            flat::<T, _>(&[&self.opacities[..]]),
            flat::<T, _>(&self.colors),
        );
        let gaussians = Gaussians {
            means: &means,
            quats: &quats,
            scales: &scales,
            opacities: &opacities,
        };
        let harmonics = self.degree.map(|degree| Harmonics {
            coefficients: &given,
            rest: None,
            stored: STORED,
            degree,
        });
        let background = flat::<T, _>(&[self.background]);
        let given_colors = harmonics.map_or(Colors::Channels(&given, 3), Colors::Harmonics);
        let projected = project::forward(&gaussians, given_colors, &camera, &self.options, true)
            .expect("lengths");
        let (projection, radii) = (projected.projection, projected.radii);
        let colors = if harmonics.is_some() {
            &projected.colors
        } else {
            &given
        };
        let behind = Some(&background[..]);
        let view = composite::forward(&projection, colors, 3, &camera, behind).expect("few pairs");
        let input = CompositeInput {
            projection: &projection,
            tiles: &view.tiles,
            camera: &camera,
            background: behind,
        };
        let pixels = WIDTH * HEIGHT;

        let wave = |n: usize| -> Vec<T> {
            let values = (0..n).map(|i| (1.0 + i as f64 * 0.37).sin());
            values.map(T::from_f64).collect()
        };
        let (v_image, v_alphas) = (wave(3 * pixels), wave(pixels));
        let v = CompositeCotangents {
            image: &v_image,
            alphas: Some(&v_alphas),
        };
        let wanted = composite::Wanted {
            geometry: true,
            absolute: true,
            colors: true,
            background: true,
        };
        let composited =
            composite::backward(&input, &view.composited, &v, wanted).expect("lengths");
        let (v_depths, v_conics) = (vec![T::ONE; n], vec![T::ONE; 3 * n]);
        let cotangents = ProjectCotangents {
            means2d: Some(&composited.means2d),
            whitened: Some(&composited.whitened),
            opacities: Some(&composited.opacities),
            depths: Some(&v_depths),
            conics: Some(&v_conics),
            colors: harmonics.is_some().then_some(&composited.colors[..]),
        };
        let wanted = project::Wanted {
            means: true,
            quats: true,
            scales: true,
            opacities: true,
            covars: false,
            harmonics: harmonics.is_some(),
            harmonics_rest: false,
            camera: true,
        };
        let grads = project::backward(
            &gaussians,
            projected.shading.as_ref(),
            &camera,
            &self.options,
            &projection,
            &cotangents,
            wanted,
        )
        .expect("lengths");
        let [means, quats, scales, opacities, _, of_harmonics, _] = &grads.arrays;
        let (g_colors, row) = if harmonics.is_some() {
            (of_harmonics, 3 * STORED)
        } else {
            (&composited.colors, 3)
        };
        let rows = (0..n).map(|i| Row {
            radii: [radii[2 * i], radii[2 * i + 1]],
            means: means[3 * i..3 * i + 3].to_vec(),
            quats: quats[4 * i..4 * i + 4].to_vec(),
            scales: scales[3 * i..3 * i + 3].to_vec(),
            opacity: opacities[i],
            colors: g_colors[row * i..row * (i + 1)].to_vec(),
        });
        Output {
            gaussians: rows.collect(),
            depths: projection.depths,
            image: view.image,
            alphas: view.alphas,
            background: composited.background,
            camera: grads.camera.viewmat(&camera),
        }
    }
}

/// World to camera, linear part.
fn rotation(camera: &Camera) -> glam::DMat3 {
    let [a, b, c, _, d, e, f, _, g, h, i, ..] = camera.viewmat();
    glam::DMat3::from_cols_array(&[a, d, g, b, e, h, c, f, i])
}

/// World to camera, translation.
fn translation(camera: &Camera) -> glam::DVec3 {
    let m = camera.viewmat();
    glam::DVec3::new(m[3], m[7], m[11])
}

fn camera(viewmat: &[f64; 16]) -> Camera {
    let k = [20.0, 0.0, 18.0, 0.0, 21.0, 11.0, 0.0, 0.0, 1.0];
    Camera::new(viewmat, &k, WIDTH, HEIGHT).expect("a valid camera")
}

/// World to camera: a turn about a general axis, and a shift.
fn viewmats() -> impl Strategy<Value = [f64; 16]> {
    (-3.0..3.0, vec(-1.0..1.0, 3)).prop_map(|(angle, t): (f64, Vec<f64>)| {
        let turn =
            glam::DMat3::from_axis_angle(glam::DVec3::new(0.3, 0.9, -0.1).normalize(), angle);
        let r = |i: usize| turn.row(i);
        let row = |i: usize| [r(i).x, r(i).y, r(i).z, t[i]];
        let [a, b, c] = [row(0), row(1), row(2)];
        let rows = [a, b, c, [0.0, 0.0, 0.0, 1.0]].concat();
        rows.try_into().expect("16 numbers")
    })
}

/// A nice number rounded to f32, so that it is exact in either type.
fn between(low: f64, high: f64) -> impl Strategy<Value = f64> + Clone {
    (low..high).prop_map(|x| f64::from(x as f32))
}

/// Gaussians of all usual shapes in and around the view of `viewmat`, at depths of which some are equal.
fn gaussians(viewmat: [f64; 16], most: usize) -> impl Strategy<Value = Scene> {
    let depth = prop_oneof![between(0.5, 9.0), select(vec![2.0, 3.0, 4.0])];
    let place = (between(-1.2, 1.2), between(-0.8, 0.8), depth);
    let size = (-9.0..1.5, vec(-2.0..2.0, 3));
    let size = size
        .prop_map(|(a, b): (f64, Vec<f64>)| [0, 1, 2].map(|k| f64::from((a + b[k]).exp() as f32)));
    let color = vec(between(-1.0, 2.0), 3);
    let one = (
        place,
        vec(between(-1.0, 1.0), 4),
        size,
        between(0.0, 1.1),
        color,
    );
    let background = vec(between(0.0, 1.0), 3);
    (vec(one, 0..most), background, any::<bool>()).prop_map(
        move |(all, background, antialiased)| {
            let back = camera(&viewmat);
            let inverse = rotation(&back).transpose();
            let mut s = Scene {
                means: vec![],
                quats: vec![],
                scales: vec![],
                opacities: vec![],
                colors: vec![],
                degree: None,
                background: [background[0], background[1], background[2]],
                viewmat,
                options: RenderOptions {
                    antialiased,
                    ..RenderOptions::default()
                },
            };
            for ((x, y, z), quat, scale, opacity, color) in all {
                let p = inverse * (glam::DVec3::new(x * z, y * z, z) - translation(&back));
                s.means.push(p.to_array().map(|x| f64::from(x as f32)));
                s.quats.push([quat[0], quat[1], quat[2], quat[3]]);
                s.scales.push(scale);
                s.opacities.push(opacity);
                s.colors.push(color);
            }
            s
        },
    )
}

const STRAIGHT: [f64; 16] = [
    1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0,
];

fn scenes() -> impl Strategy<Value = Scene> {
    prop_oneof![Just(STRAIGHT), viewmats()].prop_flat_map(|v| gaussians(v, 24))
}

/// Any number of the type: its bits, or one at an edge of its range.
fn bits(single: bool) -> BoxedStrategy<f64> {
    let edges = if single {
        let (max, tiny) = (f64::from(f32::MAX), f64::from(f32::MIN_POSITIVE));
        vec![
            max,
            -max,
            tiny,
            f64::from(f32::from_bits(1)),
            1e-40,
            1e19,
            1e-23,
        ]
    } else {
        let tiny = f64::from_bits(1);
        vec![
            f64::MAX,
            f64::MIN,
            f64::MIN_POSITIVE,
            tiny,
            1e-310,
            1e154,
            1e-160,
        ]
    };
    let edges = [
        &edges[..],
        &[0.0, -0.0, f64::NAN, f64::INFINITY, -f64::INFINITY],
    ]
    .concat();
    let edges = edges
        .into_iter()
        .map(|x| if single { f64::from(x as f32) } else { x });
    let edges: Vec<f64> = edges.collect();
    if single {
        let all = any::<u32>().prop_map(|b| f64::from(f32::from_bits(b)));
        prop_oneof![select(edges), all].boxed()
    } else {
        prop_oneof![select(edges), any::<u64>().prop_map(f64::from_bits)].boxed()
    }
}

/// Scenes in which up to six numbers of any input of the Gaussians are replaced by any bits, with channels or
/// harmonics as colours.
fn broken(single: bool) -> impl Strategy<Value = Scene> {
    let options = (
        select(vec![0.0, 1e-9, 0.3, 1e6]),
        select(vec![0.0, 1e-30, 0.01]),
        select(vec![None, Some(0), Some(1), Some(2), Some(3)]),
    );
    let change = (any::<prop::sample::Index>(), 0..14usize, bits(single));
    (
        prop_oneof![Just(STRAIGHT), viewmats()].prop_flat_map(|v| gaussians(v, 6)),
        options,
        vec(change, 0..7),
    )
        .prop_map(|(mut s, (eps2d, near_plane, degree), changes)| {
            s.options.eps2d = eps2d;
            s.options.near_plane = near_plane;
            s.degree = degree;
            if degree.is_some() {
                for color in &mut s.colors {
                    *color = (0..3 * STORED).map(|k| color[k % 3] * 0.5).collect();
                }
            }
            for (i, slot, value) in changes {
                if s.len() == 0 {
                    break;
                }
                let i = i.index(s.len());
                match slot {
                    0..3 => s.means[i][slot] = value,
                    3..7 => s.quats[i][slot - 3] = value,
                    7..10 => s.scales[i][slot - 7] = value,
                    10 => s.opacities[i] = value,
                    _ => s.colors[i][slot - 11] = value,
                }
            }
            s
        })
}

fn finite(s: &Scene, i: usize) -> bool {
    let used = s.degree.map_or(3, |d| 3 * (d + 1) * (d + 1));
    let all = s.means[i].iter().chain(&s.quats[i]).chain(&s.scales[i]);
    let mut all = all.chain(&s.colors[i][..used]).chain([&s.opacities[i]]);
    all.all(|x| x.is_finite())
}

/// Nothing panics or hangs; what is not finite is culled without a trace; all else is finite; alpha is one.
fn any_bits_are_survived<T: Real>(s: &Scene) -> Result<(), TestCaseError> {
    let out = s.render::<T>();
    for (i, row) in out.gaussians.iter().enumerate() {
        let culled = row.radii == [0; 2];
        prop_assert!(culled || finite(s, i), "Gaussian {i} is kept");
        prop_assert!(
            !culled || row.numbers().all(|x| x == 0.0),
            "gradient of {i}, culled"
        );
    }
    prop_assert!(out.alphas.iter().all(|a| (0.0..=1.0).contains(&a.to_f64())));
    let kept: Vec<usize> = (0..s.len())
        .filter(|i| out.gaussians[*i].radii != [0; 2])
        .collect();
    // Sums over the pixels of colours near the largest number overflow.
    let moderate = |i: &usize| s.colors[*i].iter().all(|x| x.abs() <= 1e30);
    if kept.iter().all(moderate) {
        let bad: Vec<f64> = out.numbers().filter(|x| !x.is_finite()).collect();
        prop_assert!(bad.is_empty(), "{bad:?} in {out:?}");
        let alone = s.take(&kept).render::<T>();
        prop_assert!(alone.image == out.image && alone.alphas == out.alphas);
        for (row, i) in alone.gaussians.iter().zip(&kept) {
            prop_assert_eq!(row, &out.gaussians[*i]);
        }
    }
    Ok(())
}

/// Each pixel lies between the least and the largest of what is blended, up to rounding.
fn colors_are_convex<T: Real>(s: &Scene) -> Result<(), TestCaseError> {
    let out = s.render::<T>();
    let rounding = if T::SINGLE { 1e-6 } else { 1e-15 };
    for c in 0..3 {
        let colors = s.colors.iter().map(|rgb| rgb[c]).chain([s.background[c]]);
        let (low, high) = colors.fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)));
        let slack = 4.0 * rounding;
        for x in out.image.iter().skip(c).step_by(3).map(|x| x.to_f64()) {
            prop_assert!(
                low - slack <= x && x <= high + slack,
                "{x} not in {low}..{high}"
            );
        }
    }
    Ok(())
}

/// A permutation that keeps the order of equal depths permutes the gradients and changes nothing else.
fn order_is_that_of_the_depths<T: Real>(s: &Scene, keys: &[u32]) -> Result<(), TestCaseError> {
    let out = s.render::<T>();
    let mut order: Vec<usize> = (0..s.len()).collect();
    order.sort_by_key(|i| keys[*i]);
    let depth = |i: usize| out.depths[i].to_bits();
    let mut next: std::collections::HashMap<u64, Vec<usize>> = std::collections::HashMap::new();
    for i in (0..s.len()).rev() {
        next.entry(depth(i)).or_default().push(i);
    }
    let order: Vec<usize> = order
        .iter()
        .map(|i| {
            next.get_mut(&depth(*i))
                .and_then(Vec::pop)
                .expect("as many places")
        })
        .collect();
    let other = s.take(&order).render::<T>();
    prop_assert!(other.image == out.image && other.alphas == out.alphas);
    for (row, i) in other.gaussians.iter().zip(&order) {
        prop_assert_eq!(row, &out.gaussians[*i]);
    }
    Ok(())
}

/// Gaussians that are not seen, for one reason each.
fn hide(s: &mut Scene, i: usize, how: usize) {
    let back = camera(&s.viewmat);
    let place = |p: [f64; 3]| {
        let p = glam::DVec3::from_array(p) - translation(&back);
        (rotation(&back).transpose() * p).to_array()
    };
    match how {
        0 => s.opacities[i] = 0.003,
        1 => s.means[i] = place([0.1, 0.2, -3.0]),
        2 => {
            s.means[i] = place([300.0, 0.2, 3.0]);
            s.scales[i] = [0.1; 3];
        }
        3 => s.quats[i] = [0.0; 4],
        4 => s.scales[i][1] = f64::NAN,
        _ => s.colors[i][2] = f64::INFINITY,
    }
}

fn the_unseen_change_no_bit<T: Real>(
    s: &Scene,
    hidden: &[(usize, usize)],
) -> Result<(), TestCaseError> {
    let mut s = s.clone();
    let mut seen = vec![true; s.len()];
    for (i, how) in hidden {
        if *i < s.len() {
            hide(&mut s, *i, *how);
            seen[*i] = false;
        }
    }
    let out = s.render::<T>();
    let kept: Vec<usize> = (0..s.len()).filter(|i| seen[*i]).collect();
    let alone = s.take(&kept).render::<T>();
    prop_assert!(alone.image == out.image && alone.alphas == out.alphas);
    for (row, i) in alone.gaussians.iter().zip(&kept) {
        prop_assert_eq!(row, &out.gaussians[*i]);
    }
    for i in (0..s.len()).filter(|i| !seen[*i]) {
        prop_assert_eq!(out.gaussians[i].radii, [0; 2]);
        prop_assert!(out.gaussians[i].numbers().all(|x| x == 0.0));
    }
    Ok(())
}

/// The image is linear in colours and background, doubling is exact, and their gradients do not know them.
fn colors_are_linear<T: Real>(s: &Scene) -> Result<(), TestCaseError> {
    let mut other = s.clone();
    for (i, rgb) in other.colors.iter_mut().enumerate() {
        *rgb = (0..3)
            .map(|c| f64::from(((3 * i + c) as f32).cos()))
            .collect();
    }
    other.background = [0.75, -0.5, 0.125];
    let (mut sum, mut twice) = (s.clone(), s.clone());
    for i in 0..s.len() {
        for c in 0..3 {
            sum.colors[i][c] += other.colors[i][c];
            twice.colors[i][c] *= 2.0;
        }
    }
    for c in 0..3 {
        sum.background[c] += other.background[c];
        twice.background[c] *= 2.0;
    }
    let [s, other, sum, twice] = [s, &other, &sum, &twice].map(Scene::render::<T>);
    let rounding = if T::SINGLE { 4e-6 } else { 4e-15 };
    for (k, x) in sum.image.iter().enumerate() {
        let expected = s.image[k].to_f64() + other.image[k].to_f64();
        prop_assert!((x.to_f64() - expected).abs() < rounding, "{x:?} {expected}");
    }
    for (x, y) in s.image.iter().zip(&twice.image) {
        prop_assert_eq!(2.0 * x.to_f64(), y.to_f64());
    }
    prop_assert!(s.alphas == other.alphas && s.background == other.background);
    for (a, b) in s.gaussians.iter().zip(&other.gaussians) {
        prop_assert_eq!(&a.colors, &b.colors);
    }
    Ok(())
}

fn work_in_parts_changes_no_bit<T: Real>(
    s: &Scene,
    pools: &[ThreadPool],
) -> Result<(), TestCaseError> {
    let out = s.render::<T>();
    for pool in pools {
        let other = pool.install(|| s.render::<T>());
        prop_assert!(other == out, "{} threads", pool.current_num_threads());
    }
    for (spans, skip_blocks) in [(Spans::Ellipse, false), (Spans::Box, true)] {
        let mut other = s.clone();
        other.options.knobs = AccuracyKnobs {
            spans,
            skip_blocks,
            ..AccuracyKnobs::default()
        };
        prop_assert!(other.render::<T>() == out, "{:?}", other.options.knobs);
    }
    Ok(())
}

/// Levels that round alike give the same bits.
fn levels_agree<T: Real>(s: &Scene) -> Result<(), TestCaseError> {
    let mut s = s.clone();
    let mut first: [Option<Output<T>>; 2] = [None, None];
    for level in levels() {
        s.options.level = Some(level);
        let out = s.render::<T>();
        if let Some(first) = &first[usize::from(level.is_fused())] {
            prop_assert!(out == *first, "{level:?}");
        } else {
            first[usize::from(level.is_fused())] = Some(out);
        }
    }
    Ok(())
}

/// A world `2^k` times as large looks the same, to the bit, and has gradients `2^-k` times as large.
fn the_unit_of_length_changes_no_bit<T: Real>(s: &Scene, k: i32) -> Result<(), TestCaseError> {
    let unit = 2f64.powi(k);
    let mut large = s.clone();
    large.means.iter_mut().flatten().for_each(|x| *x *= unit);
    large.scales.iter_mut().flatten().for_each(|x| *x *= unit);
    for i in [3, 7, 11] {
        large.viewmat[i] *= unit;
    }
    large.options.near_plane *= unit;
    large.options.far_plane *= unit;
    let (out, large) = (s.render::<T>(), large.render::<T>());
    prop_assert!(out.image == large.image && out.alphas == large.alphas);
    for (a, b) in out.gaussians.iter().zip(&large.gaussians) {
        prop_assert_eq!(a.radii, b.radii);
        prop_assert!(a.opacity == b.opacity && a.colors == b.colors && a.quats == b.quats);
        for (x, y) in a.scales.iter().zip(&b.scales) {
            prop_assert_eq!(x.to_f64(), y.to_f64() * unit);
        }
    }
    Ok(())
}

fn config(cases: u32) -> ProptestConfig {
    let asked = ProptestConfig::default();
    ProptestConfig {
        cases: if std::env::var_os("PROPTEST_CASES").is_some() {
            asked.cases
        } else {
            cases
        },
        rng_seed: match asked.rng_seed {
            RngSeed::Random => RngSeed::Fixed(20),
            fixed => fixed,
        },
        failure_persistence: None,
        ..asked
    }
}

/// Run a check at each level of this CPU.
fn at_each_level(
    s: &Scene,
    check: impl Fn(&Scene) -> Result<(), TestCaseError>,
) -> Result<(), TestCaseError> {
    for level in levels() {
        let mut s = s.clone();
        s.options.level = Some(level);
        check(&s).map_err(|error| match error {
            TestCaseError::Fail(why) => TestCaseError::fail(format!("{level:?}: {why}")),
            reject => reject,
        })?;
    }
    Ok(())
}

/// The square of the scale overflows, which must not reach the gradients.
#[test]
fn longest_needle() {
    let mut s = Scene {
        means: vec![[-4.944531440734863, 0.0, 5.228489875793457]],
        quats: vec![[-0.849, -0.298, -0.508, -0.952]],
        scales: vec![[1.0, 1e154, 1.0]],
        opacities: vec![0.9],
        colors: vec![vec![0.5; 3]],
        degree: None,
        background: [0.0; 3],
        viewmat: STRAIGHT,
        options: RenderOptions {
            eps2d: 0.0,
            ..RenderOptions::default()
        },
    };
    for level in levels() {
        s.options.level = Some(level);
        let out = s.render::<f64>();
        assert!(out.gaussians[0].radii[0] > 0, "{level:?}");
        assert!(
            out.numbers().all(f64::is_finite),
            "{level:?}: {:?}",
            out.gaussians
        );
    }
}

proptest! {
    #![proptest_config(config(1500))]

    #[test]
    fn any_bits_in_f32(s in broken(true)) {
        at_each_level(&s, any_bits_are_survived::<f32>)?;
    }

    #[test]
    fn any_bits_in_f64(s in broken(false)) {
        at_each_level(&s, any_bits_are_survived::<f64>)?;
    }
}

proptest! {
    #![proptest_config(config(100))]

    #[test]
    fn convex(s in scenes()) {
        at_each_level(&s, colors_are_convex::<f32>)?;
        at_each_level(&s, colors_are_convex::<f64>)?;
    }

    #[test]
    fn order(s in scenes(), keys in vec(any::<u32>(), 24)) {
        at_each_level(&s, |s| order_is_that_of_the_depths::<f32>(s, &keys))?;
        at_each_level(&s, |s| order_is_that_of_the_depths::<f64>(s, &keys))?;
    }

    #[test]
    fn unseen(s in scenes(), hidden in vec((0..24usize, 0..6usize), 1..9)) {
        at_each_level(&s, |s| the_unseen_change_no_bit::<f32>(s, &hidden))?;
        at_each_level(&s, |s| the_unseen_change_no_bit::<f64>(s, &hidden))?;
    }

    #[test]
    fn linear(s in scenes()) {
        at_each_level(&s, colors_are_linear::<f32>)?;
        at_each_level(&s, colors_are_linear::<f64>)?;
    }

    #[test]
    fn level(s in scenes()) {
        levels_agree::<f32>(&s)?;
        levels_agree::<f64>(&s)?;
    }

    #[test]
    fn unit_of_length(s in scenes(), k in -30..30) {
        at_each_level(&s, |s| the_unit_of_length_changes_no_bit::<f32>(s, k))?;
        at_each_level(&s, |s| the_unit_of_length_changes_no_bit::<f64>(s, k))?;
    }
}

#[test]
fn parts() {
    let pool = |n| {
        ThreadPoolBuilder::new()
            .num_threads(n)
            .build()
            .expect("threads")
    };
    let pools = [pool(1), pool(3)];
    proptest!(config(60), |(s in scenes())| {
        at_each_level(&s, |s| work_in_parts_changes_no_bit::<f32>(s, &pools))?;
        at_each_level(&s, |s| work_in_parts_changes_no_bit::<f64>(s, &pools))?;
    });
}
