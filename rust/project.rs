//! Projection of all Gaussians into one camera, forward and VJP: geometry, culling, spherical harmonics.

use crate::{
    camera::{Camera, CameraGrad},
    constants::{
        ALPHA_MIN, EPS2D, FACTOR_MAX, FAR_PLANE, NEAR_PLANE, PROJECT_CHUNK, SUPPORT_SLACK, TILE,
    },
    geometry::{Cotangent, Geometry},
    real::Real,
    scene::{Gaussians, Harmonics},
    sh,
};
use glam::{DVec2, DVec3};
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
    /// Centre, pixels. f64, because f32 would shift small Gaussians by up to 3e-5 px at 500 px.
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

fn vec3<T: Real>(data: &[T], i: usize) -> DVec3 {
    DVec3::new(
        data[3 * i].to_f64(),
        data[3 * i + 1].to_f64(),
        data[3 * i + 2].to_f64(),
    )
}

fn geometry<T: Real>(
    g: &Gaussians<T>,
    i: usize,
    camera: &Camera,
    o: &ProjectOptions,
) -> Option<Geometry> {
    let quat = std::array::from_fn(|k| g.quats[4 * i + k].to_f64());
    Geometry::new(
        vec3(g.means, i),
        quat,
        vec3(g.scales, i),
        camera,
        o.near_plane,
        o.far_plane,
        o.eps2d,
    )
}

