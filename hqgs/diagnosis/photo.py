"""What one photo shows, from the last step of its making back to the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from hqgs.base.threads import of_each
from hqgs.diagnosis.blur import LARGEST, LEAST_BLUR, Blur, estimate_blur, extra_sigma
from hqgs.diagnosis.codec import Hidden, Jpeg, estimate_hidden, film_detail, find_jpeg, quantised
from hqgs.photos.formula import small_side
from hqgs.photos.jpeg import ENOUGH_BLOCKS, MAX_BLOCKS, blocks_of
from hqgs.photos.pixels import Floats, luma, to_levels
from hqgs.photos.resize import resize_matrix
from hqgs.scene.constants import SMALLEST_SIDE

FACTORS = (2, 3, 4, 6, 8)  # of enlargement that are tried
ROUNDING = 0.05  # levels; a residual below this counts as this


@dataclass(frozen=True)
class Enlargement:
    """A photo's factor of enlargement; 1 for none."""

    factor: int
    evidence: float | None  # how much worse a grid off by half a period explains the photo; None: it is known
    height: int  # of the photo before it was enlarged, px
    width: int


def find_enlargement(levels: Floats) -> Enlargement:
    """Whether bicubic enlargement by a factor in `FACTORS` made this photo [H, W, 3] (levels 0..255).

    Every line of an enlarged photo lies in the space that the enlargement matrix spans, and the grid of its
    small pixels has a phase. The measure is the part of the lines outside that space, for the grid shifted by
    half a period over that for the grid in place: a photo that is merely smooth gives 1 at every factor.
    (Gallagher 2005 and Mahdian & Saic 2008 see the same period in the variance of second differences.) Both
    axes must agree. Bilinear and Lanczos enlargement show too, more weakly.
    """
    height, width = levels.shape[:2]
    grey = luma(levels)
    candidates: list[tuple[float, int, int, int]] = []
    for factor in FACTORS:  # every fourth line tells as much as all
        rows = _best_size(grey[:, ::4], factor)
        columns = _best_size(grey.T[:, ::4], factor)
        candidates.append((min(rows[0], columns[0]), factor, rows[1], columns[1]))
    evidence, factor, small_height, small_width = max(candidates)
    if evidence < 2.1:  # JPEG blocks reach 1.8 at factor 2; bicubic enlargement kept in 8 bits starts at 4.5
        return Enlargement(1, evidence, height, width)
    return Enlargement(factor, evidence, small_height, small_width)


def undo_enlargement(levels: Floats, height: int, width: int) -> Floats:
    """The photo [height, width, 3] whose bicubic enlargement comes nearest to `levels` (least squares)."""
    tall = _solve(levels, height)  # [height, W, 3]
    return _solve(tall.swapaxes(0, 1), width).swapaxes(0, 1)


