//! Groups of 16 Gaussians with one array per number (columns), read from and written to arrays that hold one
//! row per Gaussian. Rows are turned into columns in vector registers: element by element it costs more than
//! the arithmetic on them.

use super::{Lanes, Real, Wide, lanes, vec3::V3};
use fearless_simd::{Simd, SimdBase};

/// Gaussians in a group: one AVX-512 vector of f32. Any vector of f32 or f64 divides it.
pub const GROUP: usize = 16;

/// One number of each Gaussian of a group.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub struct Column<T>(pub [T; GROUP]);

impl<T: Real> Column<T> {
    /// All of them 0.
    pub const ZERO: Self = Self([T::ZERO; GROUP]);

    /// Gaussians `first..` of an array with one number each; 0 beyond its end.
    #[inline(always)]
    pub fn load(&mut self, data: &[T], first: usize) {
        if let Some(values) = data.get(first..first + GROUP) {
            self.0.copy_from_slice(values);
        } else {
            *self = Self::ZERO;
            let values = &data[first..];
            self.0[..values.len()].copy_from_slice(values);
        }
    }

    /// The Gaussians `at..` in f64.
    #[inline(always)]
    pub fn wide<S: Simd>(&self, simd: S, at: usize) -> Wide<S> {
        let mut wide = Wide::<S>::splat(simd, 0.0);
        let values = &self.0[at..at + lanes::<S>()];
        for lane in 0..lanes::<S>() {
            wide[lane] = values[lane].to_f64();
        }
        wide
    }

    /// The Gaussians `at..` as one vector.
    #[inline(always)]
    pub fn get<S: Simd>(&self, simd: S, at: usize) -> Lanes<T, S> {
        Lanes::<T, S>::from_slice(simd, &self.0[at..at + Lanes::<T, S>::LEN])
    }

    /// Set the Gaussians `at..`.
    #[inline(always)]
    pub fn set<S: Simd>(&mut self, _: S, at: usize, values: Lanes<T, S>) {
        values.store_slice(&mut self.0[at..at + Lanes::<T, S>::LEN]);
    }

    /// Set the Gaussians `at..` to the nearest values of this type.
    #[inline(always)]
    pub fn round<S: Simd>(&mut self, _: S, at: usize, values: Wide<S>) {
        let out = &mut self.0[at..at + lanes::<S>()];
        for lane in 0..lanes::<S>() {
            out[lane] = T::from_f64(values[lane]);
        }
    }

    /// Set the Gaussians `at..` to the nearest finite values of this type.
    #[inline(always)]
    pub fn saturate<S: Simd>(&mut self, _: S, at: usize, values: Wide<S>) {
        let out = &mut self.0[at..at + lanes::<S>()];
        for lane in 0..lanes::<S>() {
            out[lane] = T::saturating(values[lane]);
        }
    }
}

/// Three columns as a vector in f64.
#[inline(always)]
pub fn wide3<S: Simd, T: Real>(simd: S, columns: &[Column<T>; 3], at: usize) -> V3<Wide<S>> {
    V3::new(
        columns[0].wide(simd, at),
        columns[1].wide(simd, at),
        columns[2].wide(simd, at),
    )
}

/// Three columns as a vector.
#[inline(always)]
pub fn get3<S: Simd, T: Real>(simd: S, columns: &[Column<T>; 3], at: usize) -> V3<Lanes<T, S>> {
    V3::new(
        columns[0].get(simd, at),
        columns[1].get(simd, at),
        columns[2].get(simd, at),
    )
}

/// `[f(0), f(1), ..., f(15)]`, spelled out: a loop would keep the vectors in memory.
macro_rules! sixteen {
    ($i:ident => $value:expr) => {
        sixteen!(@ $i => $value, 0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15)
    };
    (@ $i:ident => $value:expr, $($k:literal)*) => {
        [$({
            let $i: usize = $k;
            $value
        }),*]
    };
}
/// Transpose the first `LEN` rows of a matrix: each stage is a perfect shuffle of all its elements.
#[inline(always)]
fn transpose<S: Simd, V: SimdBase<S>>(mut m: [V; GROUP]) -> [V; GROUP] {
    let half = V::LEN / 2;
    let mut side = 1;
    while side < V::LEN {
        m = sixteen!(i => {
            if i >= V::LEN {
                m[i]
            } else if i & 1 == 0 {
                m[i / 2].zip_low(m[i / 2 + half])
            } else {
                m[i / 2].zip_high(m[i / 2 + half])
            }
        });
        side *= 2;
    }
    m
}

