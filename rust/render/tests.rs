//! Images by the definition, what the knobs cost, and what must hold exactly.

use super::*;
use crate::{
    accuracy_knobs::{AccuracyKnobs, Spans},
    constants::ALPHA_MIN,
    scene::{Harmonics, synthetic::Synthetic},
    simd::{Level, at_each_level, levels},
};
use rayon::ThreadPoolBuilder;

fn harmonics<T: Real>(s: &Synthetic<T>) -> Harmonics<'_, T> {
    Harmonics {
        coefficients: &s.harmonics,
        rest: None,
        stored: 16,
        degree: 3,
    }
}

fn options(level: Level) -> RenderOptions {
    RenderOptions {
        level: Some(level),
        ..RenderOptions::default()
    }
}

fn render_with<'a, T: Real>(s: &'a Synthetic<T>, options: &RenderOptions) -> Rendered<'a, T> {
    let colors = Colors::Harmonics(harmonics(s));
    forward(s.gaussians(), colors, None, &s.camera, options).unwrap()
}

fn render<T: Real>(level: Level, s: &Synthetic<T>) -> Rendered<'_, T> {
    render_with(s, &options(level))
}

fn cotangent<T: Real>(s: &Synthetic<T>) -> Vec<T> {
    let n = 3 * s.camera.width * s.camera.height;
    (0..n)
        .map(|i| T::from_f64((i as f64 * 0.37).sin()))
        .collect()
}

fn gradients<T: Real>(s: &Synthetic<T>, r: &Rendered<T>) -> Gradients<T> {
    let v = Cotangents {
        image: &cotangent(s),
        alphas: None,
    };
    backward(r, &v, Wanted::ALL).unwrap()
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let s = Synthetic::<f32>::new(5000, 150, 97, 1).unwrap();
    let run = |level, threads| {
        ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap()
            .install(|| {
                let r = render(level, &s);
                let g = gradients(&s, &r);
                (r.image, r.alphas, g)
            })
    };
    at_each_level(|level| {
        let one = run(level, 1);
        for threads in [2, 3, 7] {
            assert!(run(level, threads) == one, "{threads} threads");
        }
    });
}

/// The image by the definition: every Gaussian at every pixel, in depth order.
fn brute_force(s: &Synthetic<f64>, r: &Rendered<f64>) -> Vec<f64> {
    let n = s.opacities.len();
    let mut order: Vec<usize> = (0..n)
        .filter(|&i| r.projection.splats[i].visible())
        .collect();
    order.sort_by(|&a, &b| r.projection.depths[a].total_cmp(&r.projection.depths[b]));
    // The colours are tested elsewhere: take them from the records.
    let mut colors = vec![[0.0; 3]; n];
    for list in &r.tiles.lists {
        for (record, color) in list.records.iter().zip(list.colors.chunks_exact(3)) {
            colors[record.gaussian as usize].copy_from_slice(color);
        }
    }
    let mut image = Vec::new();
    for y in 0..s.camera.height {
        for x in 0..s.camera.width {
            let (mut t, mut rgb) = (1.0, [0.0; 3]);
            for &i in &order {
                let alpha = r.projection.splats[i].alpha(x as f64 + 0.5, y as f64 + 0.5);
                if alpha < ALPHA_MIN {
                    continue;
                }
                if t * (1.0 - alpha) <= 0.999e-4 {
                    break;
                }
                for (c, k) in rgb.iter_mut().zip(colors[i]) {
                    *c += t * alpha * k;
                }
                t *= 1.0 - alpha;
            }
            image.extend(rgb);
        }
    }
    image
}

#[test]
fn tiles_and_blocks_leave_no_pixel_out() {
    at_each_level(check_pixels);
}

