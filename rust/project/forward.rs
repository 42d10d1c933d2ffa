//! Projection, forward.

use super::{
    Inputs, ProjectOptions, Projection, Shading, Slopes, Splat, chunks, direction,
    geometry::{CameraLanes, Geometry},
    narrow3, sh,
};
use crate::{
    accuracy_knobs::Spans,
    constants::{FACTOR_MAX, PROJECT_CHUNK, SUPPORT_SLACK, TILE},
    counts::Counts,
    scene::{Camera, Colors, Gaussians, Harmonics},
    simd::{
        Lanes, Real, Wide,
        groups::{self, Column, GROUP, MAX_COLUMNS, Rows, get3},
        lanes,
        math::ln,
        splat as splat_lanes,
        vec3::{V3, splat3},
    },
    uninit::{UninitPiece, UninitVec},
};
use fearless_simd::{Level, Select, Simd, SimdBase, SimdFloat, SimdMask, dispatch};
use rayon::prelude::*;

/// What the projection gives; zeros where a Gaussian is culled.
#[derive(Debug)]
pub struct Projected<T> {
    /// For the later stages.
    pub projection: Projection,
    /// Centres in pixels, [N, 2].
    pub means2d: Vec<T>,
    /// View-space depth, `[N]`.
    pub depths: Vec<T>,
    /// Inverse covariance (xx, xy, yy), [N, 3].
    pub conics: Vec<T>,
    /// Radii of the support in pixels, rounded up, [N, 2].
    pub radii: Vec<i32>,
    /// Opacities, compensated if antialiased, `[N]`.
    pub opacities: Vec<T>,
    /// Colours from the spherical harmonics, [N, 3]; empty without them.
    pub colors: Vec<T>,
    /// How they change, if asked for.
    pub shading: Option<Shading<T>>,
    /// Counts.
    pub counts: Counts,
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

/// The same for an array with `row` entries for each group of them, of which a chunk holds a whole number.
fn group_chunks<T: Copy>(
    array: &mut UninitVec<T>,
    n: usize,
    row: usize,
) -> Vec<UninitPiece<'_, T>> {
    const GROUPS: usize = PROJECT_CHUNK / GROUP;
    let (groups, count) = (n.div_ceil(GROUP), n.div_ceil(PROJECT_CHUNK));
    array.cut((0..count).map(|c| GROUPS.min(groups - c * GROUPS) * row))
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
            groups::read(simd, h.coefficients, first, low);
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
        let floor = o.knobs.alpha_min;
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
            let extent = match o.knobs.spans {
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
    let (mut splats, mut keys) = (UninitVec::new(n), UninitVec::new(n));
    let (mut means2d, mut depths) = (UninitVec::new(2 * n), UninitVec::new(n));
    let (mut conics, mut radii) = (UninitVec::new(3 * n), UninitVec::new(2 * n));
    let (mut opacities, mut rgb) = (UninitVec::new(n), UninitVec::new(channels * n));
    let (mut slopes, mut clamps) = (
        UninitVec::new(sloped * groups),
        UninitVec::new(clamped * groups),
    );
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
    let counts = jobs
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
        .reduce(Counts::default, Counts::plus);
    Projected {
        projection: Projection {
            splats: splats.finish(),
            depths: keys.finish(),
            knobs: options.knobs,
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
        counts,
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
) -> Counts {
    let count = out.splats.len();
    let mut counts = Counts {
        gaussians: count as u64,
        ..Counts::default()
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
                counts.harmonics += (rows * sh::count(h.degree)) as u64;
                counts.slopes += if out.slopes.is_empty() {
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
                groups::write([&r.0, &g.0, &b.0], rows_of(out.colors, 3, start, rows));
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
        counts.projected += u64::from(keep.count_ones());
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
        groups::write([&depth], rows_of(out.depths, 1, start, rows));
        let opacity = kept(&group.opacity, keep);
        groups::write([&opacity], rows_of(out.opacities, 1, start, rows));
        let (x, y) = (kept(&group.mean[0], keep), kept(&group.mean[1], keep));
        groups::write([&x, &y], rows_of(out.means2d, 2, start, rows));
        let (x, y) = (kept(&group.radii[0], keep), kept(&group.radii[1], keep));
        groups::write(
            [&integers(&x), &integers(&y)],
            rows_of(out.radii, 2, start, rows),
        );
        let [a, b, c] = &group.conic;
        let conic = [&kept(a, keep), &kept(b, keep), &kept(c, keep)];
        groups::write(conic, rows_of(out.conics, 3, start, rows));
    }
    counts
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

/// Rows `start..start + rows` of an array.
#[inline(always)]
fn rows_of<T>(data: &mut [T], row: usize, start: usize, rows: usize) -> &mut [T] {
    &mut data[start * row..(start + rows) * row]
}

fn finite<T: Real>(values: &[T]) -> bool {
    values.iter().all(|x| x.to_f64().is_finite())
}
