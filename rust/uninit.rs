//! New vectors whose chunks are set by the jobs that fill them, while they are in the cache of one core. To set
//! a large vector to zero before that would be one more pass through memory, which costs more than the
//! arithmetic on it. What does not stay in cache anyway goes around it where the processor can do that: a cached
//! store first reads what it overwrites.

use crate::{error::Error, memory, simd::Real};
use std::{
    mem::MaybeUninit,
    sync::atomic::{AtomicUsize, Ordering},
};

/// Vectors of at least so many bytes go around the cache. The last caches of today's processors hold tens of
/// megabytes, and the gradients have company there.
const STREAMED: usize = 8 << 20;

/// A vector in the making.
#[derive(Debug)]
pub(crate) struct UninitVec<T> {
    memory: Vec<T>,
    len: usize,
    /// Elements that were set since the last cut.
    set: AtomicUsize,
}

/// A piece of a vector in the making, from its first element on that is not yet set.
#[derive(Debug)]
pub(crate) struct UninitPiece<'a, T> {
    memory: &'a mut [MaybeUninit<T>],
    /// Elements that were set.
    done: usize,
    set: &'a AtomicUsize,
    /// Whether what is put goes around the cache.
    streamed: bool,
}

impl<T: Copy> UninitVec<T> {
    /// Of what `name` says.
    ///
    /// # Errors
    /// When there is no memory for it.
    pub fn new(len: usize, name: &str) -> Result<Self, Error> {
        Ok(Self {
            memory: memory::with_capacity(len, name)?,
            len,
            set: AtomicUsize::new(0),
        })
    }

    /// Several of these lengths.
    ///
    /// # Errors
    /// As for `new`.
    pub fn several<const N: usize>(lengths: [usize; N], name: &str) -> Result<[Self; N], Error> {
        let vectors = lengths.into_iter().map(|len| Self::new(len, name));
        let vectors: Vec<_> = vectors.collect::<Result<_, _>>()?;
        Ok(vectors
            .try_into()
            .unwrap_or_else(|_| unreachable!("one for each length")))
    }

    /// Cut into consecutive pieces, as many as there are lengths and elements.
    pub fn cut(&mut self, lengths: impl Iterator<Item = usize>) -> Vec<UninitPiece<'_, T>> {
        self.set = AtomicUsize::new(0); // an earlier cut does not count: the same pieces could be set twice
        let set = &self.set;
        let streamed = self.len * size_of::<T>() >= STREAMED;
        let mut rest = &mut self.memory.spare_capacity_mut()[..self.len];
        lengths
            .map(|n| {
                let (memory, tail) = std::mem::take(&mut rest).split_at_mut(n);
                rest = tail;
                UninitPiece {
                    memory,
                    done: 0,
                    set,
                    streamed,
                }
            })
            .collect()
    }

    /// The vector. Every piece must have been set.
    #[allow(unsafe_code)]
    pub fn finish(mut self) -> Vec<T> {
        assert_eq!(*self.set.get_mut(), self.len, "a piece was not set");
        // SAFETY: `new` made room for `len` elements. The pieces of one cut do not overlap, and each counts an
        // element once, after it was set; together they count `len`, so that all are set.
        unsafe { self.memory.set_len(self.len) };
        self.memory
    }
}

impl<'a, T: Copy> UninitPiece<'a, T> {
    /// Set every element that is left.
    #[inline(always)]
    pub fn fill(mut self, value: T) -> &'a mut [T] {
        self.next(self.memory.len(), value)
    }

    /// Set the next `n` elements.
    #[inline(always)]
    #[allow(unsafe_code)]
    pub fn next(&mut self, n: usize, value: T) -> &'a mut [T] {
        let (memory, rest) = std::mem::take(&mut self.memory).split_at_mut(n);
        self.memory = rest;
        memory.fill(MaybeUninit::new(value));
        self.done += n;
        // SAFETY: every element was just set, and `MaybeUninit<T>` has the layout of `T`.
        unsafe { &mut *(std::ptr::from_mut(memory) as *mut [T]) }
    }
}

impl<T: Real> UninitPiece<'_, T> {
    /// Set the next elements to those of a slice.
    #[inline(always)]
    pub fn put(&mut self, from: &[T]) {
        let (memory, rest) = std::mem::take(&mut self.memory).split_at_mut(from.len());
        self.memory = rest;
        if !(self.streamed && stream(memory, from)) {
            for (to, from) in memory.iter_mut().zip(from) {
                to.write(*from);
            }
        }
        self.done += from.len();
    }
}

