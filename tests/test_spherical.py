"""Films of 360 degrees, by what their files say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from test_film import clean_photo, encoded

from hqgs.photos.spherical import projection
from hqgs.scene.film import film_frames, frames_around
from hqgs.scene.sfm.bare_photos import BarePhotos, readable

UUID = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")  # of the XML, by the specification


def box(kind: bytes, inside: bytes) -> bytes:
    return (8 + len(inside)).to_bytes(4, "big") + kind + inside


def xml(kind: str, stereo: str = "") -> bytes:
    text = f"<GSpherical:ProjectionType>{kind}</GSpherical:ProjectionType>"
    text += f"<GSpherical:StereoMode>{stereo}</GSpherical:StereoMode>" if stereo else ""
    return box(b"uuid", UUID + f"<rdf:SphericalVideo>{text}</rdf:SphericalVideo>".encode())


def second(kind: bytes, mode: int) -> bytes:
    st3d = box(b"st3d", bytes(4) + bytes([mode]))
    proj = box(b"proj", box(b"prhd", bytes(16)) + box(kind, bytes(20)))
    return st3d + box(b"sv3d", box(b"svhd", bytes(5)) + proj)


@pytest.mark.parametrize(
    ("inside", "told"),
    [
        (xml("equirectangular"), ("equirectangular", "mono")),
        (xml("equirectangular", "top-bottom"), ("equirectangular", "top-bottom")),
        (second(b"equi", 0), ("equirectangular", "mono")),
        (second(b"equi", 2), ("equirectangular", "left-right")),
        (second(b"cbmp", 0), ("cubemap", "mono")),
        (box(b"mvhd", bytes(100)), None),
    ],
)
def test_what_a_file_says(inside: bytes, told: tuple[str, str] | None, tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    long = (1).to_bytes(4, "big") + b"mdat" + (16 + 40).to_bytes(8, "big") + bytes(40)  # of 64 bits
    path.write_bytes(box(b"ftyp", b"isom") + long + box(b"moov", inside))
    assert projection(path) == told
    for broken in (b"", b"no box", box(b"ftyp", b"isom")[:9], bytes(8) + b"moov"):
        path.write_bytes(broken)
        assert projection(path) is None


def told_film(path: Path, inside: bytes) -> Path:
    """A film of 128 x 64 px that says so: its last box is the one that describes it."""
    encoded(path, [clean_photo(k)[:64, :128] for k in range(4)], 20)
    data = path.read_bytes()
    at = data.rindex(b"moov") - 4
    size = int.from_bytes(data[at : at + 4], "big")
    assert at + size == len(data)
    path.write_bytes(data[:at] + (size + len(inside)).to_bytes(4, "big") + data[at + 4 :] + inside)
    return path


def test_frames_of_a_film_of_the_whole_sphere_are_panoramas(tmp_path: Path) -> None:
    """Whatever they show: these do not close."""
    folder, _ = film_frames(told_film(tmp_path / "a.mp4", xml("equirectangular")), tmp_path / "frames", 4)
    assert frames_around(folder)
    assert len(json.loads((folder / "frames.json").read_text())["details"]) == 4
    assert readable(BarePhotos(folder, 1.0, [p.name for p in sorted(folder.glob("*.jpg"))])).around
    plain, _ = film_frames(encoded(tmp_path / "b.mp4", [clean_photo(0)] * 4, 20), tmp_path / "frames", 4)
    assert not frames_around(plain)


@pytest.mark.parametrize(
    ("inside", "why"),
    [
        (second(b"cbmp", 0), "its frames are cubemap: export it as equirectangular, mono"),
        (xml("equirectangular", "top-bottom"), r"two pictures, one for each eye \(top-bottom\): export it"),
    ],
)
def test_other_films_of_a_sphere_are_refused_by_name(inside: bytes, why: str, tmp_path: Path) -> None:
    path = told_film(tmp_path / "a.mp4", inside)
    with pytest.raises(ValueError, match=rf"a\.mp4 is of 360 degrees, but .*{why}"):
        film_frames(path, tmp_path / "frames", 4)
