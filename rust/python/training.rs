//! The binding of the loss and of the optimizer.

use crate::{
    arrays::{Array, ArrayMut, Optional, by_dtype, gradient, is_f32, optional_of_shape},
    error::BindingResult,
    threads,
};
use hqgs::{Error, Real};
use hqgs_training::{
    adam::{self, AdamArrays, AdamOptions, AdamStep, Selection},
    growth,
    loss::{self, Images, LossOptions, LossScratch},
    views::{self, ViewColors, ViewRows},
};
use numpy::{Element, IntoPyArray, PyArrayDyn};
use pyo3::prelude::*;
use std::cell::RefCell;

/// Do the body with `$T` and `$Y` as the types of a render (f32 or f64) and of its target (u8 or the render's).
macro_rules! by_dtypes {
    ($T:ident, $Y:ident, $name:literal, $render:expr, $target:expr, $body:block) => {
        by_dtype!($T, $name, $render, {
            if $target.cast::<PyArrayDyn<u8>>().is_ok() {
                type $Y = u8;
                $body
            } else {
                type $Y = $T;
                $body
            }
        })
    };
}

type Loss<'py> = (f64, f64, Option<f64>, Option<Bound<'py, PyAny>>);

/// `loss::photometric`: (loss, L1, SSIM or None if `lambda_dssim` is 0, flat gradient or None).
#[pyfunction]
pub(crate) fn photometric<'py>(
    render: &Bound<'py, PyAny>,
    target: &Bound<'py, PyAny>,
    mask: Optional<'_, 'py>,
    lambda_dssim: f64,
    knee: f64,
    want_grad: bool,
) -> BindingResult<Loss<'py>> {
    let py = render.py();
    by_dtypes!(T, Y, "render", render, target, {
        let render = Array::<T>::new("render", render)?;
        let &[height, width, channels] = render.shape() else {
            let got = format!("{:?}", render.shape());
            return Err(Error::shape("render", "[H, W, C]", got).into());
        };
        let target = Array::<Y>::new("target", target)?.of_shape(render.shape())?;
        let mask = optional_of_shape("mask", mask, &[height, width])?;
        let images = Images {
            render: render.slice(),
            target: target.slice(),
            mask: mask.as_ref().map(Array::slice),
            size: [height, width, channels],
        };
        let options = LossOptions {
            lambda: lambda_dssim,
            knee,
        };
        let mut grad = gradient::<T>(py, images.render.len(), want_grad)?;
        let out = want_grad.then_some(&mut grad[..]);
        // Buffers that last as long as the calling thread, so that a step allocates none.
        thread_local!(static SCRATCH: RefCell<LossScratch<T>> = RefCell::default());
        let value = SCRATCH.with_borrow_mut(|scratch| {
            threads::run(py, || loss::photometric(images, &options, out, scratch))
        })?;
        let grad = want_grad.then(|| grad.into_pyarray(py).into_any());
        Ok((value.loss, value.l1, value.ssim, grad))
    })
}

/// `(param, grad, exp_avg, exp_avg_sq, step, (lr, beta1, beta2, eps), used)`
type StepOf<'py> = (
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    u64,
    (f64, f64, f64, f64),
    Option<usize>,
);

/// `adam::steps`, in place on `param`, `exp_avg` and `exp_avg_sq` of each. `used`: of parameters [N, K, ...] the first
/// so many of the K alone are updated.
#[pyfunction]
pub(crate) fn adam_steps(py: Python<'_>, steps: Vec<StepOf<'_>>) -> BindingResult<()> {
    let (mut single, mut double) = (Vec::new(), Vec::new());
    for step in &steps {
        if is_f32("param", &step.0)? {
            single.push(HeldStep::<f32>::new(step)?);
        } else {
            double.push(HeldStep::<f64>::new(step)?);
        }
    }
    let single: Vec<_> = single.iter_mut().map(HeldStep::borrow).collect();
    let double: Vec<_> = double.iter_mut().map(HeldStep::borrow).collect();
    threads::run(py, || {
        adam::check(&single)?;
        adam::check(&double)?;
        adam::steps(single).and_then(|()| adam::steps(double))
    })
}

/// The borrowed arrays of a step.
struct HeldStep<'py, T: Element> {
    param: ArrayMut<'py, T>,
    grad: Array<'py, T>,
    exp_avg: ArrayMut<'py, T>,
    exp_avg_sq: ArrayMut<'py, T>,
    step: u64,
    options: AdamOptions,
    selection: Selection,
}

impl<'py, T: Real + Element> HeldStep<'py, T> {
    fn new(
        (param, grad, exp_avg, exp_avg_sq, step, options, used): &StepOf<'py>,
    ) -> BindingResult<Self> {
        let param = ArrayMut::<T>::new("param", param)?;
        let shape = param.shape().to_vec();
        if let Some(used) = used.filter(|used| shape.len() < 2 || *used > shape[1]) {
            let message = format!("cannot update {used} columns of {shape:?}");
            return Err(Error::new("used", message).into());
        }
        let width: usize = shape.iter().skip(1).product();
        let (lr, beta1, beta2, eps) = *options;
        Ok(Self {
            param,
            exp_avg: ArrayMut::new("exp_avg", exp_avg)?.of_shape(&shape)?,
            exp_avg_sq: ArrayMut::new("exp_avg_sq", exp_avg_sq)?.of_shape(&shape)?,
            grad: Array::new("grad", grad)?.of_shape(&shape)?,
            step: *step,
            options: AdamOptions {
                lr,
                beta1,
                beta2,
                eps,
            },
            selection: Selection {
                width,
                used: used.map_or(width, |used| used * shape[2..].iter().product::<usize>()),
            },
        })
    }

