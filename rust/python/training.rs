//! The binding of the loss and of the optimizer.

use crate::arrays::{Array, ArrayMut, gradient, is_f32, optional_of_shape};
use crate::error::BindingResult;
use crate::threads;
use hqgs::{Error, Real};
use hqgs_training::{
    adam::{self, AdamArrays, AdamOptions, AdamStep, Selection},
    growth::{self, Pulls},
    loss::{self, LossOptions, LossScratch, Sample},
    views::{self, ViewColors, ViewRows},
};
use numpy::{Element, IntoPyArray, PyArrayDyn};
use pyo3::prelude::*;
use std::cell::RefCell;

/// Add the functions of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(photometric, m)?)?;
    m.add_function(wrap_pyfunction!(ssim, m)?)?;
    m.add_function(wrap_pyfunction!(adam_steps, m)?)?;
    m.add_function(wrap_pyfunction!(add_rows, m)?)?;
    m.add_function(wrap_pyfunction!(add_pulls, m)?)?;
    m.add_function(wrap_pyfunction!(all_below, m)?)?;
    m.add_function(wrap_pyfunction!(add_harmonics, m)?)
}

/// A scalar type with buffers that last as long as the calling thread, so that a step allocates none.
trait Buffered: Real + Element {
    fn with_scratch<R>(f: impl FnOnce(&mut LossScratch<Self>) -> R) -> R;
}

macro_rules! buffered {
    ($type:ty) => {
        impl Buffered for $type {
            fn with_scratch<R>(f: impl FnOnce(&mut LossScratch<Self>) -> R) -> R {
                thread_local!(static SCRATCH: RefCell<LossScratch<$type>> = RefCell::default());
                SCRATCH.with_borrow_mut(f)
            }
        }
    };
}
buffered!(f32);
buffered!(f64);

/// Call `$function::<T, Y>` for the dtypes of a render (f32 or f64) and of its target (u8 or the render's).
macro_rules! by_dtypes {
    ($name:literal, $render:expr, $target:expr, $function:ident($($argument:expr),*)) => {
        match (is_f32($name, $render)?, $target.cast::<PyArrayDyn<u8>>().is_ok()) {
            (true, true) => $function::<f32, u8>($($argument),*),
            (true, false) => $function::<f32, f32>($($argument),*),
            (false, true) => $function::<f64, u8>($($argument),*),
            (false, false) => $function::<f64, f64>($($argument),*),
        }
    };
}

/// Two images [H, W, C] and a mask [H, W].
struct Images<'py, T: Element, Y: Element> {
    x: Array<'py, T>,
    y: Array<'py, Y>,
    mask: Option<Array<'py, u8>>,
}

impl<'py, T: Element, Y: Element> Images<'py, T, Y> {
    fn new(
        [x_name, y_name]: [&'static str; 2],
        x: &Bound<'py, PyAny>,
        y: &Bound<'py, PyAny>,
        mask: Option<&Bound<'py, PyAny>>,
    ) -> BindingResult<Self> {
        let x = Array::new(x_name, x)?;
        let shape = x.shape();
        if shape.len() != 3 {
            return Err(Error::shape(x_name, "[H, W, C]", format!("{shape:?}")).into());
        }
        let y = Array::new(y_name, y)?.of_shape(shape)?;
        let mask = optional_of_shape("mask", mask, &shape[..2])?;
        Ok(Self { x, y, mask })
    }

    fn borrow(&self) -> BindingResult<loss::Images<'_, T, Y>> {
        let &[h, w, c] = self.x.shape() else {
            unreachable!("checked above")
        };
        Ok(loss::Images {
            render: self.x.slice()?,
            target: self.y.slice()?,
            mask: self.mask.as_ref().map(Array::slice).transpose()?,
            size: [h, w, c],
        })
    }
}

type Loss<'py> = (f64, f64, Option<f64>, Option<Bound<'py, PyAny>>);

