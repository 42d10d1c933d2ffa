"""The README's Python lines run as printed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from fixtures_scenes import make_truth, write_colmap


def blocks() -> list[str]:
    text = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


def test_the_lines_of_the_product_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a small scene, and with fewer iterations."""
    write_colmap(make_truth(), tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    block = blocks()[0]
    assert "iterations=3000" in block
    exec(block.replace("iterations=3000", "iterations=20"), names)
    assert names["run"].iterations == 20
    assert (tmp_path / "run" / "report.json").exists()
    camera = names["scene"].test[0].camera
    assert names["image"].shape == (camera.height, camera.width, 3)
    assert torch.equal(names["model"].means, names["run"].model.means)


def test_the_lines_of_the_rasterizer_run() -> None:
    names: dict[str, Any] = {}
    torch.manual_seed(0)
    exec(blocks()[1], names)
    assert names["image"].shape == (1, 240, 320, 3)
    assert names["alpha"].max() > 0.5
    assert names["colors"].grad.abs().sum() > 0
