//! How a camera takes a render: the mean over the exposure in linear light, with a gain for each channel.
//!
//! At each sample of the exposure the camera, or a point of its lens, stands a little elsewhere. A turn moves the
//! picture by a homography whatever the depth, a small move of the camera moves a pixel by its inverse depth; so each
//! sample is the one render, warped, and costs a bilinear look-up in the place of a render.

mod curve;

pub use curve::Light;

use curve::{Tables, tables};
use fearless_simd::{Simd, dispatch};
use hqgs::internals::{
    Error, check_len, memory, simd,
    uninit::{UninitPiece, UninitVec, zeros},
};
use rayon::prelude::*;

/// Rows that are done together: the order of the sums depends on nothing else.
const BAND: usize = 16;
/// Numbers of a pixel in linear light: red, green, blue, and one that fills the vector.
const WIDE: usize = 4;

/// The sizes of a render and of the photo in its middle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sizes {
    /// Height and width of the photo.
    pub size: [usize; 2],
    /// Pixels that the render is larger by on each side.
    pub margin: usize,
}

impl Sizes {
    fn render_size(&self) -> [usize; 2] {
        let margins = self.margin.saturating_mul(2); // no array has so many elements as these could
        self.size.map(|side| side.saturating_add(margins))
    }

    fn pixels(&self) -> usize {
        self.size[0].saturating_mul(self.size[1])
    }
}

/// One sample of the exposure: the matrix [3, 4], less the identity, that takes a pixel of the photo (x, y, 1,
/// 1 / depth) to where the render shows it, (x, y, 1) times some w > 0. Pixels' centres lie at halves.
pub type Warp = [f64; 12];

/// A photo, and what its gradient needs.
#[derive(Debug)]
pub struct Photograph<T> {
    sizes: Sizes,
    /// [H, W, 3], values
    pub photo: Vec<T>,
    /// Of the render, values.
    image: Vec<T>,
    light: Vec<[T; WIDE]>,
    /// Of the photo, light before the gains, [H, W].
    mean: Vec<[T; WIDE]>,
    nearness: Vec<T>,
    warps: Vec<Warp>,
    gains: [f64; 3],
}

/// Gradients with respect to what [`Photograph::take`] was given.
#[derive(Debug)]
pub struct PhotographGradients<T> {
    /// [H + 2 margin, W + 2 margin, 3]
    pub image: Vec<T>,
    /// As the warps.
    pub warps: Vec<Warp>,
    /// Of red, green and blue.
    pub gains: [f64; 3],
}

/// Cut a vector of `len` elements into pieces of `size`, of which the last one may be shorter.
fn pieces<T: Copy>(vector: &mut UninitVec<T>, len: usize, size: usize) -> Vec<UninitPiece<'_, T>> {
    vector.cut((0..len).step_by(size).map(|at| size.min(len - at)))
}

