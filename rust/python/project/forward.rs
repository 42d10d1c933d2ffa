//! The binding of the projection, forward.

use super::{Arrays, Frame, Projections, of_camera};
use crate::{
    arrays::{Array, Optional, Scalar, by_dtype, join},
    error::BindingResult,
    threads,
};
use hqgs::internals::{
    Error,
    accuracy_knobs::{AccuracyKnobs, Spans},
    project::{self, RenderOptions},
    scene::{Camera, Colors, Harmonics},
};
use numpy::{Element, IntoPyArray};
use pyo3::{IntoPyObjectExt, prelude::*};
use std::sync::Arc;

fn cameras(
    viewmats: &Bound<'_, PyAny>,
    ks: &Bound<'_, PyAny>,
    [width, height]: [usize; 2],
) -> BindingResult<Vec<Camera>> {
    let viewmats = Array::<f64>::new("viewmats", viewmats)?;
    let &[c, 4, 4] = viewmats.shape() else {
        let got = format!("{:?}", viewmats.shape());
        return Err(Error::shape("viewmats", "[C, 4, 4]", got).into());
    };
    let ks = Array::<f64>::new("Ks", ks)?.of_shape(&[c, 3, 3])?;
    let ((views, _), (ks, _)) = (viewmats.slice().as_chunks(), ks.slice().as_chunks());
    let cameras = views.iter().zip(ks);
    Ok(cameras
        .map(|(v, k)| {
            let camera = Camera::new(v, k, width, height);
            camera.map_err(|e| e.renamed("viewmat", "viewmats").renamed("k", "Ks"))
        })
        .collect::<Result<_, _>>()?)
}

/// alpha_min, transmittance_min, spans, skip_blocks
type Knobs<'a> = (f64, f64, &'a str, bool);

fn accuracy_knobs(knobs: Option<Knobs>) -> Result<AccuracyKnobs, Error> {
    let Some((alpha_min, transmittance_min, spans, skip_blocks)) = knobs else {
        return Ok(AccuracyKnobs::default());
    };
    let spans = match spans {
        "ellipse" => Spans::Ellipse,
        "box" => Spans::Box,
        _ => {
            let message = format!("must be ellipse or box, got {spans}");
            return Err(Error::new("spans", message));
        }
    };
    let knobs = AccuracyKnobs {
        alpha_min,
        transmittance_min,
        spans,
        skip_blocks,
    };
    knobs.check()?;
    Ok(knobs)
}

/// The borrowed arrays of colours: channels, or harmonics.
struct Shades<'py, T: Element> {
    colors: Array<'py, T>,
    rest: Option<Array<'py, T>>,
}

impl<'py, T: Scalar> Shades<'py, T> {
    fn new(colors: &Bound<'py, PyAny>, rest: Optional<'_, 'py>, n: usize) -> BindingResult<Self> {
        let Some(rest) = rest else {
            let colors = Array::new("colors", colors)?;
            return Ok(Self { colors, rest: None });
        };
        let rest = Array::new("colors[1]", rest)?;
        let k = rest.shape().get(1).copied().unwrap_or(0);
        Ok(Self {
            colors: Array::new("colors[0]", colors)?.of_shape(&[n, 1, 3])?,
            rest: Some(rest.of_shape(&[n, k, 3])?),
        })
    }

    /// Those of `n` Gaussians in each of so many cameras, by its number.
    fn of<'a>(
        &'a self,
        n: usize,
        cameras: usize,
        sh_degree: Option<usize>,
    ) -> BindingResult<impl Fn(usize) -> Colors<'a, T> + Sync + use<'a, T>> {
        let (data, rest) = (self.colors.slice(), self.rest.as_ref());
        let row = self
            .colors
            .row(n, cameras, 1 + usize::from(sh_degree.is_some()))?;
        let (width, stored) = (
            row.iter().product(),
            row[0] + rest.map_or(0, |r| r.shape()[1]),
        );
        let rest = rest.map(Array::slice);
        Ok(move |i| {
            let coefficients = of_camera(data, i, n * width);
            match sh_degree {
                None => Colors::Channels(coefficients, width),
                Some(degree) => Colors::Harmonics(Harmonics {
                    coefficients,
                    rest,
                    stored,
                    degree,
                }),
            }
        })
    }
}

/// Project Gaussians; see `hqgs/model/rasterization.py` for the shapes. `colors` are harmonics if there is a degree;
/// `options`: near, far, radius_clip, eps2d, antialiased, and whether the image is differentiated. Without `all` the
/// arrays that no image needs are empty. `knobs`, which also hold for the later stages, are for the benchmark of error
/// against run time alone.
#[pyfunction]
#[pyo3(signature = (means, quats, scales, opacities, colors, rest, viewmats, ks, width, height, options, sh_degree, activate=false, knobs=None, all=true))]
pub(crate) fn project_forward<'py>(
    means: &Bound<'py, PyAny>,
    quats: &Bound<'py, PyAny>,
    scales: &Bound<'py, PyAny>,
    opacities: &Bound<'py, PyAny>,
    colors: &Bound<'py, PyAny>,
    rest: Optional<'_, 'py>,
    viewmats: &Bound<'py, PyAny>,
    ks: &Bound<'py, PyAny>,
    width: usize,
    height: usize,
    options: (f64, f64, f64, f64, bool, bool),
    sh_degree: Option<usize>,
    activate: bool,
    knobs: Option<Knobs>,
    all: bool,
) -> BindingResult<Bound<'py, PyAny>> {
    let py = means.py();
    let (near_plane, far_plane, radius_clip, eps2d, antialiased, differentiable) = options;
    let options = RenderOptions {
        near_plane,
        far_plane,
        radius_clip,
        eps2d,
        antialiased,
        differentiable,
        activate,
        knobs: accuracy_knobs(knobs)?,
        ..RenderOptions::default()
    };
    by_dtype!(T, "means", means, {
        let arrays = Arrays::<T>::new([means, quats, scales, opacities])?;
        let gaussians = arrays.gaussians();
        let n = gaussians.len();
        let shades = Shades::<T>::new(colors, rest, n)?;
        let cameras = cameras(viewmats, ks, [width, height])?;
        let colors = shades.of(n, cameras.len(), sh_degree)?;
        let mut outs: Vec<_> = threads::run(py, || {
            let project =
                |(i, camera)| project::forward(&gaussians, colors(i), camera, &options, all);
            cameras.iter().enumerate().map(project).collect()
        })?;
        let means2d = join(&mut outs, |out| &mut out.means2d)?;
        let depths = join(&mut outs, |out| &mut out.depths)?;
        let conics = join(&mut outs, |out| &mut out.conics)?;
        let radii = join(&mut outs, |out| &mut out.radii)?;
        let opacities = join(&mut outs, |out| &mut out.opacities)?;
        let colors = join(&mut outs, |out| &mut out.colors)?;
        let kept = outs.iter().map(|out| out.kept).sum();
        let shadings = outs.iter_mut().map(|out| out.shading.take());
        let frame = Frame(Arc::new(Projections {
            cameras,
            kept,
            shadings: Box::new(shadings.collect::<Vec<_>>()),
            projections: outs.into_iter().map(|out| out.projection).collect(),
            options,
            n,
            harmonics_of_each: matches!(*shades.colors.shape(), [c, _, _, _] if c > 1),
        }));
        let out = (
            frame,
            means2d.into_pyarray(py),
            depths.into_pyarray(py),
            conics.into_pyarray(py),
            radii.into_pyarray(py),
            opacities.into_pyarray(py),
            colors.into_pyarray(py),
        );
        Ok(out.into_bound_py_any(py)?)
    })
}
