"""Stand-in checkpoints of the paper's matchers in the public files' own formats, and a manifest
that they fit.
"""

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from standin import STAND_INS, narrow_roma, standin_state
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.loma import Loma, Variant
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.networks.superglue import SuperGlue
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint
from mkpc_kaggle.setup import assembly
from mkpc_kaggle.weights import WeightFile, WeightStore


def wrapped(state: dict[str, Tensor]) -> dict[str, Any]:
    """Return a state as a training run saves it: under a prefix, with counters of the training."""
    prefixed = {f"matcher.{name}": tensor for name, tensor in state.items()}
    return {"epoch": 29, "global_step": 12345, "state_dict": prefixed}


def wrapped_aspanformer(state: dict[str, Tensor]) -> dict[str, Any]:
    """With the offsets that the published network keeps and does not read."""
    offsets = {
        f"loftr_coarse.layers.{index}.attention.sample_offset": torch.ones(64, 2)
        for index in range(4)
    }
    return wrapped(state | offsets)


def roma_alone(state: dict[str, Tensor]) -> dict[str, Any]:
    return {name: tensor for name, tensor in state.items() if not name.startswith("dinov2.")}


def dinov2_alone(state: dict[str, Tensor]) -> dict[str, Any]:
    """Return the backbone, which is a separate file."""
    found = {}
    for name, tensor in state.items():
        if name.startswith("dinov2."):
            found[name.removeprefix("dinov2.")] = tensor
    return found


def published_loma(state: dict[str, Tensor]) -> dict[str, Any]:
    """The matcher's names bare, with the assignments of the other layers that training had."""
    names = {name: name.removeprefix("matcher.") for name in state}
    names |= {
        name: f"_{name}" for name in state if name.startswith(("detector.", "descriptor."))
    }
    earlier = {
        f"log_assignment.{index}.matchability.bias": torch.ones(1) for index in range(9)
    }
    return {names[name]: tensor for name, tensor in state.items()} | earlier


@dataclass(frozen=True)
class PublicFile:
    """One public checkpoint: its matcher, its slot of the manifest, the network that it fills, its
    layout.
    """

    name: str
    matcher: str
    slot: str
    standin: str
    network: Callable[[], nn.Module]
    layout: Callable[[dict[str, Tensor]], dict[str, Any]] = lambda state: state


FILES = (
    PublicFile("superpoint_v1.pth", "superglue", "superpoint", "superpoint", SuperPoint),
    PublicFile(
        "superglue_outdoor.pth", "superglue", "superglue-outdoor", "superglue", SuperGlue
    ),
    PublicFile("outdoor_ds.ckpt", "loftr", "loftr-outdoor", "loftr", Loftr, wrapped),
    PublicFile(
        "quadtree_outdoor.ckpt", "quadtree", "quadtree-outdoor", "quadtree", Quadtree, wrapped
    ),
    PublicFile(
        "aspan.pt",
        "aspanformer",
        "aspanformer-outdoor",
        "aspanformer",
        AspanFormer,
        wrapped_aspanformer,
    ),
    PublicFile("DKMv3_outdoor.pth", "dkm", "dkm-outdoor", "dkm", DKM),
    # Narrow ones, which load where ``adapters.roma.RoMa`` is ``narrow_roma``, too.
    PublicFile("roma_outdoor.pth", "roma", "roma-outdoor", "roma", narrow_roma, roma_alone),
    PublicFile(
        "dinov2_vitl14_pretrain.pth",
        "roma",
        "dinov2-vitl14",
        "roma",
        narrow_roma,
        dinov2_alone,
    ),
    PublicFile(
        "loma_B128.pth",
        "loma",
        "loma-b128",
        "loma",
        lambda: Loma(Variant.B128),
        published_loma,
    ),
)


def write_checkpoints(
    directory: Path, files: Iterable[PublicFile] = FILES
) -> tuple[WeightFile, ...]:
    lines = []
    for file in files:
        path = directory / file.name
        torch.save(file.layout(standin_state(file.network(), STAND_INS[file.standin])), path)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        lines.append(WeightFile(file.slot, "none", sha256=digest, name=file.name))
    return tuple(lines)


def store_of(directory: Path, files: Iterable[PublicFile]) -> WeightStore:
    return WeightStore([directory], write_checkpoints(directory, files))


def use_manifest(monkeypatch: pytest.MonkeyPatch, lines: tuple[WeightFile, ...]) -> None:
    """Let runs compare weights with these lines instead of the package's."""
    # Stand-in files have other digests than the published ones.
    with_lines = partial(WeightStore, files=lines)
    monkeypatch.setattr(assembly, "WeightStore", with_lines)
