"""The README's Python lines run as printed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch


def test_the_eight_lines_run() -> None:
    text = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names: dict[str, Any] = {}
    torch.manual_seed(0)
    exec(block, names)
    assert names["image"].shape == (1, 240, 320, 3)
    assert names["alpha"].max() > 0.5
    assert names["colors"].grad.abs().sum() > 0
