//! Projection of all Gaussians into one camera, forward and VJP: geometry, culling, spherical harmonics.

use crate::{
    camera::{Camera, CameraGrad},
    constants::{
        ALPHA_MIN, EPS2D, FACTOR_MAX, FAR_PLANE, NEAR_PLANE, PROJECT_CHUNK, SUPPORT_SLACK, TILE,
    },
    geometry::{CameraGradLanes, CameraLanes, Cotangent, Geometry},
    lanes::{V3, Wide, lanes, load, load3, splat as splat_lanes, splat3},
    real::Real,
    scene::{Colors, Gaussians, Harmonics},
    sh,
};
use fearless_simd::{Level, Select, Simd, SimdBase, SimdFloat, SimdMask, dispatch};
use rayon::prelude::*;

/// Options of the projection; the defaults are gsplat's.
#[derive(Debug, Clone, Copy)]
pub struct ProjectOptions {
    /// Gaussians nearer than this are culled.
    pub near_plane: f64,
    /// Gaussians farther than this are culled.
    pub far_plane: f64,
    /// Gaussians whose two radii are at most this many pixels are culled.
    pub radius_clip: f64,
    /// Low-pass filter, px^2.
    pub eps2d: f64,
    /// Scale the opacity so that the low-pass does not brighten small Gaussians.
    pub antialiased: bool,
}

impl Default for ProjectOptions {
    fn default() -> Self {
        Self {
            near_plane: NEAR_PLANE,
            far_plane: FAR_PLANE,
            radius_clip: 0.0,
            eps2d: EPS2D,
            antialiased: false,
        }
    }
}

/// One projected Gaussian as the compositor reads it: 64 bytes, one cache line.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub struct Splat {
    /// Centre, pixels. f64, because f32 would shift small Gaussians visibly: half an ulp at 500 px is 1.5e-5 px.
    pub mean: [f64; 2],
    /// Factors (s, m, t) of the conic; see `geometry.rs`.
    pub factors: [f64; 3],
    /// Opacity, compensated if antialiased; 0 for a culled Gaussian.
    pub opacity: f64,
    /// Radius of the support in standard deviations, with the slack.
    pub reach: f32,
    /// Tiles that its bounding box touches: x begin, x end, y begin, y end.
    pub tiles: [u16; 4],
}

impl Splat {
    /// Whether it was kept by the projection.
    pub fn visible(&self) -> bool {
        self.opacity > 0.0
    }
}

/// What the later stages need of the projection of N Gaussians.
#[derive(Debug, Default)]
pub struct Projection {
    /// All N Gaussians, culled ones included.
    pub splats: Vec<Splat>,
    /// View-space depth, [N]; unspecified where culled.
    pub depths: Vec<f64>,
}

/// Arrays that the projection fills; zeros where a Gaussian is culled.
#[derive(Debug)]
pub struct ProjectOut<'a, T> {
    /// Centres in pixels, [N, 2].
    pub means2d: &'a mut [T],
    /// View-space depth, [N].
    pub depths: &'a mut [T],
    /// Inverse covariance (xx, xy, yy), [N, 3].
    pub conics: &'a mut [T],
    /// Radii of the support in pixels, rounded up, [N, 2].
    pub radii: &'a mut [i32],
    /// Opacities, compensated if antialiased, [N].
    pub opacities: &'a mut [T],
    /// Colours from the spherical harmonics, [N, 3]; empty without them.
    pub colors: &'a mut [T],
}

/// The geometry of Gaussians `first..` of `g`, one per lane.
#[inline(always)]
fn geometry<S: Simd, T: Real>(
    simd: S,
    g: &Gaussians<T>,
    first: usize,
    camera: &CameraLanes<S>,
) -> Geometry<S> {
    let quat = [
        load(simd, g.quats, 4, 0, first),
        load(simd, g.quats, 4, 1, first),
        load(simd, g.quats, 4, 2, first),
        load(simd, g.quats, 4, 3, first),
    ];
    Geometry::new(
        simd,
        load3(simd, g.means, first),
        quat,
        load3(simd, g.scales, first),
        camera,
    )
}

