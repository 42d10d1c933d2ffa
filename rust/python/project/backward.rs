//! The binding of the projection's vector-Jacobian product.

use super::{Arrays, Frame};
use crate::{
    arrays::{Array, Scalar, by_dtype, join, of_type, optional_of_shape},
    error::BindingResult,
    threads,
};
use hqgs::internals::{
    Error,
    project::{self, COTANGENTS, GaussianGrads, ProjectCotangents, Shading},
    simd::Real,
};
use numpy::IntoPyArray;
use pyo3::{IntoPyObjectExt, prelude::*};
use std::{array, mem};

/// The arrays of [`COTANGENTS`] for c cameras and n Gaussians.
fn cotangent_arrays<'py, T: Scalar>(
    given: &[Option<Bound<'py, PyAny>>],
    c: usize,
    n: usize,
) -> BindingResult<Vec<Option<Array<'py, T>>>> {
    let named = COTANGENTS.iter().zip(given);
    named
        .map(|(&(name, row), array)| {
            let shape = [c, n, row];
            let shape = if row == 1 { &shape[..2] } else { &shape };
            optional_of_shape(name, array.as_ref(), shape)
        })
        .collect()
}

/// Add the gradients from another camera; they stay finite.
fn add<T: Real>(sums: &mut [Vec<T>], grads: &[Vec<T>]) {
    for (sums, parts) in sums.iter_mut().zip(grads) {
        for (s, p) in sums.iter_mut().zip(parts) {
            *s = T::saturating(s.to_f64() + p.to_f64());
        }
    }
}

/// VJP of `project_forward`. `inputs`: means, quats, scales, opacities; `cotangents` as in [`COTANGENTS`]; `wanted`:
/// means, quats, scales, opacities, covariances, harmonics, their rest, and the cameras.
#[pyfunction]
pub(crate) fn project_backward<'py>(
    frame: &Bound<'py, Frame>,
    inputs: [Bound<'py, PyAny>; 4],
    cotangents: [Option<Bound<'py, PyAny>>; 6],
    wanted: [bool; 8],
) -> BindingResult<Bound<'py, PyAny>> {
    let (py, frame) = (frame.py(), &frame.get().0);
    let (n, c) = (frame.n, frame.cameras.len());
    let asked = project::Wanted {
        means: wanted[0],
        quats: wanted[1],
        scales: wanted[2],
        opacities: wanted[3],
        covars: wanted[4],
        harmonics: wanted[5],
        harmonics_rest: wanted[6],
        camera: wanted[7],
    };
    by_dtype!(T, "means", &inputs[0], {
        let arrays = Arrays::<T>::new(inputs.each_ref())?;
        let gaussians = arrays.gaussians();
        let shadings = of_type::<Vec<Option<Shading<T>>>>(&frame.shadings, "means")?;
        if gaussians.len() != n {
            let (expected, got) = (format!("[{n}, 3]"), format!("[{}, 3]", gaussians.len()));
            return Err(Error::shape("means", expected, got).into());
        }
        let held = cotangent_arrays::<T>(&cotangents, c, n)?;
        let slices: Vec<_> = held.iter().map(|v| v.as_ref().map(Array::slice)).collect();
        let cotangents_of = |camera: usize| {
            let part = |k: usize| {
                let len = COTANGENTS[k].1 * n;
                slices[k].map(|v| &v[camera * len..(camera + 1) * len])
            };
            ProjectCotangents {
                means2d: part(0),
                whitened: part(1),
                opacities: part(2),
                depths: part(3),
                conics: part(4),
                colors: part(5),
            }
        };
        let (sums, viewmats, mut of_each) = threads::run(py, || {
            let mut sums: Option<[Vec<T>; 7]> = None;
            let (mut viewmats, mut of_each) = (Vec::with_capacity(16 * c), Vec::new());
            for (i, camera) in frame.cameras.iter().enumerate() {
                let GaussianGrads {
                    mut arrays,
                    camera: pose,
                } = project::backward(
                    &gaussians,
                    shadings[i].as_ref(),
                    camera,
                    &frame.options,
                    &frame.projections[i],
                    &cotangents_of(i),
                    asked,
                )?;
                viewmats.extend(pose.viewmat(camera));
                if frame.harmonics_of_each {
                    of_each.push(mem::take(&mut arrays[5]));
                }
                match &mut sums {
                    None => sums = Some(arrays),
                    Some(sums) => add(sums, &arrays),
                }
            }
            Ok((sums, viewmats, of_each))
        })?;
        let mut grads = sums.ok_or_else(|| Error::new("viewmats", "there is no camera"))?;
        if frame.harmonics_of_each {
            grads[5] = join(&mut of_each, |harmonics| harmonics)?;
        }
        let [a, b, c, d, e, f, g] =
            array::from_fn(|k| wanted[k].then(|| mem::take(&mut grads[k]).into_pyarray(py)));
        let viewmats = wanted[7].then(|| viewmats.into_pyarray(py));
        Ok((a, b, c, d, e, f, g, viewmats).into_bound_py_any(py)?)
    })
}
