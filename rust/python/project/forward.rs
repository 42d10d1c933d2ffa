//! The binding of the projection, forward.

use super::{Arrays, Frame, Projections, channels_of, of_camera};
use crate::threads;
use crate::{
    arrays::{Array, Optional, Scalar, by_dtype, join, optional, optional_of_shape},
    error::BindingResult,
};
use hqgs::internals::{
    Error,
    accuracy_knobs::{AccuracyKnobs, Spans},
    counts::Counts,
    project::{self, RenderOptions},
    scene::{Camera, Colors, Harmonics},
};
use hqgs::render;
use numpy::{Element, IntoPyArray, PyArray1};
use pyo3::{IntoPyObjectExt, prelude::*};
use std::sync::Arc;

fn cameras(
    viewmats: &Bound<'_, PyAny>,
    ks: &Bound<'_, PyAny>,
    [width, height]: [usize; 2],
) -> BindingResult<Vec<Camera>> {
    let viewmats = Array::<f64>::new("viewmats", viewmats)?;
    let &[c, 4, 4] = viewmats.shape() else {
        let got = format!("{:?}", viewmats.shape());
        return Err(Error::shape("viewmats", "[C, 4, 4]", got).into());
    };
    let ks = Array::<f64>::new("Ks", ks)?.of_shape(&[c, 3, 3])?;
    let ((views, _), (ks, _)) = (viewmats.slice()?.as_chunks(), ks.slice()?.as_chunks());
    let cameras = views.iter().zip(ks);
    Ok(cameras
        .map(|(v, k)| {
            let camera = Camera::new(v, k, width, height);
            camera.map_err(|e| e.renamed("viewmat", "viewmats").renamed("k", "Ks"))
        })
        .collect::<Result<_, _>>()?)
}

/// alpha_min, transmittance_min, spans, skip_blocks
type Knobs<'a> = (f64, f64, &'a str, bool);

fn accuracy_knobs(knobs: Option<Knobs>) -> Result<AccuracyKnobs, Error> {
    let Some((alpha_min, transmittance_min, spans, skip_blocks)) = knobs else {
        return Ok(AccuracyKnobs::default());
    };
    let spans = match spans {
        "ellipse" => Spans::Ellipse,
        "box" => Spans::Box,
        _ => {
            let message = format!("must be ellipse or box, got {spans}");
            return Err(Error::new("spans", message));
        }
    };
    let knobs = AccuracyKnobs {
        alpha_min,
        transmittance_min,
        spans,
        skip_blocks,
    };
    knobs.check()?;
    Ok(knobs)
}

/// What an image is made from, as it was given.
struct Inputs<'a, 'py> {
    /// Means, quaternions, scales, opacities.
    gaussians: [&'a Bound<'py, PyAny>; 4],
    colors: &'a Bound<'py, PyAny>,
    rest: Optional<'a, 'py>,
    viewmats: &'a Bound<'py, PyAny>,
    ks: &'a Bound<'py, PyAny>,
    /// Width and height.
    size: [usize; 2],
    sh_degree: Option<usize>,
    options: RenderOptions,
}

/// Its arrays, borrowed, and the cameras.
struct Held<'py, T: Element> {
    arrays: Arrays<'py, T>,
    shades: Shades<'py, T>,
    cameras: Vec<Camera>,
}

impl<'py> Inputs<'_, 'py> {
    fn hold<T: Scalar>(&self) -> BindingResult<Held<'py, T>> {
        Ok(Held {
            arrays: Arrays::new(self.gaussians)?,
            shades: Shades::new(self.colors, self.rest)?,
            cameras: cameras(self.viewmats, self.ks, self.size)?,
        })
    }
}

/// Pictures of Gaussians in 8 bits, [C, H, W, channels], without a way back; arguments as for `project_forward`.
#[pyfunction]
#[pyo3(signature = (means, quats, scales, opacities, colors, rest, viewmats, ks, width, height, options, sh_degree, backgrounds))]
pub(super) fn pictures<'py>(
    means: &Bound<'py, PyAny>,
    quats: &Bound<'py, PyAny>,
    scales: &Bound<'py, PyAny>,
    opacities: &Bound<'py, PyAny>,
    colors: &Bound<'py, PyAny>,
    rest: Optional<'_, 'py>,
    viewmats: &Bound<'py, PyAny>,
    ks: &Bound<'py, PyAny>,
    width: usize,
    height: usize,
    options: (f64, f64, f64, f64, bool, bool),
    sh_degree: Option<usize>,
    backgrounds: Optional<'_, 'py>,
) -> BindingResult<Bound<'py, PyArray1<u8>>> {
    let inputs = Inputs {
        gaussians: [means, quats, scales, opacities],
        colors,
        rest,
        viewmats,
        ks,
        size: [width, height],
        sh_degree,
        options: options_of(options),
    };
    by_dtype!(
        "means",
        means,
        pictures_as(means.py(), &inputs, backgrounds)
    )
}

