//! The Python binding: the only file that knows Python. numpy arrays are borrowed, never copied; the GIL is
//! released while the crate works; each [`Error`] becomes a `ValueError`.

use crate::{
    camera::Camera,
    composite::{self, CompositeCotangents, CompositeInput, Composited},
    error::Error,
    project::{self, GaussianGrads, ProjectCotangents, ProjectOptions, Projection, Shading},
    real::Real,
    scene::{Colors, Gaussians, Harmonics},
    threads,
    tiles::{self, Tiles},
    tuning::{Spans, Tuning},
    work::Work,
};
use numpy::{
    Element, IntoPyArray, PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::{exceptions::PyValueError, prelude::*};
use std::{
    any::Any,
    collections::HashMap,
    ffi::{c_int, c_long},
    time::Instant,
};

/// The buffers of an iteration are as large as those of the last one: an allocator that keeps them saves the
/// page faults, which cost more than the arithmetic of the gradients.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Let the allocator keep freed memory for this long: it would give it back after a second, in each second of
/// the training again.
const KEEP_FREED_MS: c_long = 10_000;

#[allow(unsafe_code)]
fn keep_freed_memory() {
    /// `mi_option_purge_delay` of mimalloc.h.
    const PURGE_DELAY: c_int = 15;
    unsafe extern "C" {
        // SAFETY: any thread may call it with any option, and the crate is linked with mimalloc.
        safe fn mi_option_set_default(option: c_int, value: c_long);
    }
    mi_option_set_default(PURGE_DELAY, KEEP_FREED_MS);
}

impl From<Error> for PyErr {
    fn from(error: Error) -> Self {
        PyValueError::new_err(error.to_string())
    }
}

/// A borrowed C-contiguous array of known type.
pub(crate) struct Array<'py, T: Element>(PyReadonlyArrayDyn<'py, T>);

impl<'py, T: Element> Array<'py, T> {
    /// Borrow `value`. rust-numpy's own `as_slice` accepts Fortran order, which would read a transposed
    /// array silently wrong, so the layout is checked here.
    pub fn new(name: &str, value: &Bound<'py, PyAny>) -> PyResult<Self> {
        let array = value.cast::<PyArrayDyn<T>>().map_err(|_| {
            let dtype = value
                .getattr("dtype")
                .map_or_else(|_| "no array".into(), |d| d.to_string());
            PyValueError::new_err(format!(
                "{name}: expected an array of {}, got {dtype}",
                T::get_dtype(value.py())
            ))
        })?;
        if !array.is_c_contiguous() {
            return Err(PyValueError::new_err(format!(
                "{name}: must be C-contiguous, got shape {:?} with strides {:?}",
                array.shape(),
                array.strides()
            )));
        }
        Ok(Self(array.try_readonly().map_err(|e| {
            PyValueError::new_err(format!("{name}: {e}"))
        })?))
    }

    pub fn slice(&self) -> PyResult<&[T]> {
        Ok(self.0.as_slice()?)
    }

    pub fn shape(&self) -> &[usize] {
        self.0.shape()
    }
}

type Optional<'a, 'py> = Option<&'a Bound<'py, PyAny>>;
type Out<'py, T> = Option<Bound<'py, PyArray1<T>>>;

fn optional<'py, T: Element>(
    name: &str,
    value: Optional<'_, 'py>,
) -> PyResult<Option<Array<'py, T>>> {
    value.map(|v| Array::new(name, v)).transpose()
}

/// Whether `value` is an array of f32 (otherwise it must be of f64).
pub(crate) fn is_f32(value: &Bound<'_, PyAny>) -> bool {
    value.cast::<PyArrayDyn<f32>>().is_ok()
}

/// Add the gradient from another camera; it stays finite.
fn accumulate<T: Real>(sum: &mut [T], part: &[T]) {
    for (s, p) in sum.iter_mut().zip(part) {
        *s = T::saturating(s.to_f64() + p.to_f64());
    }
}

/// One array of every camera's outputs, one after the other, [C, ...].
fn join<O, T: Copy>(outs: &mut [O], array: impl Fn(&mut O) -> &mut Vec<T>) -> Vec<T> {
    let mut parts: Vec<_> = outs
        .iter_mut()
        .map(|out| std::mem::take(array(out)))
        .collect();
    match parts.len() {
        1 => parts.remove(0),
        _ => parts.concat(),
    }
}