fn check_pixels(level: Level) {
    for (seed, width, height) in [(1, 70, 45), (2, 16, 16), (3, 1, 37), (4, 129, 5)] {
        let s = Synthetic::<f64>::new(800, width, height, seed).unwrap();
        let r = render(level, &s);
        let expected = brute_force(&s, &r);
        for (i, (a, b)) in r.image.iter().zip(&expected).enumerate() {
            assert!(
                (a - b).abs() < 1e-12,
                "seed {seed}, value {i}: {a} instead of {b}"
            );
        }
    }
}

fn tuned(
    level: Level,
    s: &Synthetic<f32>,
    knobs: AccuracyKnobs,
) -> (Rendered<'_, f32>, Gradients<f32>) {
    let options = RenderOptions {
        knobs,
        ..options(level)
    };
    let r = render_with(s, &options);
    let v = gradients(s, &r);
    (r, v)
}

#[test]
fn what_is_skipped_changes_no_bit() {
    at_each_level(check_skipped);
}

fn check_skipped(level: Level) {
    let s = Synthetic::<f32>::new(2000, 150, 97, 5).unwrap();
    let (r, g) = tuned(level, &s, AccuracyKnobs::default());
    for (spans, skip_blocks) in [
        (Spans::Ellipse, false),
        (Spans::Box, true),
        (Spans::Box, false),
    ] {
        let knobs = AccuracyKnobs {
            spans,
            skip_blocks,
            ..AccuracyKnobs::default()
        };
        let (other, v) = tuned(level, &s, knobs);
        assert!(r.image == other.image && g == v, "{knobs:?}");
        let pairs = |r: &Rendered<f32>| -> usize {
            r.tiles.lists.iter().map(|list| list.records.len()).sum()
        };
        assert_eq!(pairs(&other) > pairs(&r), spans == Spans::Box, "{knobs:?}");
    }
}

#[test]
fn looser_knobs_have_larger_errors() {
    at_each_level(check_knobs);
}

fn check_knobs(level: Level) {
    let s = Synthetic::<f32>::new(2000, 150, 97, 6).unwrap();
    let exact = AccuracyKnobs {
        alpha_min: 1e-9,
        transmittance_min: 0.0,
        ..AccuracyKnobs::default()
    };
    let (r, _) = tuned(level, &s, exact);
    let error = |knobs| -> f64 {
        let (other, _) = tuned(level, &s, knobs);
        let pairs = r.image.iter().zip(&other.image);
        pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum()
    };
    let floor = |alpha_min| error(AccuracyKnobs { alpha_min, ..exact });
    let stop = |transmittance_min| {
        error(AccuracyKnobs {
            transmittance_min,
            ..exact
        })
    };
    assert!(0.0 < floor(1e-4) && floor(1e-4) < floor(4e-3) && floor(4e-3) < floor(0.03));
    assert!(0.0 < stop(1e-4) && stop(1e-4) < stop(1e-3) && stop(1e-3) < stop(1e-2));
}

#[test]
fn knobs_out_of_range_are_named() {
    let d = AccuracyKnobs::default();
    assert!(d.check().is_ok());
    for (name, knobs) in [
        (
            "alpha_min",
            AccuracyKnobs {
                alpha_min: 0.0,
                ..d
            },
        ),
        (
            "alpha_min",
            AccuracyKnobs {
                alpha_min: f64::NAN,
                ..d
            },
        ),
        (
            "transmittance_min",
            AccuracyKnobs {
                transmittance_min: 1.0,
                ..d
            },
        ),
    ] {
        assert_eq!(knobs.check().unwrap_err().name(), name);
    }
}

#[test]
fn single_precision_stays_close() {
    at_each_level(check_single);
}