    fn borrow(&mut self) -> AdamStep<'_, T> {
        AdamStep {
            arrays: AdamArrays {
                param: self.param.slice(),
                grad: self.grad.slice(),
                exp_avg: self.exp_avg.slice(),
                exp_avg_sq: self.exp_avg_sq.slice(),
            },
            step: self.step,
            options: self.options,
            selection: self.selection,
        }
    }
}

/// See [`views::add`]: `(rows [M] i32, values [M, W] f32)` of each view are added to `sums [N, W]`, f32.
#[pyfunction]
pub(crate) fn add_rows(
    py: Python<'_>,
    views: Vec<(Bound<'_, PyAny>, Bound<'_, PyAny>)>,
    sums: &Bound<'_, PyAny>,
    scale: f32,
) -> BindingResult<()> {
    let mut sums = ArrayMut::<f32>::new("sums", sums)?;
    let &[_, width] = sums.shape() else {
        let got = format!("{:?}", sums.shape());
        return Err(Error::shape("sums", "[N, W]", got).into());
    };
    let views = views
        .iter()
        .map(|(rows, values)| HeldRows::new("values", rows, values, width))
        .collect::<BindingResult<Vec<_>>>()?;
    let views: Vec<_> = views.iter().map(HeldRows::borrow).collect();
    let sums = sums.slice();
    threads::run(py, || views::add(&views, sums, width, scale))
}

/// See [`growth::add_pulls`]: the `gradient [N, 2]` of one view is added to `sums [N]` and `views [N]`, all f32, where `radii
/// [N, 2] i32` are not 0.
#[pyfunction]
pub(crate) fn add_pulls(
    sums: &Bound<'_, PyAny>,
    views: &Bound<'_, PyAny>,
    gradient: &Bound<'_, PyAny>,
    radii: &Bound<'_, PyAny>,
    half: [f32; 2],
) -> BindingResult<()> {
    let py = sums.py();
    let (gradient, n) = Array::<f32>::new("gradient", gradient)?.of_width(2)?;
    let radii = Array::<i32>::new("radii", radii)?.of_shape(&[n, 2])?;
    let mut sums = ArrayMut::<f32>::new("sums", sums)?.of_shape(&[n])?;
    let mut views = ArrayMut::<f32>::new("views", views)?.of_shape(&[n])?;
    let (sums, views) = (sums.slice(), views.slice());
    let (gradient, radii) = (gradient.slice(), radii.slice());
    threads::run(py, || growth::add_pulls(sums, views, gradient, radii, half))
}

/// `(rows [M] i32, colors [M, 3] f32, centre, degree)`
type ColorsOfView<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>, [f64; 3], usize);

/// See [`views::add_harmonics`]. Everything but the rows' numbers is f32.
#[pyfunction]
pub(crate) fn add_harmonics(
    py: Python<'_>,
    views: Vec<ColorsOfView<'_>>,
    means: &Bound<'_, PyAny>,
    high: &Bound<'_, PyAny>,
    scale: f32,
) -> BindingResult<()> {
    let (means, n) = Array::<f32>::new("means", means)?.of_width(3)?;
    let high = ArrayMut::<f32>::new("high", high)?;
    let coefficients = high.shape().get(1).copied().unwrap_or(0);
    let mut high = high.of_shape(&[n, coefficients, 3])?;
    let held = views
        .iter()
        .map(|(rows, colors, ..)| HeldRows::new("colors", rows, colors, 3))
        .collect::<BindingResult<Vec<_>>>()?;
    let views: Vec<_> = held
        .iter()
        .zip(&views)
        .map(|(colors, &(_, _, center, degree))| ViewColors {
            colors: colors.borrow(),
            center,
            degree,
        })
        .collect();
    let (means, high) = (means.slice(), high.slice());
    threads::run(py, || views::add_harmonics(&views, means, high, scale))
}

/// The borrowed rows `[M]` of a view, and the numbers `[M, width]` that it has for them.
struct HeldRows<'py> {
    rows: Array<'py, i32>,
    values: Array<'py, f32>,
}

impl<'py> HeldRows<'py> {
    fn new(
        name: &'static str,
        rows: &Bound<'py, PyAny>,
        values: &Bound<'py, PyAny>,
        width: usize,
    ) -> BindingResult<Self> {
        let (values, m) = Array::<f32>::new(name, values)?.of_width(width)?;
        let rows = Array::<i32>::new("rows", rows)?.of_shape(&[m])?;
        Ok(Self { rows, values })
    }

    fn borrow(&self) -> ViewRows<'_> {
        ViewRows {
            rows: self.rows.slice(),
            values: self.values.slice(),
        }
    }
}
