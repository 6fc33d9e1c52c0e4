"""Seconds per matcher for a pair of new images: a column of the README's table.

python -m benchmarks.pairs [--rounds 3] [--only loftr,roma] [--precision bfloat16]

Each round encodes and matches both images with one matcher after the other; times are medians of
the rounds. kornia's LoFTR is measured too. The memory is the peak of a separate process, including
Python and PyTorch. Weights are stand-ins or random, and matchers detect the maximum number of
keypoints. Views have the sizes of the recipes. Set ``THP_MEM_ALLOC_ENABLE=1``, as workers do.
"""

import argparse
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from kornia.feature import LoFTR
from numpy.typing import NDArray
from sklearn.datasets import load_sample_images
from torch import nn

from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.matchers.adapters.loma import LomaAdapter, LomaOptions
from mkpc_kaggle.matchers.adapters.roma import SPEC, RomaOptions
from mkpc_kaggle.matchers.adapters.sift import SiftMatcher, SiftOptions
from mkpc_kaggle.matchers.contract import Colour, Matcher, Picture, Placement, Precision
from mkpc_kaggle.matchers.dense import DenseMatcher
from mkpc_kaggle.matchers.networks.dinov2 import PATCH
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.loma import Loma, Variant
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.roma import RoMa
from mkpc_kaggle.matchers.sparse import image_batch
from tests.support import light_matchers
from tests.support.light_matchers import MATCHERS
from tests.support.standin import filled

KEYPOINTS = 2048  # of every matcher of keypoints, so that their rows can be compared
Run = Callable[[], int]  # runs once and returns the number of matches or keypoints


@dataclass(frozen=True)
class Case:
    """A matcher, and the size of its views in pixels."""

    make: Callable[[Placement], Matcher[Any]]
    size: Size


def random_network(make: Callable[[], nn.Module], placement: Placement) -> Any:
    """Return the network with random weights that keep activations of order 1."""
    # Stand-in weights of this size take minutes to make.
    with torch.device("meta"):
        network = make()
    network.to_empty(device="cpu")
    generator = torch.Generator().manual_seed(0)
    for name, tensor in network.state_dict().items():
        # A sum of n products of order 1 grows with the square root of n.
        if tensor.ndim > 1:
            tensor.normal_(std=tensor[0].numel() ** -0.5, generator=generator)
        else:
            tensor.fill_(1 if name.endswith(("weight", "running_var", "gamma")) else 0)
    return prepared(network, placement)


def loma(variant: Variant, placement: Placement) -> LomaAdapter:
    network = random_network(partial(Loma, variant), placement)
    return LomaAdapter(
        network, LomaOptions(variant, max_keypoints=KEYPOINTS), placement.device
    )


def roma(placement: Placement) -> DenseMatcher:
    network = random_network(RoMa, placement)
    return DenseMatcher(SPEC, network, RomaOptions(), placement.device, multiple=PATCH)


def with_lightglue(
    name: str, layers: int, keypoints: int = KEYPOINTS
) -> Callable[[Placement], Matcher[Any]]:
    """Return the maker of a LightGlue matcher with stand-in weights."""
    return partial(
        light_matchers.lightglue_matcher,
        name,
        keypoints=keypoints,
        layers=layers,
        threshold=0.1,
    )


# Views of matchers of keypoints, and of semi-dense ones, in the recipes.
SPARSE = Size(1024, 768)
SEMI_DENSE = Size(840, 630)
CASES = {
    "sift": Case(lambda placement: SiftMatcher(SiftOptions(), "cpu"), Size(1280, 960)),
    "sift_lightglue": Case(with_lightglue("sift_lightglue", 9), SPARSE),
    "sift_lightglue, 4096": Case(with_lightglue("sift_lightglue", 9, keypoints=4096), SPARSE),
    "xfeat_lighterglue": Case(with_lightglue("xfeat_lighterglue", 6), SPARSE),
    "aliked": Case(partial(light_matchers.aliked_matcher, keypoints=KEYPOINTS), SPARSE),
    "aliked_lightglue": Case(with_lightglue("aliked_lightglue", 9), SPARSE),
    "superglue": Case(partial(light_matchers.superglue_matcher, keypoints=KEYPOINTS), SPARSE),
    "loma, b128": Case(partial(loma, Variant.B128), SPARSE),
    "loma, b": Case(partial(loma, Variant.B), SPARSE),
    **{
        name: Case(MATCHERS[name], SEMI_DENSE)
        for name in ("loftr", "quadtree", "aspanformer")
    },
    "dkm": Case(partial(light_matchers.dkm_matcher, matches=5000), Size(720, 540)),
    "roma": Case(roma, Size(864, 864)),
}


