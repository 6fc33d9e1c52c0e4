"""Seconds that each matcher takes for a pair of new images: the column of the README's table.

python -m benchmarks.pairs [--rounds 3] [--only loftr,roma]

Both images are encoded and matched, one matcher after the other in each round; medians. Weights are the tests'
stand-ins, or random ones, and keypoints as many as the options allow. Views are as large as in the recipes.
"""

import argparse
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import torch
from kornia.feature import DISK, XFeat
from tqdm import tqdm

from benchmarks.matchers import Run, loma, photographs, roma_network, seconds_of
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.matchers import (
    aliked_lightglue,
    aspanformer,
    disk_lightglue,
    loftr,
    quadtree,
    xfeat_lighterglue,
)
from mkpc_kaggle.matchers.aliked import AlikedEncoder, AlikedMatcher, AlikedOptions
from mkpc_kaggle.matchers.contract import Colour, Matcher, MatcherSpec, Picture, Placement, Precision
from mkpc_kaggle.matchers.dkm import DkmMatcher, DkmOptions
from mkpc_kaggle.matchers.lightglue import Encoder, LightGlueMatcher, LightGlueOptions, light_glue
from mkpc_kaggle.matchers.networks.aliked import Aliked
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.loma import Variant
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.networks.superglue import SuperGlue, SuperGlueConfig
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint, SuperPointConfig
from mkpc_kaggle.matchers.roma import RomaMatcher, RomaOptions
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher
from mkpc_kaggle.matchers.sift import SiftMatcher, SiftOptions
from mkpc_kaggle.matchers.superglue import SuperGlueMatcher
from mkpc_kaggle.matchers.xfeat_lighterglue import XFeatEncoder
from tests.support.standin import filled

CPU = Placement()
KEYPOINTS = 2048


@dataclass(frozen=True)
class Case:
    """A matcher on views (width, height)."""

    make: Callable[[], Matcher[Any]]
    size: Size


def semi_dense(spec: MatcherSpec, network: Any) -> SemiDenseMatcher:
    return SemiDenseMatcher(placed(filled(network, spec.name), CPU), spec, "cpu")


def aliked_encoder() -> AlikedEncoder:
    return AlikedEncoder(placed(filled(Aliked(max_keypoints=KEYPOINTS), "aliked"), CPU), "cpu")


def xfeat_encoder() -> XFeatEncoder:
    network = XFeat(top_k=KEYPOINTS, detection_threshold=0.0)
    network.net = filled(network.net, "xfeat")
    return XFeatEncoder(network, KEYPOINTS, CPU)


def with_lightglue(spec: MatcherSpec, encoder: Encoder, layers: int, **shape: int) -> LightGlueMatcher:
    options = LightGlueOptions(KEYPOINTS)
    glue = filled(light_glue(layers, options.threshold, **shape), "lightglue")
    return LightGlueMatcher(spec, encoder, glue, options, CPU)


def superglue() -> SuperGlueMatcher:
    superpoint = filled(SuperPoint(SuperPointConfig(max_keypoints=KEYPOINTS)).eval(), "superpoint")
    return SuperGlueMatcher(
        placed(superpoint, CPU), placed(filled(SuperGlue(SuperGlueConfig(20)), "superglue"), CPU), "cpu"
    )


def dkm() -> DkmMatcher:
    return DkmMatcher(placed(filled(DKM(), "dkm"), CPU), DkmOptions(), "cpu")


SPARSE, SEMI_DENSE = Size(1024, 768), Size(840, 630)
CASES = {
    "sift": Case(lambda: SiftMatcher(SiftOptions(), "cpu"), Size(1280, 960)),
    "xfeat_lighterglue": Case(
        lambda: with_lightglue(xfeat_lighterglue.SPEC, xfeat_encoder(), 6, **xfeat_lighterglue.SHAPE), SPARSE
    ),
    "aliked": Case(lambda: AlikedMatcher(aliked_encoder(), AlikedOptions()), SPARSE),
    "aliked_lightglue": Case(
        lambda: with_lightglue(aliked_lightglue.SPEC, aliked_encoder(), 9, input_dim=128), SPARSE
    ),
    "disk_lightglue": Case(
        lambda: with_lightglue(
            disk_lightglue.SPEC,
            disk_lightglue.DiskEncoder(filled(DISK(), "disk"), KEYPOINTS, CPU),
            9,
            input_dim=128,
        ),
        SPARSE,
    ),
    "superglue": Case(superglue, SPARSE),
    "loma, b128": Case(lambda: loma(Variant.B128, KEYPOINTS, Precision.FLOAT32), SPARSE),
    "loma, b": Case(lambda: loma(Variant.B, KEYPOINTS, Precision.FLOAT32), SPARSE),
    "loftr": Case(lambda: semi_dense(loftr.SPEC, Loftr()), SEMI_DENSE),
    "quadtree": Case(lambda: semi_dense(quadtree.SPEC, Quadtree()), SEMI_DENSE),
    "aspanformer": Case(lambda: semi_dense(aspanformer.SPEC, AspanFormer()), SEMI_DENSE),
    "dkm": Case(dkm, Size(720, 540)),
    "roma": Case(lambda: RomaMatcher(roma_network(Precision.FLOAT32), RomaOptions(), "cpu"), Size(864, 864)),
}


def prepared(case: Case) -> Run:
    matcher = case.make()
    view = View.fit(Box.whole(case.size), long_side=max(case.size), multiple=matcher.spec.multiple)
    pictures = []
    for pixels in photographs(case.size):
        gray = matcher.spec.colour is Colour.GRAY
        shown = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if gray else pixels
        pictures.append(Picture(view.render(shown), view))
    return lambda: len(
        matcher.match(*([encoded] for picture in pictures for encoded in matcher.encode([picture])))[0]
    )


@torch.inference_mode()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--only", default=",".join(CASES), metavar="NAMES", help="matchers, by parts of their names"
    )
    arguments = parser.parse_args()
    wanted = arguments.only.split(",")
    runs = {name: prepared(case) for name, case in CASES.items() if any(part in name for part in wanted)}
    found = {name: run() for name, run in tqdm(runs.items(), desc="warming up")}
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in tqdm(range(arguments.rounds), desc="rounds"):
        for name, run in runs.items():
            times[name].append(seconds_of(run))
    print(f"{torch.get_num_threads()} threads\n\n| matcher | view | matches | seconds a pair |\n|---|---|---|---|")
    for name, seconds in times.items():
        width, height = CASES[name].size
        print(f"| {name} | {width} x {height} | {found[name]} | {statistics.median(seconds):.2f} |")


if __name__ == "__main__":
    main()
