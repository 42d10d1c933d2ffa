//! The binding of the projection.

pub(crate) mod backward;
pub(crate) mod forward;

use crate::{
    arrays::{AnyType, Array, Scalar},
    error::BindingResult,
};
use hqgs::internals::{
    project::{Projection, RenderOptions},
    scene::{Camera, Gaussians},
};
use numpy::Element;
use pyo3::prelude::*;
use std::sync::Arc;

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
    kept: usize,
}

impl Projections {
    /// Width and height of the images.
    pub(crate) fn size(&self) -> [usize; 2] {
        let first = self.cameras.first();
        first.map_or([0; 2], |camera| [camera.width(), camera.height()])
    }
}

#[pymethods]
impl Frame {
    /// Image width in pixels.
    #[getter]
    fn width(&self) -> usize {
        self.0.size()[0]
    }

    /// Image height in pixels.
    #[getter]
    fn height(&self) -> usize {
        self.0.size()[1]
    }

    /// How many pairs of Gaussian and camera were kept; the others are culled.
    #[getter]
    fn projected(&self) -> usize {
        self.0.kept
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

    fn gaussians(&self) -> Gaussians<'_, T> {
        Gaussians {
            means: self.means.slice(),
            quats: self.quats.slice(),
            scales: self.scales.slice(),
            opacities: self.opacities.slice(),
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
