//! Projection, forward.

use super::{
    Columns, Projection, RenderOptions, Shading, Splat,
    camera_lanes::CameraLanes,
    chunks,
    colors::{Coefficients, Slopes},
    splats::SplatGroup,
};
use crate::{
    constants::PROJECT_CHUNK,
    error::Error,
    scene::{Camera, Colors, Gaussians},
    simd::{
        self, Real,
        groups::{self, Column, GROUP},
    },
    uninit::{PieceWriter, UninitPiece, UninitVec},
};
use fearless_simd::{Simd, dispatch};
use rayon::prelude::*;
use std::slice;

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
    /// How many were kept.
    pub kept: usize,
}

/// What one job fills of it, group by group.
struct ForwardChunk<'a, T> {
    splats: PieceWriter<'a, Splat>,
    /// The depths of `Projection`.
    keys: PieceWriter<'a, f64>,
    radii: PieceWriter<'a, i32>,
    /// `means2d`, depths, conics, opacities, colours.
    outs: [PieceWriter<'a, T>; 5],
    slopes: PieceWriter<'a, Slopes<T>>,
    clamped: PieceWriter<'a, [u16; 3]>,
    /// Whether what no image needs is asked for, the colours, and how they change.
    asked: [bool; 4],
}

/// The colours of a group and how they change.
struct Shaded<T> {
    colors: [T; 3 * GROUP],
    slopes: Slopes<T>,
    clamped: [u16; 3],
}

impl<T: Real> Shaded<T> {
    const ZERO: Self = Self {
        colors: [T::ZERO; 3 * GROUP],
        slopes: [Column::ZERO; 9],
        clamped: [0; 3],
    };
}

impl<T: Real> ForwardChunk<'_, T> {
    /// Give out the next `rows` Gaussians, of which those in `keep` are kept.
    #[inline(always)]
    fn put(&mut self, group: &SplatGroup, keep: u16, rows: usize) {
        for lane in 0..rows {
            let splat = if keep >> lane & 1 == 1 {
                group.splat(lane)
            } else {
                Splat::default()
            };
            self.splats.put(slice::from_ref(&splat));
        }
        self.keys.put(&kept::<f64>(&group.depth, keep)[..rows]);
        let mut radii = [0; 2 * GROUP];
        let (x, y) = (kept(&group.radii[0], keep), kept(&group.radii[1], keep));
        groups::write([&integers(&x), &integers(&y)], &mut radii);
        self.radii.put(&radii[..2 * rows]);
        if !self.asked[0] {
            return;
        }
        let [means2d, depths, all_conics, opacities, _] = &mut self.outs;
        depths.put(&kept::<T>(&group.depth, keep)[..rows]);
        opacities.put(&kept::<T>(&group.opacity, keep)[..rows]);
        let mut pairs = [T::ZERO; 2 * GROUP];
        let (x, y) = (kept(&group.mean[0], keep), kept(&group.mean[1], keep));
        groups::write([&x, &y], &mut pairs);
        means2d.put(&pairs[..2 * rows]);
        let mut conics = [T::ZERO; 3 * GROUP];
        let [a, b, c] = &group.conic;
        groups::write(
            [&kept(a, keep), &kept(b, keep), &kept(c, keep)],
            &mut conics,
        );
        all_conics.put(&conics[..3 * rows]);
    }

    /// The same where none is kept.
    #[inline(always)]
    fn put_none(&mut self, rows: usize) {
        self.splats.put(&[Splat::default(); GROUP][..rows]);
        self.keys.put(&[0.0; GROUP][..rows]);
        self.radii.put(&[0; 2 * GROUP][..2 * rows]);
        if self.asked[0] {
            for (out, row) in self.outs.iter_mut().zip([2, 1, 3, 1]) {
                out.put(&[T::ZERO; 3 * GROUP][..row * rows]);
            }
        }
    }

    /// Give out the colours of the next `rows` Gaussians, where they are asked for.
    #[inline(always)]
    fn put_colors(&mut self, shaded: &Shaded<T>, rows: usize) {
        let [_, colors, clamped, slopes] = self.asked;
        if colors {
            self.outs[4].put(&shaded.colors[..3 * rows]);
        }
        if clamped {
            self.clamped.put(slice::from_ref(&shaded.clamped));
        }
        if slopes {
            self.slopes.put(slice::from_ref(&shaded.slopes));
        }
    }
}

