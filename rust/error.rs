//! The one error type of the crate.

use std::fmt;

/// An input that cannot be used: which one, and what is wrong with it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Error {
    /// The argument at fault, by its public name.
    pub name: String,
    /// What was expected and what was got.
    pub message: String,
}

impl Error {
    /// An error about the argument `name`.
    pub fn new(name: impl Into<String>, message: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            message: message.into(),
        }
    }

    /// An error about the shape of `name`.
    pub fn shape(name: &str, expected: impl fmt::Display, got: impl fmt::Display) -> Self {
        Self::new(name, format!("expected shape {expected}, got {got}"))
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.name, self.message)
    }
}

impl std::error::Error for Error {}

/// Check that `data` holds `expected` elements.
pub(crate) fn check_len<T>(name: &str, data: &[T], expected: usize) -> Result<(), Error> {
    if data.len() == expected {
        Ok(())
    } else {
        Err(Error::shape(
            name,
            format!("{expected} elements"),
            format!("{} elements", data.len()),
        ))
    }
}
