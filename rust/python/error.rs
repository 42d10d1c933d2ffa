//! What a function of the binding fails with.

use hqgs::Error;
use pyo3::{
    PyErr,
    exceptions::{PyMemoryError, PyValueError},
};

/// An error of the crate, or one of Python's own.
#[derive(Debug)]
pub(crate) struct BindingError(PyErr);

pub(crate) type BindingResult<T> = Result<T, BindingError>;

impl From<Error> for BindingError {
    fn from(error: Error) -> Self {
        let message = error.to_string();
        Self(match error {
            Error::OutOfMemory { .. } => PyMemoryError::new_err(message),
            // What the caller can mend by giving something else.
            _ => PyValueError::new_err(message),
        })
    }
}

impl From<PyErr> for BindingError {
    fn from(error: PyErr) -> Self {
        Self(error)
    }
}

impl From<BindingError> for PyErr {
    fn from(error: BindingError) -> Self {
        error.0
    }
}
