//! Projection of all Gaussians into one camera, forward and VJP: geometry, culling, spherical harmonics.

use crate::{
    camera::{Camera, CameraGrad},
    columns::{self, Column, GROUP, MAX_COLUMNS, Rows, get3, wide3},
    constants::{EPS2D, FACTOR_MAX, FAR_PLANE, NEAR_PLANE, PROJECT_CHUNK, SUPPORT_SLACK, TILE},
    fresh::{Blank, Fresh},
    geometry::{CameraGradLanes, CameraLanes, Cotangent, Geometry, GeometryGrad},
    lanes::{V3, Wide, lanes, ln, splat as splat_lanes, splat3},
    real::{Lanes, Real},
    scene::{Colors, Gaussians, Harmonics},
    sh,
    tuning::{Spans, Tuning},
    work::Work,
};
use fearless_simd::{Level, Select, Simd, SimdBase, SimdFloat, SimdMask, dispatch};
use rayon::prelude::*;
use std::slice::from_ref;

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
    /// Keep what [`backward`] needs of the harmonics.
    pub differentiable: bool,
    /// What trades accuracy for time, in this and the later stages.
    pub tuning: Tuning,
}

impl Default for ProjectOptions {
    fn default() -> Self {
        Self {
            near_plane: NEAR_PLANE,
            far_plane: FAR_PLANE,
            radius_clip: 0.0,
            eps2d: EPS2D,
            antialiased: false,
            differentiable: true,
            tuning: Tuning::default(),
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

    /// Alpha at (x, y) by the definition, for the tests.
    #[cfg(test)]
    pub fn alpha(&self, x: f64, y: f64) -> f64 {
        let [s, m, t] = self.factors;
        let (dx, dy) = (x - self.mean[0], y - self.mean[1]);
        let (u, v) = (s * (dx - m * dy), t * dy);
        (self.opacity * (-0.5 * (u * u + v * v)).exp()).min(0.99)
    }
}

/// What the later stages need of the projection of N Gaussians.
#[derive(Debug, Default)]
pub struct Projection {
    /// All N Gaussians, culled ones included.
    pub splats: Vec<Splat>,
    /// View-space depth, [N]; 0 where culled.
    pub depths: Vec<f64>,
    /// That of the options.
    pub tuning: Tuning,
}

/// How the colours from harmonics change, for [`backward`]: with it the coefficients, which are most of a
/// scene's memory, are read by the forward pass alone.
#[derive(Debug)]
pub struct Shading<T> {
    /// As `Harmonics::rows`.
    rows: (usize, usize),
    /// As `Harmonics::degree`.
    degree: usize,
    /// For each group of Gaussians the derivatives of its colours; none at degree 0.
    slopes: Vec<Slopes<T>>,
    /// For each group and channel the Gaussians whose colour is clamped at 0.
    clamped: Vec<[u16; 3]>,
}

/// Derivatives of channel c along axis a of the unit vector from the camera centre, at 3 c + a, as if its three
/// numbers were free.
type Slopes<T> = [Column<T>; 9];

/// What the projection gives; zeros where a Gaussian is culled.
#[derive(Debug)]
pub struct Projected<T> {
    /// For the later stages.
    pub projection: Projection,
    /// Centres in pixels, [N, 2].
    pub means2d: Vec<T>,
    /// View-space depth, [N].
    pub depths: Vec<T>,
    /// Inverse covariance (xx, xy, yy), [N, 3].
    pub conics: Vec<T>,
    /// Radii of the support in pixels, rounded up, [N, 2].
    pub radii: Vec<i32>,
    /// Opacities, compensated if antialiased, [N].
    pub opacities: Vec<T>,
    /// Colours from the spherical harmonics, [N, 3]; empty without them.
    pub colors: Vec<T>,
    /// How they change, if asked for.
    pub shading: Option<Shading<T>>,
    /// Counts.
    pub work: Work,
}

/// What one job fills of it; zeros before.
struct ForwardChunk<'a, T> {
    splats: &'a mut [Splat],
    /// The depths of `Projection`.
    keys: &'a mut [f64],
    means2d: &'a mut [T],
    depths: &'a mut [T],
    conics: &'a mut [T],
    radii: &'a mut [i32],
    opacities: &'a mut [T],
    colors: &'a mut [T],
    /// Empty where not asked for.
    slopes: &'a mut [Slopes<T>],
    clamped: &'a mut [[u16; 3]],
}

/// Cut an array with `row` numbers for each of n Gaussians into chunks of `PROJECT_CHUNK` of them.
fn chunks<T: Copy>(array: &mut Fresh<T>, n: usize, row: usize) -> Vec<Blank<'_, T>> {
    let rows = |c| PROJECT_CHUNK.min(n - c * PROJECT_CHUNK);
    array.cut((0..n.div_ceil(PROJECT_CHUNK)).map(|c| rows(c) * row))
}

/// The same for an array with `row` entries for each group of them, of which a chunk holds a whole number.
fn group_chunks<T: Copy>(array: &mut Fresh<T>, n: usize, row: usize) -> Vec<Blank<'_, T>> {
    const GROUPS: usize = PROJECT_CHUNK / GROUP;
    let (groups, count) = (n.div_ceil(GROUP), n.div_ceil(PROJECT_CHUNK));
    array.cut((0..count).map(|c| GROUPS.min(groups - c * GROUPS) * row))
}

