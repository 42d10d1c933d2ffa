//! Vector-Jacobian product of the projection.

use super::{
    Columns, Mask, Projection, RenderOptions, Shading,
    camera_lanes::{CameraGradLanes, CameraLanes},
    chunks,
    colors::ColorGroup,
    geometry::{Cotangent, Geometry, GeometryGrad},
    lanes_in,
};
use crate::{
    constants::PROJECT_CHUNK,
    error::{Error, check_len},
    scene::{Camera, CameraGrad, Gaussians},
    simd::{
        Lanes, Real, Wide,
        groups::{self, Column, GROUP, wide3},
        lanes, splat as splat_lanes,
        sums::{self, MAX_PARTS},
        vec3::splat3,
    },
    uninit::{PieceWriter, UninitPiece, UninitVec, prefetch_rows},
};
use fearless_simd::{Select, Simd, SimdBase, SimdMask, dispatch};
use rayon::prelude::*;
use std::slice::from_ref;

/// Cotangents of the projection's outputs, all dense over N. `None` is 0.
#[derive(Debug, Clone, Copy)]
pub struct ProjectCotangents<'a, T> {
    /// Of `means2d`, [N, 2].
    pub means2d: Option<&'a [T]>,
    /// Whitened gradient of the 2D covariance (E_uu, E_uv, E_vv), [N, 3]; see `geometry.rs`.
    pub whitened: Option<&'a [T]>,
    /// Of `opacities`, `[N]`.
    pub opacities: Option<&'a [T]>,
    /// Of `depths`, `[N]`.
    pub depths: Option<&'a [T]>,
    /// Of `conics`, [N, 3].
    pub conics: Option<&'a [T]>,
    /// Of `colors` from the harmonics, [N, 3].
    pub colors: Option<&'a [T]>,
}

/// What errors call the cotangents, in their order, and how many numbers each Gaussian has of them.
pub const COTANGENTS: [(&str, usize); 6] = [
    ("v_means2d", 2),
    ("v_whitened", 3),
    ("v_opacities", 1),
    ("v_depths", 1),
    ("v_conics", 3),
    ("v_colors", 3),
];

impl<'a, T: Copy> ProjectCotangents<'a, T> {
    /// The arrays, and what [`COTANGENTS`] says of them.
    fn arrays(&self) -> impl Iterator<Item = (Option<&'a [T]>, (&'static str, usize))> {
        let &Self {
            means2d,
            whitened,
            opacities,
            depths,
            conics,
            colors,
        } = self;
        let arrays = [means2d, whitened, opacities, depths, conics, colors];
        arrays.into_iter().zip(COTANGENTS)
    }

    /// Check that they are those of `n` Gaussians.
    fn check(&self, n: usize) -> Result<(), Error> {
        self.arrays().try_for_each(|(array, (name, row))| {
            array.map_or(Ok(()), |array| check_len(name, array, row * n))
        })
    }

    /// Send for those of the group from `first` on, and for its Gaussians: a processor does not follow so many arrays
    /// by itself.
    #[inline(always)]
    fn prefetch(&self, g: &Gaussians<T>, first: usize) {
        for (data, width) in [(g.means, 3), (g.quats, 4), (g.scales, 3), (g.opacities, 1)] {
            prefetch_rows(data, width, first, GROUP);
        }
        for (array, (_, row)) in self.arrays() {
            prefetch_rows(array.unwrap_or(&[]), row, first, GROUP);
        }
    }
}

/// The cotangents of a group, a column per number.
struct Cotangents<T> {
    means2d: [Column<T>; 2],
    whitened: [Column<T>; 3],
    opacities: Column<T>,
    depths: Column<T>,
    conics: [Column<T>; 3],
    /// Whether there are any for the conics.
    has_conics: bool,
    colors: [Column<T>; 3],
}

impl<T: Real> Cotangents<T> {
    const ZERO: Self = Self {
        means2d: [Column::ZERO; 2],
        whitened: [Column::ZERO; 3],
        opacities: Column::ZERO,
        depths: Column::ZERO,
        conics: [Column::ZERO; 3],
        has_conics: false,
        colors: [Column::ZERO; 3],
    };

