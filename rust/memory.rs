//! Memory for large buffers: an error where the system gives none, in place of an abort of the process.

use crate::error::Error;
use std::sync::{Mutex, PoisonError};

/// Buffers for each thread of rayon's current pool. rayon's own `map_init` makes them for each piece of work, which is
/// then kept large; and what a thread has begun nobody can take from it when its core is given to another process.
pub struct OfThreads<B>(Vec<Mutex<B>>);

impl<B: Default> Default for OfThreads<B> {
    fn default() -> Self {
        let threads = 0..rayon::current_num_threads();
        Self(threads.map(|_| Mutex::default()).collect())
    }
}

impl<B> OfThreads<B> {
    /// Lend `f` those of this thread; it must not wait for others of the pool.
    #[inline(always)]
    pub fn with<R>(&self, f: impl FnOnce(&mut B) -> R) -> R {
        let own = rayon::current_thread_index().unwrap_or(0);
        f(&mut self.0[own].lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// Room for `additional` more elements of what `name` says.
#[inline(always)]
pub fn reserve<T>(vector: &mut Vec<T>, additional: usize, name: &str) -> Result<(), Error> {
    vector
        .try_reserve(additional)
        .map_err(|_| no_memory::<T>(additional, name))
}

/// A vector with room for `len` elements of what `name` says.
pub fn with_capacity<T>(len: usize, name: &str) -> Result<Vec<T>, Error> {
    let mut vector = Vec::new();
    match vector.try_reserve_exact(len) {
        Ok(()) => Ok(vector),
        Err(_) => Err(no_memory::<T>(len, name)),
    }
}

/// Make a vector `len` long; elements that it did not have are `value`.
#[inline(always)]
pub fn resize<T: Clone>(
    vector: &mut Vec<T>,
    len: usize,
    value: T,
    name: &str,
) -> Result<(), Error> {
    reserve(vector, len.saturating_sub(vector.len()), name)?;
    vector.resize(len, value);
    Ok(())
}

/// A vector of `len` times the same value.
pub fn filled<T: Clone>(value: T, len: usize, name: &str) -> Result<Vec<T>, Error> {
    let mut vector = with_capacity(len, name)?;
    vector.resize(len, value);
    Ok(vector)
}

/// A copy of a slice.
pub fn copied<T: Copy>(from: &[T], name: &str) -> Result<Vec<T>, Error> {
    let mut vector = with_capacity(from.len(), name)?;
    vector.extend_from_slice(from);
    Ok(vector)
}

#[cold]
fn no_memory<T>(len: usize, name: &str) -> Error {
    Error::OutOfMemory {
        name: name.into(),
        bytes: (len as u64).saturating_mul(size_of::<T>() as u64),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_had_is_an_error() {
        assert_eq!(filled(7u8, 3, "few").unwrap(), [7; 3]);
        assert_eq!(copied(&[1u8, 2], "few").unwrap(), [1, 2]);
        let expected = Error::OutOfMemory {
            name: "image".into(),
            bytes: 1 << 60,
        };
        assert_eq!(filled(0u32, 1 << 58, "image").unwrap_err(), expected);
        let mut vector = vec![1u32];
        assert_eq!(
            reserve(&mut vector, 1 << 58, "image").unwrap_err(),
            expected
        );
        assert_eq!(
            resize(&mut vector, 1 + (1 << 58), 0, "image").unwrap_err(),
            expected
        );
        assert_eq!(vector, [1]);
        resize(&mut vector, 3, 5, "few").unwrap();
        assert_eq!(vector, [1, 5, 5]);
        resize(&mut vector, 2, 0, "few").unwrap();
        assert_eq!(vector, [1, 5]);
        assert!(with_capacity::<u64>(usize::MAX, "all").is_err()); // more bytes than can be counted
    }
}