/// The geometry of a group of Gaussians, one column per number.
struct Inputs<T> {
    means: [Column<T>; 3],
    quats: [Column<T>; 4],
    scales: [Column<T>; 3],
    opacities: Column<T>,
}

impl<T: Real> Inputs<T> {
    const ZERO: Self = Self {
        means: [Column::ZERO; 3],
        quats: [Column::ZERO; 4],
        scales: [Column::ZERO; 3],
        opacities: Column::ZERO,
    };

    #[inline(always)]
    fn read<S: Simd>(&mut self, simd: S, g: &Gaussians<T>, first: usize) {
        columns::read(simd, g.means, first, &mut self.means);
        columns::read(simd, g.quats, first, &mut self.quats);
        columns::read(simd, g.scales, first, &mut self.scales);
        self.opacities.load(g.opacities, first);
    }

    /// The geometry of the Gaussians `at..` of the group.
    #[inline(always)]
    fn geometry<S: Simd>(&self, simd: S, at: usize, camera: &CameraLanes<S>) -> Geometry<S> {
        let quat = [
            self.quats[0].wide(simd, at),
            self.quats[1].wide(simd, at),
            self.quats[2].wide(simd, at),
            self.quats[3].wide(simd, at),
        ];
        Geometry::new::<T>(
            simd,
            wide3(simd, &self.means, at),
            quat,
            wide3(simd, &self.scales, at),
            camera,
        )
    }
}

/// Unit vectors from the camera centre, and one over the distances. A Gaussian on the centre has no direction:
/// both are 0.
#[inline(always)]
fn direction<S: Simd>(simd: S, mean: V3<Wide<S>>, center: V3<Wide<S>>) -> (V3<Wide<S>>, Wide<S>) {
    let (zero, one) = (splat_lanes(simd, 0.0), splat_lanes(simd, 1.0));
    let d = mean - center;
    let length = d.dot(d).sqrt();
    let inverse = length.simd_gt(zero).select(one / length, zero);
    (d.by(inverse), inverse)
}

/// Spherical harmonics of a group: 3 k + channel.
struct Coefficients<T> {
    columns: [Column<T>; MAX_COLUMNS],
    rows: Rows<T>,
}

impl<T: Real> Coefficients<T> {
    const ZERO: Self = Self {
        columns: [Column::ZERO; MAX_COLUMNS],
        rows: Rows::ZERO,
    };

    /// The coefficients in use of the Gaussians `first..`.
    #[inline(always)]
    fn read<S: Simd>(&mut self, simd: S, h: &Harmonics<T>, first: usize) {
        let used = 3 * sh::count(h.degree);
        let (row, rest_row) = h.rows();
        if let Some(rest) = h.rest {
            let (low, high) = self.columns.split_first_chunk_mut::<3>().expect("3 of 64");
            columns::read(simd, h.coefficients, first, low);
            self.rows.read(simd, rest, rest_row, first, used - 3, high);
        } else {
            self.rows
                .read(simd, h.coefficients, row, first, used, &mut self.columns);
        }
    }
}

/// Colours of the Gaussians `at..` of a group, before the clamp at 0.
#[inline(always)]
fn evaluate<S: Simd, T: Real>(
    simd: S,
    degree: usize,
    coefficients: &[Column<T>; MAX_COLUMNS],
    basis: &[Lanes<T, S>; sh::MAX_COUNT],
    at: usize,
) -> [Lanes<T, S>; 3] {
    let mut rgb = [Lanes::<T, S>::splat(simd, T::from_f64(0.5)); 3];
    for (k, y) in basis.iter().enumerate().take(sh::count(degree)) {
        rgb[0] = y.mul_add(coefficients[3 * k].get(simd, at), rgb[0]);
        rgb[1] = y.mul_add(coefficients[3 * k + 1].get(simd, at), rgb[1]);
        rgb[2] = y.mul_add(coefficients[3 * k + 2].get(simd, at), rgb[2]);
    }
    rgb
}

/// Derivatives of the colours of the Gaussians `at..` of a group.
#[inline(always)]
fn slope<S: Simd, T: Real>(
    simd: S,
    degree: usize,
    coefficients: &[Column<T>; MAX_COLUMNS],
    direction: V3<Lanes<T, S>>,
    at: usize,
    out: &mut Slopes<T>,
) {
    let zero = Lanes::<T, S>::splat(simd, T::ZERO);
    for (channel, out) in out.chunks_exact_mut(3).enumerate() {
        let mut weights = [zero; sh::MAX_COUNT];
        for (k, weight) in weights.iter_mut().enumerate().take(sh::count(degree)) {
            *weight = coefficients[3 * k + channel].get(simd, at);
        }
        let g = sh::basis_vjp::<S, T>(simd, degree, direction, &weights);
        for (out, g) in out.iter_mut().zip([g.x, g.y, g.z]) {
            // One that overflowed would make NaN of a cotangent of 0.
            out.set(simd, at, g.is_finite().select(g, zero));
        }
    }
}

/// The lanes of a group in a bit set, as 1 or 0.
#[inline(always)]
fn lanes_in<S: Simd>(simd: S, set: u16, at: usize) -> <Wide<S> as SimdBase<S>>::Mask {
    let mut ones = [0.0; GROUP];
    for (lane, one) in ones.iter_mut().enumerate() {
        *one = f64::from(set >> lane & 1);
    }
    Wide::<S>::from_slice(simd, &ones[at..at + lanes::<S>()]).simd_gt(splat_lanes(simd, 0.0))
}

