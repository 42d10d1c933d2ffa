//! The gradients of each Gaussian from those of its pairs.

use super::{
    CompositeGrads, CompositeInput, Wanted, for_channels,
    kernel::{ABSOLUTE, MOMENTS},
};
use crate::{
    error::Error,
    memory,
    project::{Splat, lanes_in},
    simd::{
        Real,
        groups::{self, Column, GROUP},
        lanes, splat,
    },
    tiles::{Chunk, Reach, UNIT},
    uninit::{PieceWriter, UninitPiece, UninitVec, prefetch, prefetch_all},
};
use fearless_simd::{Select, Simd, dispatch};
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
    let jobs = jobs.into_par_iter().zip(chunks).with_max_len(1);
    jobs.try_for_each(|(pieces, chunk)| {
        let out = pieces.map(UninitPiece::writer);
        dispatch!(level, simd => for_channels!(
            channels, gather_chunk, simd, T, (input, pair_grads, layout, wanted, chunk, out)
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

/// Rows that are looked up before they are added.
const AHEAD: usize = 64;

/// `gather` for one chunk of Gaussians.
#[inline(always)]
fn gather_chunk<S: Simd, T: Real, const D: usize>(
    simd: S,
    input: &CompositeInput<T>,
    pair_grads: &[Vec<T>],
    layout: PairLayout,
    wanted: Wanted,
    chunk: &Chunk,
    mut out: [PieceWriter<T>; 5],
) -> Result<(), Error> {
    let channels = if D > 0 { D } else { layout.channels };
    let row = PairLayout { channels, ..layout }.row();
    let tiles_x = input.tiles.tiles_x;
    let mut next = memory::copied(&chunk.starts, NAME)?;
    let zeros = memory::filled(T::ZERO, row, NAME)?;
    let mut look_up = |reach: Option<&Reach>| {
        let Some(reach) = reach else {
            return &zeros[..];
        };
        let tile = reach.tile(tiles_x);
        let place = next[tile] as usize;
        next[tile] += 1;
        let grads = pair_grads[tile].get(place * row..(place + 1) * row);
        let grads = grads.unwrap_or(&zeros);
        prefetch(&grads[0]);
        prefetch(&grads[row - 1]);
        grads
    };
    // While some rows are added, others are on their way.
    let mut coming: [&[T]; AHEAD] = std::array::from_fn(|k| look_up(chunk.reaches.get(k)));
    let mut at = 0;
    // A row for each Gaussian of a group, and some numbers that are read and not used.
    let mut sums = memory::filled(0.0, GROUP * row + GROUP, NAME)?;
    let mut colors = memory::filled(T::ZERO, GROUP * channels, NAME)?;
    let splats = &input.projection.splats;
    for first in (chunk.begin..chunk.end).step_by(GROUP) {
        let end = chunk.end.min(first + GROUP);
        prefetch_all(&splats[end..splats.len().min(end + GROUP)]);
        sums.fill(0.0);
        let mut reached = 0u16;
        while let Some(reach) = chunk.reaches.get(at) {
            let i = reach.gaussian as usize;
            if i >= end {
                break;
            }
            reached |= 1 << (i - first);
            let coming = &mut coming[at % AHEAD];
            let grads = std::mem::replace(coming, look_up(chunk.reaches.get(at + AHEAD)));
            at += 1;
            let sums = &mut sums[(i - first) * row..(i - first + 1) * row];
            add(&mut sums[..MOMENTS + channels], grads);
            if layout.absolute {
                add(
                    &mut sums[MOMENTS + channels..],
                    &grads[MOMENTS + channels..],
                );
            }
        }
        let [means2d, whitened, opacities, absolute, v_colors] = &mut out;
        if wanted.colors {
            for (out, sums) in colors
                .chunks_exact_mut(channels.max(1))
                .zip(sums.chunks_exact(row))
            {
                for (out, sum) in out.iter_mut().zip(&sums[MOMENTS..]) {
                    *out = T::from_f64(*sum);
                }
            }
            v_colors.put(&colors[..(end - first) * channels]);
        }
        if wanted.geometry {
            let mut group = GeometryGroup::<T>::ZERO;
            group.set(simd, &splats[first..end], reached, &sums, layout, row);
            group.put(
                [means2d, whitened, opacities, absolute],
                layout.absolute,
                end - first,
            );
        }
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

/// Gradients of the geometry of a group, a column per number.
struct GeometryGroup<T> {
    means2d: [Column<T>; 2],
    whitened: [Column<T>; 3],
    opacities: Column<T>,
    absolute: [Column<T>; ABSOLUTE],
}

impl<T: Real> GeometryGroup<T> {
    const ZERO: Self = Self {
        means2d: [Column::ZERO; 2],
        whitened: [Column::ZERO; 3],
        opacities: Column::ZERO,
        absolute: [Column::ZERO; ABSOLUTE],
    };

    /// From rows of `row` sums over the pairs of each Gaussian; 0 for those without one.
    #[inline(always)]
    fn set<S: Simd>(
        &mut self,
        simd: S,
        splats: &[Splat],
        reached: u16,
        sums: &[f64],
        layout: PairLayout,
        row: usize,
    ) {
        let mut moments = [Column::<f64>::ZERO; MOMENTS];
        for begin in (0..MOMENTS).step_by(lanes::<S>()) {
            groups::read_block(simd, sums, row, 0, begin, &mut moments[begin..]);
        }
        let mut factors = [Column::<f64>::ZERO; 3];
        let mut opacities = Column::<f64>::ZERO;
        for (lane, splat) in splats.iter().enumerate() {
            for (column, factor) in factors.iter_mut().zip(splat.factors) {
                column.0[lane] = factor;
            }
            opacities.0[lane] = splat.opacity;
        }
        let zero = splat(simd, 0.0);
        for at in (0..GROUP).step_by(lanes::<S>()) {
            let some = lanes_in(simd, reached, at);
            let [s, m, t] = [0, 1, 2].map(|k| factors[k].wide(simd, at));
            // sigma = (u^2 + v^2) / 2 in standard deviations; the kernel's u and v are UNIT times that. It enters as
            // opacity exp(-sigma).
            let wu = moments[1].wide(simd, at) / UNIT;
            let wv = moments[2].wide(simd, at) / UNIT;
            let opacity = -moments[0].wide(simd, at) / opacities.wide(simd, at);
            self.means2d[0].round(simd, at, some.select(-s * wu, zero));
            self.means2d[1].round(simd, at, some.select(s * m * wu - t * wv, zero));
            // d sigma = -1/2 (y^T d cov y) with y = L (u, v)
            for (k, column) in self.whitened.iter_mut().enumerate() {
                let moment = moments[3 + k].wide(simd, at) * (-0.5 / (UNIT * UNIT));
                column.round(simd, at, some.select(moment, zero));
            }
            self.opacities.round(simd, at, some.select(opacity, zero));
        }
        if layout.absolute {
            for (lane, splat) in splats.iter().enumerate() {
                let sums = &sums[(lane + 1) * row - ABSOLUTE..];
                self.absolute[0].0[lane] = T::from_f64(splat.factors[0] * sums[0] / UNIT);
                self.absolute[1].0[lane] = T::from_f64(sums[1] / (UNIT * UNIT));
            }
        }
    }

    /// Give out the first `rows`; whether the absolute gradients are `given`.
    #[inline(always)]
    fn put(
        &self,
        [means2d, whitened, opacities, absolute]: [&mut PieceWriter<T>; 4],
        given: bool,
        rows: usize,
    ) {
        let mut buffer = [T::ZERO; 3 * GROUP];
        let [x, y] = &self.means2d;
        groups::write([&x.0, &y.0], &mut buffer[..2 * GROUP]);
        means2d.put(&buffer[..2 * rows]);
        let [x, y, z] = &self.whitened;
        groups::write([&x.0, &y.0, &z.0], &mut buffer);
        whitened.put(&buffer[..3 * rows]);
        opacities.put(&self.opacities.0[..rows]);
        if given {
            let [x, y] = &self.absolute;
            groups::write([&x.0, &y.0], &mut buffer[..2 * GROUP]);
            absolute.put(&buffer[..2 * rows]);
        }
    }
}