fn check_single(level: Level) {
    let s = Synthetic::<f64>::new(1000, 80, 60, 8).unwrap();
    let single = |v: &[f64]| v.iter().map(|x| *x as f32).collect::<Vec<f32>>();
    let s32 = Synthetic {
        means: single(&s.means),
        quats: single(&s.quats),
        scales: single(&s.scales),
        opacities: single(&s.opacities),
        harmonics: single(&s.harmonics),
        camera: s.camera,
    };
    // The same numbers in both precisions.
    let double = |v: &[f32]| v.iter().map(|x| f64::from(*x)).collect::<Vec<f64>>();
    let s64 = Synthetic {
        means: double(&s32.means),
        quats: double(&s32.quats),
        scales: double(&s32.scales),
        opacities: double(&s32.opacities),
        harmonics: double(&s32.harmonics),
        camera: s.camera,
    };
    let (r32, r64) = (render(level, &s32), render(level, &s64));
    // No alpha of this scene rounds to the other side of its floor, which would be a jump.
    let far = r32
        .image
        .iter()
        .zip(&r64.image)
        .filter(|(a, b)| (f64::from(**a) - **b).abs() > 2e-6);
    assert_eq!(far.count(), 0);
    let (g32, g64) = (gradients(&s32, &r32), gradients(&s64, &r64));
    let error = |a: &[f32], b: &[f64]| {
        let d: f64 = a
            .iter()
            .zip(b)
            .map(|(x, y)| (f64::from(*x) - y).powi(2))
            .sum();
        (d / b.iter().map(|y| y * y).sum::<f64>()).sqrt()
    };
    for (name, e) in [
        ("means", error(&g32.means, &g64.means)),
        ("quats", error(&g32.quats, &g64.quats)),
        ("scales", error(&g32.scales, &g64.scales)),
        ("opacities", error(&g32.opacities, &g64.opacities)),
        ("harmonics", error(&g32.colors, &g64.colors)),
    ] {
        assert!(e < 1e-5, "{name}: relative error {e}");
    }
}

/// What training holds gives the same picture, and gradients by the chain rule.
#[test]
fn logarithms_and_logits_are_activated() {
    let s = Synthetic::<f64>::new(300, 60, 45, 2).unwrap();
    let mut raw = Synthetic::<f64>::new(300, 60, 45, 2).unwrap();
    raw.scales.iter_mut().for_each(|x| *x = x.ln());
    raw.opacities
        .iter_mut()
        .for_each(|x| *x = (*x / (1.0 - *x)).ln());
    at_each_level(|level| {
        let options = options(level);
        let activated = RenderOptions {
            activate: true,
            ..options
        };
        for antialiased in [false, true] {
            let of = |s, options| {
                let options = RenderOptions {
                    antialiased,
                    ..options
                };
                let r = render_with(s, &options);
                let g = gradients(s, &r);
                (r.image, g)
            };
            let ((image, mut g), (found, v)) = (of(&s, options), of(&raw, activated));
            g.scales
                .iter_mut()
                .zip(&s.scales)
                .for_each(|(v, x)| *v *= x);
            let opacities = g.opacities.iter_mut().zip(&s.opacities);
            opacities.for_each(|(v, x)| *v *= x * (1.0 - x));
            let pairs = [
                (&image, &found),
                (&g.means, &v.means),
                (&g.quats, &v.quats),
                (&g.scales, &v.scales),
                (&g.opacities, &v.opacities),
                (&g.colors, &v.colors),
            ];
            for (k, (expected, found)) in pairs.into_iter().enumerate() {
                let size = expected.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
                assert!(size > 0.0);
                for (x, y) in expected.iter().zip(found) {
                    assert!((x - y).abs() < 1e-11 * size, "{k}: {x} {y}");
                }
            }
        }
    });
}

