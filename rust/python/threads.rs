//! The thread pool: as many threads as `RAYON_NUM_THREADS` or the machine says, until
//! [`set_num_threads`] says otherwise. Results never depend on it.
//!
//! A process that forks leaves its child a pool without threads: work that it is given would wait for ever. The
//! child therefore starts a pool of its own with as many threads, the first time that it needs one. All work goes
//! through [`run`], since rayon's own global pool cannot be replaced.

use crate::error::BindingResult;
use hqgs::Error;
use pyo3::{Python, exceptions::PyRuntimeError, pyfunction};
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::{
    mem, process,
    sync::{Arc, Mutex, PoisonError},
};

/// The pool and the process that it is of, this one or the one that it was forked from; None before the first work.
/// Locked only while the GIL is held: a fork, which holds it too, finds it free.
static POOL: Mutex<Option<(u32, Arc<ThreadPool>)>> = Mutex::new(None);

/// The pool of this process, made anew if there is none or it has not as many `threads` as asked for.
fn pool(_: Python<'_>, threads: Option<usize>) -> BindingResult<Arc<ThreadPool>> {
    let mut held = POOL.lock().unwrap_or_else(PoisonError::into_inner);
    let (mut wanted, here) = (threads.unwrap_or(0), process::id());
    if let Some((process, pool)) = &*held {
        let count = pool.current_num_threads();
        if *process == here && threads.is_none_or(|threads| threads == count) {
            return Ok(Arc::clone(pool));
        }
        wanted = threads.unwrap_or(count);
    }
    let pool = ThreadPoolBuilder::new().num_threads(wanted).build();
    let pool = Arc::new(pool.map_err(|e| {
        PyRuntimeError::new_err(match wanted {
            0 => format!("threads: cannot start: {e}"),
            _ => format!("threads: cannot start {wanted} threads: {e}"),
        })
    })?);
    if let Some(old) = held.replace((here, Arc::clone(&pool)))
        && old.0 != here
    {
        mem::forget(old); // the parent's: to free it would be to wait for its threads
    }
    Ok(pool)
}

/// The most threads that [`set_num_threads`] takes: beyond it they only cost memory, and a mistyped number may stop the machine.
const MAX_THREADS: i128 = 1024;

/// Use this many threads from now on, 1 to 1024; results do not depend on it.
#[pyfunction]
pub(crate) fn set_num_threads(py: Python<'_>, threads: i128) -> BindingResult<()> {
    if !(1..=MAX_THREADS).contains(&threads) {
        let message = format!("must be 1 to {MAX_THREADS}, got {threads}");
        return Err(Error::new("threads", message).into());
    }
    pool(py, Some(threads as usize))?;
    Ok(())
}

/// Number of threads in use.
#[pyfunction]
pub(crate) fn get_num_threads(py: Python<'_>) -> BindingResult<usize> {
    Ok(pool(py, None)?.current_num_threads())
}

/// Run `f` on the pool, without the GIL.
///
/// # Errors
/// That of `f`, or when the system refuses to start the threads.
pub(crate) fn run<R: Send>(
    py: Python<'_>,
    f: impl FnOnce() -> Result<R, Error> + Send,
) -> BindingResult<R> {
    let pool = pool(py, None)?;
    Ok(py.detach(|| pool.install(f))?)
}

/// Run `f` on the pool some time; here, where there is none.
pub(crate) fn spawn(f: impl FnOnce() + Send + 'static) {
    match Python::try_attach(|py| pool(py, None)) {
        Some(Ok(pool)) => pool.spawn(f),
        _ => f(),
    }
}