/// The projection of N Gaussians into C cameras.
#[pyclass(frozen, module = "hqgs._rust")]
pub(crate) struct Frame {
    pub cameras: Vec<Camera>,
    pub projections: Vec<Projection>,
    options: ProjectOptions,
    n: usize,
    /// Of each camera; a `Vec<Option<Shading<T>>>`.
    shadings: AnyType,
    work: Work,
}

/// Something for one of the scalar types.
type AnyType = Box<dyn Any + Send + Sync>;

/// What was stored for type T.
fn of_type<'a, V: 'static>(stored: &'a AnyType, name: &str) -> PyResult<&'a V> {
    stored
        .downcast_ref()
        .ok_or_else(|| Error::new(name, "dtype differs from the forward pass").into())
}

/// The counts of [`Work`] by name.
type Counts = HashMap<&'static str, u64>;

/// Tile lists and replay state of a composited frame.
#[pyclass(frozen, module = "hqgs._rust")]
struct Composite {
    /// Of each camera; a `Vec<View<T>>`.
    views: AnyType,
    work: Work,
    bin_seconds: f64,
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
    fn counts(&self) -> Counts {
        self.work.entries().collect()
    }
}

/// One camera's tile lists and replay state.
struct View<T> {
    tiles: Tiles<T>,
    composited: Composited<T>,
}

#[pymethods]
impl Composite {
    /// (pairs, blocks evaluated, blocks with a change): the work of the forward pass.
    #[getter]
    fn work(&self) -> (u64, u64, u64) {
        (self.work.pairs, self.work.blocks, self.work.changed_blocks)
    }

    /// Wall-clock seconds that the tile lists took.
    #[getter]
    fn bin_seconds(&self) -> f64 {
        self.bin_seconds
    }

    /// (Gaussian, pixel) pairs that were blended.
    #[getter]
    fn blended(&self) -> u64 {
        self.work.blended
    }

    /// Counts of the forward pass.
    #[getter]
    fn counts(&self) -> Counts {
        self.work.entries().collect()
    }
}

/// A scalar type that the binding offers.
trait Scalar: Real + Element {}
impl Scalar for f32 {}
impl Scalar for f64 {}

/// Call the generic function for the dtype of an array.
macro_rules! by_dtype {
    ($array:expr, $function:ident($($argument:expr),* $(,)?)) => {
        if is_f32($array) {
            $function::<f32>($($argument),*)?.into_pyobject($array.py()).map(|t| t.into_any())
        } else {
            $function::<f64>($($argument),*)?.into_pyobject($array.py()).map(|t| t.into_any())
        }
    };
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

fn tuning(knobs: Option<Knobs>) -> Result<Tuning, Error> {
    let Some((alpha_min, transmittance_min, spans, skip_blocks, exp2_degree)) = knobs else {
        return Ok(Tuning::default());
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
    let tuning = Tuning {
        alpha_min,
        transmittance_min,
        spans,
        skip_blocks,
        exp2_degree,
    };
    tuning.check()?;
    Ok(tuning)
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
) -> PyResult<Bound<'py, PyAny>> {
    let (near_plane, far_plane, radius_clip, eps2d, antialiased, differentiable) = options;
    let options = ProjectOptions {
        near_plane,
        far_plane,
        radius_clip,
        eps2d,
        antialiased,
        differentiable,
        tuning: tuning(knobs)?,
    };
    by_dtype!(
        means,
        project_as(
            means, quats, scales, opacities, colors, rest, viewmats, ks, width, height, options,
            sh_degree
        )
    )
}

type Projected<'py, T> = (
    Frame,
    Bound<'py, PyArray1<T>>,
    Bound<'py, PyArray1<T>>,
    Bound<'py, PyArray1<T>>,
    Bound<'py, PyArray1<i32>>,
    Bound<'py, PyArray1<T>>,
    Bound<'py, PyArray1<T>>,
);

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
) -> PyResult<Projected<'py, T>> {
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
        work: outs
            .iter()
            .fold(Work::default(), |sum, out| sum.plus(out.work)),
        shadings: Box::new(
            outs.iter_mut()
                .map(|out| out.shading.take())
                .collect::<Vec<_>>(),
        ),
        projections: outs.into_iter().map(|out| out.projection).collect(),
        options,
        n,
    };
    Ok((
        frame,
        means2d.into_pyarray(py),
        depths.into_pyarray(py),
        conics.into_pyarray(py),
        radii.into_pyarray(py),
        opacities.into_pyarray(py),
        colors.into_pyarray(py),
    ))
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
    ) -> PyResult<Self> {
        Ok(Self {
            means: Array::new("means", means)?,
            quats: Array::new("quats", quats)?,
            scales: Array::new("scales", scales)?,
            opacities: Array::new("opacities", opacities)?,
        })
    }

    fn gaussians(&self) -> PyResult<Gaussians<'_, T>> {
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
) -> PyResult<(&'a [T], usize)> {
    let (data, channels) = (colors.slice()?, colors.shape().last().copied().unwrap_or(0));
    if data.len() != n * channels && data.len() != cameras * n * channels {
        return Err(Error::shape(
            "colors",
            format!("[{n}, D] or [{cameras}, {n}, D]"),
            format!("{:?}", colors.shape()),
        )
        .into());
    }
    Ok((data, channels))
}

