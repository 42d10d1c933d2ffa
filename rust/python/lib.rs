//! The Python extension `hqgs._rust`: all that knows Python. numpy arrays are borrowed, never copied; the GIL is
//! released while the crate works; each [`hqgs::Error`] becomes an exception of Python.

mod arrays;
mod composite;
mod error;
mod exposure;
mod pictures;
mod project;
mod stereo;
mod threads;
mod training;

use error::{BindingError, BindingResult};
use hqgs::internals::{constants, simd};
use pyo3::{exceptions::PyOverflowError, prelude::*};
use std::ffi::{c_int, c_long};

/// The buffers of an iteration are as large as those of the last one: an allocator that keeps them saves the
/// page faults, which cost more than the arithmetic of the gradients.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Let the allocator keep freed memory for this long: it would give it back after a second, in each second of
/// the training again.
const KEEP_FREED_MS: c_long = 10_000;

#[allow(unsafe_code)]
fn keep_freed_memory() {
    /// `mi_option_purge_delay` of mimalloc.h.
    const PURGE_DELAY: c_int = 15;
    unsafe extern "C" {
        // SAFETY: any thread may call it with any option, and the crate is linked with mimalloc.
        safe fn mi_option_set_default(option: c_int, value: c_long);
    }
    mi_option_set_default(PURGE_DELAY, KEEP_FREED_MS);
}

/// Hand freed memory back to the system now: what the threads hold for later, and then all that nobody uses.
#[pyfunction]
#[allow(unsafe_code)]
fn give_back_memory(py: Python<'_>) -> BindingResult<()> {
    unsafe extern "C" {
        // SAFETY: any thread may call it, and the crate is linked with mimalloc.
        safe fn mi_collect(force: bool);
    }
    py.detach(|| {
        let each = threads::on_each(|| mi_collect(true));
        mi_collect(true);
        each
    })
}

/// Use this many threads from now on, 1 to 1024; results do not depend on it.
#[pyfunction]
fn set_num_threads(threads: &Bound<'_, PyAny>) -> BindingResult<()> {
    match threads.extract() {
        Ok(count) => threads::set(count),
        // Below 0, or beyond what fits.
        Err(error) if error.is_instance_of::<PyOverflowError>(threads.py()) => {
            Err(threads::out_of_range(threads).into())
        }
        Err(error) => Err(error.into()),
    }
}

/// Number of threads in use.
#[pyfunction]
fn get_num_threads() -> BindingResult<usize> {
    threads::get()
}

/// The vector instructions in use: the best of this CPU, or those that HQGS_SIMD names.
#[pyfunction]
fn simd_level() -> BindingResult<&'static str> {
    Ok(simd::level()?.name())
}

/// The constants that define an image, for Python to use the same ones.
fn add_constants(m: &Bound<'_, PyModule>) -> PyResult<()> {
    for (name, value) in [
        ("ALPHA_MIN", constants::ALPHA_MIN),
        ("ALPHA_MAX", constants::ALPHA_MAX),
        ("TRANSMITTANCE_MIN", constants::TRANSMITTANCE_MIN),
        ("EPS2D", constants::EPS2D),
        ("NEAR_PLANE", constants::NEAR_PLANE),
        ("FAR_PLANE", constants::FAR_PLANE),
        ("FOV_MARGIN", constants::FOV_MARGIN),
        ("QUAT_NORM2_MIN", constants::QUAT_NORM2_MIN),
    ] {
        m.add(name, value)?;
    }
    m.add("TILE", constants::TILE)?;
    m.add("BLOCK", constants::BLOCK)
}

/// The extension module `hqgs._rust`.
#[pymodule]
fn _rust(m: &Bound<'_, PyModule>) -> PyResult<()> {
    keep_freed_memory();
    simd::level().map_err(BindingError::from)?; // a wrong HQGS_SIMD is told at once
    m.add_function(wrap_pyfunction!(set_num_threads, m)?)?;
    m.add_function(wrap_pyfunction!(get_num_threads, m)?)?;
    m.add_function(wrap_pyfunction!(simd_level, m)?)?;
    m.add_function(wrap_pyfunction!(give_back_memory, m)?)?;
    add_constants(m)?;
    project::register(m)?;
    composite::register(m)?;
    training::register(m)?;
    pictures::register(m)?;
    exposure::register(m)?;
    stereo::register(m)
}
