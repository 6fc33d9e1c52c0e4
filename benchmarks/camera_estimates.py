"""F of pairs from their two cameras next to MAGSAC's, for the report of ``reconstruct``.

python -m benchmarks.camera_estimates OUT

OUT has the results of `reconstruct` with one unit. For the pairs that take F from their cameras, the
output has CPU milliseconds of a pair and the number of inliers, by MAGSAC as for pairs without cameras
and from cameras. The statistics (support, plane) are part of both.
"""

import argparse
import time
from pathlib import Path

from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import pair_tables
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import (
    Estimate,
    ModelKind,
    RobustConfig,
    estimate,
    sampson_distances,
)
from mkpc_kaggle.pipeline.pair import with_stats
from mkpc_kaggle.reconstruction.run import MAGSAC_ITERATIONS
from mkpc_kaggle.scene.choose import Reason

MAGSAC = RobustConfig(permutations=1, max_iterations=MAGSAC_ITERATIONS)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    with Store.read(arguments.out / "work") as store:
        published = Published.of(store)
        tables = pair_tables(store, published)
        matches = [
            Matches.concatenate(published.points_of(store, row).values()) for row in published.rows
        ]
    seconds = {"MAGSAC": 0.0, "cameras": 0.0}
    inliers = {"MAGSAC": 0, "cameras": 0}
    chosen = [number for number in tables.pairs.index if tables.pairs["source"][number] == "scene"]
    for number in chosen:
        found = matches[number]
        F = tables.estimates["F"][number]
        begin = time.process_time()
        by_magsac = estimate(found, MAGSAC)
        if by_magsac.ok:
            by_magsac = with_stats(by_magsac, found)
        between = time.process_time()
        agrees = sampson_distances(F, found) < MAGSAC.threshold
        by_cameras = with_stats(Estimate(ModelKind.F, F, agrees), found)
        end = time.process_time()
        for name, made, spent in (
            ("MAGSAC", by_magsac, between - begin),
            ("cameras", by_cameras, end - between),
        ):
            seconds[name] += spent
            inliers[name] += made.inlier_count
    print(f"{len(chosen)} of {len(matches)} pairs: {Reason.SCENE}")
    for name, spent in seconds.items():
        print(f"{name:<8} {1000 * spent / max(1, len(chosen)):6.1f} ms {inliers[name]:>8} inliers")


if __name__ == "__main__":
    main()
