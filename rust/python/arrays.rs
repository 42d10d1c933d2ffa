//! Arrays in and out. They come in as [`Array`] or [`ArrayMut`] alone, which check all that can be wrong with them,
//! overlaps among them.

use crate::{error::BindingResult, threads};
use hqgs::internals::{Error, memory::with_capacity, simd::Real, uninit::zeros};
use numpy::{
    Element, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyReadwriteArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::{exceptions::PyValueError, prelude::*};
use std::{
    any::Any,
    fmt::Display,
    ops::Range,
    process,
    sync::{Arc, Mutex, PoisonError, Weak},
};

/// A borrowed C-contiguous array of known type.
///
/// Python can still write to the memory while the GIL is released, as any thread can that has a view of it; nothing
/// here can prevent that. What this file does prevent is that calls of the binding do.
pub(crate) struct Borrowed<A> {
    claim: Arc<Claim>,
    /// A copy: numpy's own lies in memory that another thread may free while the GIL is released, by setting
    /// the array's `shape`.
    shape: Vec<usize>,
    array: A,
}

/// One to read, and one to write.
pub(crate) type Array<'py, T> = Borrowed<PyReadonlyArrayDyn<'py, T>>;
pub(crate) type ArrayMut<'py, T> = Borrowed<PyReadwriteArrayDyn<'py, T>>;

impl<'py, T: Element> Array<'py, T> {
    /// Borrow `value`, unless it cannot be read as it is or is being written.
    pub(crate) fn new(name: &'static str, value: &Bound<'py, PyAny>) -> BindingResult<Self> {
        Self::claimed(name, value, false, |array| {
            array.try_readonly().map_err(|e| refused(name, e))
        })
    }

    pub(crate) fn slice(&self) -> &[T] {
        self.array
            .as_slice()
            .expect("contiguous, as `as_it_is` checks")
    }
}

impl<'py, T: Element> ArrayMut<'py, T> {
    /// Borrow `value`, unless it cannot be written as it is or is in use.
    pub(crate) fn new(name: &'static str, value: &Bound<'py, PyAny>) -> BindingResult<Self> {
        Self::claimed(name, value, true, |array| {
            array.try_readwrite().map_err(|e| refused(name, e))
        })
    }

    pub(crate) fn slice(&mut self) -> &mut [T] {
        let slice = self.array.as_slice_mut();
        slice.expect("contiguous, as `as_it_is` checks")
    }
}

impl<A> Borrowed<A> {
    fn claimed<'py, T: Element>(
        name: &'static str,
        value: &Bound<'py, PyAny>,
        written: bool,
        borrow: impl FnOnce(&Bound<'py, PyArrayDyn<T>>) -> PyResult<A>,
    ) -> BindingResult<Self> {
        let array = as_it_is::<T>(name, value)?;
        Ok(Self {
            claim: Claim::new(name, array, written)?,
            shape: array.shape().to_vec(),
            array: borrow(array)?,
        })
    }

    pub(crate) fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The array, if it has this shape.
    pub(crate) fn of_shape(self, expected: &[usize]) -> Result<Self, Error> {
        if self.shape == expected {
            return Ok(self);
        }
        Err(self.wrong(&format!("{expected:?}")))
    }

    /// The array and N, if it is [N, width].
    pub(crate) fn of_width(self, width: usize) -> Result<(Self, usize), Error> {
        match self.shape[..] {
            [n, w] if w == width => Ok((self, n)),
            _ => Err(self.wrong(&format!("[N, {width}]"))),
        }
    }

    /// The sizes of the last `axes` axes of [N, ...] or, one for each camera, [C, N, ...].
    pub(crate) fn row(&self, n: usize, cameras: usize, axes: usize) -> Result<&[usize], Error> {
        let (of, row) = self.shape.split_at(self.shape.len().saturating_sub(axes));
        if of == [n] || of == [cameras, n] {
            return Ok(row);
        }
        Err(self.wrong(&format!("[{n}, ...] or [{cameras}, {n}, ...]")))
    }

    fn wrong(&self, expected: &str) -> Error {
        Error::shape(self.claim.name, expected, format!("{:?}", self.shape))
    }
}

fn refused(name: &str, error: impl Display) -> PyErr {
    PyValueError::new_err(format!("{name}: {error}"))
}

/// `value` as an array of this type that can be borrowed without a copy. rust-numpy's own `as_slice` accepts
/// Fortran order, which would read a transposed array silently wrong, so the layout is checked here.
fn as_it_is<'a, 'py, T: Element>(
    name: &'static str,
    value: &'a Bound<'py, PyAny>,
) -> BindingResult<&'a Bound<'py, PyArrayDyn<T>>> {
    let array = value
        .cast::<PyArrayDyn<T>>()
        .map_err(|_| wrong_type(name, T::get_dtype(value.py()), value))?;
    if !array.is_c_contiguous() {
        let (shape, strides) = (array.shape(), array.strides());
        let message = format!("must be C-contiguous, got shape {shape:?} with strides {strides:?}");
        return Err(Error::new(name, message).into());
    }
    let address = array.data().addr();
    if !array.is_empty() && !address.is_multiple_of(align_of::<T>()) {
        let message = format!(
            "must lie at a multiple of {} bytes, got the address {address:#x}",
            align_of::<T>()
        );
        return Err(Error::new(name, message).into());
    }
    Ok(array)
}

/// Memory that a call of the binding reads or writes, as long as the array is borrowed.
///
/// Memory that is written under one name and read or written under another is refused, in one call and in calls
/// from several threads. rust-numpy knows views of one array, but two tensors over the same memory come as arrays
/// that know nothing of each other.
struct Claim {
    name: &'static str,
    addresses: Range<usize>,
    written: bool,
    /// The calls of the process that this one was forked from are not its own.
    process: u32,
}

/// Those of all calls, in the order in which they were made.
static CLAIMS: Mutex<Vec<Weak<Claim>>> = Mutex::new(Vec::new());

impl Claim {
    fn new<T: Element>(
        name: &'static str,
        array: &Bound<'_, PyArrayDyn<T>>,
        written: bool,
    ) -> Result<Arc<Self>, Error> {
        let begin = array.data().addr();
        let addresses = begin..begin + array.len() * size_of::<T>();
        let process = process::id();
        let mut claims = CLAIMS.lock().unwrap_or_else(PoisonError::into_inner);
        claims.retain(|claim| claim.upgrade().is_some_and(|c| c.process == process));
        for other in claims.iter().filter_map(Weak::upgrade) {
            let both =
                addresses.start.max(other.addresses.start) < addresses.end.min(other.addresses.end);
            if both && (written || other.written) {
                let (of, writes) = if other.written {
                    (name, other.name)
                } else {
                    (other.name, name)
                };
                let message = format!("shares memory with {writes}, which is written");
                return Err(Error::new(of, message));
            }
        }
        let claim = Arc::new(Self {
            name,
            addresses,
            written,
            process,
        });
        claims.push(Arc::downgrade(&claim));
        Ok(claim)
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

/// An optional array that must have this shape where it is given.
pub(crate) fn optional_of_shape<'py, T: Element>(
    name: &'static str,
    value: Optional<'_, 'py>,
    expected: &[usize],
) -> BindingResult<Option<Array<'py, T>>> {
    value
        .map(|v| Ok(Array::new(name, v)?.of_shape(expected)?))
        .transpose()
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

/// A gradient to be filled, with no elements if it is not `wanted`.
pub(crate) fn gradient<T: Real>(py: Python<'_>, len: usize, wanted: bool) -> BindingResult<Vec<T>> {
    threads::run(py, || zeros(if wanted { len } else { 0 }, "gradient"))
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

/// A scalar type that the binding offers.
pub(crate) trait Scalar: Real + Element {}
impl Scalar for f32 {}
impl Scalar for f64 {}

/// Do the body with `$T` as the type of the numbers of the array of this name.
macro_rules! by_dtype {
    ($T:ident, $name:literal, $array:expr, $body:block) => {
        if $crate::arrays::is_f32($name, $array)? {
            type $T = f32;
            $body
        } else {
            type $T = f64;
            $body
        }
    };
}

pub(crate) use by_dtype;