#[test]
fn a_picture_is_the_image_in_8_bits() {
    at_each_level(|level| {
        let mut s = Synthetic::<f32>::new(400, 75, 50, 3).unwrap();
        s.harmonics.iter_mut().for_each(|x| *x *= 3.0); // some colours beyond white
        let background = [0.3, 0.6, 0.9];
        let options = options(level);
        for (n, channels) in [(400, 3), (400, 5), (0, 3)] {
            let gaussians = Gaussians {
                means: &s.means[..3 * n],
                quats: &s.quats[..4 * n],
                scales: &s.scales[..3 * n],
                opacities: &s.opacities[..n],
            };
            let given: Vec<f32> = s.harmonics[..n * channels].to_vec();
            let of_harmonics = Harmonics {
                coefficients: &s.harmonics[..48 * n],
                ..harmonics(&s)
            };
            let (colors, behind) = if channels == 3 {
                (Colors::Harmonics(of_harmonics), Some(&background[..]))
            } else {
                (Colors::Channels(&given, channels), None)
            };
            let image = forward(gaussians, colors, behind, &s.camera, &options).unwrap();
            let (projection, channels) = (&image.projection, colors.channels());
            let projected = project::forward(&gaussians, colors, &s.camera, &options, false);
            let shaded = projected.unwrap().colors;
            let given = if channels == 3 { &shaded } else { &given };
            let picture =
                |behind| composite::picture(projection, given, channels, &s.camera, behind);
            let bytes = picture(behind).unwrap();
            let level = |x: &f32| (x * 255.0).round_ties_even().clamp(0.0, 255.0) as u8;
            assert_eq!(bytes, image.image.iter().map(level).collect::<Vec<_>>());
            assert_eq!(picture(Some(&[0.0])).unwrap_err().name(), "background");
        }
    });
}

#[test]
fn no_gaussians_and_none_visible_give_an_empty_image() {
    at_each_level(check_empty);
}

fn check_empty(level: Level) {
    let empty = Synthetic::<f32>::new(0, 20, 20, 1).unwrap();
    assert!(render(level, &empty).image.iter().all(|x| *x == 0.0));
    let mut behind = Synthetic::<f32>::new(50, 20, 20, 1).unwrap();
    behind
        .means
        .iter_mut()
        .skip(2)
        .step_by(3)
        .for_each(|z| *z = -*z - 1.0);
    let r = render(level, &behind);
    assert!(r.image.iter().chain(&r.alphas).all(|x| *x == 0.0));
    assert!(r.radii.iter().all(|x| *x == 0));
    assert!(gradients(&behind, &r).means.iter().all(|x| *x == 0.0));
}

#[test]
fn the_wrong_length_is_named() {
    let s = Synthetic::<f32>::new(10, 20, 20, 1).unwrap();
    let g = Gaussians {
        scales: &s.scales[..29],
        ..s.gaussians()
    };
    let given = harmonics(&s);
    let colors = Colors::Harmonics(given);
    let options = RenderOptions::default();
    let error = forward(g, colors, None, &s.camera, &options).unwrap_err();
    assert_eq!(error.name(), "scales");
    let error = forward(s.gaussians(), colors, Some(&[0.0]), &s.camera, &options).unwrap_err();
    assert_eq!(error.name(), "background");
    let channels = Colors::Channels(&s.harmonics, 47);
    let error = forward(s.gaussians(), channels, None, &s.camera, &options).unwrap_err();
    assert_eq!(error.name(), "colors");
    let narrow = RenderOptions {
        far_plane: options.near_plane,
        ..options
    };
    let error = forward(s.gaussians(), colors, None, &s.camera, &narrow).unwrap_err();
    assert_eq!(error.name(), "far_plane");
    let r = render_with(&s, &options);
    for (image, alphas, name) in [(1199, 400, "v.image"), (1200, 399, "v.alphas")] {
        let v = Cotangents {
            image: &vec![0.0; image],
            alphas: Some(&vec![0.0; alphas]),
        };
        let error = backward(&r, &v, Wanted::ALL).unwrap_err();
        assert_eq!(error.name(), name);
    }
}

/// All inputs as one list of numbers, and the gradient in the same order.
struct Inputs {
    scene: Synthetic<f64>,
    colors: Vec<f64>,
    background: Vec<f64>,
    viewmat: [f64; 16],
    harmonics: bool,
    antialiased: bool,
}