    #[inline(always)]
    fn read<S: Simd>(&mut self, simd: S, v: &ProjectCotangents<T>, first: usize) {
        if let Some(v) = v.means2d {
            groups::read(simd, v, first, &mut self.means2d);
        }
        if let Some(v) = v.whitened {
            groups::read(simd, v, first, &mut self.whitened);
        }
        if let Some(v) = v.opacities {
            self.opacities.load(v, first);
        }
        if let Some(v) = v.depths {
            self.depths.load(v, first);
        }
        self.has_conics = v.conics.is_some();
        if let Some(v) = v.conics {
            groups::read(simd, v, first, &mut self.conics);
        }
        if let Some(v) = v.colors {
            groups::read(simd, v, first, &mut self.colors);
        }
    }

    /// What arrives at the geometry `g` of the Gaussians `at..`, and the gradient of their opacities; `opacity`:
    /// these, if they are compensated.
    #[inline(always)]
    fn gather<S: Simd>(
        &self,
        simd: S,
        at: usize,
        g: &Geometry<S>,
        opacity: Option<Wide<S>>,
        camera: &CameraLanes<S>,
    ) -> (Cotangent<S>, Wide<S>) {
        let v_splat_opacity = self.opacities.wide(simd, at);
        let mut v_opacity = v_splat_opacity;
        let mut whitened = wide3(simd, &self.whitened, at);
        if self.has_conics {
            whitened = whitened + g.whiten_conic(simd, wide3(simd, &self.conics, at));
        }
        if let Some(opacity) = opacity {
            let v_compensation = v_splat_opacity * opacity;
            whitened = whitened + g.whiten_compensation(simd, camera, v_compensation);
            v_opacity = v_splat_opacity * g.compensation();
        }
        let [x, y] = &self.means2d;
        let cotangent = Cotangent {
            mean2d: [x.wide(simd, at), y.wide(simd, at)],
            whitened,
            depth: self.depths.wide(simd, at),
        };
        (cotangent, v_opacity)
    }

    /// Gaussians of the group with a cotangent that is not 0.
    #[inline(always)]
    fn nonzero<S: Simd>(&self, simd: S) -> u16 {
        let zero = Lanes::<T, S>::splat(simd, T::ZERO);
        let mut set = 0;
        for at in (0..GROUP).step_by(Lanes::<T, S>::LEN) {
            let mut none = zero.simd_eq(zero);
            for columns in [
                &self.means2d[..],
                &self.whitened,
                from_ref(&self.opacities),
                from_ref(&self.depths),
                &self.conics,
                &self.colors,
            ] {
                for column in columns {
                    none &= column.get(simd, at).simd_eq(zero);
                }
            }
            set |= ((!none).to_bitmask() as u16) << at;
        }
        set
    }
}

/// Which gradients [`backward()`] is to compute.
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
    /// Of the covariances that the quaternions and scales stand for.
    pub covars: bool,
    /// Of `Harmonics::coefficients`.
    pub harmonics: bool,
    /// Of `Harmonics::rest`.
    pub harmonics_rest: bool,
    /// Of the whole pose of the camera, not only of its centre.
    pub camera: bool,
}

/// Gradients of the projection's inputs.
#[derive(Debug)]
pub struct GaussianGrads<T> {
    /// Of the means [N, 3], quaternions [N, 4], scales [N, 3], opacities `[N]`, covariances [N, 6],
    /// `Harmonics::coefficients` and `Harmonics::rest`; empty where not wanted. Zeros for a Gaussian that is culled or
    /// without a cotangent, and for harmonics above the degree in use. Of a covariance the entries xx, xy, xz, yy, yz,
    /// zz; those beside the diagonal stand for two.
    pub arrays: [Vec<T>; 7],
    /// Of the camera.
    pub camera: CameraGrad,
}

/// What one job fills of the arrays: empty where not wanted.
struct BackwardChunk<'a, T> {
    outs: [PieceWriter<'a, T>; 7],
    /// Numbers per Gaussian, in their order.
    rows: [usize; 7],
}

