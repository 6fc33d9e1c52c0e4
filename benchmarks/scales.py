"""The change of scale of pairs by their matches, as the rule of `light`, and by their critical regions.

    python -m benchmarks.scales --journal DIR

The journal is a work directory of `validate`; the matches are those of stage 1. Scenes SCENE_zoomN have
a true change of scale of N.
"""

import argparse
import re
from collections import defaultdict
from math import sqrt
from pathlib import Path

import numpy as np

from benchmarks.estimation import read_journal
from mkpc_kaggle.geometry.critical_region import MkpcConfig, critical_region
from mkpc_kaggle.geometry.crop_need import scale_between
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import PairMatch

MKPC = MkpcConfig()
NEAR = 1.25  # a scale is right within this factor of the true one


def scales_of(match: PairMatch) -> tuple[float, float]:
    """Return the scale of a pair by its matches of stage 1, and by the sides of its two regions."""
    of_stage = [result.matches for result in match.results if result.unit.stage == 1]
    matches = Matches.concatenate(of_stage)
    size0, size1 = match.sizes
    sides = []
    for points, size in ((matches.points0, size0), (matches.points1, size1)):
        width, height = critical_region(points, size, MKPC).box.size
        # Relative to the image's longer side, since a matcher's views have equal ones.
        sides.append(sqrt(width * height) / max(size))
    return scale_between(matches, (size0, size1)), max(sides) / min(sides)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--journal", type=Path, required=True)
    parser.add_argument("--factor", type=float, default=MKPC.min_scale, help="of the rule")
    arguments = parser.parse_args()
    _, journal = read_journal(arguments.journal)
    scenes = defaultdict(list)
    for pair, (match, _) in journal.items():
        scenes[pair.split(";")[0]].append(scales_of(match))
    print("by matches, by regions: median; share of pairs above the factor; share near the truth")
    near = []  # of the pairs with a known change of scale
    for scene, scales in scenes.items():
        of_both = np.array(scales).T
        cells = [f"{np.median(each):6.2f}" for each in of_both]
        cells += [f"{(each >= arguments.factor).mean():6.2f}" for each in of_both]
        if truth := re.search(r"_zoom(\d)$", scene):
            near.append(np.abs(np.log(of_both / float(truth[1]))) < np.log(NEAR))
            cells += [f"{share:6.2f}" for share in near[-1].mean(axis=1)]
        print(f"{scene:<22}{len(scales):>5}" + "".join(cells))
    if near:
        shares = [f"{share:.2f}" for share in np.hstack(near).mean(axis=1)]
        print(f"near the truth, of all pairs: {', '.join(shares)}")


if __name__ == "__main__":
    main()