/// Project all Gaussians into `camera`.
///
/// Without `all` only what an image needs: `means2d`, `depths`, `conics` and `opacities` are empty.
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
    all: bool,
) -> Result<Projected<T>, Error> {
    let (n, all) = (gaussians.len(), usize::from(all));
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
    let clamped_rows = usize::from(shaded.is_some());
    let sloped = usize::from(shaded.is_some_and(|h| h.degree > 0));
    let groups = n.div_ceil(GROUP);
    let name = "splats";
    let (mut splats, mut keys) = (UninitVec::new(n, name)?, UninitVec::new(n, name)?);
    let rows = [2 * all, all, 3 * all, all, channels];
    let mut outs = UninitVec::several(rows.map(|row| row * n), name)?;
    let mut radii = UninitVec::new(2 * n, name)?;
    let mut slopes = UninitVec::new(sloped * groups, name)?;
    let mut clamps = UninitVec::new(clamped_rows * groups, name)?;
    let of = |row| chunks(n, PROJECT_CHUNK).map(move |count| count * row);
    let of_groups = |row| chunks(groups, PROJECT_CHUNK / GROUP).map(move |count| count * row);
    let jobs: Vec<_> = splats
        .cut(of(1))
        .into_iter()
        .zip(keys.cut(of(1)))
        .zip(radii.cut(of(2)))
        .zip(UninitVec::cut_rows(&mut outs, rows, of(1)))
        .zip(slopes.cut(of_groups(sloped)))
        .zip(clamps.cut(of_groups(clamped_rows)))
        .collect();
    let kept = jobs
        .into_par_iter()
        .enumerate()
        .with_max_len(1)
        .map(
            |(chunk, (((((splats, keys), radii), outs), slopes), clamped))| {
                let out = ForwardChunk {
                    splats: splats.writer(),
                    keys: keys.writer(),
                    radii: radii.writer(),
                    outs: outs.map(UninitPiece::writer),
                    slopes: slopes.writer(),
                    clamped: clamped.writer(),
                    asked: [all, channels, clamped_rows, sloped].map(|row| row > 0),
                };
                dispatch!(level.token, simd => forward_chunk(
                    simd, gaussians, colors, camera, options, chunk * PROJECT_CHUNK, n, out
                ))
            },
        )
        .sum();
    let [means2d, depths, conics, opacities, colors] = outs.map(UninitVec::finish);
    Ok(Projected {
        projection: Projection {
            splats: splats.finish(),
            depths: keys.finish(),
            knobs: options.knobs,
            level,
        },
        means2d,
        depths,
        conics,
        radii: radii.finish(),
        opacities,
        colors,
        shading: shaded.map(|h| Shading {
            rows: h.rows(),
            degree: h.degree,
            slopes: slopes.finish(),
            clamped: clamps.finish(),
        }),
        kept,
    })
}

/// Project the Gaussians from `begin` on, a chunk of the `n` that there are. Returns how many are kept.
#[inline(always)]
fn forward_chunk<S: Simd, T: Real>(
    simd: S,
    gaussians: &Gaussians<T>,
    colors: Colors<T>,
    camera: &Camera,
    options: &RenderOptions,
    begin: usize,
    n: usize,
    mut out: ForwardChunk<T>,
) -> usize {
    let count = PROJECT_CHUNK.min(n - begin);
    let mut kept = 0;
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
    let (mut shaded, none) = (Shaded::ZERO, Shaded::ZERO);
    let directed = matches!(colors, Colors::Harmonics(_));
    for start in (0..count).step_by(GROUP) {
        let rows = GROUP.min(count - start);
        let first = begin + start;
        if let Colors::Harmonics(ref h) = colors {
            // A processor fetches ahead within a page, of which a group takes the most part.
            Coefficients::prefetch(h, first + GROUP);
        }
        inputs.read(simd, gaussians, first, options.activate);
        let mut keep = group.project(simd, &inputs, camera, &camera_lanes, options, directed);
        if rows < GROUP {
            keep &= (1 << rows) - 1;
        }
        // Those that harmonics made not finite have colours, too.
        let shown = keep != 0;
        shaded.clamped = [0; 3];
        match colors {
            Colors::Harmonics(ref h) if keep != 0 => {
                let [_, _, clamped, sloped] = out.asked;
                let slopes = sloped.then_some(&mut shaded.slopes);
                let clamped = clamped.then_some(&mut shaded.clamped);
                let direction = &group.direction;
                let [r, g, b] =
                    harmonics.shade(simd, h, first, direction, &mut keep, slopes, clamped);
                groups::write([&r.0, &g.0, &b.0], &mut shaded.colors);
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
        kept += keep.count_ones() as usize;
        if keep != 0 {
            out.put(&group, keep, rows);
        } else {
            out.put_none(rows);
        }
        out.put_colors(if shown { &shaded } else { &none }, rows);
    }
    kept
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

fn finite<T: Real>(values: &[T]) -> bool {
    values.iter().all(|x| x.to_f64().is_finite())
}
