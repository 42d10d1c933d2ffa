//! The binding of the tile lists and of compositing.

use crate::{
    arrays::{AnyType, Array, CountsByName, Optional, Scalar, by_dtype, join, of_type, optional},
    error::BindingResult,
    project::{Frame, check_colors, of_camera},
};
use hqgs::{
    Error,
    composite::{self, CompositeCotangents, CompositeInput, Composited},
    counts::Counts,
    threads,
    tiles::{self, Tiles},
};
use numpy::IntoPyArray;
use pyo3::{IntoPyObjectExt, prelude::*};
use std::time::Instant;

/// Add the functions and classes of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Composite>()?;
    m.add_function(wrap_pyfunction!(composite_forward, m)?)?;
    m.add_function(wrap_pyfunction!(composite_backward, m)?)
}

/// Tile lists and replay state of a composited frame.
#[pyclass(frozen, module = "hqgs._rust")]
struct Composite {
    /// Of each camera; a `Vec<View<T>>`.
    views: AnyType,
    counts: Counts,
    bin_seconds: f64,
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
        (
            self.counts.pairs,
            self.counts.blocks,
            self.counts.changed_blocks,
        )
    }

    /// Wall-clock seconds that the tile lists took.
    #[getter]
    fn bin_seconds(&self) -> f64 {
        self.bin_seconds
    }

    /// (Gaussian, pixel) pairs that were blended.
    #[getter]
    fn blended(&self) -> u64 {
        self.counts.blended
    }

    /// Counts of the forward pass.
    #[getter]
    fn counts(&self) -> CountsByName {
        self.counts.entries().collect()
    }
}

fn check_inputs<T>(
    frame: &Frame,
    colors: &[T],
    background: Option<&[T]>,
    channels: usize,
) -> Result<(), Error> {
    let (n, c) = (frame.n, frame.cameras.len());
    check_colors(colors, n, c, channels)?;
    match background {
        Some(b) if b.len() != c * channels => {
            let (expected, got) = (
                format!("[{c}, {channels}]"),
                format!("{} elements", b.len()),
            );
            Err(Error::shape("backgrounds", expected, got))
        }
        _ => Ok(()),
    }
}

/// Bin and composite a frame.
#[pyfunction]
#[pyo3(signature = (frame, colors, backgrounds, channels))]
fn composite_forward<'py>(
    frame: &Bound<'py, Frame>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    channels: usize,
) -> BindingResult<Bound<'py, PyAny>> {
    by_dtype!(colors, composite_as(frame, colors, backgrounds, channels))
}

fn composite_as<'py, T: Scalar>(
    frame: &Bound<'py, Frame>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    channels: usize,
) -> BindingResult<Bound<'py, PyAny>> {
    let py = colors.py();
    let frame = frame.get();
    let colors = Array::<T>::new("colors", colors)?;
    let backgrounds = optional::<T>("backgrounds", backgrounds)?;
    let colors = colors.slice()?;
    let backgrounds = backgrounds.as_ref().map(Array::slice).transpose()?;
    check_inputs(frame, colors, backgrounds, channels)?;
    let (state, image, alphas) = py.detach(|| {
        threads::install(|| -> Result<_, Error> {
            let (mut images, mut alphas) = (Vec::new(), Vec::new());
            let (mut views, mut total, mut bin_seconds) = (Vec::new(), Counts::default(), 0.0);
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
                total = total.plus(view.counts);
                images.push(view.image);
                alphas.push(view.alphas);
                let composited = view.composited;
                views.push(View { tiles, composited });
            }
            Ok((
                Composite {
                    views: Box::new(views),
                    counts: total,
                    bin_seconds,
                },
                join(&mut images, |image| image),
                join(&mut alphas, |alphas| alphas),
            ))
        })
    })?;
    let out = (state, image.into_pyarray(py), alphas.into_pyarray(py));
    Ok(out.into_bound_py_any(py)?)
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
) -> BindingResult<Bound<'py, PyAny>> {
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

fn composite_backward_as<'py, T: Scalar>(
    frame: &Bound<'py, Frame>,
    composite: &Bound<'py, Composite>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    v_image: &Bound<'py, PyAny>,
    v_alphas: Optional<'_, 'py>,
    channels: usize,
    wanted: [bool; 4],
) -> BindingResult<Bound<'py, PyAny>> {
    let py = colors.py();
    let (frame, composite) = (frame.get(), composite.get());
    let views = of_type::<Vec<View<T>>>(&composite.views, "colors")?;
    let colors = Array::<T>::new("colors", colors)?;
    let backgrounds = optional::<T>("backgrounds", backgrounds)?;
    let v_image = Array::<T>::new("v_render_colors", v_image)?;
    let v_alphas = optional::<T>("v_render_alphas", v_alphas)?;
    let colors = colors.slice()?;
    let backgrounds = backgrounds.as_ref().map(Array::slice).transpose()?;
    check_inputs(frame, colors, backgrounds, channels)?;
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
    let counts = outs
        .iter()
        .fold(Counts::default(), |sum, out| sum.plus(out.counts));
    let means2d = join(&mut outs, |out| &mut out.means2d);
    let whitened = join(&mut outs, |out| &mut out.whitened);
    let opacities = join(&mut outs, |out| &mut out.opacities);
    let absolutes = join(&mut outs, |out| &mut out.absolute);
    let v_colors = join(&mut outs, |out| &mut out.colors);
    let v_background = join(&mut outs, |out| &mut out.background);
    let out = (
        geometry.then(|| means2d.into_pyarray(py)),
        geometry.then(|| whitened.into_pyarray(py)),
        geometry.then(|| opacities.into_pyarray(py)),
        (geometry && absolute).then(|| absolutes.into_pyarray(py)),
        want_colors.then(|| v_colors.into_pyarray(py)),
        background.then(|| v_background.into_pyarray(py)),
        counts.entries().collect::<CountsByName>(),
    );
    Ok(out.into_bound_py_any(py)?)
}
