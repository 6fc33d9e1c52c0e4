"""The loop's own cost: CPU of the parent for a pair, size of the store, seconds of a start from it,
memory.

Workers are simulated on a virtual clock, so that all CPU time is the loop's: the schedule, keys,
state, store, publications of the submission's F, estimates and scenes. The store is a real file.

python -m benchmarks.journal [--pairs 10000] [--units 5] [--batches 40] [--matches 2000]
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.request import Request
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.engine.store import FILE_NAME, Store
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.view_graph import BatchImage
from tests.support import simulator
from tests.support.simulator import Scenario, simulate


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=10_000)
    parser.add_argument("--units", type=int, default=5)
    parser.add_argument("--batches", type=int, default=40)
    parser.add_argument("--matches", type=int, default=2000)
    arguments = parser.parse_args()
    scenario = scenario_of(
        arguments.pairs, arguments.batches, arguments.units, arguments.matches
    )
    with tempfile.TemporaryDirectory() as directory:
        with Store.open(Path(directory)) as store:
            started = time.process_time()
            ran = simulate(scenario, store)
            seconds = time.process_time() - started
        size = (Path(directory) / FILE_NAME).stat().st_size
        started, cpu = time.perf_counter(), time.process_time()
        with Store.open(Path(directory)) as store:
            state = restored(scenario, store)
        resuming, resuming_cpu = time.perf_counter() - started, time.process_time() - cpu
    what = f"{int(state.estimated.sum())} pairs, {arguments.units} units of {arguments.matches} matches"
    print(f"{what}, {len(ran.scenes)} scenes: {ran.report.ending}")
    print(f"CPU: {1e3 * seconds / arguments.pairs:.2f} ms a pair; store: {size / 1e6:.0f} MB")
    stale = f"{state.stale.sum()} scenes out of date"
    print(f"start from the store: {resuming:.2f} s, {resuming_cpu:.2f} s CPU; {stale}")
    print(f"memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")


def scenario_of(pairs: int, batches: int, units: int = 5, matches: int = 2000) -> Scenario:
    """Return a run without a limit, whose units return the same random matches."""
    rng = np.random.default_rng(0)
    # Random sub-pixel points on images of 1600 x 1200 pixels hardly compress.
    points0, points1 = (rng.random((2, matches, 2)) * (1600, 1200)).astype(np.float32)
    simulator.POINTS = Matches(points0, points1, rng.random(matches).astype(np.float32))
    return Scenario(pairs, (0.5,) * units, 1, float("inf"), 0.1, 0, batches=batches)


def loop_seconds(pairs: int, batches: int) -> float:
    """Return the CPU seconds of the loop in a run of these pairs."""
    scenario = scenario_of(pairs, batches)
    with tempfile.TemporaryDirectory() as directory, Store.open(Path(directory)) as store:
        started = time.process_time()
        simulate(scenario, store)
        return time.process_time() - started


def restored(scenario: Scenario, store: Store) -> State:
    """Return the state that a resumed run of the scenario starts with."""
    share = max(1, scenario.batches) / scenario.pairs
    pairs = [
        Pair(str(n), f"{int(n * share):03d}", f"{n:07d}", "b") for n in range(scenario.pairs)
    ]
    names = {name for pair in pairs for name in (pair.file0, pair.file1)}
    images = {name: BatchImage(name, name, simulator.SIZE) for name in names}
    state = State(Request(pairs, scenario.recipe, scenario.keys), images)
    state.restore(store)
    return state


if __name__ == "__main__":
    main()
