"""Size of the journal of a long run, and the time to go on from it.

python -m benchmarks.journal [--pairs 10000] [--units 5] [--matches 2000]

All pairs are swept, then given their other units.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from mkpc_kaggle.engine.jobs import Outcome
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.plan import JOB_PAIRS
from mkpc_kaggle.engine.records import PairRecord, UnitRecord
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit


def results(units: list[Unit], matches: int, rng: np.random.Generator) -> tuple[UnitResult, ...]:
    """Sub-pixel points on images of 1600 x 1200, in no order: little that a compressor could use."""
    size = np.array([1600, 1200])
    return tuple(
        UnitResult(
            unit, Matches(rng.random((matches, 2)) * size, rng.random((matches, 2)) * size, rng.random(matches))
        )
        for unit in units
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=10_000)
    parser.add_argument("--units", type=int, default=5)
    parser.add_argument("--matches", type=int, default=2000)
    arguments = parser.parse_args()
    units = [Unit(1, f"m{number}", 1024) for number in range(arguments.units)]
    rng = np.random.default_rng(0)
    found = results(units, arguments.matches, rng)
    records = [UnitRecord(unit.name, 1, arguments.matches, 100, 0.1, 0.1, "") for unit in units]
    with tempfile.TemporaryDirectory() as directory:
        journal = Journal(Path(directory), {"benchmark": 1})
        started = time.perf_counter()
        for first, last in ((0, 1), (1, len(units))):
            for start in range(0, arguments.pairs, JOB_PAIRS):
                indices = range(start, min(start + JOB_PAIRS, arguments.pairs))
                had = tuple(records[:last])
                made = (PairRecord(index, FALLBACK_FUNDAMENTAL, "", had) for index in indices)
                journal.save([Outcome(record, found[first:last]) for record in made])
        saving = time.perf_counter() - started
        journal.close()
        size = journal.path.stat().st_size
        started = time.perf_counter()
        again = Journal(Path(directory), {"benchmark": 1})
        count = len(again.records())
        resuming = time.perf_counter() - started
        again.close()
    print(f"{count} pairs, {arguments.units} units of {arguments.matches} matches")
    print(
        f"journal: {size / 1e6:.0f} MB; saving: {1e3 * saving / count:.1f} ms a pair; resuming: {resuming:.1f} s"
    )


if __name__ == "__main__":
    main()
