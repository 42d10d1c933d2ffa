//! The binding of the search for depths.

use crate::{arrays::Array, error::BindingResult, threads};
use hqgs::Error;
use hqgs_training::stereo::{self, Other, Photo};
use numpy::IntoPyArray;
use pyo3::prelude::*;

type Found<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>);

/// `stereo::depths`: (depths [M] of float64, correlations [M] of float32). `first` and each of `others` [h, w] of
/// float32, `maps` [K, 3, 4], `pixels` and `ranges` (nearest and farthest depth) [M, 2] of float64.
#[pyfunction]
pub(crate) fn agreed_depths<'py>(
    first: &Bound<'py, PyAny>,
    others: Vec<Bound<'py, PyAny>>,
    maps: &Bound<'py, PyAny>,
    pixels: &Bound<'py, PyAny>,
    ranges: &Bound<'py, PyAny>,
    agreeing: usize,
) -> BindingResult<Found<'py>> {
    let py = first.py();
    let first = Array::<f32>::new("first", first)?;
    let others = others
        .iter()
        .map(|other| Array::<f32>::new("others", other))
        .collect::<BindingResult<Vec<_>>>()?;
    let maps = Array::<f64>::new("maps", maps)?.of_shape(&[others.len(), 3, 4])?;
    let (pixels, count) = Array::<f64>::new("pixels", pixels)?.of_width(2)?;
    let ranges = Array::<f64>::new("ranges", ranges)?.of_shape(&[count, 2])?;
    let first = picture("first", &first)?;
    let others = others
        .iter()
        .zip(maps.slice().as_chunks().0)
        .map(|(other, &map)| {
            let picture = picture("others", other)?;
            Ok(Other { picture, map })
        })
        .collect::<BindingResult<Vec<_>>>()?;
    let (pixels, ranges) = (pixels.slice().as_chunks().0, ranges.slice().as_chunks().0);
    let found = threads::run(py, || {
        stereo::depths(first, &others, pixels, ranges, agreeing)
    })?;
    let (depths, scores): (Vec<_>, Vec<_>) = found.into_iter().unzip();
    Ok((
        depths.into_pyarray(py).into_any(),
        scores.into_pyarray(py).into_any(),
    ))
}

fn picture<'a>(name: &'static str, array: &'a Array<'_, f32>) -> BindingResult<Photo<'a>> {
    let &[height, width] = array.shape() else {
        return Err(Error::shape(name, "[H, W]", format!("{:?}", array.shape())).into());
    };
    Ok(Photo {
        size: [height, width],
        grey: array.slice(),
    })
}