impl Inputs {
    fn new(harmonics: bool, antialiased: bool) -> Self {
        let mut scene = Synthetic::<f64>::new(12, 23, 18, 4).unwrap();
        // The first one lies where the Jacobian is that of the border, the second one is opaque up to the cap.
        let k = scene.camera.k();
        for (i, (ratio, opacity)) in [(2.0 * k[2] / k[0], 0.7), (0.0, 0.999)]
            .into_iter()
            .enumerate()
        {
            let depth = scene.means[3 * i + 2];
            scene.means[3 * i] = ratio * depth;
            scene.scales[3 * i..3 * i + 3].copy_from_slice(&[
                0.5 * depth,
                0.4 * depth,
                0.3 * depth,
            ]);
            scene.opacities[i] = opacity;
        }
        let wave = |n: usize| (0..n).map(|i| 0.5 + 0.4 * (i as f64 * 1.7).sin()).collect();
        let (colors, background) = if harmonics {
            (scene.harmonics.clone(), wave(3))
        } else {
            (wave(12 * 5), wave(5))
        };
        let viewmat = scene.camera.viewmat();
        Self {
            scene,
            colors,
            background,
            viewmat,
            harmonics,
            antialiased,
        }
    }

    /// The loss is a sum of all pixels and alphas with different weights.
    fn loss(&self, wanted: Option<Wanted>) -> (f64, Gradients<f64>) {
        let s = &self.scene;
        let camera = Camera::new(&self.viewmat, &s.camera.k(), 23, 18).unwrap();
        let harmonics = Harmonics {
            coefficients: &self.colors,
            rest: None,
            stored: 16,
            degree: 3,
        };
        let colors = if self.harmonics {
            Colors::Harmonics(harmonics)
        } else {
            Colors::Channels(&self.colors, 5)
        };
        // No jumps: nothing is left out.
        let options = RenderOptions {
            knobs: AccuracyKnobs {
                alpha_min: 1e-15,
                transmittance_min: 0.0,
                ..AccuracyKnobs::default()
            },
            antialiased: self.antialiased,
            ..RenderOptions::default()
        };
        let background = Some(&self.background[..]);
        let r = forward(s.gaussians(), colors, background, &camera, &options).unwrap();
        let weights = |n: usize| -> Vec<f64> { (0..n).map(|i| (i as f64 * 0.73).cos()).collect() };
        let (image, alphas) = (weights(r.image.len()), weights(r.alphas.len()));
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        let loss = dot(&image, &r.image) + dot(&alphas, &r.alphas);
        let v = Cotangents {
            image: &image,
            alphas: Some(&alphas),
        };
        let gradients = wanted.map(|wanted| backward(&r, &v, wanted).unwrap());
        (loss, gradients.unwrap_or_default())
    }

    fn array(&mut self, k: usize) -> &mut [f64] {
        let s = &mut self.scene;
        match k {
            0 => &mut s.means,
            1 => &mut s.quats,
            2 => &mut s.scales,
            3 => &mut s.opacities,
            4 => &mut self.colors,
            5 => &mut self.background,
            _ => &mut self.viewmat[..12],
        }
    }
}

/// A grey Gaussian on the axis of a camera, of opacity 0.8.
fn alone(depth: f64) -> Synthetic<f64> {
    let mut s = Synthetic::<f64>::new(1, 32, 24, 0).unwrap();
    s.camera = Camera::at_origin(30.0, 32, 24).unwrap();
    s.means = vec![0.0, 0.0, depth];
    s.scales = vec![0.4; 3];
    s.opacities = vec![0.8];
    s
}

#[test]
fn a_border_of_what_is_shown_belongs_to_one_side() {
    let s = alone(2.0);
    let radius = |change: fn(&mut RenderOptions, f64), value: f64| {
        let mut options = RenderOptions::default();
        change(&mut options, value);
        f64::from(render_with(&s, &options).radii[0])
    };
    let near = |o: &mut RenderOptions, x| o.near_plane = x;
    let far = |o: &mut RenderOptions, x| o.far_plane = x;
    let clip = |o: &mut RenderOptions, x| o.radius_clip = x;
    let whole = radius(near, 2.0);
    assert!(whole > 0.0 && radius(near, 2f64.next_up()) == 0.0);
    assert!(radius(far, 2.0) == whole && radius(far, 2f64.next_down()) == 0.0);
    assert!(radius(clip, whole - 0.5) == whole && radius(clip, whole) == 0.0);
}

