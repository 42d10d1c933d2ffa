"""What one photo shows, from the last step of its making back to the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hqgs.diagnosis.blur import LARGEST, LEAST_BLUR, Blur, estimate_blur, extra_sigma
from hqgs.diagnosis.codec import Hidden, Jpeg, estimate_hidden, film_detail, find_jpeg, quantised
from hqgs.diagnosis.noise import estimate_noise, neighbour_correlation
from hqgs.diagnosis.resolution import Enlargement, find_enlargement, undo_enlargement
from hqgs.photos.formula import small_side
from hqgs.photos.jpeg import MAX_BLOCKS
from hqgs.photos.pixels import Floats, to_levels

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


def diagnose_photo(image: Photo, low: Photo | None = None) -> PhotoDiagnosis:
    """What degraded a photo [H, W, 3]: enlargement, then of the small photo JPEG, noise and blur.

    `low` is the small photo [h, w, 3] where it is at hand. ValueError for another shape or type, values that
    are not finite, or a `low` larger than the photo.
    """
    return conclude([inspect_photo("photo", image, low)])[0]


def inspect_photo(name: str, image: Photo, low: Photo | None = None, film: float | None = None) -> Inspected:
    """The first half of `diagnose_photo`, errors included; `film`: `View.film`, where known."""
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
        for k in members:
            if hiding:
                diagnoses[k] = _with_hidden(diagnoses[k], hidden)
            else:
                diagnoses[k] = _with_blur(diagnoses[k], photos[k].levels, hidden)
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
