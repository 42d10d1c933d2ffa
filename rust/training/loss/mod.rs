//! The photometric loss of 3D Gaussian Splatting, `(1 - lambda) L1 + lambda (1 - SSIM)`, with its gradient.
//!
//! SSIM (Wang et al. 2004) per channel, 11 x 11 Gaussian window with sigma 1.5, zero padding to the image's
//! own size, mean over pixels and channels. With `p = x + y - 1`, `q = x - y`, their windowed means P, Q and
//! their windowed variances Vp, Vq,
//!
//! ```text
//! 1 - SSIM = 1 - (1 - a) (1 - b)
//! a = 2 Q^2 / ((P + 1)^2 + Q^2 + 2 C1),   b = 2 Vq / (Vp + Vq + 2 C2)
//! ```
//!
//! which is the usual formula rearranged. It needs four windowed sums instead of five, and nothing cancels
//! where the images agree: a and b go to 0 with q. The shift by 1 centres p, so that Vp keeps its digits in
//! f32. A padded pixel (x = y = 0) has p = -1, q = 0; as the window sums to 1, that makes the shift exact.
//! In f32, `1 - SSIM` is within 2e-5 of f64, relatively, even on black, white and almost equal images.

mod band;

use band::Band;
use fearless_simd::dispatch;
use hqgs::internals::{
    Error, check_len, memory,
    simd::{self, Real},
};
use rayon::prelude::*;

/// What an error calls the buffers of this folder.
const NAME: &str = "loss";

/// Threads have two bands each, so that a late one can be helped, where these are as high as this: below it the rows
/// that a band shares with its neighbours cost more than they gain.
const HIGH_BAND: usize = 32;
/// A band is at least this high.
const MIN_BAND: usize = 16;

/// A pixel value that can be compared with a render of `T`.
pub trait Sample<T>: Copy + Send + Sync {
    /// The value on the scale where white is 1.
    fn value(self) -> T;
}

impl<T: Real> Sample<T> for u8 {
    #[inline(always)]
    fn value(self) -> T {
        T::from(self) / T::from(Self::MAX)
    }
}

macro_rules! sample {
    ($($real:ty),*) => {
        $(impl Sample<$real> for $real {
            #[inline(always)]
            fn value(self) -> $real {
                self
            }
        })*
    };
}
sample!(f32, f64);

/// The loss and its two parts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Photometric {
    /// `(1 - lambda) l1 + lambda (1 - ssim)`.
    pub loss: f64,
    /// Mean absolute difference (or Huber's function of it) over the channels of the pixels that count; 0 if
    /// none does.
    pub l1: f64,
    /// Mean SSIM; None where lambda is 0, as it was not computed.
    pub ssim: Option<f64>,
}

/// Buffers that [`photometric`] reuses from call to call.
#[derive(Debug, Default)]
pub struct LossScratch<T> {
    sums: Vec<RowSums>,
    bands: Vec<Vec<T>>,
}

/// Sums over one row.
#[derive(Debug, Default, Clone, Copy)]
struct RowSums {
    l1: f64,
    dissimilarity: f64,
}

/// The pair of images, and what of them counts.
#[derive(Debug, Clone, Copy)]
pub struct Images<'a, T, Y> {
    /// What is judged, [H, W, C].
    pub render: &'a [T],
    /// What it is compared with, [H, W, C]; u8 is divided by 255.
    pub target: &'a [Y],
    /// [H, W], 0 where a pixel does not count. None: all of them do.
    pub mask: Option<&'a [u8]>,
    /// Height, width and channels.
    pub size: [usize; 3],
}

/// How they are compared; the default is that of 3DGS.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossOptions {
    /// The part of `1 - SSIM` in the loss, in [0, 1]; with 0 no SSIM is computed.
    pub lambda: f64,
    /// k > 0 puts Huber's function in the place of |x|: x^2 / (2 k) up to k, |x| - k / 2 beyond.
    pub knee: f64,
}

impl Default for LossOptions {
    fn default() -> Self {
        Self {
            lambda: 0.2,
            knee: 0.0,
        }
    }
}

/// What to compute, and the factors of the gradient.
#[derive(Clone, Copy)]
struct Plan {
    ssim: bool,
    knee: f64,
    l1_scale: f64,
    ssim_scale: f64,
}

