//! The list of one tile: its pairs, front to back.

use super::{
    NAME,
    block_masks::{Shapes, all_blocks, make_room, reached_blocks},
    pairs::{Pairs, Record},
};
use crate::{
    constants::TILE_BLOCKS, error::Error, memory, project::Projection, simd::Real,
    uninit::prefetch_all,
};
use fearless_simd::Simd;

/// The Gaussians whose support reaches a pixel centre of one tile.
#[derive(Debug, Default)]
pub(crate) struct List<T> {
    /// What the kernels need of each pair, by (depth, index), so that they read a stream.
    pub records: Vec<Record<T>>,
    /// Colours of the records, [pairs, channels].
    pub colors: Vec<T>,
    /// For each record its place by index among the tile's records.
    pub places: Vec<u32>,
    /// For each record the blocks that it reaches: bit b for block b.
    pub masks: Vec<u16>,
    /// For each block, one after the other, the records that reach it, front to back.
    pub blocks: Vec<u32>,
    /// Begin of each block in `blocks`, and the end.
    pub begins: [u32; TILE_BLOCKS + 1],
}

impl<T: Copy> List<T> {
    /// Hold nothing, and keep the memory.
    fn clear(&mut self) {
        self.records.clear();
        self.colors.clear();
        self.places.clear();
        self.blocks.clear();
        self.begins = [0; TILE_BLOCKS + 1];
    }

    /// Send for what the blocks will ask for one by one.
    #[inline(always)]
    pub fn prefetch(&self) {
        prefetch_all(&self.records);
        prefetch_all(&self.colors);
        prefetch_all(&self.blocks);
    }
}

/// Buffers of one thread, reused from tile to tile.
#[derive(Default)]
pub(crate) struct Scratch<T> {
    /// (bits of the depth as f32, place by index).
    keys: Vec<u64>,
    /// For their sort.
    sorted: Vec<u64>,
    /// Records and colours by index.
    records: Vec<Record<T>>,
    colors: Vec<T>,
    shapes: Shapes,
    reached: [Vec<u32>; TILE_BLOCKS],
}

/// Collect a tile's pairs and order them, in the place of what `list` held.
#[inline(always)]
pub(super) fn collect<S: Simd, T: Real>(
    simd: S,
    projection: &Projection,
    chunks: &[Pairs<T>],
    channels: usize,
    tile: usize,
    scratch: &mut Scratch<T>,
    list: &mut List<T>,
) -> Result<(), Error> {
    let Scratch {
        keys,
        sorted,
        records,
        colors,
        shapes,
        reached,
    } = scratch;
    keys.clear();
    records.clear();
    colors.clear();
    let n = chunks.iter().map(|pairs| pairs.tile(tile).len()).sum();
    memory::reserve(keys, n, NAME)?;
    memory::reserve(records, n, NAME)?;
    memory::reserve(colors, n * channels, NAME)?;
    // The pieces are short, and the first line of each is a miss: those of the next tile are sent for now.
    for pairs in chunks {
        let range = pairs.tile(tile + 1);
        prefetch_all(&pairs.depths[range.clone()]);
        prefetch_all(&pairs.records[range.clone()]);
        prefetch_all(&pairs.colors[range.start * channels..range.end * channels]);
    }
    for pairs in chunks {
        let range = pairs.tile(tile);
        for depth in &pairs.depths[range.clone()] {
            keys.push(u64::from(*depth) << 32 | keys.len() as u64);
        }
        colors.extend_from_slice(&pairs.colors[range.start * channels..range.end * channels]);
        records.extend_from_slice(&pairs.records[range]);
    }
    list.clear();
    if n == 0 {
        return Ok(());
    }
    memory::reserve(&mut list.records, n, NAME)?;
    memory::reserve(&mut list.colors, n * channels, NAME)?;
    memory::reserve(&mut list.places, n, NAME)?;
    sort(keys, sorted)?;
    for key in keys.iter() {
        list.places.push(*key as u32);
    }
    order_ties(projection, keys, records, &mut list.places);
    shapes.resize(n)?;
    for (k, place) in list.places.iter().enumerate() {
        let place = *place as usize;
        match &colors[place * channels..(place + 1) * channels] {
            &[r, g, b] => list.colors.extend_from_slice(&[r, g, b]), // as in `copy_color`
            color => list.colors.extend_from_slice(color),
        }
        shapes.set(k, &records[place]);
        list.records.push(records[place]);
    }
    make_room(n, &mut list.masks, reached)?;
    let lengths = if projection.knobs.skip_blocks {
        reached_blocks(simd, shapes, n, &mut list.masks, reached)
    } else {
        all_blocks(n, &mut list.masks, reached)
    };
    memory::reserve(&mut list.blocks, lengths.iter().sum(), NAME)?;
    for (block, length) in lengths.into_iter().enumerate() {
        list.blocks.extend_from_slice(&reached[block][..length]);
        list.begins[block + 1] = list.blocks.len() as u32;
    }
    Ok(())
}