fn harmonics<'a, T: Scalar>(
    colors: &'a Array<'_, T>,
    rest: Option<&'a Array<'_, T>>,
    n: usize,
    degree: usize,
) -> PyResult<Harmonics<'a, T>> {
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
) -> PyResult<Bound<'py, PyAny>> {
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

type ProjectGrads<'py, T> = (
    Out<'py, T>,
    Out<'py, T>,
    Out<'py, T>,
    Out<'py, T>,
    Out<'py, T>,
    Out<'py, T>,
    Out<'py, f64>,
    Counts,
);

fn project_backward_as<'py, T: Scalar>(
    frame: &Bound<'py, Frame>,
    inputs: &Inputs<'py>,
    v: Cotangents<'py>,
    wanted: [bool; 7],
) -> PyResult<ProjectGrads<'py, T>> {
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
    let part = |a: &Option<Array<'py, T>>| -> PyResult<Option<usize>> {
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
                        sums.work = sums.work.plus(grads.work);
                    }
                }
            }
            (sums, viewmats)
        })
    });
    let grads = sums.ok_or_else(|| Error::new("viewmats", "there is no camera"))?;
    Ok((
        wanted.means.then(|| grads.means.into_pyarray(py)),
        wanted.quats.then(|| grads.quats.into_pyarray(py)),
        wanted.scales.then(|| grads.scales.into_pyarray(py)),
        wanted.opacities.then(|| grads.opacities.into_pyarray(py)),
        wanted.harmonics.then(|| grads.harmonics.into_pyarray(py)),
        wanted
            .harmonics_rest
            .then(|| grads.harmonics_rest.into_pyarray(py)),
        wanted.camera.then(|| viewmats.into_pyarray(py)),
        grads.work.entries().collect(),
    ))
}

/// Colours of camera `i`: one set for all cameras, or one each.
fn of_camera<T>(data: &[T], i: usize, len: usize) -> &[T] {
    if data.len() == len {
        data
    } else {
        &data[i * len..(i + 1) * len]
    }
}

fn check_colors<T>(
    frame: &Frame,
    colors: &[T],
    background: Option<&[T]>,
    channels: usize,
) -> PyResult<()> {
    let (n, c) = (frame.n, frame.cameras.len());
    if colors.len() != n * channels && colors.len() != c * n * channels {
        return Err(Error::shape(
            "colors",
            format!("[{n}, {channels}] or [{c}, {n}, {channels}]"),
            format!("{} elements", colors.len()),
        )
        .into());
    }
    if background.is_some_and(|b| b.len() != c * channels) {
        return Err(Error::shape("backgrounds", format!("[{c}, {channels}]"), "other").into());
    }
    Ok(())
}

/// What the backward pass needs, the image and the alphas.
type Image<'py, T> = (Composite, Bound<'py, PyArray1<T>>, Bound<'py, PyArray1<T>>);