/// Copy around the cache, in pieces of 16 bytes; returns whether that was possible. What was written may not be
/// read before `fence`.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
#[allow(unsafe_code)]
fn stream<T: Real>(to: &mut [MaybeUninit<T>], from: &[T]) -> bool {
    use std::arch::x86_64::{__m128i, _mm_loadu_si128, _mm_stream_si128};
    let (pieces, rest) = (size_of_val(from) / 16, size_of_val(from) % 16);
    let (to, source) = (
        to.as_mut_ptr().cast::<__m128i>(),
        from.as_ptr().cast::<__m128i>(),
    );
    if rest != 0 || !to.is_aligned() {
        return false;
    }
    for k in 0..pieces {
        // SAFETY: both slices have `16 * pieces` bytes, `to` is aligned, and any x86_64 has SSE2.
        unsafe { _mm_stream_si128(to.add(k), _mm_loadu_si128(source.add(k))) };
    }
    true
}

/// Order what `stream` wrote before everything that follows.
#[cfg(target_arch = "x86_64")]
#[allow(unsafe_code)]
fn fence() {
    // SAFETY: any x86_64 has it.
    unsafe { std::arch::x86_64::_mm_sfence() };
}

#[cfg(not(target_arch = "x86_64"))]
fn stream<T: Real>(_: &mut [MaybeUninit<T>], _: &[T]) -> bool {
    false
}

#[cfg(not(target_arch = "x86_64"))]
fn fence() {}

impl<T> Drop for UninitPiece<'_, T> {
    fn drop(&mut self) {
        if self.streamed {
            fence(); // before another thread learns that this job is done
        }
        self.set.fetch_add(self.done, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::prelude::*;

    #[test]
    fn pieces_become_one_vector() {
        for lengths in [vec![], vec![0], vec![3, 0, 4], vec![1; 1000]] {
            let mut vector = UninitVec::new(lengths.iter().sum(), "test").unwrap();
            let pieces = vector.cut(lengths.iter().copied());
            assert_eq!(pieces.len(), lengths.len());
            pieces.into_par_iter().enumerate().for_each(|(k, piece)| {
                let mut piece = piece;
                let first = piece.next(lengths[k] / 2, k as f64);
                let rest = piece.fill(0.5);
                assert_eq!(first.len() + rest.len(), lengths[k]);
                assert!(rest.iter().all(|x| *x == 0.5));
                rest.fill(k as f64);
            });
            let expected: Vec<f64> = lengths
                .iter()
                .enumerate()
                .flat_map(|(k, n)| vec![k as f64; *n])
                .collect();
            assert_eq!(vector.finish(), expected);
        }
    }

    #[test]
    fn what_is_put_is_there_around_the_cache_or_not() {
        // The second is streamed; its pieces begin at addresses that are aligned to 16 bytes, and not.
        for len in [1000, STREAMED / 4 + 7] {
            let expected: Vec<f32> = (0..len).map(|i| i as f32).collect();
            let mut vector = UninitVec::new(len, "test").unwrap();
            let parts: Vec<_> = expected.chunks(len / 5 + 1).collect();
            let pieces = vector.cut(parts.iter().map(|part| part.len()));
            pieces
                .into_par_iter()
                .zip(parts)
                .for_each(|(mut piece, part)| {
                    for (k, rows) in part.chunks(48).enumerate() {
                        if k % 7 == 3 {
                            piece.next(rows.len(), 0.0).copy_from_slice(rows);
                        } else {
                            piece.put(rows);
                        }
                    }
                });
            assert!(vector.finish() == expected, "{len} elements");
        }
    }

    #[test]
    #[should_panic(expected = "a piece was not set")]
    fn a_piece_that_was_put_in_part_is_found() {
        let mut vector = UninitVec::new(4, "test").unwrap();
        vector.cut([4].into_iter()).pop().unwrap().put(&[1.0f32; 3]);
        vector.finish();
    }

    #[test]
    #[should_panic(expected = "a piece was not set")]
    fn a_piece_that_was_not_set_is_found() {
        let mut vector = UninitVec::new(5, "test").unwrap();
        vector.cut([2, 3].into_iter()).pop().unwrap().fill(1u8);
        vector.finish();
    }

    #[test]
    #[should_panic(expected = "a piece was not set")]
    fn a_piece_that_was_set_in_part_is_found() {
        let mut vector = UninitVec::new(5, "test").unwrap();
        for mut piece in vector.cut([2, 3].into_iter()) {
            piece.next(2, 1u8);
        }
        vector.finish();
    }

    #[test]
    #[should_panic(expected = "a piece was not set")]
    fn setting_one_piece_in_two_cuts_is_not_enough() {
        let mut vector = UninitVec::new(4, "test").unwrap();
        for _ in 0..2 {
            vector.cut([2, 2].into_iter()).pop().unwrap().fill(1u8);
        }
        vector.finish();
    }

    #[test]
    #[should_panic]
    fn more_than_there_is_cannot_be_cut() {
        let mut vector = UninitVec::<u8>::new(4, "test").unwrap();
        vector.cut([2, 3].into_iter());
    }
}
