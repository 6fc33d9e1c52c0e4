"""Time, work and memory of every network beside kornia's LoFTR at 640 x 480, in one process, alternating.

python -m benchmarks.matchers [--rounds 5] [--precision bfloat16] [--only LoFTR,DKM]

Weights are the tests' stand-ins, or random ones; the pictures a photograph and its shifted copy. The work is
counted by PyTorch (matrix products and convolutions); the peak is the most that a large convolution reaches in any
of the rounds. The memory is the largest of a process that does nothing else, Python and PyTorch included. To have
what a worker has, run it with ``THP_MEM_ALLOC_ENABLE=1``.
"""

import argparse
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.datasets import load_sample_images
from torch import Tensor
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode
from tqdm import tqdm

from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.matchers.contract import Picture, Placement, Precision
from mkpc_kaggle.matchers.loma import Encoded, LomaAdapter, LomaOptions
from mkpc_kaggle.matchers.networks.aliked import Aliked, own_name
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.dense_sampling import SamplingConfig, sample
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.loma import WIDTHS, Loma, Variant
from mkpc_kaggle.matchers.networks.loma_matcher import LomaKeypoints
from mkpc_kaggle.matchers.networks.pixels import network_input
from mkpc_kaggle.matchers.networks.placement import Network, placed
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.networks.roma import RoMa, RomaFeatures
from mkpc_kaggle.matchers.networks.superglue import ImageKeypoints, SuperGlue, SuperGlueConfig
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint, SuperPointConfig
from tests.support.standin import filled

Run = Callable[[], int]
"""Does the work once; the number of matches or keypoints that it found."""

VGA, DKM_SIZE = Size(640, 480), Size(720, 540)
ROMA_SIZES = Size(560, 560), Size(864, 864)
ALIKED_SIZE = Size(1024, 768)
YARDSTICK = "kornia LoFTR"
GIGA = 1e9


@cache
def photographs(size: Size) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two views (H, W, 3) RGB, the second 16 pixels further right and 8 further down."""
    photograph = load_sample_images().images[0]
    resized = cv2.resize(photograph, size, interpolation=cv2.INTER_AREA)
    return resized, np.roll(resized, (8, 16), axis=(0, 1))


def gray_images(size: Size) -> list[Tensor]:
    grays = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in photographs(size))
    return [torch.from_numpy(gray)[None, None].float() / 255 for gray in grays]


def kornia_loftr(precision: Precision) -> Run:
    """Always in float32, with the weights of ours."""
    from kornia.feature import LoFTR

    network = LoFTR(pretrained=None).eval()
    tensors = filled(Loftr(), "loftr").state_dict()
    network.load_state_dict({**network.state_dict(), **tensors})
    image0, image1 = gray_images(VGA)
    return lambda: len(network({"image0": image0, "image1": image1})["keypoints0"])


def semi_dense(make: Callable[[], Loftr | Quadtree | AspanFormer], name: str, size: Size) -> Callable[..., Run]:
    def prepare(precision: Precision) -> Run:
        network = placed(filled(make(), name), Placement(precision=precision))
        image0, image1 = gray_images(size)
        return lambda: len(network.match(network.encode(image0), network.encode(image1)).points0)

    return prepare


def superpoint(precision: Precision) -> Run:
    network = placed(filled(SuperPoint(SuperPointConfig()), "superpoint").eval(), Placement(precision=precision))
    image = gray_images(VGA)[0]
    return lambda: len(network(image)[0].points)


def superglue(number: int, precision: Precision) -> Run:
    network = placed(filled(SuperGlue(SuperGlueConfig(20)), "superglue"), Placement(precision=precision))
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1, number, 2, generator=generator) * torch.tensor(VGA)
    scores = torch.rand(1, number, generator=generator)
    descriptors = functional.normalize(torch.randn(1, number, 256, generator=generator), dim=2)
    keypoints = ImageKeypoints(points, scores, descriptors, VGA)
    return lambda: int((network(keypoints, keypoints).matches0 >= 0).sum())


def dkm(precision: Precision) -> Run:
    network = placed(filled(DKM(), "dkm"), Placement(precision=precision))
    pictures = [torch.from_numpy(view).permute(2, 0, 1)[None] for view in photographs(DKM_SIZE)]

    def run() -> int:
        inputs = [network_input(picture, DKM_SIZE[::-1]) for picture in pictures]
        warps = network.match(*(network.encode(image) for image in inputs))
        warp = torch.cat([one.warp.reshape(-1, 4) for one in warps])
        certainty = torch.cat([one.certainty.flatten() for one in warps])
        return len(sample(warp, certainty, SamplingConfig()).matches)

    return run


def with_random_weights(make: Callable[[], Network], precision: Precision) -> Network:
    """With weights that keep activations of order 1: stand-ins of such large networks take minutes."""
    with torch.device("meta"):
        network = make()
    network.to_empty(device="cpu")
    generator = torch.Generator().manual_seed(0)
    for name, tensor in network.state_dict().items():
        if tensor.ndim > 1:
            tensor.normal_(std=tensor[0].numel() ** -0.5, generator=generator)
        else:
            tensor.fill_(1 if name.endswith(("weight", "running_var", "gamma")) else 0)
    return placed(network, Placement(precision=precision))


@cache
def roma_network(precision: Precision) -> RoMa:
    return with_random_weights(RoMa, precision)


def roma_images(passes: int = 2) -> list[list[Tensor]]:
    """Of two pictures, versions for each pass."""
    pictures = [torch.from_numpy(view).permute(2, 0, 1)[None] for view in photographs(ROMA_SIZES[-1])]
    return [[network_input(picture, size) for size in ROMA_SIZES[:passes]] for picture in pictures]


def roma(passes: int, cached: bool, precision: Precision) -> Run:
    """At the published sizes, both ways, with the encodings' time or without."""
    network = roma_network(precision)

    def encoded() -> list[RomaFeatures]:
        return [network.encode(*images) for images in roma_images(passes)]

    given = encoded() if cached else None

    def run() -> int:
        warps = network.match(*(given or encoded()))
        warp = torch.cat([one.warp.reshape(-1, 4) for one in warps])
        certainty = torch.cat([one.certainty.flatten() for one in warps])
        return len(sample(warp, certainty, SamplingConfig()).matches)

    return run


