//! Projection, forward.

use super::{
    Columns, Projection, RenderOptions, Shading, Splat,
    camera_lanes::CameraLanes,
    chunks,
    colors::{Coefficients, Slopes},
    sh,
    splats::SplatGroup,
};
use crate::{
    constants::PROJECT_CHUNK,
    counts::Counts,
    error::Error,
    scene::{Camera, Colors, Gaussians},
    simd::{
        self, Real,
        groups::{self, Column, GROUP},
    },
    uninit::{UninitPiece, UninitVec},
};
use fearless_simd::{Simd, dispatch};
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

impl<T: Real> ForwardChunk<'_, T> {
    /// Write the Gaussians in `keep` of a group of `rows`, the first of which is the chunk's `start`.
    #[inline(always)]
    fn write(&mut self, group: &SplatGroup, keep: u16, start: usize, rows: usize) {
        let splats = &mut self.splats[start..start + rows];
        for (lane, splat) in splats.iter_mut().enumerate() {
            if keep >> lane & 1 == 1 {
                *splat = group.splat(lane);
            }
        }
        let depth = kept::<f64>(&group.depth, keep);
        self.keys[start..start + rows].copy_from_slice(&depth[..rows]);
        let depth = kept(&group.depth, keep);
        groups::write([&depth], rows_of(self.depths, 1, start, rows));
        let opacity = kept(&group.opacity, keep);
        groups::write([&opacity], rows_of(self.opacities, 1, start, rows));
        let (x, y) = (kept(&group.mean[0], keep), kept(&group.mean[1], keep));
        groups::write([&x, &y], rows_of(self.means2d, 2, start, rows));
        let (x, y) = (kept(&group.radii[0], keep), kept(&group.radii[1], keep));
        groups::write(
            [&integers(&x), &integers(&y)],
            rows_of(self.radii, 2, start, rows),
        );
        let [a, b, c] = &group.conic;
        let conic = [&kept(a, keep), &kept(b, keep), &kept(c, keep)];
        groups::write(conic, rows_of(self.conics, 3, start, rows));
    }
}

/// As [`chunks`], for an array with `row` entries for each group of Gaussians, of which a chunk holds a whole
/// number.
fn group_chunks<T: Copy>(
    array: &mut UninitVec<T>,
    n: usize,
    row: usize,
) -> Vec<UninitPiece<'_, T>> {
    const GROUPS: usize = PROJECT_CHUNK / GROUP;
    let (groups, count) = (n.div_ceil(GROUP), n.div_ceil(PROJECT_CHUNK));
    array.cut((0..count).map(|c| GROUPS.min(groups - c * GROUPS) * row))
}

/// Project all Gaussians into `camera`.
///
/// Culled: outside the depth range or the image, not finite (its colour included), without rotation, too
/// transparent, or not larger than `radius_clip`.
///
/// # Errors
/// When the arrays do not describe the same number of Gaussians, or an option is out of its range.
pub fn forward<T: Real>(
    gaussians: &Gaussians<T>,
    colors: Colors<T>,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<Projected<T>, Error> {
    let n = gaussians.len();
    options.check()?;
    let level = options.level.map_or_else(simd::level, Ok)?;
    gaussians.check()?;
    colors.check(n)?;
    let harmonics = match colors {
        Colors::Harmonics(h) => Some(h),
        Colors::Channels(..) => None,
    };
    let channels = if harmonics.is_some() { 3 } else { 0 };
    let shaded = harmonics.filter(|_| options.differentiable);
    let clamped = usize::from(shaded.is_some());
    let sloped = usize::from(shaded.is_some_and(|h| h.degree > 0));
    let groups = n.div_ceil(GROUP);
    let name = "splats";
    let (mut splats, mut keys) = (UninitVec::new(n, name)?, UninitVec::new(n, name)?);
    let [mut means2d, mut depths, mut conics, mut opacities, mut rgb] =
        UninitVec::several([2 * n, n, 3 * n, n, channels * n], name)?;
    let mut radii = UninitVec::new(2 * n, name)?;
    let mut slopes = UninitVec::new(sloped * groups, name)?;
    let mut clamps = UninitVec::new(clamped * groups, name)?;
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
                dispatch!(level.token, simd => forward_chunk(
                    simd, gaussians, colors, camera, options, chunk * PROJECT_CHUNK, out
                ))
            },
        )
        .reduce(Counts::default, Counts::plus);
    Ok(Projected {
        projection: Projection {
            splats: splats.finish(),
            depths: keys.finish(),
            knobs: options.knobs,
            level,
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
    })
}

/// Project the Gaussians from `begin` on, as many as `out` has.
#[inline(always)]
fn forward_chunk<S: Simd, T: Real>(
    simd: S,
    gaussians: &Gaussians<T>,
    colors: Colors<T>,
    camera: &Camera,
    options: &RenderOptions,
    begin: usize,
    mut out: ForwardChunk<T>,
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
    let mut inputs = Columns::ZERO;
    let mut group = SplatGroup::ZERO;
    let mut harmonics = Coefficients::ZERO;
    let directed = matches!(colors, Colors::Harmonics(_));
    for start in (0..count).step_by(GROUP) {
        let rows = GROUP.min(count - start);
        let first = begin + start;
        inputs.read(simd, gaussians, first);
        let mut keep = group.project(simd, &inputs, camera, &camera_lanes, options, directed);
        if rows < GROUP {
            keep &= (1 << rows) - 1;
        }
        match colors {
            Colors::Harmonics(ref h) if keep != 0 => {
                counts.harmonics += (rows * sh::count(h.degree)) as u64;
                let (slopes, clamped) = (
                    out.slopes.get_mut(start / GROUP),
                    out.clamped.get_mut(start / GROUP),
                );
                counts.slopes += if slopes.is_some() { rows as u64 } else { 0 };
                let direction = &group.direction;
                let [r, g, b] =
                    harmonics.shade(simd, h, first, direction, &mut keep, slopes, clamped);
                let colors = rows_of(out.colors, 3, start, rows);
                groups::write([&r.0, &g.0, &b.0], colors);
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
        if keep != 0 {
            out.write(&group, keep, start, rows);
        }
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