#[inline(always)]
fn columns3<S: Simd, T: Real>(simd: S, data: &[T], first: usize) -> [Wide<S>; 3] {
    [
        load(simd, data, 3, 0, first),
        load(simd, data, 3, 1, first),
        load(simd, data, 3, 2, first),
    ]
}

/// Unit vectors from the camera centre, and distances. A Gaussian on the centre has no direction: (0, 0, 0).
#[inline(always)]
fn direction<S: Simd>(simd: S, mean: V3<Wide<S>>, center: V3<Wide<S>>) -> (V3<Wide<S>>, Wide<S>) {
    let (zero, one) = (splat_lanes(simd, 0.0), splat_lanes(simd, 1.0));
    let d = mean - center;
    let length = d.dot(d).sqrt();
    let inverse = length.simd_gt(zero).select(one / length, zero);
    (d.by(inverse), length)
}

/// Range of tiles whose pixel centres lie within `center +- extent`, clipped to `size` pixels.
fn tile_range(center: f64, extent: f64, size: usize) -> (u16, u16) {
    let first = (center - extent - 0.5).ceil().max(0.0);
    let last = (center + extent - 0.5).floor().min(size as f64 - 1.0);
    if first <= last {
        (
            (first as usize / TILE) as u16,
            (last as usize / TILE + 1) as u16,
        )
    } else {
        (0, 0)
    }
}

/// One lane of the geometry, as the culling reads it.
struct Projected {
    mean: [f64; 2],
    /// Standard deviations along x and y, pixels.
    sigma: [f64; 2],
    factors: [f64; 3],
    opacity: f64,
}

/// Cull and pack one Gaussian; the radii in pixels, rounded up.
#[inline(always)]
fn splat(p: &Projected, camera: &Camera, o: &ProjectOptions) -> Option<(Splat, [f64; 2])> {
    if !(p.opacity >= ALPHA_MIN && p.opacity.is_finite()) {
        return None;
    }
    let radius = (2.0 * (p.opacity / ALPHA_MIN).ln()).sqrt();
    let radii = p.sigma.map(|s| (radius * s).ceil());
    let size = [camera.width as f64, camera.height as f64];
    let inside = (0..2).all(|k| p.mean[k] + radii[k] > 0.0 && p.mean[k] - radii[k] < size[k]);
    if !(inside && radii[0].max(radii[1]) > o.radius_clip) {
        return None;
    }
    let [s, m, t] = p.factors;
    let stiffness = s * (1.0 + m.abs()) + t;
    if !stiffness.is_finite() || stiffness >= FACTOR_MAX {
        return None;
    }
    let reach = radius + SUPPORT_SLACK * (1.0 + stiffness);
    let (x0, x1) = tile_range(p.mean[0], reach * p.sigma[0], camera.width);
    let (y0, y1) = tile_range(p.mean[1], reach * p.sigma[1], camera.height);
    let splat = Splat {
        mean: p.mean,
        factors: p.factors,
        opacity: p.opacity,
        // f32 rounds to nearest: the slack is far larger than half an ulp of any radius below 10.
        reach: reach as f32,
        tiles: [x0, x1, y0, y1],
    };
    Some((splat, radii))
}