def roma_encoder(part: str, precision: Precision) -> Run:
    """One of the two networks that look at an image, at the size at which it takes most."""
    network = roma_network(precision)
    coarse, fine = roma_images()[0]
    return {
        "dinov2": lambda: network.dinov2(coarse).shape[1],
        "vgg": lambda: len(network.encoder(fine)),
    }[part]


def roma_decoder(part: str, precision: Precision) -> Run:
    """One direction of what looks at a pair: the coarse estimate, or the second pass's refiners."""
    network = roma_network(precision)
    query, support = (network.encode(*images) for images in roma_images())
    estimate = network.decoder.coarse_estimate(query, support)
    assert query.fine is not None
    assert support.fine is not None
    fine0, fine1 = query.fine, support.fine
    return {
        "coarse": lambda: network.decoder.coarse_estimate(query, support).flow.shape[1],
        "refiners": lambda: network.decoder.refine(estimate, fine0, fine1).flow.shape[1],
    }[part]


@cache
def loma_network(variant: Variant, precision: Precision) -> Loma:
    return with_random_weights(partial(Loma, variant), precision)


def loma(variant: Variant, number: int, precision: Precision) -> LomaAdapter:
    return LomaAdapter(loma_network(variant, precision), LomaOptions(variant, max_keypoints=number), "cpu")


def loma_encode(variant: Variant, long_side: int, number: int, precision: Precision) -> Run:
    matcher = loma(variant, number, precision)
    size = Size(long_side, long_side * 3 // 4)
    picture = Picture(photographs(size)[0], View(Box.whole(size), size, size))
    return lambda: matcher.encode([picture])[0].keypoints.points.shape[1]


def loma_match(variant: Variant, number: int, precision: Precision) -> Run:
    matcher = loma(variant, number, precision)
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1, number, 2, generator=generator) * 2 - 1
    descriptors = torch.randn(1, number, WIDTHS[variant].descriptor, generator=generator)
    encoded = Encoded(LomaKeypoints(points, descriptors), VGA)
    return lambda: len(matcher.match([encoded], [encoded])[0])


def aliked(kornias: bool, precision: Precision) -> Run:
    """n16; kornia's always in float32, with the same weights."""
    from kornia.feature import ALIKED

    theirs = filled(ALIKED("aliked-n16", max_num_keypoints=2048, detection_threshold=0.0).eval(), "aliked")
    image = torch.from_numpy(photographs(ALIKED_SIZE)[0]).permute(2, 0, 1)[None].float() / 255
    if kornias:
        return lambda: int(theirs(image)[0].n)
    ours = Aliked(max_keypoints=2048)
    tensors = {own_name(name): tensor for name, tensor in theirs.state_dict().items()}
    ours.load_state_dict({name: tensor for name, tensor in tensors.items() if name in ours.state_dict()})
    network = placed(ours, Placement(precision=precision))
    return lambda: len(network(image)[0].points)


