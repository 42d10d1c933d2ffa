//! The binding of the exposure.

use crate::{
    arrays::{AnyType, Array, Optional, by_dtype, of_type, optional_of_shape},
    error::BindingResult,
    threads,
};
use hqgs::{Error, internals::memory};
use hqgs_training::exposure::{Photograph, Sizes, Warp};
use numpy::IntoPyArray;
use pyo3::prelude::*;

/// A taken photo, for its gradient; a `Photograph<T>`.
#[pyclass(frozen, module = "hqgs._rust")]
pub(crate) struct Exposure(AnyType);

/// `Photograph::take`: (state, flat photo). `image` [h, w, 3], `size` (H, W) of the photo in its middle, `nearness`
/// [H, W] or None, `warps` [K, 3, 4] of float64, `gains` [3] of float64.
#[pyfunction]
pub(crate) fn exposure_forward<'py>(
    image: &Bound<'py, PyAny>,
    size: [usize; 2],
    nearness: Optional<'_, 'py>,
    warps: &Bound<'py, PyAny>,
    gains: [f64; 3],
) -> BindingResult<(Exposure, Bound<'py, PyAny>)> {
    let py = image.py();
    by_dtype!(T, "image", image, {
        let image = Array::<T>::new("image", image)?;
        let rows = image.shape().first().copied().unwrap_or(0);
        let margin = rows.saturating_sub(size[0]) / 2;
        let [height, width] = size.map(|side| side.saturating_add(2 * margin));
        let image = image.of_shape(&[height, width, 3])?;
        let nearness = optional_of_shape::<T>("nearness", nearness, &size)?;
        let warps = Array::<f64>::new("warps", warps)?;
        let &[_, 3, 4] = warps.shape() else {
            let got = format!("{:?}", warps.shape());
            return Err(Error::shape("warps", "[K, 3, 4]", got).into());
        };
        let warps: &[Warp] = warps.slice().as_chunks().0;
        let sizes = Sizes { size, margin };
        let (image, near) = (
            image.slice(),
            nearness.as_ref().map_or(&[][..], Array::slice),
        );
        let (taken, photo) = threads::run(py, || {
            let taken = Photograph::take(sizes, image, near, warps, gains)?;
            let photo = memory::copied(&taken.photo, "photo")?;
            Ok((taken, photo))
        })?;
        Ok((Exposure(Box::new(taken)), photo.into_pyarray(py).into_any()))
    })
}

type Gradients<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>, [f64; 3]);

/// `Photograph::backward` of `v_photo` [H, W, 3]: the flat gradients of the image and of the warps, and that of the
/// gains.
#[pyfunction]
pub(crate) fn exposure_backward<'py>(
    exposure: &Bound<'py, Exposure>,
    v_photo: &Bound<'py, PyAny>,
) -> BindingResult<Gradients<'py>> {
    let py = v_photo.py();
    by_dtype!(T, "v_photo", v_photo, {
        let taken: &Photograph<T> = of_type(&exposure.get().0, "v_photo")?;
        let [height, width] = taken.size();
        let v_photo = Array::<T>::new("v_photo", v_photo)?.of_shape(&[height, width, 3])?;
        let v_photo = v_photo.slice();
        let out = threads::run(py, || taken.backward(v_photo))?;
        Ok((
            out.image.into_pyarray(py).into_any(),
            out.warps.into_flattened().into_pyarray(py).into_any(),
            out.gains,
        ))
    })
}