def _best_size(lines: Floats, factor: int) -> tuple[float, int]:
    """Evidence and small size for lines along axis 0; sizes may have been rounded up or down."""
    size = len(lines)
    sizes = {-(-size // factor), size // factor}
    return max((_evidence(lines, small, factor), small) for small in sizes)


def _evidence(lines: Floats, small: int, factor: int) -> float:
    if small < SMALLEST_SIDE:
        return 0.0
    basis = _basis(small, len(lines))
    lines = lines[: len(basis)]
    shift = factor // 2
    shifted = np.concatenate([lines[shift:], lines[::-1][:shift]])
    inside = slice(3 * factor, -3 * factor)  # away from the border that the shift made up
    in_place, off = (
        np.sqrt(np.square((part - basis @ (basis.T @ part))[inside]).mean()) for part in (lines, shifted)
    )
    return float(off / max(in_place, ROUNDING)) if off > ROUNDING else 0.0


@lru_cache(maxsize=32)
def _basis(small: int, size: int) -> Floats:
    """Orthonormal columns that span the first pixels of enlarged lines, [pixels, small pixels]."""
    matrix = resize_matrix(small, size)[:768]  # px of a line that are looked at
    return np.linalg.qr(matrix[:, matrix.any(axis=0)])[0]


def _solve(levels: Floats, small: int) -> Floats:
    """The [small, ...] whose enlargement along axis 0 comes nearest to `levels`, by the normal equations."""
    matrix = csc_array(resize_matrix(small, len(levels)))
    right = matrix.T @ levels.reshape(len(levels), -1)
    return splu((matrix.T @ matrix).tocsc()).solve(right).reshape(small, *levels.shape[1:])


def estimate_noise(levels: Floats) -> tuple[float, float] | None:
    """White noise in a photo [H, W, 3] of levels 0..255: its standard deviation in each channel, and the
    least that no fine texture reaches, levels; None where too few pixels tell.

    Patches of all three channels span a space in which texture fills few directions and white noise all of
    them, so the smallest eigenvalue of their covariance is the noise variance (Pyatenko 2013, Liu et al.
    2013, Chen et al. 2015). The eigenvector comes from one half of the photo (the white fields of a
    chessboard) and its variance is measured on the other half, and the other way round: a minimum taken and
    measured on the same patches would come out too small. Patches with a value of exactly 0 or 255 are left
    out, where clipping takes noise away. Noise that a later step made smooth (JPEG, enlargement) is not seen.
    """
    height, width = levels.shape[:2]
    # below this the large patch has too many directions for the photo
    # px; and levels: photos of fine texture without noise reach 1.9, small ones 3.2
    size, limit = (5, 2.5) if height * width >= 4 * 4_000 else (3, 4.0)
    if min(height, width) < size:
        return None
    step = max(1, int(np.sqrt(height * width / 12_000)))  # patches that are looked at
    patches = np.lib.stride_tricks.sliding_window_view(levels, (size, size), axis=(0, 1))[::step, ::step]
    # px: the photo is cut into a chessboard of tiles of this size
    rows, columns = np.indices(patches.shape[:2]) * step // 24
    white = ((rows + columns) % 2 == 0).ravel()
    vectors = patches.reshape(-1, 3 * size * size)
    clipped = ((vectors == 0) | (vectors == 255)).any(axis=1)
    halves = [vectors[side & ~clipped] for side in (white, ~white)]
    if min(len(half) for half in halves) < 200:
        return None
    covariances = [np.cov(half.T) for half in halves]
    variances = []
    for here, there in (covariances, covariances[::-1]):
        flattest = np.linalg.eigh(here)[1][:, 0]
        variances.append(flattest @ there @ flattest)
    level = float(np.sqrt(max(np.mean(variances), 0.0)))
    return level, limit


def neighbour_correlation(levels: Floats) -> float | None:
    """The least correlation of neighbouring pixels in the luma's noise, of a photo [H, W, 3], levels 0..255.

    None: too few blocks tell. Differences have 2 (1 - r) times the noise's power, where r is the correlation
    of their pixels: one minus the power over one pixel in that over two is r of neighbours, or less where two
    pixels still go together. What a photo shows raises it, so it is taken of the blocks with the least. White
    noise strong enough to be told comes to 0.12 at most, a phone's, denoised and as JPEG, to 0.24 to 0.5.
    """
    # px a side: blocks without clipped values tell how neighbours go together
    blocks = blocks_of(luma(levels), 16)
    blocks = blocks[((blocks > 0) & (blocks < 255)).all((1, 2))]
    one, two = (
        np.square(blocks[:, n:] - blocks[:, :-n]).mean((1, 2))
        + np.square(blocks[..., n:] - blocks[..., :-n]).mean((1, 2))
        for n in (1, 2)
    )
    if (two > 0).sum() < ENOUGH_BLOCKS:
        return None
    together = 1 - one[two > 0] / two[two > 0]
    return float(max(np.quantile(together, 0.05), 0.0))  # share of the blocks that show noise and little else


Table = tuple[tuple[int, ...], ...]
Photo = NDArray[np.uint8] | NDArray[np.float32]

ROUNDING_ONLY: Table = ((1,) * 8,) * 8


@dataclass(frozen=True)
class Finding:
    """One step of how the photos were made, and whether the method must undo it."""

    name: str  # of its kind (`KINDS`)
    reason: str  # one sentence
    step: str | None = None  # in the grammar of `parse_formation`; None: nothing must be undone
    value: float | None = None  # median over photos: px, factor, levels or quality; None: not told
    spread: float | None = None  # robust standard deviation over photos; None: estimated from all together
    needed: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "needed", self.step is not None)


@dataclass(frozen=True)
class PhotoDiagnosis:
    """Estimates for one photo; those of JPEG and noise belong to the photo before it was enlarged."""

    name: str
    height: int  # px
    width: int
    enlargement: Enlargement
    jpeg: Jpeg
    noise: float | None  # levels of 1/255 in each channel; None: not told from this photo
    noise_limit: float  # levels: weaker noise is not told from texture, or hidden by the JPEG
    blur: Blur | None  # beyond a sharp photo's own, px of the full-size photo; None: not told from this photo
    blur_limit: float  # px of the full-size photo, a Gaussian's sigma: sharp photos can look as soft
    film: float | None = None  # `fine_detail` of a film's frame, as it was decoded; None: it is none
    correlation: float | None = None  # of neighbours in its noise, at least; None: not told from this photo

    @property
    def told_noise(self) -> float | None:
        """Its noise, levels, where that is told from texture."""
        return self.noise if self.noise is not None and self.noise >= self.noise_limit else None

    @property
    def hiding(self) -> bool:
        """Whether its JPEG hides the photo's noise and blur from all but the coefficients."""
        # from this quality on, JPEG leaves the luma's noise and spectrum as they were
        return self.jpeg.quality is not None and self.jpeg.quality < 92


@dataclass(frozen=True)
class Inspected:
    """A photo on the way to its diagnosis: noise under JPEG and blur are not told yet."""

    diagnosis: PhotoDiagnosis
    kept: NDArray[np.uint8] | Floats  # `levels`, in 8 bits where that loses nothing: many photos are held

    @property
    def levels(self) -> Floats:
        """[h, w, 3], 0..255: the middle of the photo before it was enlarged."""
        return self.kept.astype(np.float64, copy=False)

    @property
    def table(self) -> Table:
        """The quantisation table that rules the photo's coefficients, [8] rows of 8."""
        found = self.diagnosis.jpeg.table
        return found if found is not None and self.diagnosis.hiding else ROUNDING_ONLY


def inspect_photo(name: str, image: Photo, low: Photo | None = None, film: float | None = None) -> Inspected:
    """What degraded a photo [H, W, 3]: enlargement, then of the small photo JPEG; the rest `conclude` tells.

    `low` is the small photo [h, w, 3] where it is at hand, `film`: `View.film`, where known. ValueError for
    another shape or type, values that are not finite, or a `low` larger than the photo.
    """
    levels = to_levels(image, f"photo {name!r}")
    height, width = levels.shape[:2]
    if low is not None:
        levels = to_levels(low, f"the small photo of {name!r}")
        h, w = levels.shape[:2]
        if h > height or w > width:
            raise ValueError(
                f"the small photo of {name!r} is {w} x {h} px, larger than its photo, {width} x {height} px"
            )
        near = max(1, round(height / h))  # sides were rounded up, which of small ones is much
        fits = (f for f in (near, *range(1, 17)) if (small_side(height, f), small_side(width, f)) == (h, w))
        enlargement = Enlargement(next(fits, near), None, h, w)
    else:
        enlargement = find_enlargement(levels)
        if enlargement.factor > 1:
            levels = undo_enlargement(levels, enlargement.height, enlargement.width)
    levels = _middle(levels)
    jpeg = find_jpeg(levels)
    limit = _least_blur(LEAST_BLUR, enlargement) * width / enlargement.width
    found = PhotoDiagnosis(name, height, width, enlargement, jpeg, None, 0.0, None, limit)
    film = film_detail(levels) if film is None else film
    found = replace(found, film=film, correlation=neighbour_correlation(levels))
    if not found.hiding and (noise := estimate_noise(levels)) is not None:
        found = replace(found, noise=noise[0], noise_limit=noise[1])
    return Inspected(found, _kept(levels))


def conclude(photos: Sequence[Inspected]) -> list[PhotoDiagnosis]:
    """The diagnoses of photos that were made in the same way.

    Where a JPEG hides them, noise and blur come from the coefficients of all photos of one table together.
    Otherwise the blur is each photo's own. Its noise is too, unless no photo shows any in all its channels:
    a JPEG of a quality too good to be found, or a camera, may have smoothed the colours, and the luma's
    coefficients, again of all photos, may still show it.
    """
    diagnoses = [photo.diagnosis for photo in photos]
    for table in dict.fromkeys(photo.table for photo in photos):
        members = [k for k, photo in enumerate(photos) if photo.table == table]
        hiding = table is not ROUNDING_ONLY
        shown = [d.noise - d.noise_limit for k in members if (d := diagnoses[k]).noise is not None]
        # px a side; the coefficients of smaller photos have the fine texture of large ones
        large = min(min(photos[k].kept.shape[:2]) for k in members) >= 100
        hidden = None
        if hiding or (large and shown and np.median(shown) < 0):
            # of all photos together, to look for noise in the luma alone
            share = -(-(MAX_BLOCKS if hiding else 1_000) // len(members))
            steps = np.array(table)
            corners = [diagnoses[k].jpeg.phase if hiding else (0, 0) for k in members]
            blocks = [
                quantised(photos[k].levels, steps, c)[:share] for k, c in zip(members, corners, strict=True)
            ]
            hidden = estimate_hidden(np.concatenate(blocks), steps)
        if hiding:
            told = [_with_hidden(diagnoses[k], hidden) for k in members]
        else:
            told = of_each(lambda k, h=hidden: _with_blur(diagnoses[k], photos[k].levels, h), members)
        for k, diagnosis in zip(members, told, strict=True):
            diagnoses[k] = diagnosis
    return diagnoses


def _with_hidden(photo: PhotoDiagnosis, hidden: Hidden | None) -> PhotoDiagnosis:
    """Noise and blur of a photo whose JPEG hides them; all blur counts as Gaussian."""
    if hidden is None:
        return photo
    sigma, scale = extra_sigma(hidden.sigma), photo.width / photo.enlargement.width
    return replace(
        photo,
        noise=hidden.noise,
        noise_limit=hidden.noise_limit,
        blur=_enlarged(Blur("gaussian", sigma, sigma), scale),
        blur_limit=_least_blur(hidden.sigma_limit, photo.enlargement) * scale,
    )


def _with_blur(photo: PhotoDiagnosis, levels: Floats, hidden: Hidden | None) -> PhotoDiagnosis:
    """The blur of a photo without a hiding JPEG; and the noise that `hidden` has in the luma alone."""
    if hidden is not None and hidden.noise > 0:
        photo = replace(photo, noise=hidden.noise, noise_limit=hidden.noise_limit)
    blur = estimate_blur(levels, photo.noise or 0.0)
    return (
        photo if blur is None else replace(photo, blur=_enlarged(blur, photo.width / photo.enlargement.width))
    )


def _least_blur(limit: float, enlargement: Enlargement) -> float:
    """The least blur that is told, px of the small photo; `limit`: of photos that were not enlarged."""
    # px of the small photo: shrinking halves a camera's own softness or more, to 0.45 at most
    return limit - 0.2 if enlargement.factor > 1 else limit


def _enlarged(blur: Blur, scale: float) -> Blur:
    """The same blur in pixels of the photo after enlargement."""
    return replace(blur, amount=blur.amount * scale, sigma=blur.sigma * scale)


def _middle(levels: Floats) -> Floats:
    """At most `LARGEST` px a side, cut so that blocks of 8 x 8 pixels stay whole."""
    top, left = (max(0, side - LARGEST) // 16 * 8 for side in levels.shape[:2])
    return levels[top : top + LARGEST, left : left + LARGEST]


def _kept(levels: Floats) -> NDArray[np.uint8] | Floats:
    """A copy, since `levels` may be a part of a photo that nobody needs any more."""
    whole = levels.clip(0, 255).astype(np.uint8)
    return whole if np.array_equal(whole, levels) else levels.copy()
