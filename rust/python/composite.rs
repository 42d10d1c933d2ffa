//! The binding of the tile lists and of compositing.

use crate::{
    arrays::{AnyType, Array, Optional, by_dtype, join, of_type, optional_of_shape},
    error::BindingResult,
    project::{Frame, Projections, of_camera},
    threads,
};
use hqgs::internals::{
    Error,
    composite::{self, CompositeCotangents, CompositeInput, Composited},
    tiles::Tiles,
};
use numpy::{IntoPyArray, PyArray1};
use pyo3::{IntoPyObjectExt, prelude::*};
use std::sync::Arc;

/// Tile lists and replay state of a composited frame.
#[pyclass(frozen, module = "hqgs._rust")]
pub(crate) struct Composite {
    /// What was composited: another frame's splats would not be those of the tile lists.
    frame: Arc<Projections>,
    channels: usize,
    /// Of each camera; a `Vec<View<T>>`.
    views: AnyType,
    /// Pairs of Gaussian and tile, blocks evaluated: the work of the forward pass.
    #[pyo3(get)]
    work: (u64, u64),
    /// Wall-clock seconds that the tile lists took.
    #[pyo3(get)]
    bin_seconds: f64,
}

impl Drop for Composite {
    /// To free thousands of lists takes a while, in which the caller need not wait.
    fn drop(&mut self) {
        let views = std::mem::replace(&mut self.views, Box::new(()));
        threads::spawn(move || drop(views));
    }
}

/// One camera's tile lists and replay state.
type View<T> = (Tiles<T>, Composited<T>);

/// Bin and composite a frame.
#[pyfunction]
pub(crate) fn composite_forward<'py>(
    frame: &Bound<'py, Frame>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
    channels: usize,
) -> BindingResult<Bound<'py, PyAny>> {
    let (py, frame) = (colors.py(), &frame.get().0);
    let (n, c) = (frame.n, frame.cameras.len());
    by_dtype!(T, "colors", colors, {
        let colors = Array::<T>::new("colors", colors)?;
        if colors.row(n, c, 1)? != [channels] {
            let (expected, got) = (
                format!("[..., {channels}]"),
                format!("{:?}", colors.shape()),
            );
            return Err(Error::shape("colors", expected, got).into());
        }
        let colors = colors.slice();
        let backgrounds = optional_of_shape::<T>("backgrounds", backgrounds, &[c, channels])?;
        let backgrounds = backgrounds.as_ref().map(Array::slice);
        let (views, image, alphas, work, bin_seconds) = threads::run(py, || {
            let (mut images, mut alphas, mut views) = (Vec::new(), Vec::new(), Vec::new());
            let (mut work, mut bin_seconds) = ([0; 2], 0.0);
            for (i, camera) in frame.cameras.iter().enumerate() {
                let view = composite::forward(
                    &frame.projections[i],
                    of_camera(colors, i, n * channels),
                    channels,
                    camera,
                    backgrounds.map(|b| &b[i * channels..(i + 1) * channels]),
                )?;
                bin_seconds += view.bin_seconds;
                work = composite::plus(work, view.work);
                images.push(view.image);
                alphas.push(view.alphas);
                views.push((view.tiles, view.composited));
            }
            let image = join(&mut images, |image| image)?;
            let alphas = join(&mut alphas, |alphas| alphas)?;
            Ok((views, image, alphas, work, bin_seconds))
        })?;
        let state = Composite {
            frame: Arc::clone(frame),
            channels,
            views: Box::new(views),
            work: work.into(),
            bin_seconds,
        };
        let out = (state, image.into_pyarray(py), alphas.into_pyarray(py));
        Ok(out.into_bound_py_any(py)?)
    })
}