/// Project all Gaussians into `camera`.
///
/// Culled: outside the depth range or the image, not finite (its colour included), without rotation, too transparent, or not
/// larger than `radius_clip`. The lengths of all slices must already agree (`Gaussians::check`).
pub fn forward<T: Real>(
    gaussians: &Gaussians<T>,
    colors: Colors<T>,
    camera: &Camera,
    options: &ProjectOptions,
    projection: &mut Projection,
    out: ProjectOut<T>,
) {
    let n = gaussians.len();
    projection.splats.resize(n, Splat::default());
    projection.depths.resize(n, 0.0);
    let color_channels = if matches!(colors, Colors::Harmonics(_)) {
        3
    } else {
        0
    };
    let mut out_colors = out.colors;
    let color_chunks = (0..n.div_ceil(PROJECT_CHUNK)).map(|c| {
        let rows = PROJECT_CHUNK.min(n - c * PROJECT_CHUNK);
        let (head, tail) = std::mem::take(&mut out_colors).split_at_mut(rows * color_channels);
        out_colors = tail;
        head
    });
    let jobs: Vec<_> = projection
        .splats
        .chunks_mut(PROJECT_CHUNK)
        .zip(projection.depths.chunks_mut(PROJECT_CHUNK))
        .zip(out.means2d.chunks_mut(2 * PROJECT_CHUNK))
        .zip(out.depths.chunks_mut(PROJECT_CHUNK))
        .zip(out.conics.chunks_mut(3 * PROJECT_CHUNK))
        .zip(out.radii.chunks_mut(2 * PROJECT_CHUNK))
        .zip(out.opacities.chunks_mut(PROJECT_CHUNK))
        .zip(color_chunks)
        .map(
            |(((((((splats, keys), means2d), depths), conics), radii), opacities), colors)| {
                (
                    splats,
                    keys,
                    ProjectOut {
                        means2d,
                        depths,
                        conics,
                        radii,
                        opacities,
                        colors,
                    },
                )
            },
        )
        .enumerate()
        .collect();
    let level = Level::new();
    jobs.into_par_iter().for_each(|(chunk, (splats, keys, mut out))| {
        dispatch!(level, simd => forward_chunk(
            simd, gaussians, colors, camera, options, chunk * PROJECT_CHUNK, splats, keys, &mut out
        ));
    });
}

/// Project the Gaussians `begin..begin + splats.len()`.
#[inline(always)]
fn forward_chunk<S: Simd, T: Real>(
    simd: S,
    gaussians: &Gaussians<T>,
    colors: Colors<T>,
    camera: &Camera,
    options: &ProjectOptions,
    begin: usize,
    splats: &mut [Splat],
    keys: &mut [f64],
    out: &mut ProjectOut<T>,
) {
    let lanes_of = CameraLanes::new(
        simd,
        camera,
        options.near_plane,
        options.far_plane,
        options.eps2d,
    );
    let center = splat3(simd, camera.center);
    for first in (0..splats.len()).step_by(lanes::<S>()) {
        let g = geometry(simd, gaussians, begin + first, &lanes_of);
        let valid = g.valid.to_bitmask();
        let mean2d = g.mean2d(&lanes_of);
        let sigma = [g.a.sqrt(), g.c.sqrt()];
        let conic = g.conic();
        let mut opacity = load(simd, gaussians.opacities, 1, 0, begin + first);
        if options.antialiased {
            opacity *= g.compensation();
        }
        let basis = match colors {
            Colors::Harmonics(h) => {
                Some(sh::basis(simd, h.degree, direction(simd, g.mean, center).0))
            }
            Colors::Channels(..) => None,
        };
        for lane in 0..lanes::<S>().min(splats.len() - first) {
            let j = first + lane;
            let projected = Projected {
                mean: mean2d.map(|m| m[lane]),
                sigma: sigma.map(|s| s[lane]),
                factors: g.factors.map(|f| f[lane]),
                opacity: opacity[lane],
            };
            let mut kept = if valid >> lane & 1 == 1 {
                splat(&projected, camera, options)
            } else {
                None
            };
            match (colors, &basis) {
                (Colors::Harmonics(h), Some(basis)) => {
                    let mut rgb = evaluate(h, begin + j, |k| T::from_f64(basis[k][lane]));
                    if kept.is_none() || !finite(&rgb) {
                        (kept, rgb) = (None, [T::ZERO; 3]);
                    }
                    for (o, c) in out.colors[3 * j..3 * j + 3].iter_mut().zip(rgb) {
                        *o = if c > T::ZERO { c } else { T::ZERO };
                    }
                }
                (Colors::Channels(data, channels), _) => {
                    if !finite(&data[(begin + j) * channels..(begin + j + 1) * channels]) {
                        kept = None;
                    }
                }
                _ => unreachable!("the basis belongs to the harmonics"),
            }
            let (s, r) = kept.unwrap_or_default();
            splats[j] = s;
            let depth = if kept.is_some() { g.p.z[lane] } else { 0.0 };
            keys[j] = depth;
            out.depths[j] = T::from_f64(depth);
            out.opacities[j] = T::from_f64(s.opacity);
            for (o, m) in out.means2d[2 * j..2 * j + 2].iter_mut().zip(s.mean) {
                *o = T::from_f64(m);
            }
            for (o, r) in out.radii[2 * j..2 * j + 2].iter_mut().zip(r) {
                *o = r as i32; // saturates
            }
            for (o, q) in out.conics[3 * j..3 * j + 3].iter_mut().zip(conic) {
                *o = if kept.is_some() {
                    T::from_f64(q[lane])
                } else {
                    T::ZERO
                };
            }
        }
    }
}