/// Bin and composite a frame.
#[pyfunction]
#[pyo3(signature = (frame, colors, backgrounds, channels))]
fn composite_forward<'py>(
    frame: &Bound<'py, Frame>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    channels: usize,
) -> PyResult<Bound<'py, PyAny>> {
    by_dtype!(colors, composite_as(frame, colors, backgrounds, channels))
}

fn composite_as<'py, T: Scalar>(
    frame: &Bound<'py, Frame>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    channels: usize,
) -> PyResult<Image<'py, T>> {
    let py = colors.py();
    let frame = frame.get();
    let colors = Array::<T>::new("colors", colors)?;
    let backgrounds = optional::<T>("backgrounds", backgrounds)?;
    let colors = colors.slice()?;
    let backgrounds = backgrounds.as_ref().map(Array::slice).transpose()?;
    check_colors(frame, colors, backgrounds, channels)?;
    let (state, image, alphas) = py.detach(|| {
        threads::install(|| -> Result<_, Error> {
            let (mut images, mut alphas) = (Vec::new(), Vec::new());
            let (mut views, mut total, mut bin_seconds) = (Vec::new(), Work::default(), 0.0);
            for (i, (camera, projection)) in
                frame.cameras.iter().zip(&frame.projections).enumerate()
            {
                let started = Instant::now();
                let tiles = tiles::bin(
                    projection,
                    of_camera(colors, i, frame.n * channels),
                    channels,
                    camera,
                )?;
                bin_seconds += started.elapsed().as_secs_f64();
                let input = CompositeInput {
                    projection,
                    tiles: &tiles,
                    camera,
                    background: backgrounds.map(|b| &b[i * channels..(i + 1) * channels]),
                };
                let view = composite::forward(&input)?;
                total = total.plus(view.work);
                images.push(view.image);
                alphas.push(view.alphas);
                let composited = view.composited;
                views.push(View { tiles, composited });
            }
            Ok((
                Composite {
                    views: Box::new(views),
                    work: total,
                    bin_seconds,
                },
                join(&mut images, |image| image),
                join(&mut alphas, |alphas| alphas),
            ))
        })
    })?;
    Ok((state, image.into_pyarray(py), alphas.into_pyarray(py)))
}

/// VJP of `composite_forward`. `wanted`: geometry, absolute, colors, backgrounds.
#[pyfunction]
#[pyo3(signature = (frame, composite, colors, backgrounds, v_image, v_alphas, channels, wanted))]
fn composite_backward<'py>(
    frame: &Bound<'py, Frame>,
    composite: &Bound<'py, Composite>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    v_image: &Bound<'py, PyAny>,
    v_alphas: Optional<'_, 'py>,
    channels: usize,
    wanted: [bool; 4],
) -> PyResult<Bound<'py, PyAny>> {
    by_dtype!(
        colors,
        composite_backward_as(
            frame,
            composite,
            colors,
            backgrounds,
            v_image,
            v_alphas,
            channels,
            wanted
        )
    )
}

type CompositeOut<'py, T> = (
    Out<'py, T>,
    Out<'py, T>,
    Out<'py, T>,
    Out<'py, T>,
    Out<'py, T>,
    Out<'py, T>,
    Counts,
);

