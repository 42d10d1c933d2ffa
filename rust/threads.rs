//! The thread pool of the Python binding: as many threads as `RAYON_NUM_THREADS` or the machine says, until
//! [`set`] says otherwise. Results never depend on it.

use crate::error::Error;
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::sync::{Arc, PoisonError, RwLock};

static POOL: RwLock<Option<Arc<ThreadPool>>> = RwLock::new(None);

/// Use `threads` threads from now on.
///
/// # Errors
/// When `threads` is 0, or the system refuses to start them.
pub fn set(threads: usize) -> Result<(), Error> {
    if threads == 0 {
        return Err(Error::new("threads", "must be at least 1, got 0"));
    }
    let pool = ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| Error::Threads {
            message: format!("cannot start {threads} threads: {e}"),
        })?;
    *POOL.write().unwrap_or_else(PoisonError::into_inner) = Some(Arc::new(pool));
    Ok(())
}

/// The number of threads in use.
pub fn get() -> usize {
    install(rayon::current_num_threads)
}

/// Run `f` on the pool.
pub fn install<R: Send>(f: impl FnOnce() -> R + Send) -> R {
    let pool = POOL.read().unwrap_or_else(PoisonError::into_inner).clone();
    match pool {
        Some(pool) => pool.install(f),
        None => f(),
    }
}