#[test]
fn depths_that_f32_does_not_tell_apart_are_ordered() {
    let mut s = alone(2.0 + 1e-9);
    let nearer = alone(2.0);
    for (all, one) in [
        (&mut s.means, nearer.means),
        (&mut s.quats, nearer.quats),
        (&mut s.scales, nearer.scales),
        (&mut s.opacities, nearer.opacities),
    ] {
        all.extend(one);
    }
    let colors = [1.0, 0.0];
    let colors = Colors::Channels(&colors, 1); // the farther one is white, the nearer one black
    let r = forward(
        s.gaussians(),
        colors,
        None,
        &s.camera,
        &RenderOptions::default(),
    )
    .unwrap();
    let middle = 12 * 32 + 16;
    assert!(r.alphas[middle] > 0.9 && r.image[middle] < 0.25);
}

#[test]
fn what_no_layer_hides_shows_the_background() {
    let s = Synthetic::<f64>::room(20_000, 150, 100, 1).unwrap();
    let plain = render(levels()[0], &s);
    let given = harmonics(&s);
    let background = [3.0, 5.0, 7.0];
    let colors = Colors::Harmonics(given);
    let options = RenderOptions::default();
    let r = forward(
        s.gaussians(),
        colors,
        Some(&background),
        &s.camera,
        &options,
    )
    .unwrap();
    for (pixel, alpha) in r.alphas.iter().enumerate() {
        for (c, behind) in background.iter().enumerate() {
            let expected = plain.image[3 * pixel + c] + (1.0 - alpha) * behind;
            assert!(
                (r.image[3 * pixel + c] - expected).abs() < 1e-12,
                "pixel {pixel}"
            );
        }
    }
}

#[test]
fn gradients_are_those_of_finite_differences() {
    for (harmonics, antialiased) in [(false, true), (true, false)] {
        let mut inputs = Inputs::new(harmonics, antialiased);
        let (_, g) = inputs.loss(Some(Wanted::ALL));
        let viewmat = g.viewmat.unwrap();
        assert_eq!(viewmat[12..], [0.0; 4]);
        let arrays: [&[f64]; 7] = [
            &g.means,
            &g.quats,
            &g.scales,
            &g.opacities,
            &g.colors,
            &g.background,
            &viewmat[..12],
        ];
        for (k, gradient) in arrays.into_iter().enumerate() {
            assert_eq!(gradient.len(), inputs.array(k).len());
            for (i, exact) in gradient.iter().enumerate() {
                let (h, value) = (1e-5, inputs.array(k)[i]);
                let mut at = |x| {
                    inputs.array(k)[i] = x;
                    inputs.loss(None).0
                };
                let difference = (at(value + h) - at(value - h)) / (2.0 * h);
                inputs.array(k)[i] = value;
                assert!(
                    (exact - difference).abs() < 1e-5 * (1.0 + difference.abs()),
                    "harmonics {harmonics}, array {k}, number {i}: {exact}, not {difference}"
                );
            }
        }
    }
}

