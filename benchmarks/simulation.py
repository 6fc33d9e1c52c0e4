"""How well the engine uses its time, on random simulated runs.

python -m benchmarks.simulation [--scenarios 1000] [--seed 0] [--pairs 10000]
"""

import argparse
import math

import numpy as np

from tests.support.simulator import random_scenario, simulate, without_records


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pairs", type=int, default=1000, help="on average; the scale of a run (default: 1000)")
    arguments = parser.parse_args()
    runs = [
        without_records(simulate(random_scenario(seed, arguments.pairs)))
        for seed in range(arguments.seed, arguments.seed + arguments.scenarios)
    ]
    busy = [run.utilisation for run in runs if run.work_left]
    print(f"{len(runs)} scenarios, {len(busy)} with work left at the end")
    print(f"late: {sum(run.late > 0 for run in runs)}, rows lost: {sum(run.lost for run in runs)}")
    low, middle = np.percentile(busy, [5, 50]) if busy else (math.nan, math.nan)
    print(f"utilisation: median {middle:.4f}, 5th percentile {low:.4f}, least {min(busy, default=math.nan):.4f}")
    worst = max(runs, key=lambda run: run.planning)
    print(f"planning: {1e3 * worst.planning:.3f} ms a job at most, {worst.jobs} jobs")
    for run in sorted((run for run in runs if run.work_left), key=lambda run: run.utilisation)[:5]:
        print(f"  {run.utilisation:.4f} {run.scenario}")


if __name__ == "__main__":
    main()