impl<T: Real> BackwardChunk<'_, T> {
    /// A buffer for the rows of one group for each output.
    fn buffers(&self) -> [Vec<T>; 7] {
        self.rows.map(|row| vec![T::ZERO; GROUP * row])
    }

    /// Give out the first `rows` rows of the buffers.
    #[inline(always)]
    fn put(&mut self, buffers: &[Vec<T>; 7], rows: usize) {
        for ((out, buffer), row) in self.outs.iter_mut().zip(buffers).zip(self.rows) {
            out.put(&buffer[..row * rows]);
        }
    }
}

/// Vector-Jacobian product of [`forward()`](super::forward()). Groups of 16 Gaussians without a cotangent are left
/// out, and so is the geometry where the colours alone have cotangents.
///
/// `projection` and `shading` must be those that `forward` made from the same inputs.
///
/// # Errors
/// When the length of an array does not fit, or `colors` have a cotangent without the `shading` of as many
/// Gaussians.
pub fn backward<T: Real>(
    gaussians: &Gaussians<T>,
    shading: Option<&Shading<T>>,
    camera: &Camera,
    options: &RenderOptions,
    projection: &Projection,
    v: &ProjectCotangents<T>,
    wanted: Wanted,
) -> Result<GaussianGrads<T>, Error> {
    let n = gaussians.len();
    gaussians.check()?;
    check_len("projection", &projection.splats, n)?;
    v.check(n)?;
    match shading {
        None if v.colors.is_some() => {
            let message = "the forward pass was not to be differentiated";
            return Err(Error::new("v_colors", message));
        }
        Some(shading) => check_len("shading", &shading.clamped, n.div_ceil(GROUP))?,
        None => {}
    }
    let (row, rest_row) = shading.map_or((0, 0), |s| s.rows);
    let rows = [
        (wanted.means, 3),
        (wanted.quats, 4),
        (wanted.scales, 3),
        (wanted.opacities, 1),
        (wanted.covars, 6),
        (wanted.harmonics, row),
        (wanted.harmonics_rest, rest_row),
    ]
    .map(|(wanted, row)| if wanted { row } else { 0 });
    let mut arrays = UninitVec::<T>::several(rows.map(|row| row * n), "gradients")?;
    let jobs = UninitVec::cut_rows(&mut arrays, rows, chunks(n, PROJECT_CHUNK));
    let level = projection.level.token;
    let parts: Vec<_> = jobs
        .into_par_iter()
        .enumerate()
        .with_max_len(1)
        .map(|(chunk, pieces)| {
            let out = BackwardChunk {
                outs: pieces.map(UninitPiece::writer),
                rows,
            };
            dispatch!(level, simd => backward_chunk(
                simd, gaussians, shading, camera, options, projection, v, chunk * PROJECT_CHUNK, out, wanted.camera
            ))
        })
        .collect();
    let mut camera_grad = CameraGrad::ZERO;
    for part in &parts {
        camera_grad.add(part);
    }
    Ok(GaussianGrads {
        arrays: arrays.map(UninitVec::finish),
        camera: camera_grad,
    })
}

