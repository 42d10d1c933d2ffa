//! The binding of the projection.

use crate::arrays::{
    AnyType, Array, CountsByName, Optional, Scalar, by_dtype, join, of_type, optional,
};
use crate::error::BindingResult;
use hqgs::{
    Error,
    accuracy_knobs::{AccuracyKnobs, Spans},
    counts::Counts,
    project::{self, GaussianGrads, ProjectCotangents, ProjectOptions, Projection, Shading},
    scene::{Camera, Colors, Gaussians, Harmonics},
    simd::Real,
    threads,
};
use numpy::{Element, IntoPyArray};
use pyo3::{IntoPyObjectExt, prelude::*};

/// Add the functions and classes of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Frame>()?;
    m.add_function(wrap_pyfunction!(project_forward, m)?)?;
    m.add_function(wrap_pyfunction!(project_backward, m)?)
}

/// Add the gradient from another camera; it stays finite.
fn accumulate<T: Real>(sum: &mut [T], part: &[T]) {
    for (s, p) in sum.iter_mut().zip(part) {
        *s = T::saturating(s.to_f64() + p.to_f64());
    }
}

/// The projection of N Gaussians into C cameras.
#[pyclass(frozen, module = "hqgs._rust")]
pub(crate) struct Frame {
    pub(crate) cameras: Vec<Camera>,
    pub(crate) projections: Vec<Projection>,
    options: ProjectOptions,
    pub(crate) n: usize,
    /// Of each camera; a `Vec<Option<Shading<T>>>`.
    shadings: AnyType,
    counts: Counts,
}

#[pymethods]
impl Frame {
    /// Image width in pixels.
    #[getter]
    fn width(&self) -> usize {
        self.cameras.first().map_or(0, |c| c.width)
    }

    /// Image height in pixels.
    #[getter]
    fn height(&self) -> usize {
        self.cameras.first().map_or(0, |c| c.height)
    }

    /// Counts of the projection.
    #[getter]
    fn counts(&self) -> CountsByName {
        self.counts.entries().collect()
    }
}

fn cameras(
    viewmats: &[f64],
    ks: &[f64],
    width: usize,
    height: usize,
) -> Result<Vec<Camera>, Error> {
    let (views, left_over) = viewmats.as_chunks::<16>();
    if !left_over.is_empty() || views.len() * 9 != ks.len() {
        let got = format!("{} and {} elements", viewmats.len(), ks.len());
        return Err(Error::shape("viewmats, Ks", "[C, 4, 4] and [C, 3, 3]", got));
    }
    let (ks, _) = ks.as_chunks::<9>();
    views
        .iter()
        .zip(ks)
        .map(|(v, k)| Camera::new(v, k, width, height))
        .collect()
}

/// alpha_min, transmittance_min, spans, skip_blocks, exp2_degree
type Knobs<'a> = (f64, f64, &'a str, bool, usize);

fn accuracy_knobs(knobs: Option<Knobs>) -> Result<AccuracyKnobs, Error> {
    let Some((alpha_min, transmittance_min, spans, skip_blocks, exp2_degree)) = knobs else {
        return Ok(AccuracyKnobs::default());
    };
    let spans = match spans {
        "ellipse" => Spans::Ellipse,
        "box" => Spans::Box,
        "square" => Spans::Square,
        _ => {
            let message = format!("must be ellipse, box or square, got {spans}");
            return Err(Error::new("spans", message));
        }
    };
    let knobs = AccuracyKnobs {
        alpha_min,
        transmittance_min,
        spans,
        skip_blocks,
        exp2_degree,
    };
    knobs.check()?;
    Ok(knobs)
}

