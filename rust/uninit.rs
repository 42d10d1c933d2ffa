//! New vectors whose chunks are set by the jobs that fill them, while they are in the cache of one core. To set
//! a large vector to zero before that would be one more pass through memory, which costs more than the
//! arithmetic on it. What does not stay in cache anyway goes around it where the processor can do that: a cached store first reads what it overwrites.

use crate::{
    error::Error,
    memory,
    project::Splat,
    simd::{Real, groups::Column},
};
use rayon::prelude::*;
use std::{
    array,
    marker::PhantomData,
    mem::MaybeUninit,
    ptr,
    sync::atomic::{AtomicUsize, Ordering},
};

/// Vectors of at least so many bytes go around the cache. The last caches of today's processors hold tens of
/// megabytes, and the gradients have company there.
const STREAMED: usize = if cfg!(miri) { 1 << 12 } else { 8 << 20 };

/// Types that are copied as bytes.
///
/// # Safety
/// Every byte of a value has been set: there is no padding.
#[allow(unsafe_code)]
pub unsafe trait Plain: Copy {}

macro_rules! plain {
    ($($type:ty),*) => {
        $(
            // SAFETY: a number has no padding.
            #[allow(unsafe_code)]
            unsafe impl Plain for $type {}
        )*
    };
}
plain!(f32, f64, i32, u16);

const _: () = assert!(size_of::<Splat>() == 6 * 8 + 4 + 4 * 2 + 4);
// SAFETY: its fields, which have no padding, fill it.
#[allow(unsafe_code)]
unsafe impl Plain for Splat {}

// SAFETY: an array has no padding between its elements.
#[allow(unsafe_code)]
unsafe impl<T: Plain, const N: usize> Plain for [T; N] {}

// SAFETY: 16 numbers of at least 4 bytes fill whole multiples of the 64 bytes to which it is aligned.
#[allow(unsafe_code)]
unsafe impl<T: Real> Plain for Column<T> {}

/// A vector in the making.
#[derive(Debug)]
pub struct UninitVec<T> {
    memory: Vec<T>,
    len: usize,
    /// Elements that were set since the last cut.
    set: AtomicUsize,
}

/// A piece of a vector in the making, none of which is set yet.
#[derive(Debug)]
pub struct UninitPiece<'a, T> {
    memory: &'a mut [MaybeUninit<T>],
    set: &'a AtomicUsize,
    /// Whether what is put goes around the cache.
    streamed: bool,
}

/// The same while one thread sets it, element after element: what is left of it.
///
/// What goes around the cache is ordered before what follows only on the thread that wrote it, so that this type
/// cannot be sent to another one: the thread that drops it is the one that put.
#[derive(Debug)]
pub struct PieceWriter<'a, T> {
    memory: &'a mut [MaybeUninit<T>],
    /// Elements that were set.
    done: usize,
    set: &'a AtomicUsize,
    streamed: bool,
    stays: PhantomData<*mut T>,
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
                    set,
                    streamed,
                }
            })
            .collect()
    }

    /// Several cut alike, into pieces of so many rows each; a row of the k-th has `rows[k]` elements.
    pub fn cut_rows<const N: usize>(
        vectors: &mut [Self; N],
        rows: [usize; N],
        counts: impl Iterator<Item = usize> + Clone,
    ) -> Vec<[UninitPiece<'_, T>; N]> {
        let mut all = vectors.each_mut().into_iter().zip(rows);
        let mut pieces: [_; N] = array::from_fn(|_| {
            let (vector, row) = all.next().expect("N of both");
            vector
                .cut(counts.clone().map(|count| count * row))
                .into_iter()
        });
        counts
            .map(|_| {
                pieces
                    .each_mut()
                    .map(|of_one| of_one.next().expect("one for each count"))
            })
            .collect()
    }

    /// The vector. Every piece must have been set.
    #[allow(unsafe_code)]
    pub fn finish(mut self) -> Vec<T> {
        assert_eq!(*self.set.get_mut(), self.len, "a piece was not set");
        // SAFETY: `new` made room for `len` elements. The pieces of one cut do not overlap, and each counts an
        // element once, after it was set; together they count `len`, so that all are set. They borrow `self`, so
        // that none is left, and whatever waited for the threads that set them sees what they wrote: a writer
        // fences its streaming stores before it counts, on the thread that made them.
        unsafe { self.memory.set_len(self.len) };
        self.memory
    }
}

/// Zeros that one thread sets at a time.
const PIECE: usize = if cfg!(miri) { 1 << 6 } else { 1 << 15 };

/// As many zeros, set by all threads of rayon's current pool.
///
/// # Errors
/// As for [`UninitVec::new`].
pub fn zeros<T: Real>(len: usize, name: &str) -> Result<Vec<T>, Error> {
    let mut vector = UninitVec::new(len, name)?;
    let lengths = (0..len.div_ceil(PIECE)).map(|k| PIECE.min(len - k * PIECE));
    vector.cut(lengths).into_par_iter().for_each(|piece| {
        piece.fill(T::ZERO);
    });
    Ok(vector.finish())
}