/// VJP of the Gaussians of one chunk.
#[inline(always)]
fn backward_chunk<S: Simd, T: Real>(
    simd: S,
    gaussians: &Gaussians<T>,
    shading: Option<&Shading<T>>,
    camera: &Camera,
    options: &RenderOptions,
    projection: &Projection,
    v: &ProjectCotangents<T>,
    begin: usize,
    mut chunk: BackwardChunk<T>,
    camera_wanted: bool,
) -> CameraGrad {
    let zero = splat_lanes(simd, 0.0);
    let camera_lanes = CameraLanes::new(
        simd,
        camera,
        options.near_plane,
        options.far_plane,
        options.eps2d,
    );
    let center = splat3(simd, camera.center);
    let mut camera_grads = [CameraGradLanes::zero(simd); MAX_PARTS];
    let mut inputs = Columns::ZERO;
    let mut cotangents = Cotangents::ZERO;
    let geometry_wanted = v.means2d.is_some()
        || v.whitened.is_some()
        || v.opacities.is_some()
        || v.depths.is_some()
        || v.conics.is_some();
    let shading = shading.filter(|_| v.colors.is_some());
    let mut colors = ColorGroup::ZERO;
    let mut out = Columns::<T>::ZERO;
    let (mut buffers, zeros) = (chunk.buffers(), chunk.buffers());
    let mut covars = [Column::<T>::ZERO; 6];
    let [_, _, _, _, covar_row, row, rest_row] = chunk.rows;
    let end = gaussians.len().min(begin + PROJECT_CHUNK);
    for first in (begin..end).step_by(GROUP) {
        let rows = GROUP.min(end - first);
        v.prefetch(gaussians, first + GROUP);
        if let Some(shading) = shading {
            shading.prefetch(first / GROUP + 1);
        }
        let mut visible = 0u16;
        for (lane, depth) in projection.depths[first..first + rows].iter().enumerate() {
            visible |= u16::from(*depth > 0.0) << lane;
        }
        if visible == 0 {
            chunk.put(&zeros, rows);
            continue;
        }
        cotangents.read(simd, v, first);
        if visible & cotangents.nonzero(simd) == 0 {
            chunk.put(&zeros, rows);
            continue;
        }
        inputs.read(simd, gaussians, first, options.activate);
        if let Some(shading) = shading {
            let (means, v_colors) = (&inputs.means, &cotangents.colors);
            let group = first / GROUP;
            colors.backward(simd, shading, group, means, center, v_colors, visible);
        }
        for at in (0..GROUP).step_by(lanes::<S>()) {
            // Not those that were culled, nor those beyond the end.
            let valid = lanes_in(simd, visible, at);
            let camera_grad = &mut camera_grads[at / lanes::<S>() % sums::parts::<S, f64>()];
            let (mut grad, mut v_opacity) = (GeometryGrad::zero(simd), zero);
            if geometry_wanted {
                let mut g = inputs.geometry(simd, at, &camera_lanes);
                g.valid = valid;
                let opacity = if options.antialiased {
                    Some(inputs.opacities.wide(simd, at))
                } else {
                    None
                };
                let camera_grad = camera_wanted.then_some(&mut *camera_grad);
                let cotangent;
                (cotangent, v_opacity) = cotangents.gather(simd, at, &g, opacity, &camera_lanes);
                grad = g.vjp(simd, &cotangent, &camera_lanes, camera_grad);
                if covar_row > 0 {
                    let v_covar = g.covar_vjp(&cotangent.whitened, &camera_lanes);
                    for (column, v) in covars.iter_mut().zip(v_covar) {
                        column.saturate(simd, at, valid.select(v, zero));
                    }
                }
            }
            if shading.is_some() {
                let v_mean = colors.mean_vjp(simd, at, valid);
                grad.mean = grad.mean + v_mean;
                camera_grad.center = camera_grad.center - v_mean;
            }
            if options.activate {
                grad.scale = grad.scale.times(wide3(simd, &inputs.scales, at));
                let opacity = inputs.opacities.wide(simd, at);
                v_opacity *= opacity * (splat_lanes(simd, 1.0) - opacity);
            }
            out.set(simd, at, &grad, v_opacity, valid, zero);
        }
        let [means, quats, scales, alphas, covar, coefficients, rest] = &mut buffers;
        out.write([means, quats, scales, alphas]);
        groups::write(covars.each_ref().map(|column| &column.0), covar);
        if let Some(shading) = shading {
            colors.write(simd, shading, [coefficients, rest], [row, rest_row]);
        }
        chunk.put(&buffers, rows);
    }
    let camera_grads = &mut camera_grads[..sums::parts::<S, f64>()];
    CameraGradLanes::sum(camera_grads)
}

/// As gradients, in the type of the inputs.
impl<T: Real> Columns<T> {
    /// Set the Gaussians `at..`; 0 where they are not valid.
    #[inline(always)]
    fn set<S: Simd>(
        &mut self,
        simd: S,
        at: usize,
        grad: &GeometryGrad<S>,
        opacity: Wide<S>,
        valid: Mask<S>,
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

    /// Write them as rows.
    #[inline(always)]
    fn write(&self, [means, quats, scales, opacities]: [&mut [T]; 4]) {
        let [x, y, z] = &self.means;
        groups::write([&x.0, &y.0, &z.0], means);
        let [w, x, y, z] = &self.quats;
        groups::write([&w.0, &x.0, &y.0, &z.0], quats);
        let [x, y, z] = &self.scales;
        groups::write([&x.0, &y.0, &z.0], scales);
        groups::write([&self.opacities.0], opacities);
    }
}
