//! The one error type of the crate.

use std::fmt;

/// Why a call did not do its work. The call can be made again: what it reads and updates is as it was. A buffer that
/// it was to fill, as the gradient of a loss, may be filled in part.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Error {
    /// An argument has a value that cannot be used.
    InvalidArgument {
        /// The argument, by its public name.
        name: String,
        /// What was expected and what was got.
        message: String,
    },
    /// The system does not give the memory that a buffer needs.
    OutOfMemory {
        /// What the buffer would have held.
        name: String,
        /// Its size.
        bytes: u64,
    },
}

impl Error {
    /// [`Error::InvalidArgument`].
    pub fn new(name: impl Into<String>, message: impl Into<String>) -> Self {
        Self::InvalidArgument {
            name: name.into(),
            message: message.into(),
        }
    }

    /// An array has another shape than the other arguments ask for.
    pub fn shape(name: &str, expected: impl fmt::Display, got: impl fmt::Display) -> Self {
        Self::new(name, format!("expected shape {expected}, got {got}"))
    }

    /// The same of an argument that is called `other` where `name` stands.
    #[must_use]
    #[doc(hidden)]
    pub fn renamed(mut self, from: &str, to: &str) -> Self {
        if let Self::InvalidArgument { name, .. } = &mut self
            && name == from
        {
            *name = to.into();
        }
        self
    }

    /// The argument or the resource that the message begins with.
    pub fn name(&self) -> &str {
        match self {
            Self::InvalidArgument { name, .. } | Self::OutOfMemory { name, .. } => name,
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.name())?;
        match self {
            Self::InvalidArgument { message, .. } => f.write_str(message),
            Self::OutOfMemory { bytes, .. } => write!(f, "cannot allocate {bytes} bytes"),
        }
    }
}

impl std::error::Error for Error {}

/// Check that `data` holds `expected` elements.
pub fn check_len<T>(name: &str, data: &[T], expected: usize) -> Result<(), Error> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_message_begins_with_what_is_at_fault() {
        for (error, message) in [
            (
                Error::new("lr", "must be finite and not negative, got -1"),
                "lr: must be finite and not negative, got -1",
            ),
            (
                Error::shape("scales", "30 elements", "29 elements"),
                "scales: expected shape 30 elements, got 29 elements",
            ),
            (
                Error::OutOfMemory {
                    name: "image".into(),
                    bytes: 1 << 40,
                },
                "image: cannot allocate 1099511627776 bytes",
            ),
        ] {
            assert_eq!(error.to_string(), message);
        }
    }
}
