//! Arrays in and out.

use crate::error::BindingResult;
use hqgs::internals::{Error, simd::Real};
use numpy::{Element, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::{exceptions::PyValueError, prelude::*};
use std::{any::Any, collections::HashMap, fmt::Display, ops::Range};

/// A borrowed C-contiguous array of known type.
pub(crate) struct Array<'py, T: Element> {
    name: &'static str,
    /// A copy: numpy's own lies in memory that another thread may free while the GIL is released, by setting
    /// the array's `shape`.
    shape: Vec<usize>,
    array: PyReadonlyArrayDyn<'py, T>,
}

impl<'py, T: Element> Array<'py, T> {
    /// Borrow `value`. rust-numpy's own `as_slice` accepts Fortran order, which would read a transposed
    /// array silently wrong, so the layout is checked here.
    pub(crate) fn new(name: &'static str, value: &Bound<'py, PyAny>) -> BindingResult<Self> {
        let array = value
            .cast::<PyArrayDyn<T>>()
            .map_err(|_| wrong_type(name, T::get_dtype(value.py()), value))?;
        if !array.is_c_contiguous() {
            return Err(PyValueError::new_err(format!(
                "{name}: must be C-contiguous, got shape {:?} with strides {:?}",
                array.shape(),
                array.strides()
            ))
            .into());
        }
        let shape = array.shape().to_vec();
        let array = array
            .try_readonly()
            .map_err(|e| PyValueError::new_err(format!("{name}: {e}")))?;
        Ok(Self { name, shape, array })
    }

    pub(crate) fn slice(&self) -> BindingResult<&[T]> {
        Ok(self.array.as_slice()?)
    }

    pub(crate) fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The array, if it has this shape.
    pub(crate) fn of_shape(self, expected: &[usize]) -> Result<Self, Error> {
        if self.shape == expected {
            return Ok(self);
        }
        let (expected, got) = (format!("{expected:?}"), format!("{:?}", self.shape));
        Err(Error::shape(self.name, expected, got))
    }

    /// The array and N, if it is [N, width].
    pub(crate) fn of_width(self, width: usize) -> Result<(Self, usize), Error> {
        match self.shape[..] {
            [n, w] if w == width => Ok((self, n)),
            _ => {
                let (expected, got) = (format!("[N, {width}]"), format!("{:?}", self.shape));
                Err(Error::shape(self.name, expected, got))
            }
        }
    }
}

fn wrong_type(name: &str, expected: impl Display, value: &Bound<'_, PyAny>) -> PyErr {
    let got = value.getattr("dtype").map_or_else(
        |_| {
            let kind = value.get_type().name();
            kind.map_or_else(|_| "another object".into(), |kind| kind.to_string())
        },
        |dtype| dtype.to_string(),
    );
    PyValueError::new_err(format!(
        "{name}: expected an array of {expected}, got {got}"
    ))
}

pub(crate) type Optional<'a, 'py> = Option<&'a Bound<'py, PyAny>>;

pub(crate) fn optional<'py, T: Element>(
    name: &'static str,
    value: Optional<'_, 'py>,
) -> BindingResult<Option<Array<'py, T>>> {
    value.map(|v| Array::new(name, v)).transpose()
}

/// An optional array that must have this shape where it is given.
pub(crate) fn optional_of_shape<'py, T: Element>(
    name: &'static str,
    value: Optional<'_, 'py>,
    expected: &[usize],
) -> BindingResult<Option<Array<'py, T>>> {
    let array = optional::<T>(name, value)?;
    Ok(array.map(|a| a.of_shape(expected)).transpose()?)
}

/// An array's name and addresses.
pub(crate) type Place = (&'static str, Range<usize>);

/// Where a slice lies.
pub(crate) fn place<T>(name: &'static str, data: &[T]) -> Place {
    let Range { start, end } = data.as_ptr_range();
    (name, start.addr()..end.addr())
}

/// Refuse memory that is written under one name and read or written under another. rust-numpy knows views of
/// one array, but two tensors over the same memory come as arrays that know nothing of each other.
pub(crate) fn check_apart(written: &[Place], read: &[Place]) -> Result<(), Error> {
    for (i, (name, a)) in written.iter().enumerate() {
        for (other, b) in written[i + 1..].iter().chain(read) {
            if a.start.max(b.start) < a.end.min(b.end) {
                let message = format!("shares memory with {name}, which is written");
                return Err(Error::new(*other, message));
            }
        }
    }
    Ok(())
}

/// Whether `value` is an array of f32; otherwise it is one of f64.
pub(crate) fn is_f32(name: &str, value: &Bound<'_, PyAny>) -> BindingResult<bool> {
    if value.cast::<PyArrayDyn<f32>>().is_ok() {
        return Ok(true);
    }
    match value.cast::<PyArrayDyn<f64>>() {
        Ok(_) => Ok(false),
        Err(_) => Err(wrong_type(name, "float32 or float64", value).into()),
    }
}

/// Room for `len` elements of what `name` says.
fn with_capacity<T>(len: usize, name: &str) -> Result<Vec<T>, Error> {
    let mut vector = Vec::new();
    match vector.try_reserve_exact(len) {
        Ok(()) => Ok(vector),
        Err(_) => Err(Error::OutOfMemory {
            name: name.into(),
            bytes: (len as u64).saturating_mul(size_of::<T>() as u64),
        }),
    }
}

/// The elements of what `name` says.
pub(crate) fn filled<T>(
    elements: impl ExactSizeIterator<Item = T>,
    name: &str,
) -> Result<Vec<T>, Error> {
    let mut vector = with_capacity(elements.len(), name)?;
    vector.extend(elements);
    Ok(vector)
}

/// A gradient to be filled, with no elements if it is not `wanted`.
pub(crate) fn gradient<T: Real>(len: usize, wanted: bool) -> Result<Vec<T>, Error> {
    let len = if wanted { len } else { 0 };
    let mut gradient = with_capacity(len, "gradient")?;
    gradient.resize(len, T::ZERO);
    Ok(gradient)
}

/// One array of every camera's outputs, one after the other, [C, ...].
pub(crate) fn join<O, T: Copy>(
    outs: &mut [O],
    array: impl Fn(&mut O) -> &mut Vec<T>,
) -> Result<Vec<T>, Error> {
    let mut parts: Vec<_> = outs
        .iter_mut()
        .map(|out| std::mem::take(array(out)))
        .collect();
    if parts.len() == 1 {
        return Ok(parts.remove(0));
    }
    let mut joined = with_capacity(parts.iter().map(Vec::len).sum(), "views")?;
    for part in parts {
        joined.extend_from_slice(&part);
    }
    Ok(joined)
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

/// Call the generic function for the dtype of the array of this name.
macro_rules! by_dtype {
    ($name:literal, $array:expr, $function:ident($($argument:expr),* $(,)?)) => {
        if $crate::arrays::is_f32($name, $array)? {
            $function::<f32>($($argument),*)
        } else {
            $function::<f64>($($argument),*)
        }
    };
}

pub(crate) use by_dtype;
