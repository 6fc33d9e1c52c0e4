"""What tests of DKM and RoMa share: all intermediate values of a match, and pictures as the network wants them."""

import re
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from golden import Stage, recorded

from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.matchers.networks.dense_warp import DenseWarp, dense_warp, kernel
from mkpc_kaggle.matchers.networks.pixels import MEAN, STD, network_input
from mkpc_kaggle.matchers.networks.warp_refiner import local_correlation

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
def recorded_refinement(decoder):
    """What modules of the decoder got and gave, by name, and the estimate after each refiner."""
    strides = decoder.conv_refiner.keys()
    correct = decoder.correct
    estimates = {f"estimate.{stride}": [] for stride in strides}

    def recording(estimate, query, support, stride):
        estimates[f"estimate.{stride}"].append(correct(estimate, query, support, stride))
        return estimates[f"estimate.{stride}"][-1]

    decoder.correct = recording
    names = [f"gps.{stride}" for stride in decoder.gps]
    names += ["embedding_decoder", *(f"conv_refiner.{stride}" for stride in strides)]
    try:
        with recorded(decoder, names) as calls:
            yield calls | estimates
    finally:
        del decoder.correct


@one_thread()
@torch.inference_mode()
def computed(network, images, fine_images=(None, None), *, symmetric=True):
    """All values on the way to a pair's match, in order: names of the golden files, "up_" in the second pass.

    The directions are run one after the other; here they are one batch, as in the golden files.
    """
    features = [network.encode(*versions) for versions in zip(images, fine_images, strict=True)]
    with recorded_refinement(network.decoder) as calls:
        dense = side_by_side(network.match(*features) if symmetric else [dense_warp(*network.decoder(*features))])
    values = encoded(network, images, 32) | coarse_values(network.decoder, calls)
    passes = 1 if fine_images[0] is None else 2
    values |= refiner_values(network.decoder, calls, 0, passes)
    final = ""
    if passes == 2:
        final = "up_"
        second = encoded(network, fine_images, 8) | refiner_values(network.decoder, calls, 1, passes)
        values |= {f"up_{name}": value for name, value in second.items()}
    return values | {f"{final}warp": dense.warp, f"{final}certainty": dense.certainty}


def encoded(network, images, coarsest):
    pyramids = [network.encoder(image, coarsest).levels for image in images]
    return {f"enc{2**i}": torch.cat(levels) for i, levels in enumerate(zip(*pyramids, strict=True))}


def coarse_values(decoder, calls):
    """Projections, kernels, posteriors and first estimates at strides 32 and 16."""
    values = {}
    for s in (32, 16):
        query, support = joined(got[:2] for got, _ in calls[f"gps.{s}"])
        flow, certainty, context = joined(
            (e.flow, e.certainty, z) for (at, *_), (e, z) in calls["embedding_decoder"] if at == s
        )
        x, y = query.flatten(2).mT, support.flatten(2).mT
        values |= {f"proj{s}_q": query, f"proj{s}_s": support}
        values |= {f"pos{s}": decoder.gps[str(s)].embed_coordinates(support)[:, ::8]}
        values |= {f"K{s}_yy": kernel(y, y), f"K{s}_xy": kernel(x, y)}
        values |= {f"gp{s}": torch.cat([gave for _, gave in calls[f"gps.{s}"]])}
        values |= {f"dfn{s}_flow": flow, f"dfn{s}_cert": certainty, f"dfn{s}_ctx": context}
        if s == 32:
            values |= {"flow32": flow, "cert32": certainty}
    return values


def refiner_values(decoder, calls, number, passes, certainty=0):
    """Correlations, corrections and estimates of one of the passes; the second has no stride 16.

    ``certainty``: its channel in the corrections.
    """
    values = {}
    for s, refiner in decoder.conv_refiner.items():
        if number and s == "16":
            continue
        every = 1 if s == "16" else passes
        calls_of_pass = calls[f"conv_refiner.{s}"][number::every]
        if refiner.radius is not None:
            seen = [local_correlation(*got[:3], refiner.radius) for got, _ in calls_of_pass]
            values[f"corr_r{refiner.radius}"] = torch.cat(seen)
        corrections = torch.cat([gave for _, gave in calls_of_pass]).roll(-certainty, dims=1)
        flow, logits = joined((e.flow, e.certainty) for e in calls[f"estimate.{s}"][number::every])
        values |= {f"ref{s}_dcert": corrections[:, :1], f"ref{s}_disp": corrections[:, 1:]}
        values |= {f"flow{s}": flow, f"cert{s}": logits}
    return values


def side_by_side(warps):
    """The published layout (B, H, 2 W, 4) of both directions, for images of one size."""
    return DenseWarp(*(torch.cat([getattr(dense, part) for dense in warps], 2) for part in ("warp", "certainty")))


def joined(calls):
    return [torch.cat(parts) for parts in zip(*calls, strict=True)]


def compared(values, golden, within):
    """Stages in the order of the network for all arrays of a golden file that ``values`` has.

    Of some batches the file has the first item only, of some maps each k-th channel: ``_chK``.
    """
    for name, value in values.items():
        for key in golden:
            reduced = re.fullmatch(rf"{name}(?:_ch(\d+))?", key)
            if reduced:
                step = int(reduced[1] or 1)
                got = value[..., ::step] if value.ndim == 3 else value[:, ::step]
                yield within(key, got[: len(golden[key])], golden[key])


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