/// Splats of a group, a column per number. The numbers of culled ones are of no meaning.
struct Group {
    mean: [Column<f64>; 2],
    factors: [Column<f64>; 3],
    opacity: Column<f64>,
    reach: Column<f64>,
    /// x begin, x end, y begin, y end.
    tiles: [Column<f64>; 4],
    radii: [Column<f64>; 2],
    depth: Column<f64>,
    conic: [Column<f64>; 3],
    direction: [Column<f64>; 3],
}

impl Group {
    const ZERO: Self = Self {
        mean: [Column::ZERO; 2],
        factors: [Column::ZERO; 3],
        opacity: Column::ZERO,
        reach: Column::ZERO,
        tiles: [Column::ZERO; 4],
        radii: [Column::ZERO; 2],
        depth: Column::ZERO,
        conic: [Column::ZERO; 3],
        direction: [Column::ZERO; 3],
    };

    /// Project and pack the Gaussians `at..`; returns which are kept, their colours aside.
    #[inline(always)]
    fn fill<S: Simd>(
        &mut self,
        simd: S,
        at: usize,
        g: &Geometry<S>,
        opacity: Wide<S>,
        camera: &Camera,
        camera_lanes: &CameraLanes<S>,
        o: &ProjectOptions,
    ) -> u64 {
        let (zero, infinity) = (splat_lanes(simd, 0.0), splat_lanes(simd, f64::INFINITY));
        let mean = g.mean2d(camera_lanes);
        let sigma = g.sigma();
        let conic = g.conic();
        let floor = o.tuning.alpha_min;
        let opaque = opacity.simd_ge(splat_lanes(simd, floor)) & opacity.simd_lt(infinity);
        let radius = (ln(simd, opacity * (1.0 / floor)).max(zero) * 2.0).sqrt();
        let [s, m, t] = g.factors;
        let stiffness = s * (m.abs() + 1.0) + t;
        let reach = radius + (stiffness + 1.0) * SUPPORT_SLACK;
        let mut keep = g.valid & opaque & stiffness.simd_lt(splat_lanes(simd, FACTOR_MAX));
        let mut largest = zero;
        let size = [camera.width as f64, camera.height as f64];
        for k in 0..2 {
            let radii = (radius * sigma[k]).ceil();
            keep = keep
                & (mean[k] + radii).simd_gt(zero)
                & (mean[k] - radii).simd_lt(splat_lanes(simd, size[k]));
            largest = largest.max(radii);
            // Tiles whose pixel centres lie within `mean +- extent`, clipped to the image.
            let extent = match o.tuning.spans {
                Spans::Square => g.largest_sigma() * 3.0,
                Spans::Ellipse | Spans::Box => reach * sigma[k],
            };
            let first = (mean[k] - extent - 0.5).ceil().max(zero);
            let last = (mean[k] + extent - 0.5)
                .floor()
                .min(splat_lanes(simd, size[k] - 1.0));
            let some = first.simd_le(last);
            let tile = 1.0 / TILE as f64;
            self.tiles[2 * k].set(simd, at, some.select((first * tile).floor(), zero));
            self.tiles[2 * k + 1].set(simd, at, some.select((last * tile).floor() + 1.0, zero));
            self.radii[k].set(simd, at, radii);
            self.mean[k].set(simd, at, mean[k]);
        }
        keep &= largest.simd_gt(splat_lanes(simd, o.radius_clip));
        for (column, x) in self.factors.iter_mut().zip(&g.factors) {
            column.set(simd, at, *x);
        }
        for (column, x) in self.conic.iter_mut().zip(&conic) {
            column.set(simd, at, *x);
        }
        self.opacity.set(simd, at, opacity);
        self.reach.set(simd, at, reach);
        self.depth.set(simd, at, g.p.z);
        keep.to_bitmask()
    }