/// Keys below which a comparing sort is faster.
const FEW: usize = 96;
/// Values of a digit of the depth.
const DIGITS: usize = 256;

/// Sort keys by their upper halves; those with the same one stay in their order. `other` is a buffer.
///
/// Digit by digit from the lowest, each pass stable; a digit that all share, as the exponent mostly is, needs none.
fn sort(keys: &mut Vec<u64>, other: &mut Vec<u64>) -> Result<(), Error> {
    if keys.len() < FEW {
        keys.sort_unstable(); // their lower halves ascend
        return Ok(());
    }
    memory::resize(other, keys.len(), 0, NAME)?;
    let digit = |key: u64, pass: usize| (key >> (32 + 8 * pass)) as usize % DIGITS;
    let mut counts = [[0u32; DIGITS]; 4];
    for &key in keys.iter() {
        for (pass, counts) in counts.iter_mut().enumerate() {
            counts[digit(key, pass)] += 1;
        }
    }
    for (pass, counts) in counts.iter_mut().enumerate() {
        if counts[digit(keys[0], pass)] as usize == keys.len() {
            continue;
        }
        let mut sum = 0;
        for count in counts.iter_mut() {
            sum += std::mem::replace(count, sum);
        }
        for &key in keys.iter() {
            let place = &mut counts[digit(key, pass)];
            other[*place as usize] = key;
            *place += 1;
        }
        std::mem::swap(keys, other);
    }
    Ok(())
}

/// Depths that are equal as f32 are ordered by their exact values; the sort is stable, so that exactly
/// equal ones stay in the order of their indices.
fn order_ties<T>(projection: &Projection, keys: &[u64], records: &[Record<T>], order: &mut [u32]) {
    let depth = |o: &u32| projection.depths[records[*o as usize].gaussian as usize];
    let mut begin = 0;
    for run in keys.chunk_by(|a, b| a >> 32 == b >> 32) {
        if run.len() > 1 {
            order[begin..begin + run.len()].sort_by(|a, b| depth(a).total_cmp(&depth(b)));
        }
        begin += run.len();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_sorted_by_depth_and_then_by_index() {
        let mut other = Vec::new();
        for n in [0, 1, FEW - 1, FEW, FEW + 1, 3000] {
            // All bits of the depth, one exponent, the lowest digit alone, the same depth for all.
            for mask in [0x7fff_ffff, 0x40ff_ffff, 0x4000_00ff, 0x4000_0000_u32] {
                let depth = |k: u64| (k as u32).wrapping_mul(0x9e37_79b9) & mask;
                let mut keys: Vec<_> = (0..n as u64)
                    .map(|k| u64::from(depth(k)) << 32 | k)
                    .collect();
                let mut expected = keys.clone();
                expected.sort();
                sort(&mut keys, &mut other).unwrap();
                assert_eq!(keys, expected, "{n} keys, {mask:x}");
            }
        }
    }
}
