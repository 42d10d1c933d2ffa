//! Linear operators on pictures [H, W, C]: a banded matrix for each axis, and one that mixes the channels.

use fearless_simd::{Simd, SimdBase, SimdFloat, dispatch};
use hqgs::internals::{
    Error, check_len, memory,
    simd::groups::{GROUP, turned},
    simd::{self, Lanes, Real},
    uninit::UninitVec,
};
use rayon::prelude::*;

/// A matrix whose rows are kept from their first weight to their last: the zeros between them count, too.
#[derive(Debug, Clone)]
struct Bands<T> {
    /// Number of columns.
    width: usize,
    /// For each row the column of its first weight.
    firsts: Vec<usize>,
    /// Begin of each row in `weights`, and the end.
    begins: Vec<usize>,
    weights: Vec<T>,
}

impl<T: Real> Bands<T> {
    /// From a dense matrix, or from its transpose where it is `turned`.
    fn new(dense: &Dense, turned: bool, name: &str) -> Result<Self, Error> {
        let (mut height, mut width) = (dense.height, dense.width);
        let (mut down, mut across) = (dense.width, 1); // from one weight to the next
        if turned {
            (height, width, down, across) = (width, height, across, down);
        }
        let mut bands = Self {
            width,
            firsts: memory::with_capacity(height, name)?,
            begins: memory::with_capacity(height + 1, name)?,
            weights: Vec::new(),
        };
        bands.begins.push(0);
        for row in 0..height {
            let weight = |k: usize| dense.weights[row * down + k * across];
            let first = (0..width).position(|k| weight(k) != 0.0).unwrap_or(0);
            let last = (0..width).rposition(|k| weight(k) != 0.0);
            let end = last.map_or(0, |last| last + 1);
            memory::reserve(&mut bands.weights, end - first, name)?;
            let weights = (first..end).map(|k| T::from_f64(weight(k)));
            bands.weights.extend(weights);
            bands.firsts.push(first);
            bands.begins.push(bands.weights.len());
        }
        Ok(bands)
    }

    fn height(&self) -> usize {
        self.firsts.len()
    }

    /// Column of the first weight of a row, and its weights.
    #[inline(always)]
    fn row(&self, row: usize) -> (usize, &[T]) {
        let weights = &self.weights[self.begins[row]..self.begins[row + 1]];
        (self.firsts[row], weights)
    }
}

/// A dense matrix, row-major.
#[derive(Debug, Clone, Copy)]
pub struct Dense<'a> {
    /// [height, width]
    pub weights: &'a [f64],
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
}

impl Dense<'_> {
    fn check(&self, name: &'static str) -> Result<(), Error> {
        if self.height == 0 || self.width == 0 {
            let got = format!("[{}, {}]", self.height, self.width);
            return Err(Error::shape(name, "a matrix with rows and columns", got));
        }
        check_len(name, self.weights, self.height * self.width)
    }
}

/// `rows . channel . columns^T` for each channel of a picture, and between the two a matrix that mixes the
/// channels. In f32 the sums are fused in f32, front to back.
#[derive(Debug, Clone)]
pub struct Separable<T> {
    rows: Bands<T>,
    columns: Bands<T>,
    channels: Option<Bands<T>>,
}

impl<T: Real> Separable<T> {
    /// The operator of these matrices, and the one of their transposes, which gives its gradient. Without
    /// `channels` any number of them stay apart.
    ///
    /// # Errors
    /// Names a matrix without elements, or one whose weights find no memory.
    pub fn pair(
        rows: Dense,
        columns: Dense,
        channels: Option<Dense>,
    ) -> Result<(Self, Self), Error> {
        rows.check("rows")?;
        columns.check("columns")?;
        channels.map_or(Ok(()), |m| m.check("channels"))?;
        let of = |turned| -> Result<Self, Error> {
            let channels = channels.map(|m| Bands::new(&m, turned, "channels"));
            Ok(Self {
                rows: Bands::new(&rows, turned, "rows")?,
                columns: Bands::new(&columns, turned, "columns")?,
                channels: channels.transpose()?,
            })
        };
        Ok((of(false)?, of(true)?))
    }