def photographs(size: Size) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return two images (H, W, 3) RGB; the second is the first, 16 pixels right and 8 down."""
    photograph = load_sample_images().images[0]
    resized = np.asarray(cv2.resize(photograph, size, interpolation=cv2.INTER_AREA), np.uint8)
    return resized, np.roll(resized, (8, 16), axis=(0, 1))


def pictures_of(size: Size, colour: Colour, multiple: int) -> list[Picture]:
    """Return the two images as a matcher's input."""
    view = View.fit(Box.whole(size), long_side=max(size), multiple=multiple)
    pictures = []
    for rgb in photographs(size):
        is_gray = colour is Colour.GRAY
        pixels = np.asarray(
            cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) if is_gray else rgb, np.uint8
        )
        pictures.append(Picture(view.render(pixels), view))
    return pictures


def run_of(case: Case, placement: Placement) -> Run:
    """Return the work on a pair of new images; the matcher is loaded before."""
    matcher = case.make(placement)
    first, second = pictures_of(case.size, matcher.spec.colour, matcher.spec.multiple)

    def run() -> int:
        # One by one, as on a CPU.
        encodings0 = matcher.encode([first])
        encodings1 = matcher.encode([second])
        return len(matcher.match(encodings0, encodings1)[0])

    return run


def kornias_loftr(placement: Placement) -> Run:
    """Return a run of kornia's LoFTR in float32, with our weights."""
    network = LoFTR(pretrained=None).eval()
    # Its table of positions is not in checkpoints, so it keeps its own.
    weights = filled(Loftr(), "loftr").state_dict()
    network.load_state_dict({**network.state_dict(), **weights})
    first, second = pictures_of(SEMI_DENSE, Colour.GRAY, 8)
    image0 = image_batch([first], "cpu")
    image1 = image_batch([second], "cpu")
    return lambda: len(network({"image0": image0, "image1": image1})["keypoints0"])


RUNS: dict[str, Callable[[Placement], Run]] = {
    name: partial(run_of, case) for name, case in CASES.items()
}
RUNS["kornia's loftr"] = kornias_loftr
SIZES = {name: case.size for name, case in CASES.items()}
SIZES["kornia's loftr"] = SEMI_DENSE


def seconds_of(run: Run) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def high_water() -> int:
    """Return the peak memory of this process in kilobytes."""
    # ``getrusage`` may report the parent's peak.
    kilobytes = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert kilobytes is not None
    return int(kilobytes[1])


def peak_memory(name: str, precision: str) -> float:
    """Return the peak memory of a separate process, in GB."""
    # A peak never falls, so each matcher needs a process.
    options = ["--memory-of", name, "--precision", precision]
    command = [sys.executable, "-m", "benchmarks.pairs", *options]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return int(done.stdout) * 1024 / 1e9


@torch.inference_mode()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--precision", choices=list(Precision), default=Precision.FLOAT32)
    parser.add_argument(
        "--only",
        default=",".join(RUNS),
        metavar="NAMES",
        help="matchers, by parts of their names",
    )
    parser.add_argument(
        "--memory-of",
        metavar="NAME",
        help="run this matcher once and print the process's peak",
    )
    arguments = parser.parse_args()
    placement = Placement(precision=Precision(arguments.precision))
    if arguments.memory_of:
        RUNS[arguments.memory_of](placement)()
        print(high_water())
        return
    wanted = arguments.only.split(",")
    runs = {}
    for name, make in RUNS.items():
        if any(part in name for part in wanted):
            runs[name] = make(placement)
    # The first run is not timed: it allocates memory and chooses kernels.
    found = {name: run() for name, run in runs.items()}
    times: dict[str, list[float]] = {name: [] for name in runs}
    # In turns, so that other work on the machine meets all matchers.
    for _ in range(arguments.rounds):
        for name, run in runs.items():
            times[name].append(seconds_of(run))
    print(f"{torch.get_num_threads()} threads, {placement.precision}\n")
    print("| matcher | view | matches | seconds a pair | memory |\n|---|---|---|---|---|")
    for name, seconds in times.items():
        width, height = SIZES[name]
        memory = peak_memory(name, arguments.precision)
        row = f"{name} | {width} x {height} | {found[name]} | {statistics.median(seconds):.2f} | {memory:.2f} GB"
        print(f"| {row} |", flush=True)


if __name__ == "__main__":
    main()
