"""Size of a long run's journal, time to save a pair, time to resume, and memory of the process.

python -m benchmarks.journal [--pairs 10000] [--units 5] [--matches 2000]
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import Estimated, Outcome, WantedPair
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.request import Request
from mkpc_kaggle.engine.settings import Settings
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.view_graph import BatchImage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=10_000)
    parser.add_argument("--units", type=int, default=5)
    parser.add_argument("--matches", type=int, default=2000)
    arguments = parser.parse_args()
    units, rng = [Unit(1, f"m{number}", 1024) for number in range(arguments.units)], np.random.default_rng(0)
    # Random sub-pixel points on images of 1600 x 1200 pixels hardly compress.
    points = (rng.random((arguments.matches, 2)) * (1600, 1200) for _ in range(2))
    matches = Matches(*points, rng.random(arguments.matches))
    names = [(f"{number}.jpg", f"{number % 100}.jpg") for number in range(arguments.pairs)]
    pairs = [WantedPair(Pair(str(n), "one", *both), both, "F") for n, both in enumerate(names)]
    settings = {unit.name: unit.name for unit in units}
    recipe = Recipe(tuple(units))
    request = Request([each.pair for each in pairs], recipe, Settings(tuple(settings), "F", "scene"))
    with tempfile.TemporaryDirectory() as directory:
        with Journal(Path(directory)) as journal:
            journal.want(pairs, [(unit, unit.name) for unit in units], {"one": "scene"})
            started = time.perf_counter()
            for index, both in enumerate(names):
                images = tuple(BatchImage(name, name, Size(1600, 1200)) for name in both)
                found = tuple(UnitResult(unit, matches, 0.1, 0.1) for unit in units)
                journal.save_outcomes([Outcome(index, images, found)], settings)
                inputs = tuple(journal.inputs(index).values())
                journal.save_estimates([Estimated(index, inputs, inputs, FALLBACK_FUNDAMENTAL)])
            saving = time.perf_counter() - started
        size = journal.path.stat().st_size
        started = time.perf_counter()
        with Journal(Path(directory)) as journal:
            state = State(journal, request, pairs, journal.digests())
        resuming = time.perf_counter() - started
    print(f"{int(state.is_estimated.sum())} pairs, {arguments.units} units of {arguments.matches} matches")
    print(f"journal: {size / 1e6:.0f} MB; saving: {1e3 * saving / len(pairs):.1f} ms; resuming: {resuming:.1f} s")
    print(f"memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")


if __name__ == "__main__":
    main()