fn pictures_as<'py, T: Scalar>(
    py: Python<'py>,
    inputs: &Inputs<'_, 'py>,
    backgrounds: Optional<'_, 'py>,
) -> BindingResult<Bound<'py, PyArray1<u8>>> {
    let Held {
        arrays,
        shades,
        cameras,
    } = &inputs.hold::<T>()?;
    let gaussians = arrays.gaussians()?;
    let colors = shades.of(gaussians.len(), cameras.len(), inputs.sh_degree)?;
    let (channels, options) = (colors(0).channels(), inputs.options);
    let backgrounds =
        optional_of_shape::<T>("backgrounds", backgrounds, &[cameras.len(), channels])?;
    let backgrounds = backgrounds.as_ref().map(Array::slice).transpose()?;
    let mut pictures: Vec<_> = py.detach(|| {
        threads::install(|| {
            let picture = |(i, camera)| {
                let behind = backgrounds.map(|b| &b[i * channels..(i + 1) * channels]);
                render::picture(gaussians, colors(i), behind, camera, &options)
            };
            let cameras = cameras.iter().enumerate();
            cameras.map(picture).collect::<Result<_, Error>>()
        })
    })??;
    Ok(join(&mut pictures, |picture| picture)?.into_pyarray(py))
}

/// The options of an image: near, far, radius_clip, eps2d, antialiased, and whether it is differentiated.
fn options_of(options: (f64, f64, f64, f64, bool, bool)) -> RenderOptions {
    let (near_plane, far_plane, radius_clip, eps2d, antialiased, differentiable) = options;
    RenderOptions {
        near_plane,
        far_plane,
        radius_clip,
        eps2d,
        antialiased,
        differentiable,
        ..RenderOptions::default()
    }
}

/// The borrowed arrays of colours: channels, or harmonics.
struct Shades<'py, T: Element> {
    colors: Array<'py, T>,
    rest: Option<Array<'py, T>>,
}

impl<'py, T: Scalar> Shades<'py, T> {
    fn new(colors: &Bound<'py, PyAny>, rest: Optional<'_, 'py>) -> BindingResult<Self> {
        let name = if rest.is_some() {
            "colors[0]"
        } else {
            "colors"
        };
        Ok(Self {
            colors: Array::new(name, colors)?,
            rest: optional("colors[1]", rest)?,
        })
    }

    /// Those of `n` Gaussians in each of so many cameras, by its number.
    fn of<'a>(
        &'a self,
        n: usize,
        cameras: usize,
        sh_degree: Option<usize>,
    ) -> BindingResult<impl Fn(usize) -> Colors<'a, T> + Sync + use<'a, T>> {
        let harmonics = sh_degree
            .map(|degree| harmonics(&self.colors, self.rest.as_ref(), n, cameras, degree))
            .transpose()?;
        let (data, channels) = match harmonics {
            Some(harmonics) => (harmonics.coefficients, 0),
            None => channels_of(&self.colors, n, cameras)?,
        };
        Ok(move |i| match harmonics {
            None => Colors::Channels(of_camera(data, i, n * channels), channels),
            Some(harmonics) => Colors::Harmonics(Harmonics {
                coefficients: of_camera(data, i, n * harmonics.rows().0),
                ..harmonics
            }),
        })
    }

    /// Whether each camera has harmonics of its own.
    fn of_each(&self) -> bool {
        matches!(*self.colors.shape(), [c, _, _, _] if c > 1)
    }
}