/// Direction from the camera centre, its length, and the degree that can be used along it.
fn direction(mean: DVec3, camera: &Camera, degree: usize) -> (DVec3, f64, usize) {
    let d = mean - camera.center;
    let length = d.length();
    if length > 0.0 {
        (d / length, length, degree)
    } else {
        (DVec3::ZERO, 0.0, 0)
    }
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

/// Cull and pack one Gaussian. `radii` in pixels, rounded up.
fn splat(
    geometry: &Geometry,
    opacity: f64,
    camera: &Camera,
    o: &ProjectOptions,
) -> Option<(Splat, [f64; 2])> {
    let opacity = if o.antialiased {
        opacity * geometry.compensation()
    } else {
        opacity
    };
    if !(opacity >= ALPHA_MIN && opacity.is_finite()) {
        return None;
    }
    let radius = (2.0 * (opacity / ALPHA_MIN).ln()).sqrt();
    let sigma = DVec2::new(geometry.a, geometry.c).map(f64::sqrt);
    let radii = (radius * sigma).map(f64::ceil);
    let mean = geometry.mean2d(camera);
    let size = DVec2::new(camera.width as f64, camera.height as f64);
    let inside = (mean + radii).min_element() > 0.0 && (size - mean + radii).min_element() > 0.0;
    if !(inside && radii.max_element() > o.radius_clip) {
        return None;
    }
    let (s, m, t) = geometry.factors();
    let stiffness = s * (1.0 + m.abs()) + t;
    if !(stiffness < FACTOR_MAX) {
        return None;
    }
    let reach = radius + SUPPORT_SLACK * (1.0 + stiffness);
    let (x0, x1) = tile_range(mean.x, reach * sigma.x, camera.width);
    let (y0, y1) = tile_range(mean.y, reach * sigma.y, camera.height);
    let splat = Splat {
        mean: mean.to_array(),
        factors: [s, m, t],
        opacity,
        // f32 rounds to nearest: the slack is far larger than half an ulp of any radius below 10.
        reach: reach as f32,
        tiles: [x0, x1, y0, y1],
    };
    Some((splat, radii.to_array()))
}

/// Project all Gaussians into `camera`.
///
/// Culled: outside the depth range or the image, not finite, without rotation, too transparent, or not
/// larger than `radius_clip`. The lengths of all slices must already agree (`Gaussians::check`).
pub fn forward<T: Real>(
    gaussians: &Gaussians<T>,
    harmonics: Option<&Harmonics<T>>,
    camera: &Camera,
    options: &ProjectOptions,
    projection: &mut Projection,
    out: ProjectOut<T>,
) {
    let n = gaussians.len();
    projection.splats.resize(n, Splat::default());
    projection.depths.resize(n, 0.0);
    let color_channels = if harmonics.is_some() { 3 } else { 0 };
    let mut colors = out.colors;
    let color_chunks = (0..n.div_ceil(PROJECT_CHUNK)).map(|c| {
        let rows = PROJECT_CHUNK.min(n - c * PROJECT_CHUNK);
        let (head, tail) = std::mem::take(&mut colors).split_at_mut(rows * color_channels);
        colors = tail;
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
        .collect();
    jobs.into_par_iter().enumerate().for_each(
        |(chunk, (((((((splats, keys), means2d), depths), conics), radii), opacities), colors))| {
            for j in 0..splats.len() {
                let i = chunk * PROJECT_CHUNK + j;
                let projected = geometry(gaussians, i, camera, options).and_then(|g| {
                    splat(&g, gaussians.opacities[i].to_f64(), camera, options).map(|s| (g, s))
                });
                let Some((g, (s, r))) = projected else {
                    splats[j] = Splat::default();
                    (depths[j], opacities[j]) = (T::ZERO, T::ZERO);
                    means2d[2 * j..2 * j + 2].fill(T::ZERO);
                    conics[3 * j..3 * j + 3].fill(T::ZERO);
                    radii[2 * j..2 * j + 2].fill(0);
                    colors
                        .chunks_mut(3)
                        .skip(j)
                        .take(1)
                        .for_each(|c| c.fill(T::ZERO));
                    continue;
                };
                splats[j] = s;
                keys[j] = g.p.z;
                depths[j] = T::from_f64(g.p.z);
                opacities[j] = T::from_f64(s.opacity);
                for k in 0..2 {
                    means2d[2 * j + k] = T::from_f64(s.mean[k]);
                    radii[2 * j + k] = r[k] as i32; // saturates
                }
                for (out, q) in conics[3 * j..].iter_mut().zip(g.conic()) {
                    *out = T::from_f64(q);
                }
                if let Some(h) = harmonics {
                    let (d, _, degree) = direction(vec3(gaussians.means, i), camera, h.degree);
                    let rgb = evaluate(h, i, degree, d);
                    for k in 0..3 {
                        colors[3 * j + k] = T::from_f64(rgb[k].max(0.0));
                    }
                }
            }
        },
    );
}

/// Colour of Gaussian `i` along the unit vector `d`, before the clamp at 0.
fn evaluate<T: Real>(h: &Harmonics<T>, i: usize, degree: usize, d: DVec3) -> [f64; 3] {
    let basis = sh::basis(degree, d.to_array());
    let rows = &h.coefficients[3 * h.stored * i..][..3 * sh::count(degree)];
    let mut rgb = [0.5; 3];
    for (y, row) in basis.iter().zip(rows.chunks_exact(3)) {
        for (c, x) in rgb.iter_mut().zip(row) {
            *c += y * x.to_f64();
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
    /// [N, K, 3]
    pub harmonics: Option<&'a mut [T]>,
}

/// Split an optional array of `n` rows into chunks of `PROJECT_CHUNK` rows.
fn chunks<T>(data: Option<&mut [T]>, n: usize, row: usize) -> Vec<Option<&mut [T]>> {
    match data {
        Some(d) => d
            .chunks_mut((PROJECT_CHUNK * row).max(1))
            .map(Some)
            .collect(),
        None => (0..n.div_ceil(PROJECT_CHUNK)).map(|_| None).collect(),
    }
}

fn add<T: Real>(out: &mut Option<&mut [T]>, j: usize, values: &[f64]) {
    if let Some(out) = out {
        for (o, v) in out[j * values.len()..].iter_mut().zip(values) {
            *o = T::from_f64(o.to_f64() + v);
        }
    }
}

/// Vector-Jacobian product of [`forward`]: adds to `grads` and returns the gradient of the camera.
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
) -> CameraGrad {
    let n = gaussians.len();
    let harmonics_row = harmonics.map_or(0, |h| 3 * h.stored);
    let jobs: Vec<_> = chunks(grads.means, n, 3)
        .into_iter()
        .zip(chunks(grads.quats, n, 4))
        .zip(chunks(grads.scales, n, 3))
        .zip(chunks(grads.opacities, n, 1))
        .zip(chunks(grads.harmonics, n, harmonics_row))
        .collect();
    let parts: Vec<CameraGrad> = jobs
        .into_par_iter()
        .enumerate()
        .map(
            |(chunk, ((((mut means, mut quats), mut scales), mut opacities), mut sh_grad))| {
                let mut camera_grad = CameraGrad::ZERO;
                let begin = chunk * PROJECT_CHUNK;
                for j in 0..PROJECT_CHUNK.min(n - begin) {
                    let i = begin + j;
                    if !projection.splats[i].visible() {
                        continue;
                    }
                    let Some(g) = geometry(gaussians, i, camera, options) else {
                        continue;
                    };
                    let at = |data: &[T], row: usize, k: usize| data[row * i + k].to_f64();
                    let v_opacity = at(v.opacities, 1, 0);
                    let mut cotangent = Cotangent {
                        mean2d: DVec2::new(at(v.means2d, 2, 0), at(v.means2d, 2, 1)),
                        whitened: std::array::from_fn(|k| at(v.whitened, 3, k)),
                        depth: v.depths.map_or(0.0, |d| at(d, 1, 0)),
                        conic: v
                            .conics
                            .map_or([0.0; 3], |c| std::array::from_fn(|k| at(c, 3, k))),
                        compensation: 0.0,
                    };
                    let mut v_input_opacity = v_opacity;
                    if options.antialiased {
                        cotangent.compensation = v_opacity * gaussians.opacities[i].to_f64();
                        v_input_opacity = v_opacity * g.compensation();
                    }
                    let mut grad = g.vjp(&cotangent, camera, &mut camera_grad);
                    if let (Some(h), Some(colors)) = (harmonics, v.colors) {
                        let v_rgb = std::array::from_fn(|k| at(colors, 3, k));
                        let out = sh_grad
                            .as_mut()
                            .map(|s| &mut s[j * harmonics_row..][..harmonics_row]);
                        let v_mean = harmonics_vjp(gaussians, h, i, camera, v_rgb, out);
                        grad.mean += v_mean;
                        camera_grad.center -= v_mean;
                    }
                    add(&mut means, j, &grad.mean.to_array());
                    add(&mut quats, j, &grad.quat);
                    add(&mut scales, j, &grad.scale.to_array());
                    add(&mut opacities, j, &[v_input_opacity]);
                }
                camera_grad
            },
        )
        .collect();
    parts.iter().fold(CameraGrad::ZERO, |mut sum, part| {
        sum.add(part);
        sum
    })
}

/// VJP of the colour of Gaussian `i`: adds to its coefficients, returns the gradient of its mean.
fn harmonics_vjp<T: Real>(
    gaussians: &Gaussians<T>,
    h: &Harmonics<T>,
    i: usize,
    camera: &Camera,
    v_rgb: [f64; 3],
    out: Option<&mut [T]>,
) -> DVec3 {
    let (d, length, degree) = direction(vec3(gaussians.means, i), camera, h.degree);
    let rgb = evaluate(h, i, degree, d);
    // Zero gradient where the colour is clamped at 0.
    let v: [f64; 3] = std::array::from_fn(|k| if rgb[k] >= 0.0 { v_rgb[k] } else { 0.0 });
    if v == [0.0; 3] {
        return DVec3::ZERO;
    }
    if let Some(out) = out {
        let basis = sh::basis(degree, d.to_array());
        for (y, row) in basis
            .iter()
            .zip(out.chunks_exact_mut(3))
            .take(sh::count(degree))
        {
            for (o, v) in row.iter_mut().zip(v) {
                *o = T::from_f64(o.to_f64() + y * v);
            }
        }
    }
    if degree == 0 {
        return DVec3::ZERO;
    }
    let rows = &h.coefficients[3 * h.stored * i..][..3 * sh::count(degree)];
    let mut weights = [0.0; sh::MAX_COUNT];
    for (w, row) in weights.iter_mut().zip(rows.chunks_exact(3)) {
        *w = v[0] * row[0].to_f64() + v[1] * row[1].to_f64() + v[2] * row[2].to_f64();
    }
    let v_d = DVec3::from(sh::basis_vjp(degree, d.to_array(), &weights));
    (v_d - d * d.dot(v_d)) / length
}