    /// Height and width of the picture that comes out.
    #[must_use]
    pub fn size(&self) -> [usize; 2] {
        [self.rows.height(), self.columns.height()]
    }

    /// The absolute values of all weights.
    #[must_use]
    pub fn absolute(&self) -> Self {
        let abs = |m: &Bands<T>| Bands {
            weights: m
                .weights
                .iter()
                .map(|w| T::from_f64(w.to_f64().abs()))
                .collect(),
            ..m.clone()
        };
        Self {
            rows: abs(&self.rows),
            columns: abs(&self.columns),
            channels: self.channels.as_ref().map(abs),
        }
    }

    /// Shape [h, w, D] of what comes of a picture of this shape.
    ///
    /// # Errors
    /// When `shape` is not [H, W, C] with the height and width of the matrices, and their channels.
    pub fn shape(&self, shape: &[usize]) -> Result<[usize; 3], Error> {
        let (height, width) = (self.rows.width, self.columns.width);
        let [h, w] = self.size();
        match (shape, &self.channels) {
            (&[a, b, c], None) if (a, b) == (height, width) && c > 0 => Ok([h, w, c]),
            (&[a, b, c], Some(m)) if (a, b, c) == (height, width, m.width) => {
                Ok([h, w, m.height()])
            }
            _ => {
                let channels = self.channels.as_ref();
                let c = channels.map_or_else(|| "C".into(), |m| m.width.to_string());
                let expected = format!("[{height}, {width}, {c}]");
                Err(Error::shape("image", expected, format!("{shape:?}")))
            }
        }
    }

    /// The picture [h, w, D] from `image` of shape [H, W, C].
    ///
    /// # Errors
    /// As for [`Self::shape`], or when `image` has another length.
    pub fn apply(&self, image: &[T], shape: &[usize]) -> Result<Vec<T>, Error> {
        let [h, w, d] = self.shape(shape)?;
        let (row, mut pitch) = (shape[1] * shape[2], shape[1] * shape[2]);
        check_len("image", image, shape[0] * row)?;
        // The kernel reads whole vectors.
        let mut padded = Vec::new();
        if row < GROUP {
            pitch = GROUP;
            padded = memory::filled(T::ZERO, shape[0] * pitch, "image")?;
            for (to, from) in padded.chunks_exact_mut(pitch).zip(image.chunks_exact(row)) {
                to[..row].copy_from_slice(from);
            }
        }
        let picture = Padded {
            data: if row < GROUP { &padded } else { image },
            pitch,
            channels: shape[2],
        };
        let mut out = UninitVec::new(h * w * d, "image")?;
        let level = simd::level()?.token();
        let pieces = out.cut((0..h).step_by(GROUP).map(|row| GROUP.min(h - row) * w * d));
        pieces.into_par_iter().enumerate().try_for_each_init(
            Buffers::default,
            |buffers, (group, out)| {
                let out = out.fill(T::ZERO);
                dispatch!(level, simd => self.group(simd, &picture, group * GROUP, d, buffers, out))
            },
        )?;
        Ok(out.finish())
    }

