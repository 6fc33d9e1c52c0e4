"""The engine's use of time in random simulated runs.

python -m benchmarks.simulation [--scenarios 1000] [--seed 0] [--pairs 1000] [--without MECHANISM]
"""

import argparse
import math

import numpy as np

from tests.support.simulator import (
    MECHANISMS,
    Ran,
    random_scenario,
    simulate,
    switch_off,
    without_tables,
)


def summary(runs: list[Ran]) -> None:
    """Print counts of late runs, lost rows and missed scenes, and the utilisation."""
    busy = [run.utilisation for run in runs if run.work_left]
    print(f"{len(runs)} scenarios, {len(busy)} with work left at the end")
    print(
        f"late: {sum(run.late > 0 for run in runs)}, rows lost: {sum(run.lost for run in runs)}"
    )
    bad = sum(run.scenario.bad_places for run in runs)
    closed = sum(len(run.closed) for run in runs)
    wrongly = sum(len(run.wrongly_closed) for run in runs)
    pairs = sum(len(run.scenario.fates) for run in runs)
    print(
        f"bad pairs: {pairs}; bad places: {bad}; places closed: {closed}, good ones: {wrongly}"
    )
    print(f"units run: {sum(run.report.about.units_run for run in runs)}")
    fit = [run for run in runs if run.scenario.batches and run.scenes_fit]
    batches = sum(run.scenario.batches for run in fit)
    missed = sum(run.missed for run in fit)
    unmatched = sum(run.unmatched for run in fit)
    print(
        f"scenes: {len(fit)} scenarios in which they fit, {missed} of {batches} batches missed; "
        f"{unmatched} have no matches"
    )
    low, middle = np.percentile(busy or [math.nan], [5, 50])
    print(
        f"utilisation: median {middle:.4f}, mean {np.mean(busy or [math.nan]):.4f}, 5th percentile {low:.4f}"
    )
    for run in sorted(
        (run for run in runs if run.work_left), key=lambda run: run.utilisation
    )[:5]:
        print(f"  {run.utilisation:.4f} {run.scenario}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenarios", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--pairs",
        type=int,
        default=1000,
        help="on average; the scale of a run (default: 1000)",
    )
    parser.add_argument(
        "--without", choices=MECHANISMS, action="append", default=[], help="may be repeated"
    )
    arguments = parser.parse_args()
    for name in arguments.without:
        switch_off(name)
    seeds = range(arguments.seed, arguments.seed + arguments.scenarios)
    summary(
        [without_tables(simulate(random_scenario(seed, arguments.pairs))) for seed in seeds]
    )


if __name__ == "__main__":
    main()
