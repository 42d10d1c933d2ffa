//! Where photos agree on a surface: the depth of single pixels, by a sweep that other photos judge.
//!
//! A patch around the pixel is taken to lie at one depth. At each depth that is tried every other photo shows it
//! somewhere; how alike it looks there is the correlation of the two patches, which no gain of a photo changes. The
//! depth at which the photos that agree best agree most is the pixel's.

#[cfg(test)]
mod tests;

use fearless_simd::{Simd, dispatch};
use hqgs::internals::{Error, check_len, memory, simd};
use rayon::prelude::*;

/// Samples to each side of a patch's middle.
const HALF: usize = 2;
const SIDE: usize = 2 * HALF + 1;
const SAMPLES: usize = SIDE * SIDE;
/// Their places, in steps from the middle.
const ACROSS: [f32; SAMPLES] = steps_of_samples(1);
const DOWN: [f32; SAMPLES] = steps_of_samples(SIDE);
/// px between them.
const STRIDE: f32 = 1.5;
/// Variance of a patch, where 1 is white squared, below which it tells nothing.
const FLAT: f32 = 1e-4;
/// px that a step of the sweep may move the patch in any of the other photos, and the bounds on the steps.
const SPACING: f64 = 1.5;
const STEPS: std::ops::RangeInclusive<usize> = 9..=49;
/// Halvings of the step around the best depth of the sweep.
const HALVINGS: usize = 3;
/// Pixels that a thread takes at a time.
const CHUNK: usize = 32;
/// The correlation of what cannot be compared.
const NOTHING: f32 = -1.0;

const fn steps_of_samples(every: usize) -> [f32; SAMPLES] {
    let (mut steps, mut k) = ([0.0; SAMPLES], 0);
    while k < SAMPLES {
        steps[k] = (k / every % SIDE) as f32 - HALF as f32;
        k += 1;
    }
    steps
}

/// A photo [H, W] in one channel, where 1 is white.
#[derive(Debug, Clone, Copy)]
pub struct Photo<'a> {
    /// Height and width.
    pub size: [usize; 2],
    /// [H, W]
    pub grey: &'a [f32],
}

impl Photo<'_> {
    /// That it has as many pixels as its size says, and that they can be numbered.
    fn check(&self, name: &str) -> Result<(), Error> {
        let [height, width] = self.size;
        if i32::try_from(height.max(1).saturating_mul(width.max(1))).is_err() {
            let message = format!("has more than 2^31 pixels, {height} x {width}");
            return Err(Error::new(name, message));
        }
        check_len(name, self.grey, height * width)
    }
}

/// Another photo, and the matrix [3, 4] that takes a pixel of the first one (x, y, 1, 1 / depth) to where this one
/// shows it, (x, y, 1) times some w > 0. Pixels' centres lie at halves.
#[derive(Debug, Clone, Copy)]
pub struct Other<'a> {
    /// As the first one.
    pub picture: Photo<'a>,
    /// [3, 4]
    pub map: [f64; 12],
}

