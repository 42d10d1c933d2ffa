//! The gradients of each Gaussian from those of its pairs.

use super::{
    CompositeGrads, CompositeInput, Wanted, for_channels,
    kernel::{ABSOLUTE, MOMENTS},
};
use crate::{
    error::Error,
    memory,
    project::Splat,
    simd::Real,
    tiles::{Chunk, Span, UNIT},
    uninit::{UninitVec, prefetch},
};
use fearless_simd::{Simd, dispatch};
use rayon::prelude::*;

/// What an error calls the buffers of this file.
const NAME: &str = "gradients";

/// Layout of one pair's gradients: moments, colours, absolute gradients.
#[derive(Debug, Clone, Copy)]
pub(super) struct PairLayout {
    pub absolute: bool,
    pub channels: usize,
}

impl PairLayout {
    /// Numbers of a pair.
    pub const fn row(self) -> usize {
        MOMENTS + self.channels + if self.absolute { ABSOLUTE } else { 0 }
    }
}

/// Sum each Gaussian's pairs in tile order, and turn the moments into gradients.
pub(super) fn gather<T: Real>(
    input: &CompositeInput<T>,
    pair_grads: &[Vec<T>],
    layout: PairLayout,
    wanted: Wanted,
) -> Result<CompositeGrads<T>, Error> {
    let chunks = &input.tiles.chunks;
    let channels = layout.channels;
    let rows = [
        (wanted.geometry, 2),
        (wanted.geometry, 3),
        (wanted.geometry, 1),
        (layout.absolute, ABSOLUTE),
        (wanted.colors, channels),
    ]
    .map(|(wanted, row)| if wanted { row } else { 0 });
    let n = input.projection.splats.len();
    let mut arrays = UninitVec::several(rows.map(|row| row * n), NAME)?;
    let jobs = UninitVec::cut_rows(&mut arrays, rows, chunks.iter().map(|c| c.end - c.begin));
    let level = input.projection.level.token;
    let jobs = jobs.into_par_iter().zip(chunks);
    jobs.try_for_each(|(pieces, chunk)| {
        let [means2d, whitened, opacities, absolute, colors] =
            pieces.map(|piece| piece.fill(T::ZERO));
        let out = Gather {
            chunk,
            means2d,
            whitened,
            opacities,
            absolute,
            colors,
        };
        dispatch!(level, simd => for_channels!(
            channels, gather_chunk, simd, T, (input, pair_grads, layout, out)
        ))
    })?;
    let [means2d, whitened, opacities, absolute, colors] = arrays.map(UninitVec::finish);
    Ok(CompositeGrads {
        means2d,
        whitened,
        opacities,
        absolute,
        colors,
        ..CompositeGrads::default()
    })
}

/// The outputs of one chunk: empty where not wanted, zeros before.
struct Gather<'a, T> {
    chunk: &'a Chunk,
    means2d: &'a mut [T],
    whitened: &'a mut [T],
    opacities: &'a mut [T],
    absolute: &'a mut [T],
    colors: &'a mut [T],
}

impl<T: Real> Gather<'_, T> {
    /// Write the gradients of Gaussian `i` from the sums over its pairs.
    #[inline(always)]
    fn write(
        &mut self,
        i: usize,
        splat: &Splat,
        moments: &[f64],
        colors: &[f64],
        absolute: &[f64],
    ) {
        let i = i - self.chunk.begin;
        write(self.colors, i, colors);
        let [s, m, t] = splat.factors;
        // sigma = (u^2 + v^2) / 2 in standard deviations; the kernel's u and v are UNIT times that. It enters as
        // opacity exp(-sigma). All in one vector: divisions are what takes time here.
        let mut quotients = [moments[1], moments[2], -moments[0], 0.0];
        for (x, by) in quotients.iter_mut().zip([UNIT, UNIT, splat.opacity, 1.0]) {
            *x /= by;
        }
        let [wu, wv, opacity, _] = quotients;
        write(self.means2d, i, &[-s * wu, s * m * wu - t * wv]);
        // d sigma = -1/2 (y^T d cov y) with y = L (u, v)
        let k = -0.5 / (UNIT * UNIT);
        let whitened = [k * moments[3], k * moments[4], k * moments[5]];
        write(self.whitened, i, &whitened);
        write(self.opacities, i, &[opacity]);
        if !self.absolute.is_empty() {
            let absolute = [s * absolute[0] / UNIT, absolute[1] / (UNIT * UNIT)];
            write(self.absolute, i, &absolute);
        }
    }
}

