//! One band of rows of the photometric loss.
//!
//! Two rows at a time pass through all stages: filter horizontally, filter vertically and compare, filter the
//! gradients horizontally, then vertically. Between the stages lie ring buffers of 12 rows, which stay in the
//! cache. The images are interleaved, so the horizontal filter steps by the number of channels.
//!
//! No closure holds SIMD code here: one that the compiler does not inline loses the instruction set.

use super::{Images, NAME, Plan, RowSums, Sample};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat};
use hqgs::internals::{
    Error, memory,
    simd::{Lanes, Real},
};

/// Half the window: 11 taps.
const REACH: usize = 5;
/// In pixels.
pub(super) const SIGMA: f64 = 1.5;
/// (K1 L)^2 of Wang et al. with data range L = 1.
pub(super) const C1: f64 = 0.01 * 0.01;
/// (K2 L)^2 there.
pub(super) const C2: f64 = 0.03 * 0.03;

/// Rows that go through a stage together: a row loaded for the vertical filter then serves both.
const PAIR: usize = 2;
/// Rows that the vertical filter of a pair reads, and the rows of each ring buffer.
const RING: usize = PAIR + 2 * REACH;
/// Buffer rows start on a cache line (of f32) and hold whole vectors of any machine.
const LINE: usize = 16;

/// The window's taps 0..=5 from its centre.
type Kernel<T, S> = [Lanes<T, S>; REACH + 1];

/// Rows of [`Buffers`]: four rings of windowed sums, three of gradients, and the single rows.
const BUFFER_ROWS: usize = (4 + 3) * RING + 2 + 3 * PAIR + PAIR;

