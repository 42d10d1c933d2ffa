//! Arrays in and out.

use crate::error::BindingResult;
use hqgs::{Error, simd::Real};
use numpy::{Element, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::{exceptions::PyValueError, prelude::*};
use std::{any::Any, collections::HashMap};

/// A borrowed C-contiguous array of known type.
pub(crate) struct Array<'py, T: Element>(PyReadonlyArrayDyn<'py, T>);

impl<'py, T: Element> Array<'py, T> {
    /// Borrow `value`. rust-numpy's own `as_slice` accepts Fortran order, which would read a transposed
    /// array silently wrong, so the layout is checked here.
    pub(crate) fn new(name: &str, value: &Bound<'py, PyAny>) -> BindingResult<Self> {
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
            ))
            .into());
        }
        Ok(Self(array.try_readonly().map_err(|e| {
            PyValueError::new_err(format!("{name}: {e}"))
        })?))
    }

    pub(crate) fn slice(&self) -> BindingResult<&[T]> {
        Ok(self.0.as_slice()?)
    }

    pub(crate) fn shape(&self) -> &[usize] {
        self.0.shape()
    }
}

pub(crate) type Optional<'a, 'py> = Option<&'a Bound<'py, PyAny>>;

pub(crate) fn optional<'py, T: Element>(
    name: &str,
    value: Optional<'_, 'py>,
) -> BindingResult<Option<Array<'py, T>>> {
    value.map(|v| Array::new(name, v)).transpose()
}

/// Whether `value` is an array of f32 (otherwise it must be of f64).
pub(crate) fn is_f32(value: &Bound<'_, PyAny>) -> bool {
    value.cast::<PyArrayDyn<f32>>().is_ok()
}

/// One array of every camera's outputs, one after the other, [C, ...].
pub(crate) fn join<O, T: Copy>(outs: &mut [O], array: impl Fn(&mut O) -> &mut Vec<T>) -> Vec<T> {
    let mut parts: Vec<_> = outs
        .iter_mut()
        .map(|out| std::mem::take(array(out)))
        .collect();
    match parts.len() {
        1 => parts.remove(0),
        _ => parts.concat(),
    }
}

/// Something for one of the scalar types.
pub(crate) type AnyType = Box<dyn Any + Send + Sync>;

/// What was stored for type T.
pub(crate) fn of_type<'a, V: 'static>(stored: &'a AnyType, name: &str) -> BindingResult<&'a V> {
    stored
        .downcast_ref()
        .ok_or_else(|| Error::new(name, "dtype differs from the forward pass").into())
}

/// The counts of [`Counts`] by name.
pub(crate) type CountsByName = HashMap<&'static str, u64>;

/// A scalar type that the binding offers.
pub(crate) trait Scalar: Real + Element {}
impl Scalar for f32 {}
impl Scalar for f64 {}

/// Call the generic function for the dtype of an array.
macro_rules! by_dtype {
    ($array:expr, $function:ident($($argument:expr),* $(,)?)) => {
        if $crate::arrays::is_f32($array) {
            $function::<f32>($($argument),*)
        } else {
            $function::<f64>($($argument),*)
        }
    };
}

pub(crate) use by_dtype;