impl<T: Light> Photograph<T> {
    /// The photo [H, W, 3] of a render [H + 2 margin, W + 2 margin, 3], values of sRGB: the mean of the `warps` of
    /// its light, times `gains`. Without warps the render as it stands. `nearness` [H, W] is the inverse depth of
    /// each pixel; empty, everything is infinitely far. Beyond its border the render goes on as it ends.
    ///
    /// # Errors
    /// Names an array of another size, or a warp or gain that is not finite.
    pub fn take(
        sizes: Sizes,
        image: &[T],
        nearness: &[T],
        warps: &[Warp],
        gains: [f64; 3],
    ) -> Result<Self, Error> {
        let [height, width] = sizes.render_size();
        if sizes.size.contains(&0) {
            let got = format!("{:?}", sizes.size);
            return Err(Error::shape("size", "a photo with pixels", got));
        }
        let pixels = height.saturating_mul(width);
        check_len("image", image, pixels.saturating_mul(3))?;
        if !nearness.is_empty() {
            check_len("nearness", nearness, sizes.pixels())?;
        }
        for (name, finite) in [
            ("warps", warps.iter().flatten().all(|x| x.is_finite())),
            ("gains", gains.iter().all(|x| x.is_finite())),
            ("nearness", nearness.iter().all(|x| x.to_f64().is_finite())),
        ] {
            if !finite {
                return Err(Error::new(name, "must be finite"));
            }
        }
        let tables = tables();
        let mut light = UninitVec::new(pixels, "light")?;
        let mut copy = UninitVec::new(image.len(), "image")?;
        pieces(&mut light, pixels, BAND * width)
            .into_par_iter()
            .zip(pieces(&mut copy, image.len(), BAND * width * 3))
            .zip(image.par_chunks(BAND * width * 3))
            .for_each(|((light, copy), image)| {
                copy.writer().put(image);
                let light = light.fill([T::ZERO; WIDE]);
                for (light, pixel) in light.iter_mut().zip(image.chunks_exact(3)) {
                    for c in 0..3 {
                        light[c] = pixel[c].to_light(tables);
                    }
                }
            });
        let mut taken = Self {
            sizes,
            photo: Vec::new(),
            image: copy.finish(),
            light: light.finish(),
            mean: Vec::new(),
            nearness: memory::copied(nearness, "nearness")?,
            warps: memory::copied(warps, "warps")?,
            gains,
        };
        let mut mean = UninitVec::new(sizes.pixels(), "mean")?;
        let mut photo = UninitVec::new(sizes.pixels() * 3, "photo")?;
        let (across, token) = (sizes.size[1], simd::level()?.token());
        pieces(&mut mean, sizes.pixels(), across)
            .into_par_iter()
            .zip(pieces(&mut photo, sizes.pixels() * 3, across * 3))
            .enumerate()
            .try_for_each_init(Vec::new, |sources, (row, (mean, photo))| {
                let (mean, photo) = (mean.fill([T::ZERO; WIDE]), photo.fill(T::ZERO));
                dispatch!(token, simd => taken.take_row(simd, row, sources, tables, mean, photo))
            })?;
        (taken.mean, taken.photo) = (mean.finish(), photo.finish());
        Ok(taken)
    }

    /// Height and width of the photo.
    pub fn size(&self) -> [usize; 2] {
        self.sizes.size
    }

    /// Gradients for the cotangent `v_photo` [H, W, 3]. None flows to `nearness`.
    ///
    /// # Errors
    /// Names the array when its length differs from that of the photo.
    pub fn backward(&self, v_photo: &[T]) -> Result<PhotographGradients<T>, Error> {
        check_len("v_photo", v_photo, self.photo.len())?;
        let ([height, width], across) = (self.sizes.render_size(), self.sizes.size[1]);
        let token = simd::level()?.token();
        let mut image = zeros::<T>(height * width * 3, "gradient")?;
        let mut warps = memory::filled([0.0; 12], self.warps.len(), "gradient")?;
        let mut gains = [0.0; 3];
        let across = BAND * across;
        let bands: Vec<_> = v_photo.chunks(across * 3).enumerate().collect();
        let reached =
            |k: usize, v: &[T]| self.reached(k * BAND..k * BAND + v.len() * BAND / (across * 3));
        let mut rest = &bands[..];
        while !rest.is_empty() {
            // Bands are held together as long as their rows of the render are no more than it has twice: one may
            // reach all of them.
            let mut rows = 0;
            let held = rest.iter().take_while(|(k, v)| {
                let first = rows == 0;
                rows += reached(*k, v).len();
                first || rows <= 2 * height
            });
            let (wave, others) = rest.split_at(held.count());
            rest = others;
            let wave: Vec<Band<T>> = wave
                .par_iter()
                .map(|&(k, v)| dispatch!(token, simd => self.backward_band(simd, k * BAND, v)))
                .collect::<Result<_, _>>()?;
            image
                .par_chunks_mut(width * 3)
                .enumerate()
                .for_each(|(row, v)| {
                    // Rows of the photo whose warps reach here, in their order.
                    for band in wave.iter().filter(|band| band.rows.contains(&row)) {
                        let from = &band.v_light[(row - band.rows.start) * width..][..width];
                        for (v, from) in v.chunks_exact_mut(3).zip(from) {
                            for c in 0..3 {
                                v[c] += from[c];
                            }
                        }
                    }
                });
            for band in &wave {
                let parts = band.v_warps.iter().flatten();
                for (sum, part) in warps.iter_mut().flatten().zip(parts) {
                    *sum += part;
                }
                for (sum, part) in gains.iter_mut().zip(&band.v_gains) {
                    *sum += part;
                }
            }
        }
        image
            .par_chunks_mut(width * 3)
            .enumerate()
            .for_each(|(row, v)| {
                let at = row * width;
                let pixels = self.light[at..at + width].iter();
                let values = self.image[at * 3..].chunks_exact(3);
                for ((v, light), value) in v.chunks_exact_mut(3).zip(pixels).zip(values) {
                    for c in 0..3 {
                        v[c] *= value[c].light_slope(light[c]);
                    }
                }
            });
        Ok(PhotographGradients {
            image,
            warps,
            gains,
        })
    }

