"""What the prior on focal lengths does on flat pairs, whose inliers one homography explains.

python -m benchmarks.flat_pairs --train-dir DIR --scenes NAME [NAME ...]

All pairs of the scenes are matched by RootSIFT. The table has pairs by the share of their inliers
that one homography explains, the mAA of MAGSAC's F and of F under the prior, which knows the
images' sizes only, and the gain with its interval over images.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

from mkpc_kaggle import TwoStageMatcher
from mkpc_kaggle.data.competition import read_train_side
from mkpc_kaggle.evaluation.compare import paired_difference
from mkpc_kaggle.evaluation.validate import error_of, image_paths_of
from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.metrics import pair_accuracy
from mkpc_kaggle.geometry.planarity import MIN_PLANE_SHARE, plane_share
from mkpc_kaggle.geometry.robust import Estimate, RobustConfig, estimate

MAGSAC = RobustConfig(permutations=1)
# A pair of MAGSAC alone, so that matching costs one estimate less; both follow below.
MATCHER = {"magsac.permutations": 1, "magsac.max_iterations": 1}
BOUNDS = (0.0, 0.6, 0.7, 0.8, 0.85, MIN_PLANE_SHARE)


class Scored(NamedTuple):
    """A pair: its images, the share on a plane, the accuracy of MAGSAC and under the prior."""

    images: tuple[str, str]
    plane: float
    magsac: float
    prior: float


def scored_pairs(train_dir: Path, name: str) -> list[Scored]:
    """Match and score all pairs of a scene."""
    (scene,) = read_train_side(train_dir, scenes=[name], min_covisibility=0)
    pairs = sorted(scene.pairs, key=lambda true: true.pair.file0)
    matcher = TwoStageMatcher("sift", settings=MATCHER, device="cpu")
    found = []
    for true, match in zip(
        pairs, matcher.match_pairs([true.pair.images for true in pairs]), strict=True
    ):

        def accuracy(made: Estimate) -> float:
            matrix = made.matrix if made.ok else None
            return pair_accuracy(error_of(matrix, true, scene))  # noqa: B023  called at once

        size0, size1 = match.sizes
        priors = (FocalPrior.of_image(size0), FocalPrior.of_image(size1))
        prior = estimate_with_prior(match.matches, priors, MAGSAC, FocalConfig())
        plane = plane_share(prior.matrix, match.matches) if prior.ok else 0.0
        plain = accuracy(estimate(match.matches, MAGSAC))
        found.append(Scored(image_paths_of(true), plane, plain, accuracy(prior)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", required=True)
    arguments = parser.parse_args()
    scenes = [scored_pairs(arguments.train_dir, name) for name in arguments.scenes]
    print("| share on a plane | pairs | MAGSAC | prior | gain |\n| --- | --- | --- | --- | --- |")
    for low in BOUNDS:
        groups = [[pair for pair in scene if pair.plane >= low] for scene in scenes]
        groups = [group for group in groups if group]
        if not groups:
            continue
        compared = []
        for group in groups:
            before = [pair.magsac for pair in group]
            after = [pair.prior for pair in group]
            compared.append((before, after, [pair.images for pair in group]))
        means = [
            sum(map(sum, sides)) / sum(map(len, sides))
            for sides in zip(*[c[:2] for c in compared], strict=True)
        ]
        count = sum(map(len, groups))
        print(
            f"| >= {low:g} | {count} | {means[0]:.3f} | {means[1]:.3f} | {paired_difference(compared)} |"
        )


if __name__ == "__main__":
    main()