/// The transpose of `LEN` vectors that lie one after the other.
#[inline(always)]
pub fn turned<S: Simd, T: Real>(simd: S, data: &[T]) -> [Lanes<T, S>; GROUP] {
    let n = Lanes::<T, S>::LEN;
    transpose(sixteen!(i => Lanes::<T, S>::from_slice(simd, &data[i % n * n..][..n])))
}

/// Columns `begin..` of the rows `first..` of an array with `row` numbers per row: as many as the vector is
/// long or `out` has. Rows beyond the end are 0.
#[inline(always)]
pub fn read_block<S: Simd, T: Real>(
    simd: S,
    data: &[T],
    row: usize,
    first: usize,
    begin: usize,
    out: &mut [Column<T>],
) {
    let n = Lanes::<T, S>::LEN;
    let last = (first + GROUP - 1) * row + begin;
    if last + n <= data.len() {
        let data = &data[first * row + begin..last + n];
        for at in (0..GROUP).step_by(n) {
            let m = sixteen!(i => {
                let start = if i < n { (at + i) * row } else { 0 };
                Lanes::<T, S>::from_slice(simd, &data[start..start + n])
            });
            let m = transpose(m);
            for c in 0..n.min(out.len()) {
                out[c].set(simd, at, m[c]);
            }
        }
    } else {
        for (c, out) in out.iter_mut().enumerate().take(n) {
            for (r, x) in out.0.iter_mut().enumerate() {
                // What lies beyond the row is not used; what lies beyond the array is not there.
                let value = data.get((first + r) * row + begin + c);
                *x = value.copied().unwrap_or(T::ZERO);
            }
        }
    }
}

/// The columns of the rows `first..` of an array with C numbers per row; 0 beyond its end.
#[inline(always)]
pub fn read<S: Simd, T: Real, const C: usize>(
    simd: S,
    data: &[T],
    first: usize,
    out: &mut [Column<T>; C],
) {
    for begin in (0..C).step_by(Lanes::<T, S>::LEN) {
        read_block(simd, data, C, first, begin, &mut out[begin..]);
    }
}

/// Most columns that are read or written at once, rounded up so that each block of them is a whole vector.
pub const MAX_COLUMNS: usize = 64;

/// The rows of a group, on their way from an array to columns: memory is read in the order of its addresses,
/// which the processor fetches ahead; blocks of columns would jump from row to row.
pub struct Rows<T>([[T; MAX_COLUMNS]; GROUP]);

impl<T: Real> Rows<T> {
    /// All of them 0.
    pub const ZERO: Self = Self([[T::ZERO; MAX_COLUMNS]; GROUP]);

    /// Columns `..count` of the rows `first..` of an array with `row` numbers per row; rows beyond the end keep
    /// what was there. `out` has room for `count` columns, rounded up to `GROUP`; what is beyond `count` is of
    /// no meaning.
    #[inline(always)]
    pub fn read<S: Simd>(
        &mut self,
        simd: S,
        data: &[T],
        row: usize,
        first: usize,
        count: usize,
        out: &mut [Column<T>],
    ) {
        let n = Lanes::<T, S>::LEN;
        let width = count.next_multiple_of(n);
        for (i, to) in self.0.iter_mut().enumerate() {
            let begin = ((first + i) * row).min(data.len());
            let from = &data[begin..];
            if width <= from.len() {
                for at in (0..width).step_by(n) {
                    let x = Lanes::<T, S>::from_slice(simd, &from[at..at + n]);
                    x.store_slice(&mut to[at..at + n]);
                }
            } else {
                let left = count.min(from.len());
                to[..left].copy_from_slice(&from[..left]);
            }
        }
        let rows = self.0.as_flattened();
        for at in (0..width).step_by(n) {
            read_block(simd, rows, MAX_COLUMNS, 0, at, &mut out[at..at + n]);
        }
    }
}

