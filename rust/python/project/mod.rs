//! The binding of the projection.

mod backward;
mod forward;

use crate::{
    arrays::{AnyType, Array, CountsByName, Scalar},
    error::BindingResult,
};
use hqgs::{
    Error,
    counts::Counts,
    project::{ProjectOptions, Projection},
    scene::{Camera, Gaussians},
};
use numpy::Element;
use pyo3::prelude::*;

/// Add the functions and classes of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Frame>()?;
    m.add_function(wrap_pyfunction!(forward::project_forward, m)?)?;
    m.add_function(wrap_pyfunction!(backward::project_backward, m)?)
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