    /// One Gaussian as the compositor reads it.
    #[inline(always)]
    fn splat(&self, i: usize) -> Splat {
        Splat {
            mean: [self.mean[0].0[i], self.mean[1].0[i]],
            factors: [
                self.factors[0].0[i],
                self.factors[1].0[i],
                self.factors[2].0[i],
            ],
            opacity: self.opacity.0[i],
            // f32 rounds to nearest: the slack is far larger than half an ulp of any radius below 10.
            reach: self.reach.0[i] as f32,
            tiles: [
                self.tiles[0].0[i] as u16,
                self.tiles[1].0[i] as u16,
                self.tiles[2].0[i] as u16,
                self.tiles[3].0[i] as u16,
            ],
        }
    }
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
) -> Projected<T> {
    let n = gaussians.len();
    let harmonics = match colors {
        Colors::Harmonics(h) => Some(h),
        Colors::Channels(..) => None,
    };
    let channels = if harmonics.is_some() { 3 } else { 0 };
    let shaded = harmonics.filter(|_| options.differentiable);
    let clamped = usize::from(shaded.is_some());
    let sloped = usize::from(shaded.is_some_and(|h| h.degree > 0));
    let groups = n.div_ceil(GROUP);
    let (mut splats, mut keys) = (Fresh::new(n), Fresh::new(n));
    let (mut means2d, mut depths) = (Fresh::new(2 * n), Fresh::new(n));
    let (mut conics, mut radii) = (Fresh::new(3 * n), Fresh::new(2 * n));
    let (mut opacities, mut rgb) = (Fresh::new(n), Fresh::new(channels * n));
    let (mut slopes, mut clamps) = (Fresh::new(sloped * groups), Fresh::new(clamped * groups));
    let jobs: Vec<_> = chunks(&mut splats, n, 1)
        .into_iter()
        .zip(chunks(&mut keys, n, 1))
        .zip(chunks(&mut means2d, n, 2))
        .zip(chunks(&mut depths, n, 1))
        .zip(chunks(&mut conics, n, 3))
        .zip(chunks(&mut radii, n, 2))
        .zip(chunks(&mut opacities, n, 1))
        .zip(chunks(&mut rgb, n, channels))
        .zip(group_chunks(&mut slopes, n, sloped))
        .zip(group_chunks(&mut clamps, n, clamped))
        .collect();
    let level = Level::new();
    let work = jobs
        .into_par_iter()
        .enumerate()
        .map(
            |(
                chunk,
                (
                    (
                        (((((((splats, keys), means2d), depths), conics), radii), opacities), rgb),
                        slopes,
                    ),
                    clamped,
                ),
            )| {
                let out = ForwardChunk {
                    splats: splats.fill(Splat::default()),
                    keys: keys.fill(0.0),
                    means2d: means2d.fill(T::ZERO),
                    depths: depths.fill(T::ZERO),
                    conics: conics.fill(T::ZERO),
                    radii: radii.fill(0),
                    opacities: opacities.fill(T::ZERO),
                    colors: rgb.fill(T::ZERO),
                    slopes: slopes.fill([Column::ZERO; 9]),
                    clamped: clamped.fill([0; 3]),
                };
                dispatch!(level, simd => forward_chunk(
                    simd, gaussians, colors, camera, options, chunk * PROJECT_CHUNK, out
                ))
            },
        )
        .reduce(Work::default, Work::plus);
    Projected {
        projection: Projection {
            splats: splats.finish(),
            depths: keys.finish(),
            tuning: options.tuning,
        },
        means2d: means2d.finish(),
        depths: depths.finish(),
        conics: conics.finish(),
        radii: radii.finish(),
        opacities: opacities.finish(),
        colors: rgb.finish(),
        shading: shaded.map(|h| Shading {
            rows: h.rows(),
            degree: h.degree,
            slopes: slopes.finish(),
            clamped: clamps.finish(),
        }),
        work,
    }
}

