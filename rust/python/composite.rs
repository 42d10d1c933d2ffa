//! The binding of the tile lists and of compositing.

use crate::threads;
use crate::{
    arrays::{
        AnyType, Array, CountsByName, Optional, Scalar, by_dtype, join, of_type, optional_of_shape,
    },
    error::BindingResult,
    project::{Frame, Projections, channels_of, of_camera},
};
use hqgs::internals::{
    Error,
    composite::{self, CompositeCotangents, CompositeInput, Composited},
    counts::Counts,
    tiles::Tiles,
};
use numpy::IntoPyArray;
use pyo3::{IntoPyObjectExt, prelude::*};
use std::sync::Arc;

/// Add the functions and classes of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Composite>()?;
    m.add_function(wrap_pyfunction!(composite_forward, m)?)?;
    m.add_function(wrap_pyfunction!(composite_backward, m)?)
}

/// Tile lists and replay state of a composited frame.
#[pyclass(frozen, module = "hqgs._rust")]
struct Composite {
    /// What was composited: another frame's splats would not be those of the tile lists.
    frame: Arc<Projections>,
    channels: usize,
    /// Of each camera; a `Vec<View<T>>`.
    views: AnyType,
    counts: Counts,
    bin_seconds: f64,
}

impl Drop for Composite {
    /// To free thousands of lists takes a while, in which the caller need not wait.
    fn drop(&mut self) {
        let views = std::mem::replace(&mut self.views, Box::new(()));
        threads::spawn(move || drop(views));
    }
}

/// One camera's tile lists and replay state.
type View<T> = (Tiles<T>, Composited<T>);

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

/// Bin and composite a frame.
#[pyfunction]
#[pyo3(signature = (frame, colors, backgrounds, channels))]
fn composite_forward<'py>(
    frame: &Bound<'py, Frame>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    channels: usize,
) -> BindingResult<Bound<'py, PyAny>> {
    by_dtype!(
        "colors",
        colors,
        composite_as(frame, colors, backgrounds, channels)
    )
}

fn composite_as<'py, T: Scalar>(
    frame: &Bound<'py, Frame>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    channels: usize,
) -> BindingResult<Bound<'py, PyAny>> {
    let py = colors.py();
    let frame = &frame.get().0;
    let c = frame.cameras.len();
    let colors = Array::<T>::new("colors", colors)?;
    let shape = colors.shape();
    let (colors, given) = channels_of(&colors, frame.n, c)?;
    if given != channels {
        let n = frame.n;
        let expected = format!("[{n}, {channels}] or [{c}, {n}, {channels}]");
        return Err(Error::shape("colors", expected, format!("{shape:?}")).into());
    }
    let backgrounds = optional_of_shape::<T>("backgrounds", backgrounds, &[c, channels])?;
    let backgrounds = backgrounds.as_ref().map(Array::slice).transpose()?;
    let (state, image, alphas) = py.detach(|| {
        threads::install(|| -> Result<_, Error> {
            let (mut images, mut alphas) = (Vec::new(), Vec::new());
            let (mut views, mut total, mut bin_seconds) = (Vec::new(), Counts::default(), 0.0);
            for (i, (camera, projection)) in
                frame.cameras.iter().zip(&frame.projections).enumerate()
            {
                let view = composite::forward(
                    projection,
                    of_camera(colors, i, frame.n * channels),
                    channels,
                    camera,
                    backgrounds.map(|b| &b[i * channels..(i + 1) * channels]),
                )?;
                bin_seconds += view.bin_seconds;
                total = total.plus(view.counts);
                images.push(view.image);
                alphas.push(view.alphas);
                views.push((view.tiles, view.composited));
            }
            Ok((
                Composite {
                    frame: Arc::clone(frame),
                    channels,
                    views: Box::new(views),
                    counts: total,
                    bin_seconds,
                },
                join(&mut images, |image| image)?,
                join(&mut alphas, |alphas| alphas)?,
            ))
        })
    })??;
    let out = (state, image.into_pyarray(py), alphas.into_pyarray(py));
    Ok(out.into_bound_py_any(py)?)
}

/// VJP of `composite_forward`. `wanted`: geometry, absolute, colors, backgrounds.
#[pyfunction]
#[pyo3(signature = (composite, backgrounds, v_image, v_alphas, wanted))]
fn composite_backward<'py>(
    composite: &Bound<'py, Composite>,
    backgrounds: Optional<'_, 'py>,
    v_image: &Bound<'py, PyAny>,
    v_alphas: Optional<'_, 'py>,
    wanted: [bool; 4],
) -> BindingResult<Bound<'py, PyAny>> {
    by_dtype!(
        "v_image",
        v_image,
        composite_backward_as(composite, backgrounds, v_image, v_alphas, wanted)
    )
}

fn composite_backward_as<'py, T: Scalar>(
    composite: &Bound<'py, Composite>,
    backgrounds: Optional<'_, 'py>,
    v_image: &Bound<'py, PyAny>,
    v_alphas: Optional<'_, 'py>,
    wanted: [bool; 4],
) -> BindingResult<Bound<'py, PyAny>> {
    let py = composite.py();
    let composite = composite.get();
    let (frame, channels) = (&composite.frame, composite.channels);
    let views = of_type::<Vec<View<T>>>(&composite.views, "v_image")?;
    let c = frame.cameras.len();
    let [width, height] = frame
        .cameras
        .first()
        .map_or([0; 2], |c| [c.width(), c.height()]);
    let pixels = width * height;
    let backgrounds = optional_of_shape::<T>("backgrounds", backgrounds, &[c, channels])?;
    let v_image = Array::<T>::new("v_image", v_image)?.of_shape(&[c, height, width, channels])?;
    let v_alphas = optional_of_shape::<T>("v_alphas", v_alphas, &[c, height, width, 1])?;
    let backgrounds = backgrounds.as_ref().map(Array::slice).transpose()?;
    let v_image = v_image.slice()?;
    let v_alphas = v_alphas.as_ref().map(Array::slice).transpose()?;
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
                    tiles: &views[i].0,
                    camera,
                    background: backgrounds.map(|b| &b[i * channels..(i + 1) * channels]),
                };
                let cotangents = CompositeCotangents {
                    image: &v_image[i * pixels * channels..(i + 1) * pixels * channels],
                    alphas: v_alphas.map(|a| &a[i * pixels..(i + 1) * pixels]),
                };
                composite::backward(&input, &views[i].1, &cotangents, wanted)
            };
            let cameras = frame.cameras.iter().enumerate();
            cameras.map(backward).collect::<Result<_, Error>>()
        })
    })??;
    let counts = outs
        .iter()
        .fold(Counts::default(), |sum, out| sum.plus(out.counts));
    let means2d = join(&mut outs, |out| &mut out.means2d)?;
    let whitened = join(&mut outs, |out| &mut out.whitened)?;
    let opacities = join(&mut outs, |out| &mut out.opacities)?;
    let absolutes = join(&mut outs, |out| &mut out.absolute)?;
    let v_colors = join(&mut outs, |out| &mut out.colors)?;
    let v_background = join(&mut outs, |out| &mut out.background)?;
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