/// `loss::photometric`: (loss, L1, SSIM or None if `lambda_dssim` is 0, flat gradient or None).
#[pyfunction]
fn photometric<'py>(
    render: &Bound<'py, PyAny>,
    target: &Bound<'py, PyAny>,
    mask: Option<&Bound<'py, PyAny>>,
    lambda_dssim: f64,
    knee: f64,
    want_grad: bool,
) -> BindingResult<Loss<'py>> {
    by_dtypes!(
        "render",
        render,
        target,
        photometric_as(render, target, mask, lambda_dssim, knee, want_grad)
    )
}

fn photometric_as<'py, T: Buffered, Y: Sample<T> + Element>(
    render: &Bound<'py, PyAny>,
    target: &Bound<'py, PyAny>,
    mask: Option<&Bound<'py, PyAny>>,
    lambda_dssim: f64,
    knee: f64,
    want_grad: bool,
) -> BindingResult<Loss<'py>> {
    let py = render.py();
    let images = Images::<T, Y>::new(["render", "target"], render, target, mask)?;
    let images = images.borrow()?;
    let options = LossOptions {
        lambda: lambda_dssim,
        knee,
    };
    let mut grad = gradient::<T>(images.render.len(), want_grad)?;
    let out = want_grad.then_some(&mut grad[..]);
    let value = py.detach(|| {
        T::with_scratch(|scratch| {
            threads::install(|| loss::photometric(images, &options, out, scratch))
        })
    })??;
    let grad = want_grad.then(|| grad.into_pyarray(py).into_any());
    Ok((value.loss, value.l1, value.ssim, grad))
}

/// `loss::ssim`.
#[pyfunction]
#[pyo3(signature = (a, b, mask = None))]
fn ssim(
    a: &Bound<'_, PyAny>,
    b: &Bound<'_, PyAny>,
    mask: Option<&Bound<'_, PyAny>>,
) -> BindingResult<f64> {
    by_dtypes!("a", a, b, ssim_as(a, b, mask))
}

fn ssim_as<'py, T: Buffered, Y: Sample<T> + Element>(
    a: &Bound<'py, PyAny>,
    b: &Bound<'py, PyAny>,
    mask: Option<&Bound<'py, PyAny>>,
) -> BindingResult<f64> {
    let images = Images::<T, Y>::new(["a", "b"], a, b, mask)?;
    let images = images.borrow()?;
    let value = a
        .py()
        .detach(|| T::with_scratch(|scratch| threads::install(|| loss::ssim(images, scratch))))?;
    Ok(value.map_err(|e| e.renamed("render", "a").renamed("target", "b"))?)
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
fn adam_steps(py: Python<'_>, steps: Vec<StepOf<'_>>) -> BindingResult<()> {
    let (mut single, mut double) = (Vec::new(), Vec::new());
    for step in &steps {
        if is_f32("param", &step.0)? {
            single.push(HeldStep::<f32>::new(step)?);
        } else {
            double.push(HeldStep::<f64>::new(step)?);
        }
    }
    let single = single
        .iter_mut()
        .map(HeldStep::borrow)
        .collect::<BindingResult<Vec<_>>>()?;
    let double = double
        .iter_mut()
        .map(HeldStep::borrow)
        .collect::<BindingResult<Vec<_>>>()?;
    Ok(py.detach(|| {
        threads::install(|| {
            adam::check(&single)?;
            adam::check(&double)?;
            adam::steps(single).and_then(|()| adam::steps(double))
        })
    })??)
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

    fn borrow(&mut self) -> BindingResult<AdamStep<'_, T>> {
        Ok(AdamStep {
            arrays: AdamArrays {
                param: self.param.slice()?,
                grad: self.grad.slice()?,
                exp_avg: self.exp_avg.slice()?,
                exp_avg_sq: self.exp_avg_sq.slice()?,
            },
            step: self.step,
            options: self.options,
            selection: self.selection,
        })
    }
}