/// Project Gaussians; see `hqgs/rasterize.py` for the shapes. `colors` are harmonics if there is a degree.
/// `knobs`, which also hold for the later stages, are for the benchmark of error against run time alone.
#[pyfunction]
#[pyo3(signature = (means, quats, scales, opacities, colors, rest, viewmats, ks, width, height, options, sh_degree, knobs=None))]
fn project_forward<'py>(
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
    knobs: Option<Knobs>,
) -> BindingResult<Bound<'py, PyAny>> {
    let (near_plane, far_plane, radius_clip, eps2d, antialiased, differentiable) = options;
    let options = ProjectOptions {
        near_plane,
        far_plane,
        radius_clip,
        eps2d,
        antialiased,
        differentiable,
        knobs: accuracy_knobs(knobs)?,
    };
    by_dtype!(
        means,
        project_as(
            means, quats, scales, opacities, colors, rest, viewmats, ks, width, height, options,
            sh_degree
        )
    )
}

fn project_as<'py, T: Scalar>(
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
    options: ProjectOptions,
    sh_degree: Option<usize>,
) -> BindingResult<Bound<'py, PyAny>> {
    let py = means.py();
    let arrays = Arrays::<T>::new(means, quats, scales, opacities)?;
    let colors = Array::<T>::new("colors", colors)?;
    let rest = optional::<T>("colors", rest)?;
    let (viewmats, ks) = (
        Array::<f64>::new("viewmats", viewmats)?,
        Array::<f64>::new("Ks", ks)?,
    );
    let cameras = cameras(viewmats.slice()?, ks.slice()?, width, height)?;
    let gaussians = arrays.gaussians()?;
    let n = gaussians.len();
    let harmonics = sh_degree
        .map(|degree| harmonics(&colors, rest.as_ref(), n, degree))
        .transpose()?;
    let (channel_data, channels) = match harmonics {
        Some(_) => (&[][..], 0),
        None => channels_of(&colors, n, cameras.len())?,
    };
    let mut outs: Vec<_> = py.detach(|| {
        threads::install(|| {
            let project = |(i, camera)| {
                let colors = harmonics.as_ref().map_or_else(
                    || Colors::Channels(of_camera(channel_data, i, n * channels), channels),
                    Colors::Harmonics,
                );
                project::forward(&gaussians, colors, camera, &options)
            };
            cameras.iter().enumerate().map(project).collect()
        })
    });
    let means2d = join(&mut outs, |out| &mut out.means2d);
    let depths = join(&mut outs, |out| &mut out.depths);
    let conics = join(&mut outs, |out| &mut out.conics);
    let radii = join(&mut outs, |out| &mut out.radii);
    let opacities = join(&mut outs, |out| &mut out.opacities);
    let colors = join(&mut outs, |out| &mut out.colors);
    let frame = Frame {
        cameras,
        counts: outs
            .iter()
            .fold(Counts::default(), |sum, out| sum.plus(out.counts)),
        shadings: Box::new(
            outs.iter_mut()
                .map(|out| out.shading.take())
                .collect::<Vec<_>>(),
        ),
        projections: outs.into_iter().map(|out| out.projection).collect(),
        options,
        n,
    };
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
}

/// The borrowed arrays of the Gaussians.
struct Arrays<'py, T: Element> {
    means: Array<'py, T>,
    quats: Array<'py, T>,
    scales: Array<'py, T>,
    opacities: Array<'py, T>,
}

impl<'py, T: Scalar> Arrays<'py, T> {
    fn new(
        means: &Bound<'py, PyAny>,
        quats: &Bound<'py, PyAny>,
        scales: &Bound<'py, PyAny>,
        opacities: &Bound<'py, PyAny>,
    ) -> BindingResult<Self> {
        Ok(Self {
            means: Array::new("means", means)?,
            quats: Array::new("quats", quats)?,
            scales: Array::new("scales", scales)?,
            opacities: Array::new("opacities", opacities)?,
        })
    }

    fn gaussians(&self) -> BindingResult<Gaussians<'_, T>> {
        let gaussians = Gaussians {
            means: self.means.slice()?,
            quats: self.quats.slice()?,
            scales: self.scales.slice()?,
            opacities: self.opacities.slice()?,
        };
        gaussians.check()?;
        Ok(gaussians)
    }
}