/// The buffers of a band. Rows of `p`, `q` and `maps` start with 5 padded pixels, the others with the data.
struct Buffers<'a, T> {
    /// Horizontally filtered p, q, p^2, q^2.
    moments: [Ring<'a, T>; 4],
    /// Horizontally filtered `maps`.
    adjoint: [Ring<'a, T>; 3],
    p: &'a mut [T],
    q: &'a mut [T],
    /// Gradients of the dissimilarity with respect to its windowed sums: of p and q together, of p^2, of q^2.
    maps: [[&'a mut [T]; PAIR]; 3],
    dissimilarity: [&'a mut [T]; PAIR],
}

/// The last [`RING`] rows; row i lies in slot i mod RING.
struct Ring<'a, T> {
    data: &'a mut [T],
    row: usize,
}

impl<T> Ring<'_, T> {
    fn start(&self, row: isize) -> usize {
        row.rem_euclid(RING as isize) as usize * self.row
    }

    fn row_mut(&mut self, row: isize) -> &mut [T] {
        let start = self.start(row);
        &mut self.data[start..start + self.row]
    }

    /// All rows from `first`, the oldest.
    fn rows(&self, first: isize) -> [&[T]; RING] {
        std::array::from_fn(|i| &self.data[self.start(first + i as isize)..][..self.row])
    }
}

impl<'a, T> Buffers<'a, T> {
    fn new(data: &'a mut [T], row: usize) -> Self {
        let (rings, single) = data.split_at_mut(7 * RING * row);
        let mut rings = rings
            .chunks_exact_mut(row * RING)
            .map(|data| Ring { data, row });
        let mut rows = single.chunks_exact_mut(row);
        let mut ring = || rings.next().expect("7 rings");
        let mut line = || rows.next().expect("10 rows");
        Self {
            moments: std::array::from_fn(|_| ring()),
            adjoint: std::array::from_fn(|_| ring()),
            p: line(),
            q: line(),
            maps: std::array::from_fn(|_| std::array::from_fn(|_| line())),
            dissimilarity: std::array::from_fn(|_| line()),
        }
    }
}

/// A band of rows, starting at `first`.
pub(super) struct Band<'a, T, Y> {
    images: Images<'a, T, Y>,
    plan: Plan,
    first: usize,
    /// Elements of an image row, and of the padding on either side.
    n: usize,
    pad: usize,
    buffers: Buffers<'a, T>,
}

impl<'a, T: Real, Y: Sample<T>> Band<'a, T, Y> {
    /// The band of `images` from row `first` on; `memory` grows to what it needs.
    pub fn new(
        images: Images<'a, T, Y>,
        plan: Plan,
        first: usize,
        memory: &'a mut Vec<T>,
    ) -> Result<Self, Error> {
        let [_, width, channels] = images.size;
        let (n, pad) = (width * channels, REACH * channels);
        let row = n.next_multiple_of(LINE) + (2 * pad).next_multiple_of(LINE);
        let size = BUFFER_ROWS * row;
        if memory.len() < size + LINE {
            memory::resize(memory, size + LINE, T::ZERO, NAME)?;
        }
        let start = memory
            .as_ptr()
            .align_offset(LINE * size_of::<f32>())
            .min(LINE);
        let mut buffers = Buffers::new(&mut memory[start..start + size], row);
        buffers.p.fill(-T::ONE);
        buffers.q.fill(T::ZERO);
        for map in buffers.maps.as_flattened_mut() {
            map.fill(T::ZERO);
        }
        Ok(Self {
            images,
            plan,
            first,
            n,
            pad,
            buffers,
        })
    }

    /// Fill in the sums of each row and, if wanted, the gradient of all rows.
    #[inline(always)]
    pub fn run<S: Simd>(mut self, simd: S, mut grad: Option<&mut [T]>, sums: &mut [RowSums]) {
        if self.plan.ssim {
            self.run_ssim(simd, grad.as_deref_mut(), sums);
        }
        if !self.plan.ssim || grad.is_none() {
            for (i, sums) in sums.iter_mut().enumerate() {
                let grad = grad.as_mut().map(|g| &mut g[i * self.n..(i + 1) * self.n]);
                sums.l1 = self.finish(self.first + i, grad, None);
            }
        }
    }

    #[inline(always)]
    fn run_ssim<S: Simd>(&mut self, simd: S, mut grad: Option<&mut [T]>, sums: &mut [RowSums]) {
        let kernel = window::<T, S>(simd);
        let (first, reach) = (self.first as isize, REACH as isize);
        let end = first + sums.len() as isize;
        // The gradient of a row takes the comparisons of 5 rows around it, and these the pixels of 5 more.
        let halo = if grad.is_some() { reach } else { 0 };
        let start = first - halo;
        for row in start - reach..start + reach {
            self.filter_moments(simd, &kernel, row);
        }
        for row in (start..end + halo).step_by(PAIR) {
            for i in 0..PAIR as isize {
                self.filter_moments(simd, &kernel, row + reach + i);
            }
            self.compare(simd, &kernel, row, grad.is_some());
            for (row, values) in (row..end).zip(&self.buffers.dissimilarity) {
                if row >= first {
                    sums[(row - first) as usize].dissimilarity = sum(&values[..self.n], |d| d);
                }
            }
            let Some(grad) = &mut grad else { continue };
            self.filter_maps(simd, &kernel, row);
            if row - reach < first {
                continue;
            }
            self.gather(simd, &kernel, row - reach);
            let done = (row - reach - first) as usize;
            for i in 0..PAIR.min(sums.len() - done) {
                let grad = &mut grad[(done + i) * self.n..(done + i + 1) * self.n];
                sums[done + i].l1 = self.finish(self.first + done + i, Some(grad), Some(i));
            }
        }
    }

    /// The index of `row` if it lies in the image.
    fn inside(&self, row: isize) -> Option<usize> {
        usize::try_from(row)
            .ok()
            .filter(|&row| row < self.images.size[0])
    }

    /// Read a row as `p = x + y - 1` and `q = x - y`. Where the mask is 0, x is taken to be y.
    #[inline(always)]
    fn load(&mut self, row: usize) {
        let Images {
            render,
            target,
            mask,
            size: [.., channels],
        } = self.images.row(row);
        let (p, q) = (
            &mut self.buffers.p[self.pad..],
            &mut self.buffers.q[self.pad..],
        );
        for (((p, q), &x), &y) in p.iter_mut().zip(q.iter_mut()).zip(render).zip(target) {
            let y = y.value();
            *p = x + y - T::ONE;
            *q = x - y;
        }
        for pixel in ignored(mask) {
            for c in pixel * channels..(pixel + 1) * channels {
                let y = target[c].value();
                p[c] = y + y - T::ONE;
                q[c] = T::ZERO;
            }
        }
    }

    /// Filter a row of p, q and their squares horizontally into the rings.
    #[inline(always)]
    fn filter_moments<S: Simd>(&mut self, simd: S, kernel: &Kernel<T, S>, row: isize) {
        let inside = self.inside(row);
        if let Some(row) = inside {
            self.load(row);
        }
        let [sp, sq, spp, sqq] = self
            .buffers
            .moments
            .each_mut()
            .map(|ring| ring.row_mut(row));
        if inside.is_none() {
            sp.fill(-T::ONE);
            spp.fill(T::ONE);
            sq.fill(T::ZERO);
            sqq.fill(T::ZERO);
            return;
        }
        let (n, pad, step) = (self.n, self.pad, self.images.size[2]);
        for (values, sums, squares) in [(&*self.buffers.p, sp, spp), (&*self.buffers.q, sq, sqq)] {
            for j in (0..n).step_by(Lanes::<T, S>::LEN) {
                let v = read(simd, values, j + pad);
                let mut sum = kernel[0] * v;
                let mut square = sum * v;
                for (k, &tap) in (1..).zip(&kernel[1..]) {
                    let a = read(simd, values, j + pad - k * step);
                    let b = read(simd, values, j + pad + k * step);
                    sum = tap.mul_add(a + b, sum);
                    square = tap.mul_add(a.mul_add(a, b * b), square);
                }
                write(sum, sums, j);
                write(square, squares, j);
            }
        }
    }

    /// Filter the moments of the rows `row` and `row + 1` vertically and compare them: the dissimilarity
    /// `1 - SSIM` of each pixel and, if wanted, its gradient.
    #[inline(always)]
    fn compare<S: Simd>(&mut self, simd: S, kernel: &Kernel<T, S>, row: isize, gradient: bool) {
        let (n, pad) = (self.n, self.pad);
        let Buffers {
            moments,
            maps,
            dissimilarity,
            ..
        } = &mut self.buffers;
        let moments = moments
            .each_ref()
            .map(|ring| ring.rows(row - REACH as isize));
        let zero = Lanes::<T, S>::splat(simd, T::ZERO);
        let one = Lanes::<T, S>::splat(simd, T::ONE);
        let two = one + one;
        let (c1, c2) = (two * T::from_f64(C1), two * T::from_f64(C2));
        for j in (0..n).step_by(Lanes::<T, S>::LEN) {
            let p = filter_rows(simd, kernel, &moments[0], j);
            let q = filter_rows(simd, kernel, &moments[1], j);
            let pp = filter_rows(simd, kernel, &moments[2], j);
            let qq = filter_rows(simd, kernel, &moments[3], j);
            for i in 0..PAIR {
                let (p, q, mean) = (p[i], q[i], p[i] + one);
                let (vp, vq) = (pp[i] - p * p, qq[i] - q * q);
                // Rounding may make a variance negative; NaN stays.
                let (vp, vq) = (
                    vp.simd_lt(zero).select(zero, vp),
                    vq.simd_lt(zero).select(zero, vq),
                );
                let a1 = one / (mean.mul_add(mean, q.mul_add(q, c1)));
                let b1 = one / (vp + vq + c2);
                let (a, b) = (two * q * q * a1, two * vq * b1);
                write(a + b - a * b, dissimilarity[i], j);
                if gradient {
                    let (ga, gb) = (two * (one - b) * a1, two * (one - a) * b1);
                    let (gpp, gqq) = (-gb * b, gb * (two - b));
                    let g = ga * (q * (two - a) - a * mean) - gpp * p - gqq * q;
                    write(g, maps[0][i], pad + j);
                    write(gpp, maps[1][i], pad + j);
                    write(gqq, maps[2][i], pad + j);
                }
            }
        }
    }

    /// Filter the maps of the rows `row` and `row + 1` horizontally into the rings.
    #[inline(always)]
    fn filter_maps<S: Simd>(&mut self, simd: S, kernel: &Kernel<T, S>, row: isize) {
        let (n, pad, step) = (self.n, self.pad, self.images.size[2]);
        for i in 0..PAIR {
            let row = row + i as isize;
            let inside = self.inside(row).is_some();
            for (maps, ring) in self.buffers.maps.iter_mut().zip(&mut self.buffers.adjoint) {
                let (map, out) = (&mut *maps[i], ring.row_mut(row));
                if !inside {
                    out.fill(T::ZERO);
                    continue;
                }
                map[pad + n..].fill(T::ZERO);
                for j in (0..n).step_by(Lanes::<T, S>::LEN) {
                    let mut sum = kernel[0] * read(simd, map, j + pad);
                    for (k, &tap) in (1..).zip(&kernel[1..]) {
                        let a = read(simd, map, j + pad - k * step);
                        let b = read(simd, map, j + pad + k * step);
                        sum = tap.mul_add(a + b, sum);
                    }
                    write(sum, out, j);
                }
            }
        }
    }

    /// Filter the maps of the rows `row` and `row + 1` vertically, back into `maps`.
    #[inline(always)]
    fn gather<S: Simd>(&mut self, simd: S, kernel: &Kernel<T, S>, row: isize) {
        let (n, pad) = (self.n, self.pad);
        for (ring, maps) in self.buffers.adjoint.iter().zip(&mut self.buffers.maps) {
            let rows = ring.rows(row - REACH as isize);
            for j in (0..n).step_by(Lanes::<T, S>::LEN) {
                let sums = filter_rows(simd, kernel, &rows, j);
                for (sum, map) in sums.into_iter().zip(maps.iter_mut()) {
                    write(sum, map, pad + j);
                }
            }
        }
    }

    /// The sum of the absolute differences of a row, rounded off within the knee. The gradient is that of L1
    /// (or Huber's) plus, if the filtered maps of the row lie at `maps[..][i]`, that of SSIM.
    #[inline(always)]
    fn finish(&mut self, row: usize, grad: Option<&mut [T]>, i: Option<usize>) -> f64 {
        self.load(row);
        let Images {
            mask,
            size: [.., channels],
            ..
        } = self.images.row(row);
        let knee = self.plan.knee;
        let part = self.pad..self.pad + self.n;
        let (p, q) = (&self.buffers.p[part.clone()], &self.buffers.q[part.clone()]);
        if let Some(grad) = grad {
            let scale = T::from_f64(self.plan.l1_scale);
            let narrow = T::from_f64(knee); // 0 where T has nothing so small
            for (grad, &q) in grad.iter_mut().zip(q) {
                *grad = if q > narrow {
                    scale
                } else if q < -narrow {
                    -scale
                } else if narrow > T::ZERO {
                    scale * (q / narrow)
                } else {
                    T::ZERO
                };
            }
            if let Some(i) = i {
                let scale = T::from_f64(self.plan.ssim_scale);
                let [g, gpp, gqq] = self
                    .buffers
                    .maps
                    .each_ref()
                    .map(|maps| &maps[i][part.clone()]);
                let maps = g.iter().zip(gpp).zip(gqq);
                for (((grad, ((&g, &gpp), &gqq)), &p), &q) in
                    grad.iter_mut().zip(maps).zip(p).zip(q)
                {
                    *grad += scale * (g + p * gpp + q * gqq);
                }
            }
            for pixel in ignored(mask) {
                grad[pixel * channels..(pixel + 1) * channels].fill(T::ZERO);
            }
        }
        if knee > 0.0 {
            sum(q, |q| {
                let within = q.abs().min(knee);
                within / knee * (q.abs() - within / 2.0)
            })
        } else {
            sum(q, f64::abs)
        }
    }
}

/// The pixels of a row that do not count.
fn ignored(mask: Option<&[u8]>) -> impl Iterator<Item = usize> {
    mask.unwrap_or_default()
        .iter()
        .enumerate()
        .filter(|(_, counts)| **counts == 0)
        .map(|(pixel, _)| pixel)
}

/// The window's taps 0..=5 from its centre, normalised to a sum of 1 over all 11.
#[inline(always)]
fn window<T: Real, S: Simd>(simd: S) -> Kernel<T, S> {
    let taps: [f64; REACH + 1] =
        std::array::from_fn(|k| (-((k * k) as f64) / (2.0 * SIGMA * SIGMA)).exp());
    let total = taps[0] + 2.0 * taps[1..].iter().sum::<f64>();
    let mut kernel = [Lanes::<T, S>::splat(simd, T::ZERO); REACH + 1];
    for (lanes, tap) in kernel.iter_mut().zip(taps) {
        *lanes = Lanes::<T, S>::splat(simd, T::from_f64(tap / total));
    }
    kernel
}

/// Filter vertically at column `j`: the pair of rows in the middle of `rows`.
#[inline(always)]
fn filter_rows<T: Real, S: Simd>(
    simd: S,
    kernel: &Kernel<T, S>,
    rows: &[&[T]; RING],
    j: usize,
) -> [Lanes<T, S>; PAIR] {
    let mut sums = [Lanes::<T, S>::splat(simd, T::ZERO); PAIR];
    for (k, row) in rows.iter().enumerate() {
        let v = read(simd, row, j);
        for (i, sum) in sums.iter_mut().enumerate() {
            if (i..=i + 2 * REACH).contains(&k) {
                *sum = kernel[(k - i).abs_diff(REACH)].mul_add(v, *sum);
            }
        }
    }
    sums
}

#[inline(always)]
fn read<T: Real, S: Simd>(simd: S, row: &[T], j: usize) -> Lanes<T, S> {
    Lanes::<T, S>::from_slice(simd, &row[j..j + Lanes::<T, S>::LEN])
}

#[inline(always)]
fn write<T: Real, S: Simd, V: SimdBase<S, Element = T>>(v: V, row: &mut [T], j: usize) {
    v.store_slice(&mut row[j..j + V::LEN]);
}

/// The sum in f64, in an order that the compiler can vectorise: 16 interleaved sums.
#[inline(always)]
fn sum<T: Real>(row: &[T], value: impl Fn(f64) -> f64) -> f64 {
    let mut sums = [0.0; 16];
    let (blocks, rest) = row.as_chunks::<16>();
    for block in blocks {
        for (sum, x) in sums.iter_mut().zip(block) {
            *sum += value(x.to_f64());
        }
    }
    for (sum, x) in sums.iter_mut().zip(rest) {
        *sum += value(x.to_f64());
    }
    sums.iter().sum()
}