/// Project the Gaussians from `begin` on, as many as `out` has.
#[inline(always)]
fn forward_chunk<S: Simd, T: Real>(
    simd: S,
    gaussians: &Gaussians<T>,
    colors: Colors<T>,
    camera: &Camera,
    options: &ProjectOptions,
    begin: usize,
    out: ForwardChunk<T>,
) -> Work {
    let count = out.splats.len();
    let mut work = Work {
        gaussians: count as u64,
        ..Work::default()
    };
    let camera_lanes = CameraLanes::new(
        simd,
        camera,
        options.near_plane,
        options.far_plane,
        options.eps2d,
    );
    let center = splat3(simd, camera.center);
    let mut inputs = Inputs::ZERO;
    let mut group = Group::ZERO;
    let mut harmonics = Coefficients::ZERO;
    for start in (0..count).step_by(GROUP) {
        let rows = GROUP.min(count - start);
        let first = begin + start;
        inputs.read(simd, gaussians, first);
        let mut keep = 0u16;
        for at in (0..GROUP).step_by(lanes::<S>()) {
            let g = inputs.geometry(simd, at, &camera_lanes);
            let mut opacity = inputs.opacities.wide(simd, at);
            if options.antialiased {
                opacity *= g.compensation();
            }
            let kept = group.fill(simd, at, &g, opacity, camera, &camera_lanes, options);
            keep |= (kept as u16) << at;
            if let Colors::Harmonics(_) = colors {
                let (d, _) = direction(simd, g.mean, center);
                group.direction[0].set(simd, at, d.x);
                group.direction[1].set(simd, at, d.y);
                group.direction[2].set(simd, at, d.z);
            }
        }
        if rows < GROUP {
            keep &= (1 << rows) - 1;
        }
        match colors {
            Colors::Harmonics(h) if keep != 0 => {
                work.harmonics += (rows * sh::count(h.degree)) as u64;
                work.slopes += if out.slopes.is_empty() {
                    0
                } else {
                    rows as u64
                };
                harmonics.read(simd, h, first);
                let d = narrow3::<T>(&group.direction);
                let mut rgb = [Column::ZERO; 3];
                for at in (0..GROUP).step_by(Lanes::<T, S>::LEN) {
                    let zero = Lanes::<T, S>::splat(simd, T::ZERO);
                    let basis = sh::basis::<S, T>(simd, h.degree, get3(simd, &d, at));
                    let values = evaluate(simd, h.degree, &harmonics.columns, &basis, at);
                    // A sum of finite numbers that overflowed counts as not finite: it is culled either way.
                    let finite =
                        values[0].is_finite() & values[1].is_finite() & values[2].is_finite();
                    let lanes = ((1u32 << Lanes::<T, S>::LEN) - 1) << at;
                    keep &= !(lanes as u16) | (finite.to_bitmask() as u16) << at;
                    for (rgb, value) in rgb.iter_mut().zip(values) {
                        rgb.set(simd, at, value.simd_gt(zero).select(value, zero));
                    }
                    if let Some(clamped) = out.clamped.get_mut(start / GROUP) {
                        for (clamped, value) in clamped.iter_mut().zip(values) {
                            let negative = (!value.simd_ge(zero)).to_bitmask() as u16;
                            *clamped |= negative << at;
                        }
                    }
                    if let Some(slopes) = out.slopes.get_mut(start / GROUP) {
                        let d = get3(simd, &d, at);
                        slope(simd, h.degree, &harmonics.columns, d, at, slopes);
                    }
                }
                for column in &mut rgb {
                    for (lane, x) in column.0.iter_mut().enumerate() {
                        *x = if keep >> lane & 1 == 1 { *x } else { T::ZERO };
                    }
                }
                let [r, g, b] = &rgb;
                columns::write([&r.0, &g.0, &b.0], rows_of(out.colors, 3, start, rows));
            }
            Colors::Harmonics(_) => {}
            Colors::Channels(data, channels) => {
                for lane in 0..rows {
                    let i = first + lane;
                    if !finite(&data[i * channels..(i + 1) * channels]) {
                        keep &= !(1 << lane);
                    }
                }
            }
        }
        work.projected += u64::from(keep.count_ones());
        if keep == 0 {
            continue;
        }
        let splats = &mut out.splats[start..start + rows];
        for (lane, splat) in splats.iter_mut().enumerate() {
            if keep >> lane & 1 == 1 {
                *splat = group.splat(lane);
            }
        }
        let depth = kept::<f64>(&group.depth, keep);
        out.keys[start..start + rows].copy_from_slice(&depth[..rows]);
        let depth = kept(&group.depth, keep);
        columns::write([&depth], rows_of(out.depths, 1, start, rows));
        let opacity = kept(&group.opacity, keep);
        columns::write([&opacity], rows_of(out.opacities, 1, start, rows));
        let (x, y) = (kept(&group.mean[0], keep), kept(&group.mean[1], keep));
        columns::write([&x, &y], rows_of(out.means2d, 2, start, rows));
        let (x, y) = (kept(&group.radii[0], keep), kept(&group.radii[1], keep));
        columns::write(
            [&integers(&x), &integers(&y)],
            rows_of(out.radii, 2, start, rows),
        );
        let [a, b, c] = &group.conic;
        let conic = [&kept(a, keep), &kept(b, keep), &kept(c, keep)];
        columns::write(conic, rows_of(out.conics, 3, start, rows));
    }
    work
}

/// The values of the Gaussians in a set, 0 elsewhere.
#[inline(always)]
fn kept<T: Real>(column: &Column<f64>, set: u16) -> [T; GROUP] {
    let mut out = [T::ZERO; GROUP];
    for (lane, (o, x)) in out.iter_mut().zip(column.0).enumerate() {
        *o = if set >> lane & 1 == 1 {
            T::from_f64(x)
        } else {
            T::ZERO
        };
    }
    out
}

#[inline(always)]
fn integers(values: &[f64; GROUP]) -> [i32; GROUP] {
    let mut out = [0; GROUP];
    for (o, x) in out.iter_mut().zip(values) {
        *o = *x as i32; // saturates
    }
    out
}

/// Three columns in the type of the inputs.
#[inline(always)]
fn narrow3<T: Real>(columns: &[Column<f64>; 3]) -> [Column<T>; 3] {
    let mut out = [Column::ZERO; 3];
    for (out, column) in out.iter_mut().zip(columns) {
        for (o, x) in out.0.iter_mut().zip(column.0) {
            *o = T::from_f64(x);
        }
    }
    out
}

/// Rows `start..start + rows` of an array.
#[inline(always)]
fn rows_of<T>(data: &mut [T], row: usize, start: usize, rows: usize) -> &mut [T] {
    &mut data[start * row..(start + rows) * row]
}

fn finite<T: Real>(values: &[T]) -> bool {
    values.iter().all(|x| x.to_f64().is_finite())
}

/// Cotangents of the projection's outputs, all dense over N. `None` is 0.
#[derive(Debug, Clone, Copy)]
pub struct ProjectCotangents<'a, T> {
    /// Of `means2d`, [N, 2].
    pub means2d: Option<&'a [T]>,
    /// Whitened gradient of the 2D covariance (E_uu, E_uv, E_vv), [N, 3]; see `geometry.rs`.
    pub whitened: Option<&'a [T]>,
    /// Of `opacities`, [N].
    pub opacities: Option<&'a [T]>,
    /// Of `depths`, [N].
    pub depths: Option<&'a [T]>,
    /// Of `conics`, [N, 3].
    pub conics: Option<&'a [T]>,
    /// Of `colors` from the harmonics, [N, 3].
    pub colors: Option<&'a [T]>,
}

/// The cotangents of a group, a column per number.
struct Cotangents<T> {
    means2d: [Column<T>; 2],
    whitened: [Column<T>; 3],
    opacities: Column<T>,
    depths: Column<T>,
    conics: [Column<T>; 3],
    colors: [Column<T>; 3],
}