/// For each of `pixels` (x, y) of `first`: the depth in its range at which the others agree best, and the mean
/// correlation of those `agreeing` that agree best, in which each one that is missing counts as -1; -1 where the
/// patch is flat or no photo shows it.
///
/// # Errors
/// Names an array of another size, a range that is not 0 < nearest <= farthest, a value out of range, or what
/// there is no memory for.
pub fn depths(
    first: Photo<'_>,
    others: &[Other<'_>],
    pixels: &[[f64; 2]],
    ranges: &[[f64; 2]],
    agreeing: usize,
) -> Result<Vec<(f64, f32)>, Error> {
    if agreeing == 0 {
        return Err(Error::new("agreeing", "must be at least 1"));
    }
    check_len("ranges", ranges, pixels.len())?;
    first.check("first")?;
    for other in others {
        other.picture.check("others")?;
        if !other.map.iter().all(|x| x.is_finite()) {
            return Err(Error::new("maps", "must be finite"));
        }
    }
    if let Some([near, far]) = ranges
        .iter()
        .find(|[near, far]| !(*near > 0.0 && near <= far && far.is_finite()))
    {
        let message = format!("must be finite and 0 < nearest <= farthest, got {near} to {far}");
        return Err(Error::new("ranges", message));
    }
    if let Some(bad) = pixels
        .iter()
        .find(|pixel| !pixel.iter().all(|x| x.is_finite()))
    {
        return Err(Error::new("pixels", format!("must be finite, got {bad:?}")));
    }
    let mut found = memory::filled((0.0, NOTHING), pixels.len(), "depths")?;
    let token = simd::level()?.token();
    found
        .par_chunks_mut(CHUNK)
        .zip(pixels.par_chunks(CHUNK).zip(ranges.par_chunks(CHUNK)))
        .try_for_each(|(found, (pixels, ranges))| {
            dispatch!(token, simd => chunk(simd, first, others, pixels, ranges, agreeing, found))
        })?;
    Ok(found)
}

#[inline(always)]
fn chunk<S: Simd>(
    _: S, // the instructions that this is compiled for
    first: Photo<'_>,
    others: &[Other<'_>],
    pixels: &[[f64; 2]],
    ranges: &[[f64; 2]],
    agreeing: usize,
    found: &mut [(f64, f32)],
) -> Result<(), Error> {
    let mut best = memory::filled(NOTHING, agreeing, "agreeing")?;
    for ((pixel, &[near, far]), found) in pixels.iter().zip(ranges).zip(found) {
        *found = ((near * far).sqrt(), NOTHING);
        let Some(patch) = Patch::of(first, *pixel) else {
            continue;
        };
        let mut score = |depth: f64| patch.agreement(others, *pixel, depth, &mut best);
        let steps = steps(others, *pixel, [near, far]);
        let mut spacing = (far / near).ln() / (steps - 1) as f64;
        let mut most = NOTHING;
        for k in 0..steps {
            let depth = near * (k as f64 * spacing).exp();
            let now = score(depth);
            if now > most {
                (most, *found) = (now, (depth, now));
            }
        }
        if most <= NOTHING {
            continue;
        }
        for _ in 0..HALVINGS {
            spacing *= 0.5;
            let middle = found.0;
            for depth in [middle * (-spacing).exp(), middle * spacing.exp()] {
                let now = score(depth);
                if now > most {
                    (most, *found) = (now, (depth, now));
                }
            }
        }
    }
    Ok(())
}

/// Depths that are tried: as many as move the patch by SPACING at most.
fn steps(others: &[Other<'_>], pixel: [f64; 2], [near, far]: [f64; 2]) -> usize {
    let mut farthest = 0.0f64;
    for other in others {
        let ends = [near, (near * far).sqrt(), far].map(|depth| {
            let q = mapped(&other.map, pixel, 1.0 / depth);
            (q[2] > 0.0).then(|| [q[0] / q[2], q[1] / q[2]])
        });
        for pair in ends.windows(2) {
            if let [Some(a), Some(b)] = pair {
                farthest = farthest.max(2.0 * (a[0] - b[0]).hypot(a[1] - b[1]));
            }
        }
    }
    let wanted = (farthest / SPACING).ceil().min(1e6) as usize + 1;
    wanted.clamp(*STEPS.start(), *STEPS.end())
}

/// (x, y, 1) times w of a pixel at a nearness (1 / depth).
fn mapped(map: &[f64; 12], pixel: [f64; 2], nearness: f64) -> [f64; 3] {
    [0, 4, 8].map(|row| {
        map[row] * pixel[0] + map[row + 1] * pixel[1] + map[row + 2] + map[row + 3] * nearness
    })
}

/// The samples around a pixel, less their mean.
struct Patch {
    values: [f32; SAMPLES],
    mean: f32,
    /// Of the squares.
    sum: f32,
}

impl Patch {
    /// None where it is flat or reaches out of the picture.
    #[inline(always)]
    fn of(picture: Photo<'_>, pixel: [f64; 2]) -> Option<Self> {
        let samples = Samples {
            base: [pixel[0] as f32, pixel[1] as f32, 1.0],
            across: [STRIDE, 0.0, 0.0],
            down: [0.0, STRIDE, 0.0],
        };
        let mut values = samples.sampled(picture)?;
        let mean = values.iter().sum::<f32>() / SAMPLES as f32;
        let mut sum = 0.0;
        for value in &mut values {
            *value -= mean;
            sum += *value * *value;
        }
        (sum > FLAT * SAMPLES as f32).then_some(Self { values, mean, sum })
    }

    /// The mean of the largest correlations, as many as `best` has room for, of this patch of a pixel at a depth.
    #[inline(always)]
    fn agreement(
        &self,
        others: &[Other<'_>],
        pixel: [f64; 2],
        depth: f64,
        best: &mut [f32],
    ) -> f32 {
        best.fill(NOTHING);
        for other in others {
            let mut score = self.correlation(other, pixel, 1.0 / depth);
            for kept in best.iter_mut() {
                if score > *kept {
                    std::mem::swap(kept, &mut score);
                }
            }
        }
        best.iter().sum::<f32>() / best.len() as f32
    }

    #[inline(always)]
    fn correlation(&self, other: &Other<'_>, pixel: [f64; 2], nearness: f64) -> f32 {
        let map = &other.map;
        let base = mapped(map, pixel, nearness).map(|x| x as f32);
        let samples = Samples {
            base,
            across: [map[0], map[4], map[8]].map(|x| x as f32 * STRIDE),
            down: [map[1], map[5], map[9]].map(|x| x as f32 * STRIDE),
        };
        let Some(values) = samples.sampled(other.picture) else {
            return NOTHING;
        };
        let (mut sum, mut squares, mut products) = (0.0, 0.0, 0.0);
        for (value, own) in values.iter().zip(&self.values) {
            let value = value - self.mean;
            sum += value;
            squares += value * value;
            products += value * own;
        }
        let variance = squares - sum * sum / SAMPLES as f32;
        let norm = (variance.max(0.0) * self.sum).sqrt();
        if norm > 0.0 { products / norm } else { NOTHING }
    }
}

/// Where the samples of a patch lie in a picture, (x, y, 1) times w: the middle's, and what a step adds.
struct Samples {
    base: [f32; 3],
    across: [f32; 3],
    down: [f32; 3],
}

impl Samples {
    #[inline(always)]
    fn at(&self, across: f32, down: f32) -> [f32; 3] {
        std::array::from_fn(|i| self.base[i] + across * self.across[i] + down * self.down[i])
    }

    /// None where one of them is behind the camera or outside.
    #[inline(always)]
    fn sampled(&self, picture: Photo<'_>) -> Option<[f32; SAMPLES]> {
        let [height, width] = picture.size;
        if height < 2 || width < 2 {
            return None;
        }
        // What is drawn is convex: its corners tell.
        let reach = HALF as f32;
        let (most_x, most_y) = (width as f32 - 1.001, height as f32 - 1.001);
        for (across, down) in [
            (-reach, -reach),
            (reach, -reach),
            (-reach, reach),
            (reach, reach),
        ] {
            let [x, y, w] = self.at(across, down);
            // NaN is outside too.
            let inside = w > 0.0
                && x >= 0.5 * w
                && y >= 0.5 * w
                && x - 0.5 * w <= most_x * w
                && y - 0.5 * w <= most_y * w;
            if !inside {
                return None;
            }
        }
        let (mut at, mut fx, mut fy) = ([0; SAMPLES], [0.0; SAMPLES], [0.0; SAMPLES]);
        for k in 0..SAMPLES {
            let [x, y, w] = self.at(ACROSS[k], DOWN[k]);
            let inverse = 1.0 / w;
            let x = (x * inverse - 0.5).clamp(0.0, most_x);
            let y = (y * inverse - 0.5).clamp(0.0, most_y);
            // From 2^15 px on, a float just below the last pixel rounds up to it.
            let (column, row) = (
                (x as i32).min(width as i32 - 2),
                (y as i32).min(height as i32 - 2),
            );
            at[k] = row * width as i32 + column;
            fx[k] = x - column as f32;
            fy[k] = y - row as f32;
        }
        let mut corners = [[0.0; SAMPLES]; 4];
        for k in 0..SAMPLES {
            let at = at[k] as usize;
            let (top, bottom) = (
                &picture.grey[at..at + 2],
                &picture.grey[at + width..at + width + 2],
            );
            corners[0][k] = top[0];
            corners[1][k] = top[1];
            corners[2][k] = bottom[0];
            corners[3][k] = bottom[1];
        }
        let mut values = [0.0; SAMPLES];
        for k in 0..SAMPLES {
            let top = corners[0][k] + fx[k] * (corners[1][k] - corners[0][k]);
            let bottom = corners[2][k] + fx[k] * (corners[3][k] - corners[2][k]);
            values[k] = top + fy[k] * (bottom - top);
        }
        Some(values)
    }
}
