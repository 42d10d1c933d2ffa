//! The binding of the projection's vector-Jacobian product.

use super::{Arrays, Frame};
use crate::threads;
use crate::{
    arrays::{Array, CountsByName, Scalar, by_dtype, of_type, optional_of_shape},
    error::BindingResult,
};
use hqgs::internals::{
    Error,
    project::{self, GaussianGrads, ProjectCotangents, Shading},
    simd::Real,
};
use numpy::{Element, IntoPyArray};
use pyo3::{IntoPyObjectExt, prelude::*};

/// VJP of `project_forward`.
#[pyfunction]
pub(super) fn project_backward<'py>(
    frame: &Bound<'py, Frame>,
    inputs: Inputs<'py>,
    cotangents: Cotangents<'py>,
    wanted: [bool; 8],
) -> BindingResult<Bound<'py, PyAny>> {
    by_dtype!(
        "means",
        &inputs.0,
        project_backward_as(frame, &inputs, cotangents, wanted)
    )
}

/// means, quats, scales, opacities
pub(super) type Inputs<'py> = (
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
);

/// means2d, whitened, opacities, depths, conics, colors
pub(super) type Cotangents<'py> = (
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyAny>>,
);

/// The borrowed arrays of the cotangents.
struct CotangentArrays<'py, T: Element> {
    means2d: Option<Array<'py, T>>,
    whitened: Option<Array<'py, T>>,
    opacities: Option<Array<'py, T>>,
    depths: Option<Array<'py, T>>,
    conics: Option<Array<'py, T>>,
    colors: Option<Array<'py, T>>,
}

impl<'py, T: Scalar> CotangentArrays<'py, T> {
    /// Those for c cameras and n Gaussians.
    fn new(v: &Cotangents<'py>, c: usize, n: usize) -> BindingResult<Self> {
        Ok(Self {
            means2d: optional_of_shape("v_means2d", v.0.as_ref(), &[c, n, 2])?,
            whitened: optional_of_shape("v_whitened", v.1.as_ref(), &[c, n, 3])?,
            opacities: optional_of_shape("v_opacities", v.2.as_ref(), &[c, n])?,
            depths: optional_of_shape("v_depths", v.3.as_ref(), &[c, n])?,
            conics: optional_of_shape("v_conics", v.4.as_ref(), &[c, n, 3])?,
            colors: optional_of_shape("v_colors", v.5.as_ref(), &[c, n, 3])?,
        })
    }

    /// Those of all cameras.
    fn slices(&self) -> BindingResult<ProjectCotangents<'_, T>> {
        Ok(ProjectCotangents {
            means2d: self.means2d.as_ref().map(Array::slice).transpose()?,
            whitened: self.whitened.as_ref().map(Array::slice).transpose()?,
            opacities: self.opacities.as_ref().map(Array::slice).transpose()?,
            depths: self.depths.as_ref().map(Array::slice).transpose()?,
            conics: self.conics.as_ref().map(Array::slice).transpose()?,
            colors: self.colors.as_ref().map(Array::slice).transpose()?,
        })
    }
}

/// The cotangents of camera i, from those of all cameras.
fn of_view<'a, T>(all: &ProjectCotangents<'a, T>, i: usize, n: usize) -> ProjectCotangents<'a, T> {
    let part =
        |array: Option<&'a [T]>, rows: usize| array.map(|a| &a[rows * i * n..rows * (i + 1) * n]);
    ProjectCotangents {
        means2d: part(all.means2d, 2),
        whitened: part(all.whitened, 3),
        opacities: part(all.opacities, 1),
        depths: part(all.depths, 1),
        conics: part(all.conics, 3),
        colors: part(all.colors, 3),
    }
}

/// Add the gradients from another camera.
fn add<T: Real>(sums: &mut GaussianGrads<T>, grads: &GaussianGrads<T>) {
    accumulate(&mut sums.means, &grads.means);
    accumulate(&mut sums.quats, &grads.quats);
    accumulate(&mut sums.scales, &grads.scales);
    accumulate(&mut sums.opacities, &grads.opacities);
    accumulate(&mut sums.covars, &grads.covars);
    accumulate(&mut sums.harmonics, &grads.harmonics);
    accumulate(&mut sums.harmonics_rest, &grads.harmonics_rest);
    sums.counts = sums.counts.plus(grads.counts);
}

/// Add one array of them; it stays finite.
fn accumulate<T: Real>(sum: &mut [T], part: &[T]) {
    for (s, p) in sum.iter_mut().zip(part) {
        *s = T::saturating(s.to_f64() + p.to_f64());
    }
}

fn project_backward_as<'py, T: Scalar>(
    frame: &Bound<'py, Frame>,
    inputs: &Inputs<'py>,
    v: Cotangents<'py>,
    wanted: [bool; 8],
) -> BindingResult<Bound<'py, PyAny>> {
    let py = frame.py();
    let frame = &frame.get().0;
    let arrays = Arrays::<T>::new(&inputs.0, &inputs.1, &inputs.2, &inputs.3)?;
    let gaussians = arrays.gaussians()?;
    let shadings = of_type::<Vec<Option<Shading<T>>>>(&frame.shadings, "means")?;
    let (n, c) = (frame.n, frame.cameras.len());
    if gaussians.len() != n {
        let (expected, got) = (format!("[{n}, 3]"), format!("[{}, 3]", gaussians.len()));
        return Err(Error::shape("means", expected, got).into());
    }
    let v = CotangentArrays::<T>::new(&v, c, n)?;
    if v.colors.is_some() && shadings.iter().any(Option::is_none) {
        return Err(Error::new("v_colors", "the forward pass was not to be differentiated").into());
    }
    let v = v.slices()?;
    let [
        means,
        quats,
        scales,
        opacities,
        covars,
        harmonics_wanted,
        harmonics_rest,
        camera,
    ] = wanted;
    let wanted = project::Wanted {
        means,
        quats,
        scales,
        opacities,
        covars,
        harmonics: harmonics_wanted,
        harmonics_rest,
        camera,
    };
    let (sums, viewmats) = py.detach(|| {
        threads::install(|| -> Result<_, Error> {
            let mut sums: Option<GaussianGrads<T>> = None;
            let mut viewmats = Vec::with_capacity(16 * c);
            for (i, camera) in frame.cameras.iter().enumerate() {
                let grads = project::backward(
                    &gaussians,
                    shadings[i].as_ref(),
                    camera,
                    &frame.options,
                    &frame.projections[i],
                    &of_view(&v, i, n),
                    wanted,
                )?;
                viewmats.extend(grads.camera.viewmat(camera));
                match &mut sums {
                    None => sums = Some(grads),
                    Some(sums) => add(sums, &grads),
                }
            }
            Ok((sums, viewmats))
        })
    })??;
    let grads = sums.ok_or_else(|| Error::new("viewmats", "there is no camera"))?;
    let out = (
        wanted.means.then(|| grads.means.into_pyarray(py)),
        wanted.quats.then(|| grads.quats.into_pyarray(py)),
        wanted.scales.then(|| grads.scales.into_pyarray(py)),
        wanted.opacities.then(|| grads.opacities.into_pyarray(py)),
        wanted.covars.then(|| grads.covars.into_pyarray(py)),
        wanted.harmonics.then(|| grads.harmonics.into_pyarray(py)),
        wanted
            .harmonics_rest
            .then(|| grads.harmonics_rest.into_pyarray(py)),
        wanted.camera.then(|| viewmats.into_pyarray(py)),
        grads.counts.entries().collect::<CountsByName>(),
    );
    Ok(out.into_bound_py_any(py)?)
}