fn composite_backward_as<'py, T: Scalar>(
    frame: &Bound<'py, Frame>,
    composite: &Bound<'py, Composite>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    v_image: &Bound<'py, PyAny>,
    v_alphas: Optional<'_, 'py>,
    channels: usize,
    wanted: [bool; 4],
) -> PyResult<CompositeOut<'py, T>> {
    let py = colors.py();
    let (frame, composite) = (frame.get(), composite.get());
    let views = of_type::<Vec<View<T>>>(&composite.views, "colors")?;
    let colors = Array::<T>::new("colors", colors)?;
    let backgrounds = optional::<T>("backgrounds", backgrounds)?;
    let v_image = Array::<T>::new("v_render_colors", v_image)?;
    let v_alphas = optional::<T>("v_render_alphas", v_alphas)?;
    let colors = colors.slice()?;
    let backgrounds = backgrounds.as_ref().map(Array::slice).transpose()?;
    check_colors(frame, colors, backgrounds, channels)?;
    let v_image = v_image.slice()?;
    let v_alphas = v_alphas.as_ref().map(Array::slice).transpose()?;
    let c = frame.cameras.len();
    let pixels = frame.cameras.first().map_or(0, |c| c.width * c.height);
    for (name, got, expected) in [
        ("v_render_colors", v_image.len(), c * pixels * channels),
        (
            "v_render_alphas",
            v_alphas.map_or(c * pixels, <[T]>::len),
            c * pixels,
        ),
    ] {
        if got != expected {
            return Err(Error::shape(
                name,
                format!("{expected} elements"),
                format!("{got} elements"),
            )
            .into());
        }
    }
    let [geometry, absolute, want_colors, background] = wanted;
    let wanted = composite::Wanted {
        geometry,
        absolute,
        colors: want_colors,
        background,
    };
    let mut outs: Vec<_> = py.detach(|| {
        threads::install(|| {
            let backward = |(i, camera): (usize, _)| {
                let input = CompositeInput {
                    projection: &frame.projections[i],
                    tiles: &views[i].tiles,
                    camera,
                    background: backgrounds.map(|b| &b[i * channels..(i + 1) * channels]),
                };
                let cotangents = CompositeCotangents {
                    image: &v_image[i * pixels * channels..(i + 1) * pixels * channels],
                    alphas: v_alphas.map(|a| &a[i * pixels..(i + 1) * pixels]),
                };
                composite::backward(&input, &views[i].composited, &cotangents, wanted)
            };
            let cameras = frame.cameras.iter().enumerate();
            cameras.map(backward).collect::<Result<_, Error>>()
        })
    })?;
    let work = outs
        .iter()
        .fold(Work::default(), |sum, out| sum.plus(out.work));
    let means2d = join(&mut outs, |out| &mut out.means2d);
    let whitened = join(&mut outs, |out| &mut out.whitened);
    let opacities = join(&mut outs, |out| &mut out.opacities);
    let absolutes = join(&mut outs, |out| &mut out.absolute);
    let v_colors = join(&mut outs, |out| &mut out.colors);
    let v_background = join(&mut outs, |out| &mut out.background);
    Ok((
        geometry.then(|| means2d.into_pyarray(py)),
        geometry.then(|| whitened.into_pyarray(py)),
        geometry.then(|| opacities.into_pyarray(py)),
        (geometry && absolute).then(|| absolutes.into_pyarray(py)),
        want_colors.then(|| v_colors.into_pyarray(py)),
        background.then(|| v_background.into_pyarray(py)),
        work.entries().collect(),
    ))
}

/// Use this many threads from now on; results do not depend on it.
#[pyfunction]
fn set_num_threads(threads: usize) -> PyResult<()> {
    Ok(threads::set(threads)?)
}

/// Number of threads in use.
#[pyfunction]
fn get_num_threads() -> usize {
    threads::get()
}

/// Address of the first element of an array as the crate sees it, to test that nothing is copied.
#[pyfunction]
fn data_pointer(array: &Bound<'_, PyAny>) -> PyResult<usize> {
    if is_f32(array) {
        Ok(Array::<f32>::new("array", array)?.slice()?.as_ptr() as usize)
    } else {
        Ok(Array::<f64>::new("array", array)?.slice()?.as_ptr() as usize)
    }
}

/// The extension module `hqgs._rust`.
#[pymodule]
fn _rust(m: &Bound<'_, PyModule>) -> PyResult<()> {
    keep_freed_memory();
    m.add_class::<Frame>()?;
    m.add_class::<Composite>()?;
    m.add_function(wrap_pyfunction!(project_forward, m)?)?;
    m.add_function(wrap_pyfunction!(project_backward, m)?)?;
    m.add_function(wrap_pyfunction!(composite_forward, m)?)?;
    m.add_function(wrap_pyfunction!(composite_backward, m)?)?;
    m.add_function(wrap_pyfunction!(set_num_threads, m)?)?;
    m.add_function(wrap_pyfunction!(get_num_threads, m)?)?;
    m.add_function(wrap_pyfunction!(data_pointer, m)?)?;
    crate::python_loss::register(m)?;
    crate::python_pictures::register(m)?;
    crate::python_weights::register(m)
}