    #[inline(always)]
    fn take_row<S: Simd>(
        &self,
        _: S, // the instructions that this is compiled for
        row: usize,
        sources: &mut Vec<Source<T>>,
        tables: &Tables,
        mean: &mut [[T; WIDE]],
        photo: &mut [T],
    ) -> Result<(), Error> {
        let width = self.sizes.render_size()[1];
        if self.warps.is_empty() {
            let at = (row + self.sizes.margin) * width + self.sizes.margin;
            mean.copy_from_slice(&self.light[at..at + mean.len()]);
        }
        let share = T::from_f64(1.0 / self.warps.len().max(1) as f64);
        for warp in &self.warps {
            self.find(row, warp, sources)?;
            for (source, mean) in sources.iter().zip(mean.iter_mut()) {
                let [a, b, c, d] = self.corners(source);
                let (x, y) = (source.fx, source.fy);
                for i in 0..WIDE {
                    let top = a[i] + x * (b[i] - a[i]);
                    let bottom = c[i] + x * (d[i] - c[i]);
                    mean[i] += share * (top + y * (bottom - top));
                }
            }
        }
        let gains = self.gains.map(T::from_f64);
        for (mean, photo) in mean.iter().zip(photo.chunks_exact_mut(3)) {
            for c in 0..3 {
                photo[c] = (gains[c] * mean[c]).to_value(tables);
            }
        }
        Ok(())
    }

