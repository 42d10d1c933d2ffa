//! The binding of the projection.

mod backward;
mod forward;

use crate::{
    arrays::{AnyType, Array, CountsByName, Scalar},
    error::BindingResult,
};
use hqgs::internals::{
    Error,
    counts::Counts,
    project::{Projection, RenderOptions},
    scene::{Camera, Gaussians},
};
use numpy::Element;
use pyo3::prelude::*;
use std::sync::Arc;

/// Add the functions and classes of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Frame>()?;
    m.add_function(wrap_pyfunction!(forward::project_forward, m)?)?;
    m.add_function(wrap_pyfunction!(forward::pictures, m)?)?;
    m.add_function(wrap_pyfunction!(backward::project_backward, m)?)
}

/// The projection of N Gaussians into C cameras.
#[pyclass(frozen, module = "hqgs._rust")]
pub(crate) struct Frame(pub(crate) Arc<Projections>);

/// What a [`Frame`] is; it lives as long as what was made from it.
pub(crate) struct Projections {
    pub(crate) cameras: Vec<Camera>,
    pub(crate) projections: Vec<Projection>,
    options: RenderOptions,
    pub(crate) n: usize,
    /// Whether each camera has harmonics of its own.
    harmonics_of_each: bool,
    /// Of each camera; a `Vec<Option<Shading<T>>>`.
    shadings: AnyType,
    counts: Counts,
}

#[pymethods]
impl Frame {
    /// Image width in pixels.
    #[getter]
    fn width(&self) -> usize {
        self.0.cameras.first().map_or(0, |c| c.width())
    }

    /// Image height in pixels.
    #[getter]
    fn height(&self) -> usize {
        self.0.cameras.first().map_or(0, |c| c.height())
    }

    /// Counts of the projection.
    #[getter]
    fn counts(&self) -> CountsByName {
        self.0.counts.entries().collect()
    }
}

/// The borrowed arrays of the Gaussians.
struct Arrays<'py, T: Element> {
    means: Array<'py, T>,
    quats: Array<'py, T>,
    scales: Array<'py, T>,
    opacities: Array<'py, T>,
}

impl<'py, T: Scalar> Arrays<'py, T> {
    /// Arrays of as many Gaussians as there are means.
    fn new([means, quats, scales, opacities]: [&Bound<'py, PyAny>; 4]) -> BindingResult<Self> {
        let (means, n) = Array::new("means", means)?.of_width(3)?;
        Ok(Self {
            means,
            quats: Array::new("quats", quats)?.of_shape(&[n, 4])?,
            scales: Array::new("scales", scales)?.of_shape(&[n, 3])?,
            opacities: Array::new("opacities", opacities)?.of_shape(&[n])?,
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

/// Colours as channels, one set for all cameras or one each: the data and the number of channels.
pub(crate) fn channels_of<'a, T: Scalar>(
    colors: &'a Array<'_, T>,
    n: usize,
    cameras: usize,
) -> BindingResult<(&'a [T], usize)> {
    match *colors.shape() {
        [given, channels] if given == n => Ok((colors.slice()?, channels)),
        [c, given, channels] if (c, given) == (cameras, n) => Ok((colors.slice()?, channels)),
        ref shape => {
            let expected = format!("[{n}, D] or [{cameras}, {n}, D]");
            Err(Error::shape("colors", expected, format!("{shape:?}")).into())
        }
    }
}

/// Colours of camera `i`: one set for all cameras, or one each.
pub(crate) fn of_camera<T>(data: &[T], i: usize, len: usize) -> &[T] {
    if data.len() == len {
        data
    } else {
        &data[i * len..(i + 1) * len]
    }
}