/// The frame in 8 bits, flat [C, H, W, channels], without a way back.
#[pyfunction]
pub(crate) fn composite_picture<'py>(
    frame: &Bound<'py, Frame>,
    colors: &Bound<'py, PyAny>,
    backgrounds: Optional<'_, 'py>,
) -> BindingResult<Bound<'py, PyArray1<u8>>> {
    let (py, frame) = (colors.py(), &frame.get().0);
    let (n, c) = (frame.n, frame.cameras.len());
    by_dtype!(T, "colors", colors, {
        let colors = Array::<T>::new("colors", colors)?;
        let channels = colors.row(n, c, 1)?[0];
        let colors = colors.slice();
        let backgrounds = optional_of_shape::<T>("backgrounds", backgrounds, &[c, channels])?;
        let backgrounds = backgrounds.as_ref().map(Array::slice);
        let mut pictures: Vec<_> = threads::run(py, || {
            let picture = |(i, camera)| {
                composite::picture(
                    &frame.projections[i],
                    of_camera(colors, i, n * channels),
                    channels,
                    camera,
                    backgrounds.map(|b| &b[i * channels..(i + 1) * channels]),
                )
            };
            frame.cameras.iter().enumerate().map(picture).collect()
        })?;
        Ok(join(&mut pictures, |picture| picture)?.into_pyarray(py))
    })
}

/// VJP of `composite_forward`. `wanted`: geometry, absolute, colors, backgrounds.
#[pyfunction]
pub(crate) fn composite_backward<'py>(
    composite: &Bound<'py, Composite>,
    backgrounds: Optional<'_, 'py>,
    v_image: &Bound<'py, PyAny>,
    v_alphas: Optional<'_, 'py>,
    wanted: [bool; 4],
) -> BindingResult<Bound<'py, PyAny>> {
    let (py, composite) = (composite.py(), composite.get());
    let (frame, channels) = (&composite.frame, composite.channels);
    let (c, [width, height]) = (frame.cameras.len(), frame.size());
    let pixels = width * height;
    let [geometry, absolute, colors, background] = wanted;
    let wanted = composite::Wanted {
        geometry,
        absolute,
        colors,
        background,
    };
    by_dtype!(T, "v_image", v_image, {
        let views = of_type::<Vec<View<T>>>(&composite.views, "v_image")?;
        let backgrounds = optional_of_shape::<T>("backgrounds", backgrounds, &[c, channels])?;
        let v_image = Array::<T>::new("v_image", v_image)?;
        let v_image = v_image.of_shape(&[c, height, width, channels])?;
        let v_alphas = optional_of_shape::<T>("v_alphas", v_alphas, &[c, height, width, 1])?;
        let backgrounds = backgrounds.as_ref().map(Array::slice);
        let (v_image, v_alphas) = (v_image.slice(), v_alphas.as_ref().map(Array::slice));
        let mut outs: Vec<_> = threads::run(py, || {
            let backward = |(i, camera): (usize, _)| {
                let input = CompositeInput {
                    projection: &frame.projections[i],
                    tiles: &views[i].0,
                    camera,
                    background: backgrounds.map(|b| &b[i * channels..(i + 1) * channels]),
                };
                let cotangents = CompositeCotangents {
                    image: &v_image[i * pixels * channels..(i + 1) * pixels * channels],
                    alphas: v_alphas.map(|a| &a[i * pixels..(i + 1) * pixels]),
                };
                composite::backward(&input, &views[i].1, &cotangents, wanted)
            };
            frame.cameras.iter().enumerate().map(backward).collect()
        })?;
        let means2d = join(&mut outs, |out| &mut out.means2d)?;
        let whitened = join(&mut outs, |out| &mut out.whitened)?;
        let opacities = join(&mut outs, |out| &mut out.opacities)?;
        let absolutes = join(&mut outs, |out| &mut out.absolute)?;
        let v_colors = join(&mut outs, |out| &mut out.colors)?;
        let v_background = join(&mut outs, |out| &mut out.background)?;
        let out = (
            geometry.then(|| means2d.into_pyarray(py)),
            geometry.then(|| whitened.into_pyarray(py)),
            geometry.then(|| opacities.into_pyarray(py)),
            (geometry && absolute).then(|| absolutes.into_pyarray(py)),
            colors.then(|| v_colors.into_pyarray(py)),
            background.then(|| v_background.into_pyarray(py)),
        );
        Ok(out.into_bound_py_any(py)?)
    })
}