    #[inline(always)]
    fn backward_band<S: Simd>(&self, _: S, first: usize, v_photo: &[T]) -> Result<Band<T>, Error> {
        let ([_, width], across) = (self.sizes.render_size(), self.sizes.size[1]);
        let count = v_photo.len() / (across * 3);
        let rows = self.reached(first..first + count);
        let mut v_light = memory::filled([T::ZERO; WIDE], rows.len() * width, "gradient")?;
        let mut v_warps = memory::filled([0.0; 12], self.warps.len(), "gradient")?;
        let mut v_gains = [0.0; 3];
        let mut v_mean = memory::filled([T::ZERO; WIDE], across, "gradient")?;
        let mut sources = Vec::new();
        let gains = self.gains.map(T::from_f64);
        let share = T::from_f64(1.0 / self.warps.len().max(1) as f64);
        for (row, v_photo) in (first..).zip(v_photo.chunks_exact(across * 3)) {
            let at = row * across;
            let means = &self.mean[at..at + across];
            let values = self.photo[at * 3..].chunks_exact(3);
            let mut v_gain = [T::ZERO; 3];
            for (((v_mean, v), mean), value) in v_mean
                .iter_mut()
                .zip(v_photo.chunks_exact(3))
                .zip(means)
                .zip(values)
            {
                for c in 0..3 {
                    let v_light = v[c] * (gains[c] * mean[c]).value_slope(value[c]);
                    v_gain[c] += v_light * mean[c];
                    v_mean[c] = v_light * gains[c] * share;
                }
            }
            for c in 0..3 {
                v_gains[c] += v_gain[c].to_f64();
            }
            if self.warps.is_empty() {
                let at = (row + self.sizes.margin - rows.start) * width + self.sizes.margin;
                v_light[at..at + across].copy_from_slice(&v_mean);
            }
            for (warp, v_warp) in self.warps.iter().zip(&mut v_warps) {
                self.find(row, warp, &mut sources)?;
                let mut sums = [T::ZERO; 12];
                let y = T::from_f64(row as f64 + 0.5);
                for (x, (source, v)) in sources.iter().zip(&v_mean).enumerate() {
                    let [a, b, c, d] = self.corners(source);
                    let (fx, fy) = (source.fx, source.fy);
                    let (mut v_x, mut v_y) = (T::ZERO, T::ZERO);
                    for i in 0..WIDE {
                        let (top, bottom) = (b[i] - a[i], d[i] - c[i]);
                        v_x += v[i] * (top + fy * (bottom - top));
                        v_y += v[i] * (c[i] - a[i] + fx * (bottom - top));
                    }
                    let (right, below) = (source.right, source.below);
                    let at = source.at.wrapping_sub(rows.start * width);
                    if at.wrapping_add(right + below) >= v_light.len() {
                        continue; // coordinates beyond the range of T
                    }
                    let far = fx * fy;
                    for (at, weight) in [
                        (at, T::ONE - fx - fy + far),
                        (at + right, fx - far),
                        (at + below, fy - far),
                        (at + right + below, far),
                    ] {
                        for i in 0..WIDE {
                            v_light[at][i] += weight * v[i];
                        }
                    }
                    let v_u = v_x * source.slope_x;
                    let v_v = v_y * source.slope_y;
                    let v_w = T::ZERO - (v_u * source.x + v_v * source.y);
                    let point = [
                        T::from_f64(x as f64 + 0.5),
                        y,
                        T::ONE,
                        self.nearness_at(row * across + x),
                    ];
                    for i in 0..4 {
                        sums[i] += v_u * point[i];
                        sums[4 + i] += v_v * point[i];
                        sums[8 + i] += v_w * point[i];
                    }
                }
                for (v, sum) in v_warp.iter_mut().zip(sums) {
                    *v += sum.to_f64();
                }
            }
        }
        Ok(Band {
            rows,
            v_light,
            v_warps,
            v_gains,
        })
    }

    #[inline(always)]
    fn nearness_at(&self, pixel: usize) -> T {
        if self.nearness.is_empty() {
            T::ZERO
        } else {
            self.nearness[pixel]
        }
    }

    /// The four pixels around a source.
    #[inline(always)]
    fn corners(&self, source: &Source<T>) -> [&[T; WIDE]; 4] {
        let (at, right, below) = (source.at, source.right, source.below);
        [0, right, below, right + below].map(|step| &self.light[at + step])
    }

