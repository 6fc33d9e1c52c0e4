"""What the engine costs beside the matchers, and how much of the estimates' time hides behind matching.

python -m benchmarks.engine --test-dir DIR [--recipe classical] [--weights DIR] [--pairs 100]

A run in this process, as ``submit --workers 0`` makes it, journal and submission included. The first job, which
loads and warms up, is left out. Time that is not a unit's, clustering or waiting for an image is the engine's.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from mkpc_kaggle.data.competition import Pair, read_test_side
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.jobs import MatchJob, MatchResult, Outcome
from mkpc_kaggle.engine.plan import Plan
from mkpc_kaggle.engine.session import Interrupt, Session, submit
from mkpc_kaggle.pipeline.assembly import Assembly, assemble


@dataclass(frozen=True)
class TimeSpent:
    """Seconds by what they went into, the first job's left out; ``wall`` is from its end to the last job's.

    ``tail`` are the estimates' of the last job, which nothing can hide.
    """

    jobs: int
    wall: float
    units: float
    clusters: float
    images: float
    estimates: float
    tail: float

    @classmethod
    def of(cls, results: Sequence[tuple[float, MatchResult]]) -> "TimeSpent":
        rest = [result for _, result in results[1:]]
        records = [outcome.record for result in rest for outcome in result.outcomes]
        return cls(
            len(rest),
            results[-1][0] - results[0][0],
            sum(result.unit_seconds for result in rest),
            sum(record.cluster_seconds for record in records),
            sum(record.decode_seconds for record in records),
            sum(record.estimate_seconds for record in records),
            sum(outcome.record.estimate_seconds for outcome in rest[-1].outcomes),
        )

    @property
    def engine(self) -> float:
        return self.wall - self.tail - self.units - self.clusters - self.images

    @property
    def overlap(self) -> float:
        """How much longer it would have taken sequentially."""
        return self.units + self.clusters + self.images + self.estimates - self.wall


def run(pairs: Sequence[Pair], assembly: Assembly, directory: Path) -> TimeSpent:
    """A run from start to end in ``directory``."""
    results: list[tuple[float, MatchResult]] = []
    whole = Plan.on_result

    def on_result(plan: Plan, job: MatchJob, result: MatchResult, seconds: float) -> list[Outcome]:
        results.append((time.monotonic(), result))
        return whole(plan, job, result, seconds)

    session = Session(directory, Budget(time.monotonic()), Interrupt(), progress=False)
    with patch.object(Plan, "on_result", on_result):
        submit(pairs, assembly, session, directory / "submission.csv")
    return TimeSpent.of(results)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--test-dir", type=Path, required=True)
    parser.add_argument("--recipe", default="classical")
    parser.add_argument("--weights", type=Path, action="append", default=[])
    parser.add_argument("--pairs", type=int, default=100, help="at most (default: 100)")
    arguments = parser.parse_args()
    pairs = read_test_side(arguments.test_dir)[: arguments.pairs]
    assembly = assemble(arguments.recipe, weights=arguments.weights)
    with tempfile.TemporaryDirectory() as directory:
        spent = run(pairs, assembly, Path(directory))
    print(
        f"{len(pairs)} pairs, recipe {assembly.recipe.name}, {spent.jobs} jobs after the first: {spent.wall:.1f} s"
    )
    print(f"units {spent.units:.1f} s, clusters {spent.clusters:.2f} s, waiting for images {spent.images:.2f} s")
    print(f"engine: {spent.engine:.2f} s, {100 * spent.engine / spent.units:.2f} % of the units' time")
    print(f"estimates: {spent.estimates:.1f} s; in sequence all would have taken {spent.overlap:.1f} s longer")


if __name__ == "__main__":
    main()