fn finite<T: Real>(values: &[T]) -> bool {
    values.iter().all(|x| x.to_f64().is_finite())
}

/// Colour of Gaussian `i` before the clamp at 0.
#[inline(always)]
fn evaluate<T: Real>(h: &Harmonics<T>, i: usize, basis: impl Fn(usize) -> T) -> [T; 3] {
    let (first, rest) = h.of(i);
    let y = basis(0);
    let mut rgb = [T::ZERO; 3];
    for (c, x) in rgb.iter_mut().zip(first) {
        *c = T::from_f64(0.5) + y * *x;
    }
    for (k, row) in rest.chunks_exact(3).enumerate() {
        let y = basis(k + 1);
        for (c, x) in rgb.iter_mut().zip(row) {
            *c += y * *x;
        }
    }
    rgb
}

/// Cotangents of the projection's outputs, all dense over N.
#[derive(Debug, Clone, Copy)]
pub struct ProjectCotangents<'a, T> {
    /// Of `means2d`, [N, 2].
    pub means2d: &'a [T],
    /// Whitened gradient of the 2D covariance (E_uu, E_uv, E_vv), [N, 3]; see `geometry.rs`.
    pub whitened: &'a [T],
    /// Of `opacities`, [N].
    pub opacities: &'a [T],
    /// Of `depths`, [N].
    pub depths: Option<&'a [T]>,
    /// Of `conics`, [N, 3].
    pub conics: Option<&'a [T]>,
    /// Of `colors` from the harmonics, [N, 3].
    pub colors: Option<&'a [T]>,
}

/// Gradients to add to; `None` is not computed.
#[derive(Debug, Default)]
pub struct GaussianGrads<'a, T> {
    /// [N, 3]
    pub means: Option<&'a mut [T]>,
    /// [N, 4]
    pub quats: Option<&'a mut [T]>,
    /// [N, 3]
    pub scales: Option<&'a mut [T]>,
    /// [N]
    pub opacities: Option<&'a mut [T]>,
    /// As `Harmonics::coefficients`.
    pub harmonics: Option<&'a mut [T]>,
    /// As `Harmonics::rest`.
    pub harmonics_rest: Option<&'a mut [T]>,
}

/// Split an optional array of `n` rows into chunks of `PROJECT_CHUNK` rows.
fn chunks<T>(data: Option<&mut [T]>, n: usize, row: usize) -> Vec<Option<&mut [T]>> {
    match data {
        Some(d) if row > 0 => d.chunks_mut(PROJECT_CHUNK * row).map(Some).collect(),
        // No rows of the higher degrees still means one part for each chunk.
        _ => (0..n.div_ceil(PROJECT_CHUNK)).map(|_| None).collect(),
    }
}

