//! Which blocks of its tile a Gaussian reaches.

use super::{NAME, pairs::Record};
use crate::{
    constants::{BLOCK, BLOCKS_PER_SIDE, TILE, TILE_BLOCKS},
    error::Error,
    memory,
    simd::{Real, groups::GROUP},
};
use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

/// What the test of the blocks reads, one Gaussian per lane: u0, v0, s, n, t and the radius of the support
/// in (u, v). In f32 for either type: `SUPPORT_SLACK` covers its rounding.
#[derive(Default)]
pub(super) struct Shapes(Vec<[[f32; GROUP]; 6]>);

impl Shapes {
    /// Make room for `n` Gaussians.
    pub fn resize(&mut self, n: usize) -> Result<(), Error> {
        let groups = n.div_ceil(GROUP);
        let more = groups.saturating_sub(self.0.len());
        memory::reserve(&mut self.0, more, NAME)?;
        self.0.resize(groups, [[0.0; GROUP]; 6]);
        Ok(())
    }

    #[inline(always)]
    pub fn set<T: Real>(&mut self, k: usize, g: &Record<T>) {
        let group = &mut self.0[k / GROUP];
        for (row, value) in group.iter_mut().zip([g.u0, g.v0, g.s, g.n, g.t, g.reach]) {
            row[k % GROUP] = value.to_f64() as f32;
        }
    }
}

/// Make room for what the functions below write for `count` Gaussians: whole vectors, in the lists one more. What
/// lists held stays: to set them to zero for each tile would cost more than to fill them.
pub(super) fn make_room(
    count: usize,
    masks: &mut Vec<u16>,
    lists: &mut [Vec<u32>; TILE_BLOCKS],
) -> Result<(), Error> {
    *masks = memory::with_capacity(count.next_multiple_of(GROUP), NAME)?;
    for list in lists {
        let room = count.next_multiple_of(GROUP) + GROUP;
        if list.len() < room {
            memory::resize(list, room, 0, NAME)?;
        }
    }
    Ok(())
}

/// For each of `count` Gaussians the blocks of which a pixel centre can lie in the support (bit b for block
/// b), and for each block the Gaussians, in order. Returns how many each block has; what its list holds after them
/// means nothing.
///
/// Row of blocks by row, the extent of the ellipse in the band of the row's pixel centres. The right border
/// is concave in y and the left one convex, so in a band each is extreme at the y nearest to its top.
/// Exact up to rounding. Written so that NaN (an overflow far outside) keeps the block.
#[inline(always)]
pub(super) fn reached_blocks<S: Simd>(
    simd: S,
    shapes: &Shapes,
    count: usize,
    masks: &mut Vec<u16>,
    lists: &mut [Vec<u32>; TILE_BLOCKS],
) -> [usize; TILE_BLOCKS] {
    let lanes = S::f32s::LEN;
    let splat = |x: f32| S::f32s::splat(simd, x);
    let (zero, one) = (splat(0.0), splat(1.0));
    let mut lengths = [0; TILE_BLOCKS];
    let ramp = S::u32s::from_fn(simd, |lane| lane as u32);
    let end = S::u32s::splat(simd, count as u32);
    let half = (TILE / 2) as f32;
    for first in (0..count).step_by(lanes) {
        let group = &shapes.0[first / GROUP];
        let at = first % GROUP..first % GROUP + lanes;
        let load = |k: usize| S::f32s::from_slice(simd, &group[k][at.clone()]);
        let (u0, v0, s, n, t) = (load(0), load(1), load(2), load(3), load(4));
        let reach = load(5);
        let limit = reach * reach;
        let inverse = one / s;
        // The rightmost point of the ellipse lies at v = -top, the leftmost at v = top.
        let top = reach * n / n.mul_add(n, t * t).sqrt();
        let (y_right, y_left) = ((zero - top - v0) / t, (top - v0) / t);
        let index = ramp + S::u32s::splat(simd, first as u32);
        let valid = index.simd_lt(end);
        let mut bits = zero;
        for row in 0..BLOCKS_PER_SIDE {
            let low = (row * BLOCK) as f32 + 0.5 - half;
            let (low, high) = (splat(low), splat(low + (BLOCK - 1) as f32));
            let y = y_right.max(low).min(high);
            let v = t.mul_add(y, v0);
            let width = limit - v * v;
            let mut outside = width.simd_lt(zero);
            let right = (width.max(zero).sqrt() - n.mul_add(y, u0)) * inverse;
            let y = y_left.max(low).min(high);
            let v = t.mul_add(y, v0);
            let width = limit - v * v;
            outside &= width.simd_lt(zero);
            let left = (zero - width.max(zero).sqrt() - n.mul_add(y, u0)) * inverse;
            for column in 0..BLOCKS_PER_SIDE {
                let block = row * BLOCKS_PER_SIDE + column;
                let low = (column * BLOCK) as f32 + 0.5 - half;
                let (low, high) = (splat(low), splat(low + (BLOCK - 1) as f32));
                let inside = valid & !(outside | right.simd_lt(low) | left.simd_gt(high));
                bits += inside.select(splat((1u32 << block) as f32), zero);
                let length = &mut lengths[block];
                index
                    .compress(inside)
                    .store_slice(&mut lists[block][*length..*length + lanes]);
                *length += inside.to_bitmask().count_ones() as usize;
            }
        }
        masks.extend(bits.as_slice().iter().map(|bits| *bits as u16));
    }
    masks.truncate(count);
    lengths
}

/// The result of `reached_blocks` if every Gaussian reached every block.
pub(super) fn all_blocks(
    count: usize,
    masks: &mut Vec<u16>,
    lists: &mut [Vec<u32>; TILE_BLOCKS],
) -> [usize; TILE_BLOCKS] {
    masks.resize(count, u16::MAX);
    for list in lists.iter_mut() {
        for (k, record) in list[..count].iter_mut().enumerate() {
            *record = k as u32;
        }
    }
    [count; TILE_BLOCKS]
}
