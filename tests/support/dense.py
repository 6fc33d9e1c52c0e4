"""What tests of DKM and RoMa share: the estimates of a match, and pictures as the network wants them."""

from contextlib import contextmanager

import numpy as np
import pytest
import torch
from golden import Stage

from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.matchers.networks.dense_sampling import sample_matches
from mkpc_kaggle.matchers.networks.dense_warp import DenseWarp, dense_warp
from mkpc_kaggle.matchers.networks.pixels import MEAN, STD, network_input

MODES = {"threshold_balanced": 0.05, "balanced": 1.0}  # of sampling, by the golden files' names: the threshold


@contextmanager
def one_thread():
    """As the golden files were made. Their own rounding takes up to 0.7 of the tolerance at stride 1, and how work
    is split among threads changes that of the network by as much again.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def recorded_estimates(decoder):
    """The estimates after each refiner, by stride, in the order of the calls."""
    correct, estimates = decoder.correct, {stride: [] for stride in decoder.conv_refiner}

    def recording(estimate, query, support, stride):
        estimates[str(stride)].append(correct(estimate, query, support, stride))
        return estimates[str(stride)][-1]

    decoder.correct = recording
    try:
        yield estimates
    finally:
        del decoder.correct


@one_thread()
@torch.inference_mode()
def computed(network, images, fine_images=(None, None), *, symmetric=True):
    """Estimates at all strides and the final warp, by the names of the golden files; "up_" in the second pass.

    The directions are run one after the other; here they are one batch, as in the golden files.
    """
    features = [network.encode(*versions) for versions in zip(images, fine_images, strict=True)]
    with recorded_estimates(network.decoder) as estimates:
        dense = side_by_side(network.match(*features) if symmetric else [dense_warp(*network.decoder(*features))])
    passes = ("",) if fine_images[0] is None else ("", "up_")
    values = {}
    for number, prefix in enumerate(passes):
        for stride, found in estimates.items():
            if stride == "16" and prefix:
                continue  # the second pass begins at stride 8
            of_pass = found if stride == "16" else found[number :: len(passes)]
            values[f"{prefix}flow{stride}"] = torch.cat([estimate.flow for estimate in of_pass])
            values[f"{prefix}cert{stride}"] = torch.cat([estimate.certainty for estimate in of_pass])
    return values | {f"{passes[-1]}warp": dense.warp, f"{passes[-1]}certainty": dense.certainty}


def side_by_side(warps):
    """The published layout (B, H, 2 W, 4) of both directions, for images of one size."""
    return DenseWarp(*(torch.cat([getattr(dense, part) for dense in warps], 2) for part in ("warp", "certainty")))


def compared(values, golden, within):
    """Stages for all values that the golden file has; of some batches it has the first item only."""
    names = [name for name in values if name in golden]
    assert any(name.endswith("warp") for name in names) and any(name.endswith("certainty") for name in names)
    return [within(name, values[name][: len(golden[name])], golden[name]) for name in names]


def within(name, got, expected, share=1e-4):
    """The tolerance of the golden files: a share of the array's largest value."""
    return Stage(name, got, expected, share * expected.abs().max().item())


def input_of(pixels):
    """(H, W, 3) uint8 that has its size already."""
    return network_input(batch_of(pixels), tuple(pixels.shape[:2]))


def batch_of(pixels):
    return pixels.permute(2, 0, 1)[None].contiguous()


def resized_by_pil(pixels, size):
    image = pytest.importorskip("PIL.Image", reason="the golden images were resized by PIL")
    resized = image.fromarray(pixels.numpy()).resize(size[::-1], image.Resampling.BICUBIC)
    return torch.from_numpy(np.array(resized))


def grey_levels(image):
    mean, std = (torch.tensor(values)[:, None, None] for values in (MEAN, STD))
    return ((image * std + mean) * 255).round()


def pixels_of(golden):
    """By the golden files' names, what normalised points are in pixels whose centres are at halves."""
    height0, width0, height1, width1 = golden["pixel_sizes_HA_WA_HB_WB"].tolist()
    sides = golden["pixel_in"].numpy().reshape(-1, 2, 2).swapaxes(0, 1)
    sizes = Size(width0, height0), Size(width1, height1)
    for name, points, size in zip(("pixel_A", "pixel_B"), sides, sizes, strict=True):
        yield name, torch.from_numpy(from_normalised(points, size)) + 0.5


def mode_stages(warp, certainty, golden, within, *, number, seed, suffix=""):
    """Matches sampled in both modes, by the names of the golden files, which end in ``suffix``."""
    for mode, threshold in MODES.items():
        name = f"{mode}{suffix}"
        generator = torch.Generator().manual_seed(seed)
        found = sample_matches(warp, certainty, number, threshold, generator=generator)
        weights = certainty.masked_fill(certainty > threshold, 1)
        yield Stage(f"{name}__matches", found.matches, golden[f"{name}__matches"])
        yield within(f"{name}__certainty", weights[found.index], golden[f"{name}__certainty"])
