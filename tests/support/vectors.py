"""Vectors of our own, ``tests/data/NAME.npz``: samples of what networks compute from ``standin.py`` alone.

Networks have its weights and see its pictures, so nothing but the code decides the numbers. A test's file run with
``--write`` writes its vectors anew. That is right only when a change is wanted, and only while the parity tests
pass: it is they that say what the numbers should be.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from dense import batch_of
from golden import Stage, print_table
from standin import scene

from mkpc_kaggle.matchers.networks.pixels import network_input

DATA = Path(__file__).resolve().parents[1] / "data"
SAMPLES, STEP = 200, 1_000_003  # a prime, so that samples lie in all channels, rows and columns
TOLERANCE = 1e-3  # of a stage's largest value; on the slowest and fastest code paths it takes a tenth of it
EDGES = 3e-3  # for DKM and RoMa: refiners see a picture's edges where the flow points, which magnifies rounding
LEEWAY = 20  # of so many keypoints or matches one may be another: a threshold or a tie within rounding


class Found(NamedTuple):
    """M keypoints or matches: what tells them apart, whole numbers (M, K), and what is said of each, (M, V)."""

    rows: torch.Tensor
    values: torch.Tensor


def sampled(values):
    """Some of the numbers of a tensor, then their mean and root mean square over all of it."""
    flat = values.flatten().double()
    if len(flat) == 0:
        return flat.float()
    index = torch.arange(min(len(flat), SAMPLES)) * STEP % len(flat)
    return torch.cat([flat[index], flat.mean()[None], flat.square().mean().sqrt()[None]]).float()


def input_of(picture):
    return network_input(batch_of(torch.from_numpy(picture)), picture.shape[:2])


def shifted_inputs(size, fine=None):
    """Both images, and both of them larger or None twice.

    ``fine`` versions repeat pixels: interpolation in whole grey levels would round them either way.
    """
    whole = scene(size[0] + 8, size[1] + 16, channels=3)
    pictures = [whole[: size[0], 16:], whole[8:, : size[1]]]
    images, fine_images = [input_of(picture) for picture in pictures], (None, None)
    if fine is not None:
        rows, columns = (np.arange(many) * few // many for many, few in zip(fine, size, strict=True))
        fine_images = [input_of(picture[rows][:, columns]) for picture in pictures]
    return images, fine_images


@torch.inference_mode()
def computed_values(cases, network, case):
    """What is kept of a case, by the stage's name: samples, and all that was found."""
    kept = {}
    for name, value in cases[network, case]():
        if isinstance(value, Found):
            kept |= {f"{name}, rows": value.rows.int(), f"{name}, values": value.values.float()}
        else:
            kept[name] = sampled(value)
    return kept


def stored_values(network, case):
    with np.load(DATA / f"{network}.npz") as file:
        names = [name for name in file if name.startswith(f"{case}: ")]
        return {name.removeprefix(f"{case}: "): torch.from_numpy(file[name]) for name in names}


def stages_of(cases, network, case):
    stored, got = stored_values(network, case), computed_values(cases, network, case)
    assert list(got) == list(stored), "the stages are not those of the file"
    tolerance = EDGES if network in ("dkm", "roma") else TOLERANCE
    plain = (name for name in got if not name.endswith((", rows", ", values")))
    yield from (
        Stage(name, got[name], stored[name], tolerance * max(stored[name].abs().max().item(), 1e-6))
        for name in plain
    )
    for name in (name.removesuffix(", rows") for name in got if name.endswith(", rows")):
        yield from found_stages(
            name, *(Found(kept[f"{name}, rows"], kept[f"{name}, values"]) for kept in (got, stored))
        )


def found_stages(name, got, expected):
    """How many are others, and what is said of those in common, in shares of each column's largest value."""
    places, known = ({tuple(row): i for i, row in enumerate(found.rows.tolist())} for found in (got, expected))
    others = len(places.keys() ^ known.keys())
    yield Stage(f"{name} that differ", torch.tensor(others), torch.tensor(0), len(known) // LEEWAY)
    common = sorted(places.keys() & known.keys())
    largest = expected.values.abs().amax(dim=0) if known else 1.0
    mine, theirs = (
        found.values[[index[row] for row in common]] / largest
        for found, index in ((got, places), (expected, known))
    )
    yield Stage(f"{name}, values", mine, theirs, TOLERANCE)


def main(cases):
    """Print how far all stages are off; with ``--write``, write the vectors first."""
    networks = dict.fromkeys(network for network, _ in cases)
    for network in networks if "--write" in sys.argv else ():
        arrays = {
            f"{case}: {name}": value.numpy()
            for of, case in cases
            if of == network
            for name, value in computed_values(cases, network, case).items()
        }
        np.savez_compressed(DATA / f"{network}.npz", **arrays)
    for network in networks:
        print_table(network, [(case, stages_of(cases, network, case)) for of, case in cases if of == network])