impl<'a, T: Copy> UninitPiece<'a, T> {
    /// Set every element.
    #[inline(always)]
    #[allow(unsafe_code)]
    pub fn fill(self, value: T) -> &'a mut [T] {
        self.memory.fill(MaybeUninit::new(value));
        self.set.fetch_add(self.memory.len(), Ordering::Relaxed);
        // SAFETY: every element was just set, and `MaybeUninit<T>` has the layout of `T`.
        unsafe { &mut *(ptr::from_mut(self.memory) as *mut [T]) }
    }

    /// To set it part by part.
    pub fn writer(self) -> PieceWriter<'a, T> {
        PieceWriter {
            memory: self.memory,
            done: 0,
            set: self.set,
            streamed: self.streamed,
            stays: PhantomData,
        }
    }
}

impl<T: Plain> PieceWriter<'_, T> {
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
/// read by another thread before `fence` on this one. Miri has no such stores.
#[cfg(all(target_arch = "x86_64", not(miri)))]
#[inline(always)]
#[allow(unsafe_code)]
fn stream<T: Plain>(to: &mut [MaybeUninit<T>], from: &[T]) -> bool {
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
        // SAFETY: `to` has as many elements as `from`, which are `16 * pieces` bytes; `to` is aligned and borrowed
        // mutably, and any x86_64 has SSE2. Every byte of `from` has been set.
        unsafe { _mm_stream_si128(to.add(k), _mm_loadu_si128(source.add(k))) };
    }
    true
}

/// Order what `stream` wrote before everything that follows.
#[cfg(all(target_arch = "x86_64", not(miri)))]
#[allow(unsafe_code)]
fn fence() {
    // SAFETY: any x86_64 has it.
    unsafe { std::arch::x86_64::_mm_sfence() };
}

#[cfg(any(not(target_arch = "x86_64"), miri))]
fn stream<T: Plain>(_: &mut [MaybeUninit<T>], _: &[T]) -> bool {
    false
}

#[cfg(any(not(target_arch = "x86_64"), miri))]
fn fence() {}

impl<T> Drop for PieceWriter<'_, T> {
    fn drop(&mut self) {
        if self.streamed {
            fence(); // before another thread learns that this job is done
        }
        self.set.fetch_add(self.done, Ordering::Relaxed);
    }
}

/// Ask for the cache line of a value that is needed soon. Where the processor is not asked, it reads it and waits.
#[inline(always)]
#[allow(unsafe_code)]
pub(crate) fn prefetch<T: Copy>(value: &T) {
    #[cfg(all(target_arch = "x86_64", not(miri)))]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: any x86_64 has it, and caches are all that it changes.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(ptr::from_ref(value).cast()) };
    }
    #[cfg(any(not(target_arch = "x86_64"), miri))]
    std::hint::black_box(*value);
}

/// The same for all cache lines of a slice.
#[inline(always)]
pub(crate) fn prefetch_all<T: Copy>(data: &[T]) {
    for element in data.iter().step_by((64 / size_of::<T>()).max(1)) {
        prefetch(element);
    }
}

/// The same for `count` rows of `width` numbers from row `first` on, as far as there are any.
#[inline(always)]
pub(crate) fn prefetch_rows<T: Copy>(data: &[T], width: usize, first: usize, count: usize) {
    let end = data.len().min((first + count) * width);
    prefetch_all(data.get(first * width..end).unwrap_or(&[]));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_become_one_vector() {
        for lengths in [vec![], vec![0], vec![3, 0, 4], vec![1; 1000]] {
            let mut vector = UninitVec::new(lengths.iter().sum(), "test").unwrap();
            let pieces = vector.cut(lengths.iter().copied());
            assert_eq!(pieces.len(), lengths.len());
            pieces.into_par_iter().enumerate().for_each(|(k, piece)| {
                let all = piece.fill(0.5);
                assert_eq!(all.len(), lengths[k]);
                assert!(all.iter().all(|x| *x == 0.5));
                all.fill(k as f64);
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
    fn zeros_are_zeros() {
        for len in [0, 1, PIECE + 7] {
            assert_eq!(zeros::<f32>(len, "test").unwrap(), vec![0.0; len]);
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
            pieces.into_par_iter().zip(parts).for_each(|(piece, part)| {
                let mut piece = piece.writer();
                part.chunks(48).for_each(|rows| piece.put(rows));
            });
            assert!(vector.finish() == expected, "{len} elements");
        }
    }

    #[test]
    #[should_panic(expected = "a piece was not set")]
    fn a_piece_that_was_put_in_part_is_found() {
        let mut vector = UninitVec::new(4, "test").unwrap();
        let piece = vector.cut([4].into_iter()).pop().unwrap();
        piece.writer().put(&[1.0f32; 3]);
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
