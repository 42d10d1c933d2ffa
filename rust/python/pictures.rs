//! The binding of the operators on pictures.

use crate::{
    arrays::{Array, by_dtype, gradient, is_f32},
    error::BindingResult,
    threads,
};
use hqgs::{Error, Real};
use hqgs_training::{
    jpeg_cells,
    separable::{self, Dense},
};
use numpy::{Element, IntoPyArray};
use pyo3::prelude::*;

/// The operator and its transpose, for either dtype.
#[pyclass(frozen, module = "hqgs._rust")]
pub(crate) struct Separable {
    single: (separable::Separable<f32>, separable::Separable<f32>),
    double: (separable::Separable<f64>, separable::Separable<f64>),
}

/// A borrowed matrix.
fn dense<'a>(name: &'static str, matrix: &'a Array<f64>) -> BindingResult<Dense<'a>> {
    let &[height, width] = matrix.shape() else {
        let got = format!("{:?}", matrix.shape());
        return Err(Error::shape(name, "[height, width]", got).into());
    };
    Ok(Dense {
        weights: matrix.slice(),
        height,
        width,
    })
}

#[pymethods]
impl Separable {
    /// From dense matrices of float64: `rows` [h, H], `columns` [w, W], `channels` [D, C] or None.
    #[new]
    fn new(
        rows: &Bound<'_, PyAny>,
        columns: &Bound<'_, PyAny>,
        channels: Option<&Bound<'_, PyAny>>,
    ) -> BindingResult<Self> {
        let (rows, columns) = (Array::new("rows", rows)?, Array::new("columns", columns)?);
        let channels = channels.map(|m| Array::new("channels", m)).transpose()?;
        let (rows, columns) = (dense("rows", &rows)?, dense("columns", &columns)?);
        let channels = channels
            .as_ref()
            .map(|m| dense("channels", m))
            .transpose()?;
        Ok(Self {
            single: separable::Separable::pair(rows, columns, channels)?,
            double: separable::Separable::pair(rows, columns, channels)?,
        })
    }

    /// Height and width of what comes out.
    #[getter]
    fn size(&self) -> (usize, usize) {
        let [height, width] = self.single.0.size();
        (height, width)
    }

    /// The picture, flat, from `image` [H, W, C]; with `transposed` the other way round.
    fn apply<'py>(
        &self,
        image: &Bound<'py, PyAny>,
        transposed: bool,
    ) -> BindingResult<Bound<'py, PyAny>> {
        if is_f32("image", image)? {
            apply(of_two(&self.single, transposed), image)
        } else {
            apply(of_two(&self.double, transposed), image)
        }
    }

    /// `apply` of the operator whose weights are the absolute values, on float32.
    fn apply_absolute<'py>(&self, image: &Bound<'py, PyAny>) -> BindingResult<Bound<'py, PyAny>> {
        apply(&self.single.0.absolute(), image)
    }
}

fn of_two<O>((straight, turned): &(O, O), transposed: bool) -> &O {
    if transposed { turned } else { straight }
}

fn apply<'py, T: Real + Element>(
    operator: &separable::Separable<T>,
    image: &Bound<'py, PyAny>,
) -> BindingResult<Bound<'py, PyAny>> {
    let py = image.py();
    let image = Array::<T>::new("image", image)?;
    let (data, shape) = (image.slice(), image.shape());
    let out = threads::run(py, || operator.apply(data, shape))?;
    Ok(out.into_pyarray(py).into_any())
}

type Distance<'py> = (f64, Option<Bound<'py, PyAny>>);

/// `jpeg_cells::distance`: the value and, if wanted, the flat gradient.
#[pyfunction]
pub(crate) fn cell_distance<'py>(
    x: &Bound<'py, PyAny>,
    centres: &Bound<'py, PyAny>,
    widths: &Bound<'py, PyAny>,
    scale: f64,
    want_grad: bool,
) -> BindingResult<Distance<'py>> {
    let py = x.py();
    by_dtype!(T, "x", x, {
        let x = Array::<T>::new("x", x)?;
        let centres = Array::<T>::new("centres", centres)?.of_shape(x.shape())?;
        let widths = Array::<T>::new("widths", widths)?.of_shape(x.shape())?;
        let (x, centres, widths) = (x.slice(), centres.slice(), widths.slice());
        let mut grad = gradient::<T>(py, x.len(), want_grad)?;
        let out = want_grad.then_some(&mut grad[..]);
        let value = threads::run(py, || jpeg_cells::distance(x, centres, widths, scale, out))?;
        Ok((value, want_grad.then(|| grad.into_pyarray(py).into_any())))
    })
}