fn add<T: Real>(out: &mut Option<&mut [T]>, j: usize, values: &[f64]) {
    if let Some(out) = out {
        for (o, v) in out[j * values.len()..].iter_mut().zip(values) {
            *o = T::saturating(o.to_f64() + v);
        }
    }
}

#[inline(always)]
fn add_scaled<T: Real>(out: &mut [T], y: T, v: &[T; 3]) {
    for (o, v) in out.iter_mut().zip(v) {
        *o += y * *v;
    }
}

/// Vector-Jacobian product of [`forward`]: adds to `grads` and returns the gradient of the camera (of its
/// centre alone unless `camera_wanted`).
///
/// `projection` must be the one that `forward` filled from the same inputs.
pub fn backward<T: Real>(
    gaussians: &Gaussians<T>,
    harmonics: Option<&Harmonics<T>>,
    camera: &Camera,
    options: &ProjectOptions,
    projection: &Projection,
    v: &ProjectCotangents<T>,
    grads: GaussianGrads<T>,
    camera_wanted: bool,
) -> CameraGrad {
    let n = gaussians.len();
    let (row, rest_row) = harmonics.map_or((0, 0), Harmonics::rows);
    let jobs: Vec<_> = chunks(grads.means, n, 3)
        .into_iter()
        .zip(chunks(grads.quats, n, 4))
        .zip(chunks(grads.scales, n, 3))
        .zip(chunks(grads.opacities, n, 1))
        .zip(chunks(grads.harmonics, n, row))
        .zip(chunks(grads.harmonics_rest, n, rest_row))
        .collect();
    let level = Level::new();
    let parts: Vec<CameraGrad> = jobs
        .into_par_iter()
        .enumerate()
        .map(|(chunk, (((((means, quats), scales), opacities), harmonics_grad), harmonics_rest))| {
            let grads = GaussianGrads { means, quats, scales, opacities, harmonics: harmonics_grad, harmonics_rest };
            dispatch!(level, simd => backward_chunk(
                simd, gaussians, harmonics, camera, options, projection, v, chunk * PROJECT_CHUNK, grads, camera_wanted
            ))
        })
        .collect();
    parts.iter().fold(CameraGrad::ZERO, |mut sum, part| {
        sum.add(part);
        sum
    })
}