/// Row `i` of an output, if it is wanted.
#[inline(always)]
fn write<T: Real>(out: &mut [T], i: usize, values: &[f64]) {
    if !out.is_empty() {
        for (o, v) in out[i * values.len()..].iter_mut().zip(values) {
            *o = T::from_f64(*v);
        }
    }
}

/// Spans whose rows are looked up together.
const FETCH: usize = 64;

/// `gather` for one chunk of Gaussians.
#[inline(always)]
fn gather_chunk<S: Simd, T: Real, const D: usize>(
    _: S,
    input: &CompositeInput<T>,
    pair_grads: &[Vec<T>],
    layout: PairLayout,
    mut out: Gather<T>,
) -> Result<(), Error> {
    let channels = if D > 0 { D } else { layout.channels };
    let row = PairLayout { channels, ..layout }.row();
    let tiles_x = input.tiles.tiles_x;
    let mut next = memory::copied(&out.chunk.starts, NAME)?;
    let zeros = memory::filled(T::ZERO, row, NAME)?;
    let mut moments = [0.0; MOMENTS];
    let mut absolute = [0.0; ABSOLUTE];
    let mut colors = memory::filled(0.0, channels, NAME)?;
    let mut current = None;
    // While the rows of some spans are added, those of the next are on their way.
    let (mut rows, mut coming) = (Vec::new(), Vec::new());
    let mut blocks = out.chunk.spans.chunks(FETCH);
    let mut look_up = |spans: Option<&[Span]>, rows: &mut Vec<_>| {
        rows.clear();
        for span in spans.unwrap_or(&[]) {
            prefetch(&input.projection.splats[span.gaussian as usize]);
            for tile in span.tiles(tiles_x) {
                let place = next[tile] as usize;
                next[tile] += 1;
                let grads = pair_grads[tile]
                    .get(place * row..(place + 1) * row)
                    .unwrap_or(&zeros);
                prefetch(&grads[0]);
                prefetch(&grads[row - 1]);
                rows.push(grads);
            }
        }
    };
    let mut ahead = blocks.next();
    look_up(ahead, &mut coming);
    while let Some(spans) = ahead {
        ahead = blocks.next();
        std::mem::swap(&mut rows, &mut coming);
        look_up(ahead, &mut coming);
        let mut rows = rows.iter();
        for span in spans {
            let i = span.gaussian as usize;
            if let Some(last) = current.filter(|&last| last != i) {
                let splat = &input.projection.splats[last];
                out.write(last, splat, &moments, &colors, &absolute);
                moments.fill(0.0);
                colors.fill(0.0);
                absolute.fill(0.0);
            }
            current = Some(i);
            for grads in rows.by_ref().take(span.tiles(tiles_x).len()) {
                add(&mut moments, grads);
                add(&mut colors[..channels], &grads[MOMENTS..]);
                if layout.absolute {
                    add(&mut absolute, &grads[MOMENTS + channels..]);
                }
            }
        }
    }
    if let Some(last) = current {
        let splat = &input.projection.splats[last];
        out.write(last, splat, &moments, &colors, &absolute);
    }
    Ok(())
}

#[inline(always)]
fn add<T: Real>(sums: &mut [f64], grads: &[T]) {
    let grads = &grads[..sums.len()];
    for (sum, grad) in sums.iter_mut().zip(grads) {
        *sum += grad.to_f64();
    }
}
