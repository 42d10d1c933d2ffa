"""The scripts about networks: their sums, and what they need. Namespaces need root, so no test makes any."""

from __future__ import annotations

import sys
from pathlib import Path

import network
import network_machines
import pytest
from network import Link, line
from network_model import Model, main, table


def step(waited: float) -> dict[str, float]:
    return {"seconds": 0.5, "worked": 0.2, "waited": waited, "sent": 12_500_000}


def test_what_is_hidden_is_what_no_rank_waits_for() -> None:
    found = line(Link("1 GbE", 1e9), [step(0.9), step(0.07), step(0.01)], free=0.05)
    assert (found["transfer"], found["steps"]) == (0.1, 3)
    assert found["hidden"] == pytest.approx(0.8)
    assert line(Link("no limit"), [step(0.4)], free=0.4)["hidden"] is None


def test_namespaces_need_root(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(network_machines.os, "geteuid", lambda: 1000)
    with pytest.raises(RuntimeError, match="need root, and ip and tc"), network_machines.machines(0.0):
        pass
    monkeypatch.setattr(sys, "argv", ["network.py", "nowhere", "--out", str(tmp_path)])
    assert network.main() == 1


def test_the_model_follows_its_words(capsys: pytest.CaptureFixture[str]) -> None:
    model = Model(fixed=0.1, each=1e-6, cores=2)
    assert model.view(900_000) == pytest.approx(0.5)
    assert model.transfer(1_000_000, ranks=3, rate=1e9) == pytest.approx(1.024)
    assert model.gain(1_000, ranks=4, rate=1e15) == pytest.approx(4, rel=0.02)
    assert model.gain(10_000_000, ranks=2, rate=1e6) < 0.01
    gains = [model.gain(1_000_000, 4, rate) for rate in (1e9, 1e10, 1e11)]
    assert gains == sorted(gains)
    assert main() == 0
    said = capsys.readouterr().out
    assert "\n".join(table(1)) in said
