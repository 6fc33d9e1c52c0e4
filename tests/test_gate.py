"""The gate: ratios next to their baseline, regressions first."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import gate

RATIOS = {"same": 1.04, "worse": 1.2, "better": 0.5}


def measure(_: gate.Inputs) -> Iterator[tuple[str, float]]:
    yield from RATIOS.items()


def missing(_: gate.Inputs) -> Iterator[tuple[str, float]]:
    yield "first", 2.0
    raise gate.MissingError("no photographs")


@pytest.fixture
def baseline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "baseline.json"
    monkeypatch.setattr(gate, "BASELINE", path)
    measurements = {"folder": (measure, 0.1), "networks": (missing, 0.1)}
    monkeypatch.setattr(gate, "MEASUREMENTS", measurements)
    return path


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["gate", *arguments])
    try:
        gate.main()
    except SystemExit as ended:
        return int(str(ended.code))
    return 0


def test_a_ratio_above_its_tolerance_comes_first_and_ends_with_1(
    baseline, monkeypatch, capsys
):
    known = {name: {"ratio": 1.0, "tolerance": 0.1} for name in RATIOS}
    baseline.write_text(json.dumps({"machine": "another", "ratios": known}))
    assert run(monkeypatch) == 1
    shown = capsys.readouterr().out
    assert "left out, networks: no photographs" in shown
    assert "the baseline is of another machine: another" in shown
    lines = shown.splitlines()[3:]
    assert [line.split()[-1] for line in lines[1:]] == ["same", "better", "first"]
    assert lines[0].startswith("REGRESSION") and "worse" in lines[0]
    assert lines[-1].startswith("new")
    assert json.loads(baseline.read_text())["ratios"] == known
