//! The binding of the blending weights.

use crate::threads;
use crate::{
    arrays::{Array, optional_of_shape},
    error::BindingResult,
    project::Frame,
};
use hqgs::internals::{
    Error,
    composite::{self, CompositeInput},
    simd::Real,
    tiles,
};
use numpy::{Element, IntoPyArray};
use pyo3::prelude::*;

/// Add the function of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(blending_weights, m)?)
}

/// `composite::max_weights` of each camera of a frame, flat [C, N], computed in float64 or in float32. `mask`: uint8
/// [C, H, W], not 0 in the pixels that count.
#[pyfunction]
fn blending_weights<'py>(
    frame: &Bound<'py, Frame>,
    mask: Option<&Bound<'py, PyAny>>,
    double: bool,
) -> BindingResult<Bound<'py, PyAny>> {
    if double {
        blending_weights_as::<f64>(frame, mask)
    } else {
        blending_weights_as::<f32>(frame, mask)
    }
}

fn blending_weights_as<'py, T: Real + Element>(
    frame: &Bound<'py, Frame>,
    mask: Option<&Bound<'py, PyAny>>,
) -> BindingResult<Bound<'py, PyAny>> {
    let py = frame.py();
    let frame = &frame.get().0;
    let (cameras, projections) = (&frame.cameras, &frame.projections);
    let size = cameras.first().map_or([0; 2], |c| [c.height(), c.width()]);
    // Not bool: its bytes are 0 or 1 to Rust, and an array that is a view of another type may hold others.
    let mask = optional_of_shape::<u8>("mask", mask, &[cameras.len(), size[0], size[1]])?;
    let mask = mask.as_ref().map(Array::slice).transpose()?;
    let pixels = size[0] * size[1];
    let out = py.detach(|| {
        threads::install(|| -> Result<_, Error> {
            let mut out = Vec::new();
            for (i, (camera, projection)) in cameras.iter().zip(projections).enumerate() {
                let input = CompositeInput::<T> {
                    projection,
                    tiles: &tiles::bin(projection, &[], 0, camera)?,
                    camera,
                    background: None,
                };
                let mask = mask.map(|m| &m[i * pixels..(i + 1) * pixels]);
                out.extend(composite::max_weights(&input, mask)?);
            }
            Ok(out)
        })
    })??;
    Ok(out.into_pyarray(py).into_any())
}
