"""Accuracy by time limit: mAA of scenes at 1, 2, 4, 8 and 16 times the sweep's time.

python -m benchmarks.anytime --train-dir DIR --out FIGURE.png [--recipes classical light] [--runs 2] [-- OPTION...]

Limits are on the real clock. OPTIONs are options of `validate`, such as `--scenes A,B`. The sweep
is a run of the recipe's first unit alone, timed from process start to end. *Early* is the minimum
time between the end of a run and its limit; negative: late. Scoring comes after the run.
"""

import argparse
import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory

from mkpc_kaggle.recipe import load_recipe
from mkpc_kaggle.reporting.figures import new_figure, plain_axes, save

FACTORS = (1, 2, 4, 8, 16)  # of the sweep's time


@dataclass(frozen=True)
class Timed:
    """A run of `validate`: its mAA, the seconds of the run, and those of its process."""

    maa: float
    run_seconds: float
    process_seconds: float


def timed(arguments: list[str]) -> Timed:
    """Run `validate` and time it."""
    with TemporaryDirectory() as directory:
        result = Path(directory) / "scores.json"
        start = time.monotonic()
        # A separate process, since a limit counts from the start of a program.
        command = [sys.executable, "-m", "mkpc_kaggle", "validate", "--json", str(result)]
        command += arguments
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        seconds = time.monotonic() - start
        figures = json.loads(result.read_text())
        return Timed(figures["mAA"], figures["seconds"], seconds)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--recipes", nargs="+", default=["classical", "light"])
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("options", nargs="*")
    given = parser.parse_args()
    axes = plain_axes(new_figure(6.5, 3.2).subplots(), "mAA by time limit")
    print(f"{'recipe':12}{'limit':>10}{'early':>8}  mAA")
    for recipe in given.recipes:
        side = ["--train-dir", given.train_dir, "--recipe", recipe, *given.options]
        # The least that a run can do: no limit can be shorter.
        first_unit = load_recipe(recipe).units[0].name
        sweep = timed([*side, "--no-scenes", "--units", first_unit]).process_seconds
        means = []
        for factor in FACTORS:
            limit = factor * sweep
            runs = [timed([*side, "--time-limit", f"{limit:.1f}"]) for _ in range(given.runs)]
            # The worst of the runs: being late once loses a submission.
            early = min(limit - run.run_seconds for run in runs)
            means.append(fmean(run.maa for run in runs))
            scores = " ".join(f"{run.maa:.3f}" for run in runs)
            print(f"{recipe:12}{limit:9.1f}s{early:7.1f}s  {scores}", flush=True)
        # As text, so that the factors are evenly spaced.
        factors = [str(factor) for factor in FACTORS]
        axes.plot(factors, means, "o-", label=f"{recipe}: the sweep takes {sweep:.0f} s")
    axes.set(ylim=(0, 1), xlabel="time limit / sweep")
    axes.legend(fontsize=8, frameon=False)
    save(axes.figure, given.out)


if __name__ == "__main__":
    main()
