"""The engine's use of time in random simulated runs.

Statistics of many runs:

    python -m benchmarks.simulation [--scenarios 1000] [--seed 0] [--pairs 10000] [--without MECHANISM]

The timeline of one run; the costs are the seconds of each unit on a pair:

    python -m benchmarks.simulation --costs 0.6 0.4 0.35 [--batches 15] [--pairs 10000] [--scene-seconds 0.15]
        [--limit 8h45m] [--workers 1] [--candidates 1]
        [--crops 0.1]
"""

import argparse
import math
from collections import Counter

import numpy as np

from mkpc_kaggle.engine.budget import parse_duration
from mkpc_kaggle.progress import format_duration
from tests.support.simulator import (
    MECHANISMS,
    Ran,
    Scenario,
    random_scenario,
    simulate,
    switch_off,
    without_tables,
)


def timeline(scenario: Scenario) -> None:
    """Print the start times of the phases of a run, and the scenes of its batches."""
    ran = simulate(scenario)
    for explanation in ran.report.explanations:
        print(explanation)
    for scene in ran.scenes:
        begun, ended = map(format_duration, (scene.begun, scene.begun + scene.seconds))
        print(f"{begun:>7}  batch {scene.batch} is reconstructed until {ended}")
    units = Counter(ran.report.tables.pairs["units"])
    had = ", ".join(f"{pairs} pairs with {count} units" for count, pairs in sorted(units.items()))
    print(
        f"{format_duration(ran.report.seconds):>7}  {ran.report.ending}: {had}; {ran.missed} scenes missed"
    )
    print(
        f"workers busy: {ran.utilisation:.4f} of their time; late: {ran.late:.0f} s; rows lost: {ran.lost}"
    )


def summary(runs: list[Ran]) -> None:
    """Print counts of late runs, lost rows and missed scenes, and the utilisation."""
    busy = [run.utilisation for run in runs if run.work_left]
    print(f"{len(runs)} scenarios, {len(busy)} with work left at the end")
    print(f"late: {sum(run.late > 0 for run in runs)}, rows lost: {sum(run.lost for run in runs)}")
    bad = sum(run.scenario.bad_places for run in runs)
    closed = sum(len(run.closed) for run in runs)
    wrongly = sum(len(run.wrongly_closed) for run in runs)
    pairs = sum(len(run.scenario.fates) for run in runs)
    print(f"bad pairs: {pairs}; bad places: {bad}; places closed: {closed}, good ones: {wrongly}")
    print(f"units run: {sum(run.report.units_run for run in runs)}")
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
    for run in sorted((run for run in runs if run.work_left), key=lambda run: run.utilisation)[:5]:
        print(f"  {run.utilisation:.4f} {run.scenario}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenarios", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--pairs", type=int, default=1000, help="on average; the scale of a run (default: 1000)"
    )
    parser.add_argument(
        "--without", choices=MECHANISMS, action="append", default=[], help="may be repeated"
    )
    parser.add_argument("--costs", type=float, nargs="+")
    parser.add_argument("--batches", type=int, default=15)
    parser.add_argument(
        "--scene-seconds", type=float, default=Scenario.scene_seconds, help="for each pair"
    )
    parser.add_argument("--limit", type=parse_duration, default=parse_duration("8h45m"))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--candidates", type=int, default=1, help="of a scene")
    parser.add_argument(
        "--crops", type=float, default=1.0, metavar="SHARE", help="of the pairs need the last unit"
    )
    arguments = parser.parse_args()
    for name in arguments.without:
        switch_off(name)
    if arguments.costs is not None:
        timeline(
            Scenario(
                arguments.pairs,
                tuple(arguments.costs),
                arguments.workers,
                arguments.limit,
                batches=arguments.batches,
                scene_seconds=arguments.scene_seconds,
                candidates=arguments.candidates,
                crop_share=arguments.crops,
                seed=arguments.seed,
            )
        )
        return
    seeds = range(arguments.seed, arguments.seed + arguments.scenarios)
    summary([without_tables(simulate(random_scenario(seed, arguments.pairs))) for seed in seeds])


if __name__ == "__main__":
    main()