/// Colours as channels: the data and their number.
fn channels_of<'a, T: Scalar>(
    colors: &'a Array<'_, T>,
    n: usize,
    cameras: usize,
) -> BindingResult<(&'a [T], usize)> {
    let (data, channels) = (colors.slice()?, colors.shape().last().copied().unwrap_or(0));
    check_colors(data, n, cameras, channels)?;
    Ok((data, channels))
}

fn harmonics<'a, T: Scalar>(
    colors: &'a Array<'_, T>,
    rest: Option<&'a Array<'_, T>>,
    n: usize,
    degree: usize,
) -> BindingResult<Harmonics<'a, T>> {
    let count = |array: &Array<'_, T>| match array.shape() {
        &[_, k, 3] => Ok(k),
        other => Err(Error::shape("colors", "[N, K, 3]", format!("{other:?}"))),
    };
    let harmonics = Harmonics {
        coefficients: colors.slice()?,
        rest: rest.map(Array::slice).transpose()?,
        stored: count(colors)? + rest.map_or(Ok(0), count)?,
        degree,
    };
    harmonics.check(n)?;
    Ok(harmonics)
}

/// VJP of `project_forward`.
#[pyfunction]
fn project_backward<'py>(
    frame: &Bound<'py, Frame>,
    inputs: Inputs<'py>,
    cotangents: Cotangents<'py>,
    wanted: [bool; 7],
) -> BindingResult<Bound<'py, PyAny>> {
    by_dtype!(
        &inputs.0,
        project_backward_as(frame, &inputs, cotangents, wanted)
    )
}

/// means, quats, scales, opacities
type Inputs<'py> = (
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
);

/// means2d, whitened, opacities, depths, conics, colors
type Cotangents<'py> = (
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
);