impl<T: Real> Cotangents<T> {
    const ZERO: Self = Self {
        means2d: [Column::ZERO; 2],
        whitened: [Column::ZERO; 3],
        opacities: Column::ZERO,
        depths: Column::ZERO,
        conics: [Column::ZERO; 3],
        colors: [Column::ZERO; 3],
    };

    #[inline(always)]
    fn read<S: Simd>(&mut self, simd: S, v: &ProjectCotangents<T>, first: usize) {
        if let Some(v) = v.means2d {
            columns::read(simd, v, first, &mut self.means2d);
        }
        if let Some(v) = v.whitened {
            columns::read(simd, v, first, &mut self.whitened);
        }
        if let Some(v) = v.opacities {
            self.opacities.load(v, first);
        }
        if let Some(v) = v.depths {
            self.depths.load(v, first);
        }
        if let Some(v) = v.conics {
            columns::read(simd, v, first, &mut self.conics);
        }
        if let Some(v) = v.colors {
            columns::read(simd, v, first, &mut self.colors);
        }
    }

    /// Gaussians of the group with a cotangent that is not 0.
    #[inline(always)]
    fn nonzero(&self) -> u16 {
        let mut any = [false; GROUP];
        for columns in [
            &self.means2d[..],
            &self.whitened,
            from_ref(&self.opacities),
            from_ref(&self.depths),
            &self.conics,
            &self.colors,
        ] {
            for column in columns {
                for (any, v) in any.iter_mut().zip(&column.0) {
                    *any |= *v != T::ZERO;
                }
            }
        }
        let mut set = 0;
        for (lane, any) in any.iter().enumerate() {
            set |= u16::from(*any) << lane;
        }
        set
    }
}

/// Which gradients [`backward`] is to compute.
#[derive(Debug, Clone, Copy, Default)]
pub struct Wanted {
    /// Of the means.
    pub means: bool,
    /// Of the quaternions.
    pub quats: bool,
    /// Of the scales.
    pub scales: bool,
    /// Of the opacities.
    pub opacities: bool,
    /// Of `Harmonics::coefficients`.
    pub harmonics: bool,
    /// Of `Harmonics::rest`.
    pub harmonics_rest: bool,
    /// Of the whole pose of the camera, not only of its centre.
    pub camera: bool,
}

/// Gradients of the projection's inputs; empty where not wanted. Zeros for a Gaussian that is culled or without
/// a cotangent, and for harmonics above the degree in use.
#[derive(Debug)]
pub struct GaussianGrads<T> {
    /// [N, 3]
    pub means: Vec<T>,
    /// [N, 4]
    pub quats: Vec<T>,
    /// [N, 3]
    pub scales: Vec<T>,
    /// [N]
    pub opacities: Vec<T>,
    /// As `Harmonics::coefficients`.
    pub harmonics: Vec<T>,
    /// As `Harmonics::rest`.
    pub harmonics_rest: Vec<T>,
    /// Of the camera.
    pub camera: CameraGrad,
    /// Counts.
    pub work: Work,
}

/// What one job fills of it: empty where not wanted.
struct BackwardChunk<'a, T> {
    /// Of the means, quaternions, scales, opacities, harmonics and their rest.
    outs: [Blank<'a, T>; 6],
    /// Numbers per Gaussian, in that order.
    rows: [usize; 6],
}

impl<T: Real> BackwardChunk<'_, T> {
    /// A buffer for the rows of one group for each output.
    fn buffers(&self) -> [Vec<T>; 6] {
        self.rows.map(|row| vec![T::ZERO; GROUP * row])
    }

    /// Give out the first `rows` rows of the buffers.
    #[inline(always)]
    fn put(&mut self, buffers: &[Vec<T>; 6], rows: usize) {
        for ((out, buffer), row) in self.outs.iter_mut().zip(buffers).zip(self.rows) {
            out.put(&buffer[..row * rows]);
        }
    }
}

/// Vector-Jacobian product of [`forward`]. Groups of 16 Gaussians without a cotangent are left out, and so is
/// the geometry where the colours alone have cotangents.
///
/// `projection` and `shading` must be those that `forward` made from the same inputs.
pub fn backward<T: Real>(
    gaussians: &Gaussians<T>,
    shading: Option<&Shading<T>>,
    camera: &Camera,
    options: &ProjectOptions,
    projection: &Projection,
    v: &ProjectCotangents<T>,
    wanted: Wanted,
) -> GaussianGrads<T> {
    let n = gaussians.len();
    let (row, rest_row) = shading.map_or((0, 0), |s| s.rows);
    let rows = [
        (wanted.means, 3),
        (wanted.quats, 4),
        (wanted.scales, 3),
        (wanted.opacities, 1),
        (wanted.harmonics, row),
        (wanted.harmonics_rest, rest_row),
    ]
    .map(|(wanted, row)| if wanted { row } else { 0 });
    let mut arrays = rows.map(|row| Fresh::<T>::new(row * n));
    let [means, quats, scales, opacities, sh, rest] = &mut arrays;
    let jobs: Vec<_> = chunks(means, n, rows[0])
        .into_iter()
        .zip(chunks(quats, n, rows[1]))
        .zip(chunks(scales, n, rows[2]))
        .zip(chunks(opacities, n, rows[3]))
        .zip(chunks(sh, n, rows[4]))
        .zip(chunks(rest, n, rows[5]))
        .collect();
    let level = Level::new();
    let parts: Vec<_> = jobs
        .into_par_iter()
        .enumerate()
        .map(|(chunk, (((((means, quats), scales), opacities), sh), rest))| {
            let out = BackwardChunk {
                outs: [means, quats, scales, opacities, sh, rest],
                rows,
            };
            dispatch!(level, simd => backward_chunk(
                simd, gaussians, shading, camera, options, projection, v, chunk * PROJECT_CHUNK, out, wanted.camera
            ))
        })
        .collect();
    let (mut camera_grad, mut work) = (CameraGrad::ZERO, Work::default());
    for (part, more) in &parts {
        camera_grad.add(part);
        work = work.plus(*more);
    }
    let [means, quats, scales, opacities, sh, rest] = arrays.map(Fresh::finish);
    GaussianGrads {
        means,
        quats,
        scales,
        opacities,
        harmonics: sh,
        harmonics_rest: rest,
        camera: camera_grad,
        work,
    }
}

