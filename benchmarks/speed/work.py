"""How much work an image is: counted, not timed.

Operations are read off rust/composite/kernel/ and rust/tiles/ for three channels in float32: one for each
addition, product, division, root, minimum, comparison, logical operation, selection and shift, two for a
fused product and sum. Moves, shuffles and counts of bits are left out, and so is what is done once for each
Gaussian, row of tiles or pixel. Bytes are those of the lists that hold a row for each (Gaussian, tile) pair
or for each Gaussian in a block, once for each stage that writes the row and once for each that reads it.
What belongs to one tile (its pixels, the layers of the backward pass) stays in cache and is not counted.
Whoever changes a kernel counts again.
"""

from __future__ import annotations

from typing import Any

BLOCK_PIXELS = 16  # lanes of a block of 4 x 4 pixels

# A lane of an AVX-512 core that does nothing but blend, with all lanes in use and all data in cache (measured
# with a probe of the arithmetic). It is the limit that the times are held against.
LIMIT_FORWARD_NS, LIMIT_BACKWARD_NS = 0.65, 1.05

# Operations of a lane.
ALPHA = 30  # position 6, power 4, exp2 18, opacity 1, cap 1
FORWARD_LANE = ALPHA + 16  # blend: floor 1, transmittance 2, stop 2, weight 2, colour 6, state 3
REPLAY_LANE = ALPHA + 8  # unblend, front to back: floor 1, transmittance 2, stop 2, alpha 1, state 2
UNBLEND_LANE = 14  # unblend, back to front: weight 1, colour 6, gradient 5, what lies behind 2
SUMS_LANE = 23  # Sums::add: position 6, products 2, moments 9, colour 6
LANE = FORWARD_LANE + REPLAY_LANE + UNBLEND_LANE + SUMS_LANE

# Operations of a (Gaussian, tile) pair.
LOCAL_PAIR = 12  # Local::new
REACHED_PAIR = 15 + 4 * 28 + 16 * 7  # once, for each row of blocks, for each block
SUMS_PAIR = 16 * (5 + 3 + 2 + 1) + 9  # Sums::finish halves nine vectors four times; the gathering adds nine
PAIR = LOCAL_PAIR + REACHED_PAIR + SUMS_PAIR

# Bytes of a pair's rows.
RECORD, COLOR, DEPTH, PLACE, MASK, GRADS = 32, 12, 4, 4, 2, 36
CHUNK_BYTES = RECORD + COLOR + DEPTH  # by index, written; then read by the tile
LIST_BYTES = RECORD + COLOR + PLACE + MASK  # by depth, written; then read
PAIR_BYTES = 2 * CHUNK_BYTES + LIST_BYTES + (RECORD + COLOR) + LIST_BYTES + 2 * GRADS
BLOCK_BYTES = 3 * 4  # an index in a block's list: written, read by both passes


def count_work(
    blended: int, pixels: int, tile_pairs: int, blocks: int, changed_blocks: int
) -> dict[str, Any]:
    """The work of one forward and backward pass, from the crate's counters.

    Args:
        blended: (Gaussian, pixel) pairs that changed a pixel.
        pixels: of the image.
        tile_pairs, blocks, changed_blocks: (Gaussian, tile) pairs, (Gaussian, block) pairs that each pass
            evaluates, those of them that changed a pixel.
    """
    lanes = BLOCK_PIXELS * blocks
    operations = LANE * lanes + PAIR * tile_pairs
    size = PAIR_BYTES * tile_pairs + BLOCK_BYTES * blocks
    return {
        "blended_per_pixel": blended / pixels,
        "blended_pairs": blended,
        "tile_pairs": tile_pairs,
        "blocks": blocks,
        "changed_blocks": changed_blocks,
        "lane_use": blended / lanes,
        "operations": operations,
        "operations_per_blended_pair": operations / blended,
        "bytes": size,
        "bytes_per_tile_pair": size / tile_pairs,
        "operations_per_byte": operations / size,
        "limit_core_seconds": blended * (LIMIT_FORWARD_NS + LIMIT_BACKWARD_NS) * 1e-9,
    }
