//! The thread pool: as many threads as `RAYON_NUM_THREADS` or the machine says, until
//! [`set`] says otherwise. Results never depend on it.
//!
//! A process that forks leaves its child a pool without threads: work that it is given would wait for ever. The
//! child therefore starts a pool of its own with as many threads, the first time that it needs one. All work goes
//! through [`install`], since rayon's own global pool cannot be replaced.

use crate::error::BindingResult;
use hqgs::Error;
use pyo3::exceptions::PyRuntimeError;
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::{
    fmt, process, ptr,
    sync::{
        Arc, PoisonError, RwLock,
        atomic::{AtomicPtr, AtomicUsize, Ordering},
    },
};

/// The pool of one process.
struct Pool {
    process: u32,
    /// Beside the lock, which another thread may have held when the process forked.
    threads: AtomicUsize,
    pool: RwLock<Arc<ThreadPool>>,
}

/// That of this process, or of the one that it was forked from; null before the first work.
static POOL: AtomicPtr<Pool> = AtomicPtr::new(ptr::null_mut());

impl Pool {
    /// One with `threads` threads, or with the default number for 0.
    fn new(threads: usize) -> BindingResult<Self> {
        let pool = start(threads)?;
        Ok(Self {
            process: process::id(),
            threads: AtomicUsize::new(pool.current_num_threads()),
            pool: RwLock::new(Arc::new(pool)),
        })
    }

    #[allow(unsafe_code)]
    fn load() -> Option<&'static Self> {
        // SAFETY: `POOL` is null or holds what came from `Box::into_raw` in `of_this_process`: only the exchange there
        // writes it, and Acquire here pairs with its release. What is put there is never freed, nor given away
        // mutably: what loses the exchange was never there.
        unsafe { POOL.load(Ordering::Acquire).as_ref() }
    }

    /// The pool of this process; if there is none, one with `threads` threads, or with those of the process that
    /// this one was forked from.
    fn of_this_process(threads: Option<usize>) -> BindingResult<&'static Self> {
        loop {
            let found = Self::load();
            if let Some(pool) = found.filter(|pool| pool.process == process::id()) {
                return Ok(pool);
            }
            let inherited = found.map_or(0, |pool| pool.threads.load(Ordering::Relaxed));
            let made = Box::into_raw(Box::new(Self::new(threads.unwrap_or(inherited))?));
            // The pool of the parent stays as it is: to free it would be to wait for its threads.
            let found = found.map_or(ptr::null_mut(), |pool| ptr::from_ref(pool).cast_mut());
            let won = POOL.compare_exchange(found, made, Ordering::AcqRel, Ordering::Acquire);
            if won.is_err() {
                drop_unshared(made); // another thread was faster
            }
        }
    }
}

#[allow(unsafe_code)]
fn drop_unshared(pool: *mut Pool) {
    // SAFETY: it comes from `Box::into_raw`, and the exchange failed, so that it was never in `POOL`: nobody else has
    // a pointer to it.
    drop(unsafe { Box::from_raw(pool) });
}

fn start(threads: usize) -> BindingResult<ThreadPool> {
    ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| {
            let message = match threads {
                0 => format!("threads: cannot start: {e}"),
                _ => format!("threads: cannot start {threads} threads: {e}"),
            };
            PyRuntimeError::new_err(message).into()
        })
}

/// The most threads that [`set`] takes: beyond it they only cost memory, and a mistyped number may stop the machine.
pub(crate) const MAX_THREADS: usize = 1024;

/// The error for a number of threads that [`set`] does not take.
pub(crate) fn out_of_range(threads: impl fmt::Display) -> Error {
    let message = format!("must be 1 to {MAX_THREADS}, got {threads}");
    Error::new("threads", message)
}

/// Use `threads` threads from now on.
///
/// # Errors
/// When there are none or more than [`MAX_THREADS`], or the system refuses to start them.
pub(crate) fn set(threads: usize) -> BindingResult<()> {
    if !(1..=MAX_THREADS).contains(&threads) {
        return Err(out_of_range(threads).into());
    }
    let pool = Pool::of_this_process(Some(threads))?;
    if pool.threads.load(Ordering::Relaxed) != threads {
        let other = Arc::new(start(threads)?);
        *pool.pool.write().unwrap_or_else(PoisonError::into_inner) = other;
        pool.threads.store(threads, Ordering::Relaxed);
    }
    Ok(())
}

/// The number of threads in use.
///
/// # Errors
/// When the system refuses to start them.
pub(crate) fn get() -> BindingResult<usize> {
    install(rayon::current_num_threads)
}

/// Run `f` on the pool.
///
/// # Errors
/// When the system refuses to start its threads.
pub(crate) fn install<R: Send>(f: impl FnOnce() -> R + Send) -> BindingResult<R> {
    let pool = Pool::of_this_process(None)?;
    let pool = Arc::clone(&pool.pool.read().unwrap_or_else(PoisonError::into_inner));
    Ok(pool.install(f))
}

/// Run `f` on the pool some time; here, where there is none.
pub(crate) fn spawn(f: impl FnOnce() + Send + 'static) {
    match Pool::of_this_process(None) {
        Ok(pool) => pool
            .pool
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .spawn(f),
        Err(_) => f(),
    }
}

/// Run `f` once on each thread of the pool.
///
/// # Errors
/// As for [`install`].
pub(crate) fn on_each(f: impl Fn() + Sync) -> BindingResult<()> {
    install(|| {
        rayon::broadcast(|_| f());
    })
}