/// VJP of the Gaussians of one chunk.
#[inline(always)]
fn backward_chunk<S: Simd, T: Real>(
    simd: S,
    gaussians: &Gaussians<T>,
    shading: Option<&Shading<T>>,
    camera: &Camera,
    options: &ProjectOptions,
    projection: &Projection,
    v: &ProjectCotangents<T>,
    begin: usize,
    mut chunk: BackwardChunk<T>,
    camera_wanted: bool,
) -> (CameraGrad, Work) {
    let zero = splat_lanes(simd, 0.0);
    let camera_lanes = CameraLanes::new(
        simd,
        camera,
        options.near_plane,
        options.far_plane,
        options.eps2d,
    );
    let center = splat3(simd, camera.center);
    let mut camera_grad = CameraGradLanes::zero(simd);
    let mut inputs = Inputs::ZERO;
    let mut cotangents = Cotangents::ZERO;
    let geometry_wanted = v.means2d.is_some()
        || v.whitened.is_some()
        || v.opacities.is_some()
        || v.depths.is_some()
        || v.conics.is_some();
    let mut work = Work::default();
    let mut colors = ColorGroup::ZERO;
    let mut out = GradColumns::<T>::ZERO;
    let (mut buffers, zeros) = (chunk.buffers(), chunk.buffers());
    let [_, _, _, _, row, rest_row] = chunk.rows;
    let end = gaussians.len().min(begin + PROJECT_CHUNK);
    for first in (begin..end).step_by(GROUP) {
        let rows = GROUP.min(end - first);
        let mut visible = 0u16;
        for (lane, depth) in projection.depths[first..first + rows].iter().enumerate() {
            visible |= u16::from(*depth > 0.0) << lane;
        }
        if visible == 0 {
            chunk.put(&zeros, rows);
            continue;
        }
        cotangents.read(simd, v, first);
        if visible & cotangents.nonzero() == 0 {
            chunk.put(&zeros, rows);
            continue;
        }
        inputs.read(simd, gaussians, first);
        let mut v_colors = None;
        if let (Some(shading), true) = (shading, v.colors.is_some()) {
            work.backward_harmonics += (rows * sh::count(shading.degree)) as u64;
            let (means, directions) = (&inputs.means, &mut colors.directions);
            for at in (0..GROUP).step_by(lanes::<S>()) {
                let (d, inverse) = direction(simd, wide3(simd, means, at), center);
                let valid = lanes_in(simd, visible, at);
                let d = d.only(valid, zero);
                directions[0].set(simd, at, d.x);
                directions[1].set(simd, at, d.y);
                directions[2].set(simd, at, d.z);
                colors.inverses.set(simd, at, valid.select(inverse, zero));
            }
            colors.backward(simd, shading, first / GROUP, &cotangents.colors, visible);
            v_colors = Some(shading);
        }
        work.backward_gaussians += if geometry_wanted { rows as u64 } else { 0 };
        for at in (0..GROUP).step_by(lanes::<S>()) {
            // Not those that were culled, nor those beyond the end.
            let valid = lanes_in(simd, visible, at);
            let mut grad = GeometryGrad::zero(simd);
            let mut v_input_opacity = zero;
            if geometry_wanted {
                let mut g = inputs.geometry(simd, at, &camera_lanes);
                g.valid = valid;
                let v_opacity = cotangents.opacities.wide(simd, at);
                v_input_opacity = v_opacity;
                let mut whitened = wide3(simd, &cotangents.whitened, at);
                if v.conics.is_some() {
                    whitened = whitened + g.whiten_conic(simd, wide3(simd, &cotangents.conics, at));
                }
                if options.antialiased {
                    let v_compensation = v_opacity * inputs.opacities.wide(simd, at);
                    whitened =
                        whitened + g.whiten_compensation(simd, &camera_lanes, v_compensation);
                    v_input_opacity = v_opacity * g.compensation();
                }
                let [x, y] = &cotangents.means2d;
                let cotangent = Cotangent {
                    mean2d: [x.wide(simd, at), y.wide(simd, at)],
                    whitened,
                    depth: cotangents.depths.wide(simd, at),
                };
                grad = g.vjp(
                    simd,
                    &cotangent,
                    &camera_lanes,
                    camera_wanted.then_some(&mut camera_grad),
                );
            }
            if v_colors.is_some() {
                // Through the normalisation; a Gaussian on the camera centre gets no gradient from its colour.
                let d = wide3(simd, &colors.directions, at);
                let v_d = wide3(simd, &colors.v_directions, at).only(valid, zero);
                let v_mean = (v_d - d.by(d.dot(v_d))).by(colors.inverses.wide(simd, at));
                grad.mean = grad.mean + v_mean;
                camera_grad.center = camera_grad.center - v_mean;
            }
            out.set(simd, at, &grad, v_input_opacity, valid, zero);
        }
        let GradColumns {
            means: [x, y, z],
            quats: [q0, q1, q2, q3],
            scales: [s0, s1, s2],
            opacities,
        } = &out;
        let [means, quats, scales, alphas, first_rows, rest_rows] = &mut buffers;
        columns::write([&x.0, &y.0, &z.0], means);
        columns::write([&q0.0, &q1.0, &q2.0, &q3.0], quats);
        columns::write([&s0.0, &s1.0, &s2.0], scales);
        columns::write([&opacities.0], alphas);
        if let Some(shading) = v_colors {
            let used = 3 * sh::count(shading.degree);
            let in_first = used.min(shading.rows.0);
            let (v_first, v_rest) = colors.v_coefficients[..used].split_at(in_first);
            if row > 0 {
                columns::write_rows(simd, v_first, first_rows, row);
            }
            if rest_row > 0 {
                columns::write_rows(simd, v_rest, rest_rows, rest_row);
            }
        }
        chunk.put(&buffers, rows);
    }
    (camera_grad.sum(), work)
}

