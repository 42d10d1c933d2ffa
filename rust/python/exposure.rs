//! The binding of the exposure.

use crate::threads;
use crate::{
    arrays::{AnyType, Array, Scalar, by_dtype, filled, of_type, optional_of_shape},
    error::BindingResult,
};
use hqgs::Error;
use hqgs_training::exposure::{Light, Photograph, Sizes, Warp};
use numpy::IntoPyArray;
use pyo3::prelude::*;

/// Add the functions and classes of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Exposure>()?;
    m.add_function(wrap_pyfunction!(exposure_forward, m)?)?;
    m.add_function(wrap_pyfunction!(exposure_backward, m)?)
}

/// A taken photo, for its gradient; a `Photograph<T>`.
#[pyclass(frozen, module = "hqgs._rust")]
struct Exposure {
    taken: AnyType,
}

/// `Photograph::take`: (state, flat photo). `image` [h, w, 3], `size` (H, W) of the photo in its middle, `nearness`
/// [H, W] or None, `warps` [K, 3, 4] of float64, `gains` [3] of float64.
#[pyfunction]
fn exposure_forward<'py>(
    image: &Bound<'py, PyAny>,
    size: [usize; 2],
    nearness: Option<&Bound<'py, PyAny>>,
    warps: &Bound<'py, PyAny>,
    gains: [f64; 3],
) -> BindingResult<(Exposure, Bound<'py, PyAny>)> {
    by_dtype!(
        "image",
        image,
        forward_as(image, size, nearness, warps, gains)
    )
}

fn forward_as<'py, T: Scalar + Light>(
    image: &Bound<'py, PyAny>,
    size: [usize; 2],
    nearness: Option<&Bound<'py, PyAny>>,
    warps: &Bound<'py, PyAny>,
    gains: [f64; 3],
) -> BindingResult<(Exposure, Bound<'py, PyAny>)> {
    let py = image.py();
    let image = Array::<T>::new("image", image)?;
    let margin = image
        .shape()
        .first()
        .copied()
        .unwrap_or(0)
        .saturating_sub(size[0])
        / 2;
    let [height, width] = size.map(|side| side.saturating_add(2 * margin));
    let image = image.of_shape(&[height, width, 3])?;
    let nearness = optional_of_shape::<T>("nearness", nearness, &size)?;
    let warps = Array::<f64>::new("warps", warps)?;
    let &[_, 3, 4] = warps.shape() else {
        let got = format!("{:?}", warps.shape());
        return Err(Error::shape("warps", "[K, 3, 4]", got).into());
    };
    let warps: &[Warp] = warps.slice()?.as_chunks().0;
    let sizes = Sizes { size, margin };
    let (image, near) = (
        image.slice()?,
        nearness
            .as_ref()
            .map(Array::slice)
            .transpose()?
            .unwrap_or(&[]),
    );
    let (taken, photo) = py.detach(|| {
        threads::install(|| -> Result<_, Error> {
            let taken = Photograph::<T>::take(sizes, image, near, warps, gains)?;
            let photo = filled(taken.photo.iter().copied(), "photo")?;
            Ok((taken, photo))
        })
    })??;
    let photo = photo.into_pyarray(py).into_any();
    Ok((
        Exposure {
            taken: Box::new(taken),
        },
        photo,
    ))
}

type Gradients<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>, [f64; 3]);

/// `Photograph::backward` of `v_photo` [H, W, 3]: the flat gradients of the image and of the warps, and that of the
/// gains.
#[pyfunction]
fn exposure_backward<'py>(
    exposure: &Bound<'py, Exposure>,
    v_photo: &Bound<'py, PyAny>,
) -> BindingResult<Gradients<'py>> {
    by_dtype!("v_photo", v_photo, backward_as(exposure, v_photo))
}

fn backward_as<'py, T: Scalar + Light>(
    exposure: &Bound<'py, Exposure>,
    v_photo: &Bound<'py, PyAny>,
) -> BindingResult<Gradients<'py>> {
    let py = v_photo.py();
    let taken: &Photograph<T> = of_type(&exposure.get().taken, "v_photo")?;
    let [height, width] = taken.size();
    let v_photo = Array::<T>::new("v_photo", v_photo)?.of_shape(&[height, width, 3])?;
    let v_photo = v_photo.slice()?;
    let out = py.detach(|| threads::install(|| taken.backward(v_photo)))??;
    Ok((
        out.image.into_pyarray(py).into_any(),
        out.warps.into_flattened().into_pyarray(py).into_any(),
        out.gains,
    ))
}