CASES: dict[str, Callable[[Precision], Run]] = {
    YARDSTICK: kornia_loftr,
    "LoFTR": semi_dense(Loftr, "loftr", VGA),
    "SuperPoint": superpoint,
    "SuperGlue, 1024 keypoints": partial(superglue, 1024),
    "SuperGlue, 2048 keypoints": partial(superglue, 2048),
    "QuadTree": semi_dense(Quadtree, "quadtree", VGA),
    "ASpanFormer": semi_dense(AspanFormer, "aspanformer", VGA),
    "DKM 540x720, one pass": dkm,
    "RoMa 560": partial(roma, 1, False),
    "RoMa 560, encodings cached": partial(roma, 1, True),
    "RoMa 560 + 864": partial(roma, 2, False),
    "RoMa 560 + 864, encodings cached": partial(roma, 2, True),
    "LoMa-B128 encode 1024": partial(loma_encode, Variant.B128, 1024, 2048),
    "LoMa-B128 encode 512": partial(loma_encode, Variant.B128, 512, 1024),
    "LoMa-B encode 1024": partial(loma_encode, Variant.B, 1024, 2048),
    "LoMa-B128 match 2048": partial(loma_match, Variant.B128, 2048),
    "LoMa-B128 match 1024": partial(loma_match, Variant.B128, 1024),
    "LoMa-B match 2048": partial(loma_match, Variant.B, 2048),
    "kornia ALIKED n16 1024": partial(aliked, True),
    "ALIKED n16 1024": partial(aliked, False),
}
PARTS: dict[str, Callable[[Precision], Run]] = {
    "RoMa, DINOv2 560": partial(roma_encoder, "dinov2"),
    "RoMa, VGG 864": partial(roma_encoder, "vgg"),
    "RoMa, coarse estimate 560": partial(roma_decoder, "coarse"),
    "RoMa, refiners 864": partial(roma_decoder, "refiners"),
}
"""Of a case each: their memory is not told."""
LARGE = Size(1600, 1216)
LARGE_CASES = {
    f"{label}, {LARGE.width} x {LARGE.height}": semi_dense(make, name, LARGE)
    for label, make, name in (
        ("LoFTR", Loftr, "loftr"),
        ("QuadTree", Quadtree, "quadtree"),
        ("ASpanFormer", AspanFormer, "aspanformer"),
    )
}


def seconds_of(run: Run) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def work_of(run: Run) -> float:
    """Floating-point operations of matrix products and convolutions, two for each multiplication."""
    with FlopCounterMode(display=False) as counter:
        run()
    return float(counter.get_total_flops())


def peak(precision: torch.dtype) -> float:
    """Operations a second of a 3 x 3 convolution, channels last."""
    x = torch.randn(1, 256, 120, 160, dtype=precision).contiguous(memory_format=torch.channels_last)
    weight = torch.randn(256, 256, 3, 3, dtype=precision).contiguous(memory_format=torch.channels_last)
    run = partial(functional.conv2d, x, weight, padding=1)
    return 2 * weight[0].numel() * x.numel() / min(seconds_of(run) for _ in range(20))  # type: ignore[arg-type]


def high_water() -> float:
    """The most bytes that this process has held; what ``getrusage`` gives may be its parent's."""
    kilobytes = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert kilobytes is not None
    return float(kilobytes[1]) * 1024


def peak_memory(case: str, precision: str) -> float:
    """Bytes of a process of its own."""
    arguments = [sys.executable, "-m", "benchmarks.matchers", "--memory-of", case, "--precision", precision]
    return float(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)


@torch.inference_mode()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--precision", choices=list(Precision), default=Precision.FLOAT32)
    parser.add_argument(
        "--only", default=",".join(CASES), metavar="PARTS", help="cases with one of these in their names"
    )
    parser.add_argument("--large", action="store_true", help=f"also the memory at {LARGE.width} x {LARGE.height}")
    parser.add_argument("--memory-of", metavar="CASE", help="run this case once and print the process's peak")
    arguments = parser.parse_args()
    precision = Precision(arguments.precision)
    if arguments.memory_of:
        (CASES | LARGE_CASES)[arguments.memory_of](precision)()
        print(high_water())
        return
    every = CASES | PARTS
    chosen = [case for case in every if any(part in case for part in arguments.only.split(",") if part)]
    runs = {case: every[case](precision) for case in dict.fromkeys([YARDSTICK, *chosen])}
    found, work = {case: run() for case, run in runs.items()}, {case: work_of(run) for case, run in runs.items()}
    times: dict[str, list[float]] = {case: [] for case in runs}
    peaks = []
    for _ in tqdm(range(arguments.rounds), desc="rounds"):
        peaks.append(peak(getattr(torch, precision)))
        for case, run in runs.items():
            times[case].append(seconds_of(run))
    report(found, work, times, max(peaks), precision)
    for case in LARGE_CASES if arguments.large else ():
        print(f"{case}: {peak_memory(case, precision) / GIGA:.2f} GB")


def report(
    found: dict[str, int], work: dict[str, float], times: dict[str, list[float]], most: float, precision: str
) -> None:
    """Medians of the rounds; shares of the yardstick's median."""
    print(f"{torch.get_num_threads()} threads, {precision}; peak {most / GIGA:.0f} GFLOP/s\n")
    print("| network | found | seconds | of kornia's | GFLOP | GFLOP/s | of peak | memory |")
    print("|---|---|---|---|---|---|---|---|")
    yardstick = statistics.median(times[YARDSTICK])
    for case, seconds in times.items():
        median = statistics.median(seconds)
        memory = f"{peak_memory(case, precision) / GIGA:.2f} GB" if case in CASES else ""
        print(
            f"| {case} | {found[case]} | {median:.3f} | {median / yardstick:.2f} | {work[case] / GIGA:.0f} "
            f"| {work[case] / median / GIGA:.0f} | {work[case] / median / most:.0%} | {memory} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