#[test]
fn what_is_not_wanted_is_empty_and_changes_no_bit_of_the_rest() {
    for harmonics in [false, true] {
        let inputs = Inputs::new(harmonics, false);
        let (_, all) = inputs.loss(Some(Wanted::ALL));
        let none = Wanted::default();
        for (k, wanted) in [
            Wanted {
                means: true,
                ..none
            },
            Wanted {
                quats: true,
                ..none
            },
            Wanted {
                scales: true,
                ..none
            },
            Wanted {
                opacities: true,
                ..none
            },
            Wanted {
                colors: true,
                ..none
            },
            Wanted {
                background: true,
                ..none
            },
            Wanted {
                viewmat: true,
                ..none
            },
            Wanted {
                means2d: true,
                ..none
            },
        ]
        .into_iter()
        .enumerate()
        {
            let (_, one) = inputs.loss(Some(wanted));
            let mut expected = Gradients::default();
            match k {
                0 => expected.means = all.means.clone(),
                1 => expected.quats = all.quats.clone(),
                2 => expected.scales = all.scales.clone(),
                3 => expected.opacities = all.opacities.clone(),
                4 => expected.colors = all.colors.clone(),
                5 => expected.background = all.background.clone(),
                6 => expected.viewmat = all.viewmat,
                _ => {
                    expected.means2d = all.means2d.clone();
                    expected.means2d_absolute = all.means2d_absolute.clone();
                }
            }
            assert_eq!(one, expected);
        }
        assert_eq!(inputs.loss(Some(none)).1, Gradients::default());
    }
}

/// All outputs and gradients by name: with harmonics, and of five channels before a background.
fn outputs<T: Real>(level: Level, s: &Synthetic<T>) -> Vec<(&'static str, Vec<f64>)> {
    let r = render(level, s);
    let g = gradients(s, &r);
    let (gaussians, n) = (s.gaussians(), s.opacities.len());
    let wave = |n: usize| -> Vec<T> {
        let values = (0..n).map(|i| (1.0 + i as f64 * 0.37).sin());
        values.map(T::from_f64).collect()
    };
    let (colors, background) = (wave(5 * n), wave(5));
    let channels = Colors::Channels(&colors, 5);
    let view = forward(
        gaussians,
        channels,
        Some(&background),
        &s.camera,
        &options(level),
    )
    .unwrap();
    let (v_image, v_alphas) = (wave(view.image.len()), wave(view.alphas.len()));
    let v = Cotangents {
        image: &v_image,
        alphas: Some(&v_alphas),
    };
    let five = backward(&view, &v, Wanted::ALL).unwrap();
    let numbers = |v: &[T]| v.iter().map(|x| x.to_f64()).collect::<Vec<f64>>();
    vec![
        ("image", numbers(&r.image)),
        ("alphas", numbers(&r.alphas)),
        ("means", numbers(&g.means)),
        ("quats", numbers(&g.quats)),
        ("scales", numbers(&g.scales)),
        ("opacities", numbers(&g.opacities)),
        ("harmonics", numbers(&g.colors)),
        ("viewmat", g.viewmat.unwrap().to_vec()),
        ("5 channels", numbers(&view.image)),
        ("their means2d", numbers(&five.means2d)),
        ("their absolute", numbers(&five.means2d_absolute)),
        ("their colors", numbers(&five.colors)),
        ("their background", numbers(&five.background)),
    ]
}

/// For each level of this CPU how far it is from the best one: numbers that differ, and the largest difference of
/// each array over its largest number. `cargo test level_by_level -- --nocapture` prints it.
fn check_level_by_level<T: Real>(tolerance: f64) {
    let s = Synthetic::<T>::new(5000, 150, 97, 1).unwrap();
    let best = outputs(levels()[0], &s);
    for level in levels() {
        println!("{}, f{}:", level.name(), 8 * size_of::<T>());
        for ((name, a), (_, b)) in outputs(level, &s).iter().zip(&best) {
            let largest = b.iter().fold(0.0f64, |m, x| m.max(x.abs()));
            let pairs = || a.iter().zip(b);
            let differ = pairs().filter(|(x, y)| x.to_bits() != y.to_bits()).count();
            let worst = pairs().fold(0.0f64, |m, (x, y)| m.max((x - y).abs())) / largest;
            println!("  {name}: {differ} of {}, at most {worst:.1e}", a.len());
            if level.is_fused() == levels()[0].is_fused() {
                assert_eq!(differ, 0, "{name}");
            }
            assert!(worst < tolerance, "{name}: {worst:e}");
        }
    }
}

#[test]
fn level_by_level() {
    check_level_by_level::<f32>(1e-4);
    check_level_by_level::<f64>(1e-12);
}