fn project_backward_as<'py, T: Scalar>(
    frame: &Bound<'py, Frame>,
    inputs: &Inputs<'py>,
    v: Cotangents<'py>,
    wanted: [bool; 7],
) -> BindingResult<Bound<'py, PyAny>> {
    let py = frame.py();
    let frame = frame.get();
    let arrays = Arrays::<T>::new(&inputs.0, &inputs.1, &inputs.2, &inputs.3)?;
    let gaussians = arrays.gaussians()?;
    let shadings = of_type::<Vec<Option<Shading<T>>>>(&frame.shadings, "means")?;
    let v_means2d = optional::<T>("v_means2d", v.0.as_ref())?;
    let v_whitened = optional::<T>("v_whitened", v.1.as_ref())?;
    let v_opacities = optional::<T>("v_opacities", v.2.as_ref())?;
    let v_depths = optional::<T>("v_depths", v.3.as_ref())?;
    let v_conics = optional::<T>("v_conics", v.4.as_ref())?;
    let v_colors = optional::<T>("v_colors", v.5.as_ref())?;
    let (n, c) = (frame.n, frame.cameras.len());
    let part = |a: &Option<Array<'py, T>>| -> BindingResult<Option<usize>> {
        Ok(a.as_ref().map(|a| a.shape().iter().product()))
    };
    for (name, rows, got) in [
        ("v_means2d", 2, part(&v_means2d)?),
        ("v_whitened", 3, part(&v_whitened)?),
        ("v_opacities", 1, part(&v_opacities)?),
        ("v_depths", 1, part(&v_depths)?),
        ("v_conics", 3, part(&v_conics)?),
        ("v_colors", 3, part(&v_colors)?),
    ] {
        if got.is_some_and(|g| g != rows * c * n) || gaussians.len() != n {
            return Err(Error::shape(
                name,
                format!("[{c}, {n}, {rows}]"),
                format!("{got:?} elements"),
            )
            .into());
        }
    }
    if v_colors.is_some() && shadings.iter().any(Option::is_none) {
        return Err(Error::new("v_colors", "the forward pass was not to be differentiated").into());
    }
    let slices = (
        v_means2d.as_ref().map(Array::slice).transpose()?,
        v_whitened.as_ref().map(Array::slice).transpose()?,
        v_opacities.as_ref().map(Array::slice).transpose()?,
        v_depths.as_ref().map(Array::slice).transpose()?,
        v_conics.as_ref().map(Array::slice).transpose()?,
        v_colors.as_ref().map(Array::slice).transpose()?,
    );
    let [
        means,
        quats,
        scales,
        opacities,
        harmonics_wanted,
        harmonics_rest,
        camera,
    ] = wanted;
    let wanted = project::Wanted {
        means,
        quats,
        scales,
        opacities,
        harmonics: harmonics_wanted,
        harmonics_rest,
        camera,
    };
    let (sums, viewmats) = py.detach(|| {
        threads::install(|| {
            let mut sums: Option<GaussianGrads<T>> = None;
            let mut viewmats = Vec::with_capacity(16 * c);
            for (i, camera) in frame.cameras.iter().enumerate() {
                let cotangents = ProjectCotangents {
                    means2d: slices.0.map(|s| &s[2 * i * n..2 * (i + 1) * n]),
                    whitened: slices.1.map(|s| &s[3 * i * n..3 * (i + 1) * n]),
                    opacities: slices.2.map(|s| &s[i * n..(i + 1) * n]),
                    depths: slices.3.map(|s| &s[i * n..(i + 1) * n]),
                    conics: slices.4.map(|s| &s[3 * i * n..3 * (i + 1) * n]),
                    colors: slices.5.map(|s| &s[3 * i * n..3 * (i + 1) * n]),
                };
                let grads = project::backward(
                    &gaussians,
                    shadings[i].as_ref(),
                    camera,
                    &frame.options,
                    &frame.projections[i],
                    &cotangents,
                    wanted,
                );
                viewmats.extend(grads.camera.viewmat(camera));
                match &mut sums {
                    None => sums = Some(grads),
                    Some(sums) => {
                        accumulate(&mut sums.means, &grads.means);
                        accumulate(&mut sums.quats, &grads.quats);
                        accumulate(&mut sums.scales, &grads.scales);
                        accumulate(&mut sums.opacities, &grads.opacities);
                        accumulate(&mut sums.harmonics, &grads.harmonics);
                        accumulate(&mut sums.harmonics_rest, &grads.harmonics_rest);
                        sums.counts = sums.counts.plus(grads.counts);
                    }
                }
            }
            (sums, viewmats)
        })
    });
    let grads = sums.ok_or_else(|| Error::new("viewmats", "there is no camera"))?;
    let out = (
        wanted.means.then(|| grads.means.into_pyarray(py)),
        wanted.quats.then(|| grads.quats.into_pyarray(py)),
        wanted.scales.then(|| grads.scales.into_pyarray(py)),
        wanted.opacities.then(|| grads.opacities.into_pyarray(py)),
        wanted.harmonics.then(|| grads.harmonics.into_pyarray(py)),
        wanted
            .harmonics_rest
            .then(|| grads.harmonics_rest.into_pyarray(py)),
        wanted.camera.then(|| viewmats.into_pyarray(py)),
        grads.counts.entries().collect::<CountsByName>(),
    );
    Ok(out.into_bound_py_any(py)?)
}

/// Check that there is one set of colours for all cameras, or one each.
pub(crate) fn check_colors<T>(
    data: &[T],
    n: usize,
    cameras: usize,
    channels: usize,
) -> Result<(), Error> {
    if data.len() == n * channels || data.len() == cameras * n * channels {
        return Ok(());
    }
    let expected = format!("[{n}, {channels}] or [{cameras}, {n}, {channels}]");
    Err(Error::shape(
        "colors",
        expected,
        format!("{} elements", data.len()),
    ))
}

/// Colours of camera `i`: one set for all cameras, or one each.
pub(crate) fn of_camera<T>(data: &[T], i: usize, len: usize) -> &[T] {
    if data.len() == len {
        data
    } else {
        &data[i * len..(i + 1) * len]
    }
}