    /// Where a warp takes the pixels of a row.
    #[inline(always)]
    fn find(&self, row: usize, warp: &Warp, sources: &mut Vec<Source<T>>) -> Result<(), Error> {
        let [height, width] = self.sizes.render_size();
        let across = self.sizes.size[1];
        memory::resize(sources, across, Source::default(), "photo")?;
        let m = warp.map(T::from_f64);
        let y = T::from_f64(row as f64 + 0.5);
        let shift = T::from_f64(self.sizes.margin as f64 - 0.5);
        let (last_x, last_y) = (
            T::from_f64((width - 1) as f64),
            T::from_f64((height - 1) as f64),
        );
        for (x, source) in sources.iter_mut().enumerate() {
            let nearness = self.nearness_at(row * across + x);
            let x = T::from_f64(x as f64 + 0.5);
            let e = |r: usize| m[r] * x + m[r + 1] * y + m[r + 2] + m[r + 3] * nearness;
            let slope = T::ONE / (T::ONE + e(8));
            // In differences, so that nothing is lost where the warp is small.
            let column = x + shift + (e(0) - x * e(8)) * slope;
            let line = y + shift + (e(4) - y * e(8)) * slope;
            let (column, slope_x) = clamp(column, last_x, slope);
            let (line, slope_y) = clamp(line, last_y, slope);
            let ((i, fx), (j, fy)) = (column.split(), line.split());
            *source = Source {
                at: j * width + i,
                right: usize::from(i + 1 < width),
                below: if j + 1 < height { width } else { 0 },
                fx,
                fy,
                slope_x,
                slope_y,
                x: column - shift,
                y: line - shift,
            };
        }
        Ok(())
    }

    /// The rows of the render that the warps of these rows of the photo reach.
    fn reached(&self, rows: std::ops::Range<usize>) -> std::ops::Range<usize> {
        let ([height, _], margin, across) = (
            self.sizes.render_size(),
            self.sizes.margin,
            self.sizes.size[1],
        );
        if self.warps.is_empty() {
            return rows.start + margin..rows.end + margin;
        }
        let (mut near, mut far) = (0.0, 0.0);
        if !self.nearness.is_empty() {
            let of_rows = &self.nearness[rows.start * across..rows.end * across];
            (far, near) = of_rows
                .iter()
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| {
                    (low.min(x.to_f64()), high.max(x.to_f64()))
                });
        }
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for m in &self.warps {
            // A box of (x, y, nearness) lands within what its corners span, as long as w stays above 0.
            for corner in 0..8 {
                let x = if corner & 1 == 0 { 0.0 } else { across as f64 };
                let y = if corner & 2 == 0 {
                    rows.start
                } else {
                    rows.end
                } as f64;
                let n = if corner & 4 == 0 { near } else { far };
                let w = 1.0 + m[8] * x + m[9] * y + m[10] + m[11] * n;
                let line = (y + m[4] * x + m[5] * y + m[6] + m[7] * n) / w;
                if !(w > 1e-3 && line.is_finite()) {
                    return 0..height;
                }
                (low, high) = (low.min(line), high.max(line));
            }
        }
        let clamped = |line: f64| (line + margin as f64).clamp(0.0, height as f64) as usize;
        let start = clamped(low - 2.0).min(height - 1);
        start..clamped(high + 3.0).max(start + 1)
    }
}

/// A coordinate within the picture, and its slope: 0 beyond the border.
#[inline(always)]
fn clamp<T: Light>(x: T, last: T, slope: T) -> (T, T) {
    if x >= T::ZERO && x <= last {
        (x, slope)
    } else if x > last {
        (last, T::ZERO)
    } else {
        (T::ZERO, T::ZERO) // NaN too
    }
}

/// Where a pixel of the photo lies in the render.
#[derive(Debug, Default, Clone, Copy)]
struct Source<T> {
    /// The pixel of the render above it to the left.
    at: usize,
    /// Steps from there to the next pixel and to the next row.
    right: usize,
    below: usize,
    /// What is left of the coordinates.
    fx: T,
    fy: T,
    /// Of the coordinates by the homogeneous ones.
    slope_x: T,
    slope_y: T,
    /// In the photo's coordinates.
    x: T,
    y: T,
}

/// Gradients from one band of the photo.
struct Band<T> {
    /// Of the render.
    rows: std::ops::Range<usize>,
    v_light: Vec<[T; WIDE]>,
    v_warps: Vec<Warp>,
    v_gains: [f64; 3],
}

#[cfg(test)]
mod tests;