/// The loss of a render, and its gradient with respect to the render (`grad` is overwritten).
///
/// Where the mask is 0 a pixel contributes nothing: L1 is the mean over the other pixels, and for SSIM the render is
/// replaced by the target there; the gradient is 0. SSIM is still averaged over all pixels. The gradient of |x| at 0
/// is 0. NaN in the render gives a NaN loss. The same bits for any number of threads.
///
/// # Errors
/// Names the array whose length does not match, `lambda` outside [0, 1], or a `knee` that is negative or not
/// finite.
pub fn photometric<T: Real, Y: Sample<T>>(
    images: Images<'_, T, Y>,
    options: &LossOptions,
    grad: Option<&mut [T]>,
    scratch: &mut LossScratch<T>,
) -> Result<Photometric, Error> {
    let LossOptions { lambda, knee } = *options;
    if !(0.0..=1.0).contains(&lambda) {
        return Err(Error::new(
            "lambda",
            format!("must be in [0, 1], got {lambda}"),
        ));
    }
    if !(0.0..f64::INFINITY).contains(&knee) {
        return Err(Error::new(
            "knee",
            format!("must be finite and at least 0, got {knee}"),
        ));
    }
    images.check()?;
    let Images {
        render,
        mask,
        size: [height, width, channels],
        ..
    } = images;
    if let Some(grad) = &grad {
        check_len("grad", grad, render.len())?;
    }
    let counted = channels * mask.map_or(height * width, |m| m.iter().filter(|&&m| m != 0).count());
    let plan = Plan {
        ssim: lambda > 0.0,
        knee,
        l1_scale: (1.0 - lambda) / counted.max(1) as f64,
        ssim_scale: lambda / render.len() as f64,
    };
    let sums = run(images, plan, grad, scratch)?;
    let l1 = sums.l1 / counted.max(1) as f64;
    if !plan.ssim {
        return Ok(Photometric {
            loss: l1,
            l1,
            ssim: None,
        });
    }
    let dissimilarity = sums.dissimilarity / render.len() as f64;
    Ok(Photometric {
        loss: (1.0 - lambda) * l1 + lambda * dissimilarity,
        l1,
        ssim: Some(1.0 - dissimilarity),
    })
}

impl<T, Y> Images<'_, T, Y> {
    fn check(&self) -> Result<(), Error> {
        let [height, width, _] = self.size;
        // No slice has so many elements; a product that wrapped around could fit one.
        let n = self.size.into_iter().fold(1, usize::saturating_mul);
        if n == 0 {
            let got = format!("{:?}", self.size);
            return Err(Error::shape(
                "render",
                "[H, W, C] with at least one pixel",
                got,
            ));
        }
        check_len("render", self.render, n)?;
        check_len("target", self.target, n)?;
        self.mask
            .map_or(Ok(()), |m| check_len("mask", m, height * width))
    }

    fn row(&self, row: usize) -> Images<'_, T, Y> {
        let [_, width, channels] = self.size;
        let n = width * channels;
        Images {
            render: &self.render[row * n..(row + 1) * n],
            target: &self.target[row * n..(row + 1) * n],
            mask: self.mask.map(|m| &m[row * width..(row + 1) * width]),
            size: [1, width, channels],
        }
    }
}

/// Run the bands in parallel; returns the sums over the image.
///
/// The bits do not depend on the bands: every number depends on its own neighbourhood only, and sums are
/// taken per row and then over the rows in order.
fn run<T: Real, Y: Sample<T>>(
    images: Images<'_, T, Y>,
    plan: Plan,
    mut grad: Option<&mut [T]>,
    scratch: &mut LossScratch<T>,
) -> Result<RowSums, Error> {
    let level = simd::level()?.token();
    let [height, width, channels] = images.size;
    let n = width * channels;
    let threads = rayon::current_num_threads();
    let two_each = threads > 1 && height >= 2 * threads * HIGH_BAND;
    let wanted = if two_each { 2 * threads } else { threads };
    let rows = height.div_ceil(wanted).max(MIN_BAND);
    let count = height.div_ceil(rows);
    scratch.sums.clear();
    memory::resize(&mut scratch.sums, height, RowSums::default(), NAME)?;
    if scratch.bands.len() < count {
        scratch.bands.resize_with(count, Vec::new);
    }
    let mut jobs = Vec::with_capacity(count);
    let bands = scratch.sums.chunks_mut(rows).zip(&mut scratch.bands);
    for (i, (sums, buffer)) in bands.enumerate() {
        let grad = grad.as_mut();
        let grad = grad.map(|g| g.split_off_mut(..sums.len() * n).unwrap_or_default());
        jobs.push((i * rows, sums, buffer, grad));
    }
    jobs.into_par_iter()
        .try_for_each(|(first, sums, buffer, grad)| {
            let band = Band::new(images, plan, first, buffer)?;
            dispatch!(level, simd => band.run(simd, grad, sums));
            Ok(())
        })?;
    Ok(scratch
        .sums
        .iter()
        .fold(RowSums::default(), |a, b| RowSums {
            l1: a.l1 + b.l1,
            dissimilarity: a.dissimilarity + b.dissimilarity,
        }))
}

#[cfg(test)]
mod tests;