/// Project Gaussians; see `hqgs/model/rasterization.py` for the shapes. `colors` are harmonics if there is a degree.
/// `knobs`, which also hold for the later stages, are for the benchmark of error against run time alone.
#[pyfunction]
#[pyo3(signature = (means, quats, scales, opacities, colors, rest, viewmats, ks, width, height, options, sh_degree, activate=false, knobs=None))]
pub(super) fn project_forward<'py>(
    means: &Bound<'py, PyAny>,
    quats: &Bound<'py, PyAny>,
    scales: &Bound<'py, PyAny>,
    opacities: &Bound<'py, PyAny>,
    colors: &Bound<'py, PyAny>,
    rest: Optional<'_, 'py>,
    viewmats: &Bound<'py, PyAny>,
    ks: &Bound<'py, PyAny>,
    width: usize,
    height: usize,
    options: (f64, f64, f64, f64, bool, bool),
    sh_degree: Option<usize>,
    activate: bool,
    knobs: Option<Knobs>,
) -> BindingResult<Bound<'py, PyAny>> {
    let inputs = Inputs {
        gaussians: [means, quats, scales, opacities],
        colors,
        rest,
        viewmats,
        ks,
        size: [width, height],
        sh_degree,
        options: RenderOptions {
            activate,
            knobs: accuracy_knobs(knobs)?,
            ..options_of(options)
        },
    };
    by_dtype!("means", means, project_as(means.py(), &inputs))
}

fn project_as<'py, T: Scalar>(
    py: Python<'py>,
    inputs: &Inputs<'_, 'py>,
) -> BindingResult<Bound<'py, PyAny>> {
    let Held {
        arrays,
        shades,
        cameras,
    } = inputs.hold::<T>()?;
    let (gaussians, options) = (arrays.gaussians()?, inputs.options);
    let n = gaussians.len();
    let colors = shades.of(n, cameras.len(), inputs.sh_degree)?;
    let mut outs: Vec<_> = py.detach(|| {
        threads::install(|| {
            let project =
                |(i, camera)| project::forward(&gaussians, colors(i), camera, &options, true);
            cameras
                .iter()
                .enumerate()
                .map(project)
                .collect::<Result<_, Error>>()
        })
    })??;
    let means2d = join(&mut outs, |out| &mut out.means2d)?;
    let depths = join(&mut outs, |out| &mut out.depths)?;
    let conics = join(&mut outs, |out| &mut out.conics)?;
    let radii = join(&mut outs, |out| &mut out.radii)?;
    let opacities = join(&mut outs, |out| &mut out.opacities)?;
    let colors = join(&mut outs, |out| &mut out.colors)?;
    let frame = Frame(Arc::new(Projections {
        cameras,
        counts: outs
            .iter()
            .fold(Counts::default(), |sum, out| sum.plus(out.counts)),
        shadings: Box::new(
            outs.iter_mut()
                .map(|out| out.shading.take())
                .collect::<Vec<_>>(),
        ),
        projections: outs.into_iter().map(|out| out.projection).collect(),
        options,
        n,
        harmonics_of_each: shades.of_each(),
    }));
    let out = (
        frame,
        means2d.into_pyarray(py),
        depths.into_pyarray(py),
        conics.into_pyarray(py),
        radii.into_pyarray(py),
        opacities.into_pyarray(py),
        colors.into_pyarray(py),
    );
    Ok(out.into_bound_py_any(py)?)
}

fn harmonics<'a, T: Scalar>(
    colors: &'a Array<'_, T>,
    rest: Option<&'a Array<'_, T>>,
    n: usize,
    cameras: usize,
    degree: usize,
) -> BindingResult<Harmonics<'a, T>> {
    let count = |name: &str, array: &Array<'_, T>| match *array.shape() {
        [given, k, 3] if given == n => Ok(k),
        [c, given, k, 3] if (c, given) == (cameras, n) && rest.is_none() => Ok(k),
        ref shape => {
            let expected = format!("[{n}, K, 3]");
            Err(Error::shape(name, expected, format!("{shape:?}")))
        }
    };
    let stored = match rest {
        None => count("colors", colors)?,
        Some(rest) => {
            let constant = count("colors[0]", colors)?;
            if constant != 1 {
                let (expected, got) = (format!("[{n}, 1, 3]"), format!("[{n}, {constant}, 3]"));
                return Err(Error::shape("colors[0]", expected, got).into());
            }
            1 + count("colors[1]", rest)?
        }
    };
    let harmonics = Harmonics {
        coefficients: colors.slice()?,
        rest: rest.map(Array::slice).transpose()?,
        stored,
        degree,
    };
    let first = Harmonics {
        coefficients: of_camera(harmonics.coefficients, 0, n * harmonics.rows().0),
        ..harmonics
    };
    first
        .check(n)
        .map_err(|e| e.renamed("degree", "sh_degree"))?;
    Ok(harmonics)
}