/// Gradients of a group in the type of the inputs.
struct GradColumns<T> {
    means: [Column<T>; 3],
    quats: [Column<T>; 4],
    scales: [Column<T>; 3],
    opacities: Column<T>,
}

impl<T: Real> GradColumns<T> {
    const ZERO: Self = Self {
        means: [Column::ZERO; 3],
        quats: [Column::ZERO; 4],
        scales: [Column::ZERO; 3],
        opacities: Column::ZERO,
    };

    /// Set the Gaussians `at..`; 0 where they are not valid.
    #[inline(always)]
    fn set<S: Simd>(
        &mut self,
        simd: S,
        at: usize,
        grad: &GeometryGrad<S>,
        opacity: Wide<S>,
        valid: <Wide<S> as SimdBase<S>>::Mask,
        zero: Wide<S>,
    ) {
        let mean = grad.mean.only(valid, zero);
        let scale = grad.scale.only(valid, zero);
        self.means[0].saturate(simd, at, mean.x);
        self.means[1].saturate(simd, at, mean.y);
        self.means[2].saturate(simd, at, mean.z);
        self.scales[0].saturate(simd, at, scale.x);
        self.scales[1].saturate(simd, at, scale.y);
        self.scales[2].saturate(simd, at, scale.z);
        for k in 0..4 {
            self.quats[k].saturate(simd, at, valid.select(grad.quat[k], zero));
        }
        self.opacities
            .saturate(simd, at, valid.select(opacity, zero));
    }
}

/// What the gradients of a group's colours need, a column per number.
struct ColorGroup<T> {
    v_coefficients: [Column<T>; 3 * sh::MAX_COUNT],
    /// Unit vectors from the camera centre, and one over the distances.
    directions: [Column<f64>; 3],
    inverses: Column<f64>,
    v_directions: [Column<T>; 3],
}

impl<T: Real> ColorGroup<T> {
    const ZERO: Self = Self {
        v_coefficients: [Column::ZERO; 3 * sh::MAX_COUNT],
        directions: [Column::ZERO; 3],
        inverses: Column::ZERO,
        v_directions: [Column::ZERO; 3],
    };

    /// Gradients of the coefficients and of the directions, from that of the colours.
    #[inline(always)]
    fn backward<S: Simd>(
        &mut self,
        simd: S,
        shading: &Shading<T>,
        group: usize,
        v_colors: &[Column<T>; 3],
        visible: u16,
    ) {
        let d = narrow3::<T>(&self.directions);
        let mut v_open = *v_colors;
        for (column, clamped) in v_open.iter_mut().zip(shading.clamped[group]) {
            let open = visible & !clamped;
            for (lane, x) in column.0.iter_mut().enumerate() {
                *x = if open >> lane & 1 == 1 { *x } else { T::ZERO };
            }
        }
        for at in (0..GROUP).step_by(Lanes::<T, S>::LEN) {
            let v = v_open.map(|v| v.get(simd, at));
            let basis = sh::basis::<S, T>(simd, shading.degree, get3(simd, &d, at));
            for (k, y) in basis.iter().enumerate().take(sh::count(shading.degree)) {
                for (channel, v) in v.iter().enumerate() {
                    self.v_coefficients[3 * k + channel].set(simd, at, *y * *v);
                }
            }
            let Some(slopes) = shading.slopes.get(group) else {
                continue; // degree 0: `v_directions` stay 0
            };
            for (axis, v_direction) in self.v_directions.iter_mut().enumerate() {
                let along = v[0] * slopes[axis].get(simd, at);
                let along = v[1].mul_add(slopes[3 + axis].get(simd, at), along);
                let along = v[2].mul_add(slopes[6 + axis].get(simd, at), along);
                v_direction.set(simd, at, along);
            }
        }
    }
}