/// Write columns as the first numbers of the 16 rows of an array with `row` numbers per row, in cache.
#[inline(always)]
pub fn write_rows<S: Simd, T: Real>(simd: S, columns: &[Column<T>], out: &mut [T], row: usize) {
    let n = Lanes::<T, S>::LEN;
    let count = columns.len();
    if count < n {
        for (i, out) in out.chunks_exact_mut(row).enumerate() {
            for (x, column) in out.iter_mut().zip(columns) {
                *x = column.0[i];
            }
        }
        return;
    }
    // The last block overlaps the one before it.
    for block in (0..count).step_by(n) {
        let block = block.min(count - n);
        let columns = &columns[block..block + n];
        for at in (0..GROUP).step_by(n) {
            let m = transpose(sixteen!(i => columns[i % n].get(simd, at)));
            for (out, m) in out[at * row..(at + n) * row].chunks_exact_mut(row).zip(&m) {
                m.store_slice(&mut out[block..block + n]);
            }
        }
    }
}

/// Write C columns as the first rows of an array with C numbers per row, as many as it has.
#[inline(always)]
pub fn write<T: Copy, const C: usize>(columns: [&[T; GROUP]; C], out: &mut [T]) {
    let rows = out.as_chunks_mut::<C>().0;
    if let Some(rows) = rows.first_chunk_mut::<GROUP>() {
        for i in 0..GROUP {
            for c in 0..C {
                rows[i][c] = columns[c][i];
            }
        }
    } else {
        for (i, row) in rows.iter_mut().enumerate() {
            for c in 0..C {
                row[c] = columns[c][i];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::at_each_level;
    use fearless_simd::dispatch;

    fn numbers<T: Real>(n: usize) -> Vec<T> {
        (0..n).map(|i| T::from_f64(i as f64)).collect()
    }

    #[inline(always)]
    fn check<S: Simd, T: Real + PartialEq + std::fmt::Debug>(simd: S) {
        // 40 rows: two whole groups, and one of 8.
        for (row, count) in [(48, 48), (45, 45), (48, 27), (27, 27), (3, 3), (9, 9)] {
            let data = numbers::<T>(40 * row);
            let mut out = vec![T::ZERO; 40 * row];
            let mut buffer = Rows::ZERO;
            for first in [0, 16, 32] {
                let mut columns = [Column::ZERO; MAX_COLUMNS];
                buffer.read(simd, &data, row, first, count, &mut columns);
                for (c, column) in columns[..count].iter().enumerate() {
                    for (r, x) in column.0.iter().enumerate().take(40 - first) {
                        assert_eq!(*x, data[(first + r) * row + c], "row {r}, column {c}");
                    }
                }
                let rows = GROUP.min(40 - first);
                let mut group = vec![T::ZERO; GROUP * row];
                write_rows(simd, &columns[..count], &mut group, row);
                out[first * row..][..rows * row].copy_from_slice(&group[..rows * row]);
            }
            for (i, (x, expected)) in out.iter().zip(&data).enumerate() {
                let expected = if i % row < count { *expected } else { T::ZERO };
                assert_eq!(*x, expected, "{row} per row, element {i}");
            }
        }
        let data = numbers::<T>(40 * 3);
        let mut out = vec![T::ZERO; 40 * 3];
        for first in [0, 16, 32] {
            let mut columns = [Column::ZERO; 3];
            read(simd, &data, first, &mut columns);
            let [x, y, z] = columns;
            write([&x.0, &y.0, &z.0], &mut out[first * 3..]);
        }
        assert_eq!(out, data);
    }

    #[test]
    fn rows_come_back_from_columns() {
        at_each_level(|level| {
            dispatch!(level.token, simd => check::<_, f32>(simd));
            dispatch!(level.token, simd => check::<_, f64>(simd));
        });
    }
}
