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
use pyo3::prelude::*;
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
    threads::run(py, || {
        rayon::broadcast(|_| mi_collect(true));
        Ok(())
    })?;
    mi_collect(true);
    Ok(())
}

/// The vector instructions in use: the best of this CPU, or those that HQGS_SIMD names.
#[pyfunction]
fn simd_level() -> BindingResult<&'static str> {
    Ok(simd::level()?.name())
}

/// The extension module `hqgs._rust`.
#[pymodule]
mod _rust {
    use super::*;

    #[pymodule_export]
    use super::{give_back_memory, simd_level};
    #[pymodule_export]
    use crate::{
        composite::{Composite, composite_backward, composite_forward, composite_picture},
        exposure::{Exposure, exposure_backward, exposure_forward},
        pictures::{Separable, cell_distance},
        project::{Frame, backward::project_backward, forward::project_forward},
        stereo::agreed_depths,
        threads::{get_num_threads, set_num_threads},
        training::{adam_steps, add_harmonics, add_pulls, add_rows, photometric},
    };

    #[pymodule_init]
    fn init(m: &Bound<'_, PyModule>) -> PyResult<()> {
        keep_freed_memory();
        simd::level().map_err(BindingError::from)?; // a wrong HQGS_SIMD is told at once
        // The constants that define an image, for Python to use the same ones.
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
}