    /// The output rows `first..`, one for each lane.
    #[inline(always)]
    fn group<S: Simd>(
        &self,
        simd: S,
        image: &Padded<T>,
        mut first: usize,
        channels: usize,
        buffers: &mut Buffers<T>,
        out: &mut [T],
    ) -> Result<(), Error> {
        let n = Lanes::<T, S>::LEN;
        let row = self.columns.height() * channels;
        let Buffers { tall, mixed, small } = buffers;
        for out in out.chunks_mut(n * row) {
            self.over_rows(simd, image, first, out.len() / row, tall)?;
            first += n;
            let turned = if let Some(matrix) = &self.channels {
                let len = self.columns.width * channels * n;
                memory::resize(mixed, len, T::ZERO, "image")?;
                let pixels = tall.chunks_exact(image.channels * n);
                for (pixel, mixed) in pixels.zip(mixed.chunks_exact_mut(channels * n)) {
                    for (c, mixed) in mixed.chunks_exact_mut(n).enumerate() {
                        let (first, weights) = matrix.row(c);
                        sum(simd, weights, &pixel[first * n..], n).store_slice(mixed);
                    }
                }
                &*mixed
            } else {
                &*tall
            };
            memory::resize(small, row.max(n) * n, T::ZERO, "image")?;
            let pixels = small.chunks_exact_mut(channels * n);
            for (x, pixel) in pixels.take(self.columns.height()).enumerate() {
                let (first, weights) = self.columns.row(x);
                for (c, value) in pixel.chunks_exact_mut(n).enumerate() {
                    let data = &turned[(first * channels + c) * n..];
                    sum(simd, weights, data, channels * n).store_slice(value);
                }
            }
            turn_into_rows(simd, small, row, out);
        }
        Ok(())
    }

    /// The products with `rows` in `tall`: the output row `first + lane` in each lane, `lanes` of them.
    #[inline(always)]
    fn over_rows<S: Simd>(
        &self,
        simd: S,
        image: &Padded<T>,
        first: usize,
        lanes: usize,
        tall: &mut Vec<T>,
    ) -> Result<(), Error> {
        let n = Lanes::<T, S>::LEN;
        memory::resize(tall, image.pitch * n, T::ZERO, "image")?;
        let mut block = [T::ZERO; GROUP * GROUP];
        for at in (0..image.pitch).step_by(n) {
            // The last block overlaps the one before it.
            let at = at.min(image.pitch - n);
            for lane in 0..lanes {
                let (top, weights) = self.rows.row(first + lane);
                let data = &image.data[top * image.pitch + at..];
                sum(simd, weights, data, image.pitch).store_slice(&mut block[lane * n..][..n]);
            }
            let m = turned::<S, T>(simd, &block);
            for (m, tall) in m[..n].iter().zip(tall[at * n..].chunks_exact_mut(n)) {
                m.store_slice(tall);
            }
        }
        Ok(())
    }
}

/// What the kernel reads.
struct Padded<'a, T> {
    /// [H, pitch]
    data: &'a [T],
    /// Numbers from one row to the next, at least a vector.
    pitch: usize,
    channels: usize,
}

/// Buffers of one thread, [numbers of a row, lanes].
#[derive(Default)]
struct Buffers<T> {
    tall: Vec<T>,
    mixed: Vec<T>,
    small: Vec<T>,
}

#[inline(always)]
fn load<S: Simd, T: Real>(simd: S, data: &[T], at: usize) -> Lanes<T, S> {
    Lanes::<T, S>::from_slice(simd, &data[at..at + Lanes::<T, S>::LEN])
}

/// The sum of weighted vectors `stride` apart.
#[inline(always)]
fn sum<S: Simd, T: Real>(simd: S, weights: &[T], data: &[T], stride: usize) -> Lanes<T, S> {
    let mut sum = Lanes::<T, S>::splat(simd, T::ZERO);
    for (k, weight) in weights.iter().enumerate() {
        let weight = Lanes::<T, S>::splat(simd, *weight);
        sum = weight.mul_add(load(simd, data, k * stride), sum);
    }
    sum
}

/// Turn `small`, which has a row in each lane, into rows of `row` numbers.
#[inline(always)]
fn turn_into_rows<S: Simd, T: Real>(simd: S, small: &[T], row: usize, out: &mut [T]) {
    let n = Lanes::<T, S>::LEN;
    for at in (0..row).step_by(n) {
        let at = at.min(row.saturating_sub(n));
        let m = turned::<S, T>(simd, &small[at * n..]);
        for (m, out) in m[..n].iter().zip(out.chunks_exact_mut(row)) {
            if row >= n {
                m.store_slice(&mut out[at..at + n]);
            } else {
                out.copy_from_slice(&m.as_slice()[..row]);
            }
        }
    }
}

#[cfg(test)]
mod tests;