/// VJP of the Gaussians of one chunk.
#[inline(always)]
fn backward_chunk<S: Simd, T: Real>(
    simd: S,
    gaussians: &Gaussians<T>,
    harmonics: Option<&Harmonics<T>>,
    camera: &Camera,
    options: &ProjectOptions,
    projection: &Projection,
    v: &ProjectCotangents<T>,
    begin: usize,
    mut grads: GaussianGrads<T>,
    camera_wanted: bool,
) -> CameraGrad {
    let zero = splat_lanes(simd, 0.0);
    let lanes_of = CameraLanes::new(
        simd,
        camera,
        options.near_plane,
        options.far_plane,
        options.eps2d,
    );
    let center = splat3(simd, camera.center);
    let mut camera_grad = CameraGradLanes::zero(simd);
    let end = gaussians.len().min(begin + PROJECT_CHUNK);
    for first in (begin..end).step_by(lanes::<S>()) {
        let rows = lanes::<S>().min(end - first);
        let visible = |lane: usize| lane < rows && projection.splats[first + lane].visible();
        if !(0..rows).any(visible) {
            continue;
        }
        let mut g = geometry(simd, gaussians, first, &lanes_of);
        // Lanes that were culled for another reason, or lie beyond the end, are not valid here.
        g.valid = Wide::<S>::from_fn(simd, |lane| f64::from(u8::from(visible(lane)))).simd_gt(zero);
        let v_opacity = load(simd, v.opacities, 1, 0, first);
        let mut v_input_opacity = v_opacity;
        let mut direct = None;
        if options.antialiased || v.conics.is_some() {
            let conic = match v.conics {
                Some(c) => columns3(simd, c, first),
                None => [zero; 3],
            };
            let mut compensation = zero;
            if options.antialiased {
                compensation = v_opacity * load(simd, gaussians.opacities, 1, 0, first);
                v_input_opacity = v_opacity * g.compensation();
            }
            direct = Some((conic, compensation));
        }
        let cotangent = Cotangent {
            mean2d: [
                load(simd, v.means2d, 2, 0, first),
                load(simd, v.means2d, 2, 1, first),
            ],
            whitened: columns3(simd, v.whitened, first),
            depth: match v.depths {
                Some(d) => load(simd, d, 1, 0, first),
                None => zero,
            },
            direct,
        };
        let mut grad = g.vjp(
            simd,
            &cotangent,
            &lanes_of,
            camera_wanted.then_some(&mut camera_grad),
        );
        if let (Some(h), Some(colors)) = (harmonics, v.colors) {
            let (d, length) = direction(simd, g.mean, center);
            let basis = sh::basis(simd, h.degree, d);
            let mut weights = [zero; sh::MAX_COUNT];
            for lane in (0..rows).filter(|&lane| visible(lane)) {
                let i = first + lane;
                let basis = |k: usize| T::from_f64(basis[k][lane]);
                let rgb = evaluate(h, i, basis);
                // Zero gradient where the colour is clamped at 0.
                let v_rgb: [T; 3] = std::array::from_fn(|c| {
                    if rgb[c] >= T::ZERO {
                        colors[3 * i + c]
                    } else {
                        T::ZERO
                    }
                });
                let (first, rest) = h.of(i);
                let along = |row: &[T]| v_rgb[0] * row[0] + v_rgb[1] * row[1] + v_rgb[2] * row[2];
                weights[0][lane] = along(first).to_f64();
                for (w, row) in weights[1..].iter_mut().zip(rest.chunks_exact(3)) {
                    w[lane] = along(row).to_f64();
                }
                let (row, rest_row) = h.rows();
                let j = i - begin;
                let (mut first_grad, mut rest_grad) = (None, None);
                if let Some(out) = &mut grads.harmonics {
                    let (first, rest) = out[j * row..(j + 1) * row].split_at_mut(3);
                    (first_grad, rest_grad) = (Some(first), Some(rest));
                }
                if h.rest.is_some() {
                    let out = grads.harmonics_rest.as_mut();
                    rest_grad = out.map(|out| &mut out[j * rest_row..(j + 1) * rest_row]);
                }
                if let Some(out) = first_grad {
                    add_scaled(out, basis(0), &v_rgb);
                }
                if let Some(out) = rest_grad {
                    let rows = out.chunks_exact_mut(3).take(sh::count(h.degree) - 1);
                    for (k, out) in rows.enumerate() {
                        add_scaled(out, basis(k + 1), &v_rgb);
                    }
                }
            }
            let v_d = sh::basis_vjp(simd, h.degree, d, &weights);
            // Through the normalisation; a Gaussian on the camera centre gets no gradient from its colour.
            let inverse = length
                .simd_gt(zero)
                .select(splat_lanes(simd, 1.0) / length, zero);
            let v_mean = (v_d - d.by(d.dot(v_d))).by(inverse);
            grad.mean = grad.mean + v_mean;
            camera_grad.center = camera_grad.center - v_mean.only(g.valid, zero);
        }
        for lane in (0..rows).filter(|&lane| visible(lane)) {
            let j = first - begin + lane;
            add(
                &mut grads.means,
                j,
                &[grad.mean.x[lane], grad.mean.y[lane], grad.mean.z[lane]],
            );
            add(&mut grads.quats, j, &grad.quat.map(|q| q[lane]));
            add(
                &mut grads.scales,
                j,
                &[grad.scale.x[lane], grad.scale.y[lane], grad.scale.z[lane]],
            );
            add(&mut grads.opacities, j, &[v_input_opacity[lane]]);
        }
    }
    camera_grad.sum()
}