/// See [`views::add`]: `(rows [M] i32, values [M, W] f32)` of each view are added to `sums [N, W]`, f32.
#[pyfunction]
fn add_rows(
    views: Vec<(Bound<'_, PyAny>, Bound<'_, PyAny>)>,
    sums: &Bound<'_, PyAny>,
    scale: f32,
) -> BindingResult<()> {
    let mut held = ArrayMut::<f32>::new("sums", sums)?;
    let &[_, width] = held.shape() else {
        let got = format!("{:?}", held.shape());
        return Err(Error::shape("sums", "[N, W]", got).into());
    };
    let views = views
        .iter()
        .map(|(rows, values)| rows_of("values", rows, values, width))
        .collect::<BindingResult<Vec<_>>>()?;
    let views = views
        .iter()
        .map(|(rows, values)| {
            Ok(ViewRows {
                rows: rows.slice()?,
                values: values.slice()?,
            })
        })
        .collect::<BindingResult<Vec<_>>>()?;
    let target = held.slice()?;
    Ok(sums
        .py()
        .detach(|| threads::install(|| views::add(&views, target, width, scale)))??)
}

/// See [`Pulls::add`]: the `gradient [N, 2]` of one view is added to `sums [N]` and `views [N]`, all f32, where `radii
/// [N, 2] i32` are not 0.
#[pyfunction]
fn add_pulls(
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
    let mut pulls = Pulls {
        sums: sums.slice()?,
        views: views.slice()?,
    };
    let (gradient, radii) = (gradient.slice()?, radii.slice()?);
    Ok(py.detach(|| threads::install(|| pulls.add(gradient, radii, half)))??)
}

/// See [`growth::all_below`]: of several arrays, f32 or f64, each with its limit.
#[pyfunction]
fn all_below(py: Python<'_>, arrays: Vec<(Bound<'_, PyAny>, f64)>) -> BindingResult<bool> {
    let (mut single, mut double) = (Vec::new(), Vec::new());
    for (array, limit) in &arrays {
        if is_f32("arrays", array)? {
            single.push((Array::<f32>::new("arrays", array)?, *limit));
        } else {
            double.push((Array::<f64>::new("arrays", array)?, *limit));
        }
    }
    let (single, double) = (slices(&single)?, slices(&double)?);
    py.detach(|| threads::install(|| growth::all_below(&single) && growth::all_below(&double)))
}

fn slices<'a, T: Element>(arrays: &'a [(Array<'_, T>, f64)]) -> BindingResult<Vec<(&'a [T], f64)>> {
    arrays
        .iter()
        .map(|(array, limit)| Ok((array.slice()?, *limit)))
        .collect()
}

/// `(rows [M] i32, colors [M, 3] f32, centre, degree)`
type ColorsOfView<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>, [f64; 3], usize);

/// See [`views::add_harmonics`]. Everything but the rows' numbers is f32.
#[pyfunction]
fn add_harmonics(
    views: Vec<ColorsOfView<'_>>,
    means: &Bound<'_, PyAny>,
    high: &Bound<'_, PyAny>,
    scale: f32,
) -> BindingResult<()> {
    let (means_of, n) = Array::<f32>::new("means", means)?.of_width(3)?;
    let high = ArrayMut::<f32>::new("high", high)?;
    let coefficients = high.shape().get(1).copied().unwrap_or(0);
    let mut high = high.of_shape(&[n, coefficients, 3])?;
    let held = views
        .iter()
        .map(|(rows, colors, center, degree)| {
            Ok((rows_of("colors", rows, colors, 3)?, *center, *degree))
        })
        .collect::<BindingResult<Vec<_>>>()?;
    let views = held
        .iter()
        .map(|((rows, colors), center, degree)| {
            let colors = ViewRows {
                rows: rows.slice()?,
                values: colors.slice()?,
            };
            Ok(ViewColors {
                colors,
                center: *center,
                degree: *degree,
            })
        })
        .collect::<BindingResult<Vec<_>>>()?;
    let (high, means_of) = (high.slice()?, means_of.slice()?);
    Ok(means
        .py()
        .detach(|| threads::install(|| views::add_harmonics(&views, means_of, high, scale)))??)
}

/// The numbers `[M, width]` of a view's rows `[M]`.
fn rows_of<'py>(
    name: &'static str,
    rows: &Bound<'py, PyAny>,
    values: &Bound<'py, PyAny>,
    width: usize,
) -> BindingResult<(Array<'py, i32>, Array<'py, f32>)> {
    let (values, m) = Array::<f32>::new(name, values)?.of_width(width)?;
    Ok((Array::<i32>::new("rows", rows)?.of_shape(&[m])?, values))
}
