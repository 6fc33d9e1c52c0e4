"""LightGlue (Lindenberger et al. 2023, kornia's network): shared by all matchers that use it."""

import re
from typing import Any

import torch
from kornia.feature import LightGlue
from torch import Tensor

from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, PairwiseMatcher, Placement
from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.placement import autocast
from mkpc_kaggle.matchers.sparse import Encode, Keypoints, matches_of
from mkpc_kaggle.weights import WeightStore, load_into


class LightGlueMatcher(PairwiseMatcher[Keypoints]):
    """LightGlue on an encoder's keypoints. Scores are LightGlue's, above kornia's default threshold of 0.1."""

    def __init__(self, spec: MatcherSpec, encode: Encode, glue: LightGlue, placement: Placement) -> None:
        self.spec = spec
        self.placement = placement
        self.encode = encode
        self._glue = glue.eval().to(placement.device)
        # Autocast the layers only; their inputs and outputs are float32. Positions of keypoints and scores stay
        # float32. An autocast around LightGlue has no effect: LightGlue turns it off.
        for layer in glue.transformers:
            layer.forward = autocast(placement)(layer.forward)

    def _match(self, keypoints0: Keypoints, keypoints1: Keypoints) -> Matches:
        if len(keypoints0) == 0 or len(keypoints1) == 0:
            return Matches.empty()
        found = self._glue({"image0": _glue_input(keypoints0), "image1": _glue_input(keypoints1)})
        check_finite(f"scores of {self.spec.name}", found["log_assignment"])
        index0, index1 = found["matches"][0].T
        return matches_of(keypoints0.points, keypoints1.points, index0, index1, found["scores"][0])


def _glue_input(keypoints: Keypoints) -> dict[str, Tensor]:
    given = {
        "keypoints": keypoints.points[None],
        "descriptors": keypoints.descriptors[None],
        "image_size": keypoints.points.new_tensor([keypoints.content]),
    }
    if keypoints.scales is not None and keypoints.orientations is not None:
        given |= {"scales": keypoints.scales[None], "oris": keypoints.orientations[None]}
    return given


def load_lightglue(
    spec: MatcherSpec, encode: Encode, weights: WeightStore, placement: Placement, **shape: Any
) -> LightGlueMatcher:
    """Load LightGlue from the weights of the spec's last slot, with as many layers as these have."""
    slot = spec.slots[-1]
    tensors = {layer_name(name): tensor for name, tensor in weights.load(slot).items()}
    numbers = (int(name.split(".")[1]) for name in tensors if name.startswith("transformers."))
    layers = 1 + max(numbers, default=0)
    glue = light_glue(layers, **shape)
    # Without early stopping and pruning, only the last layer's assignment is used. Some files also have a learned
    # number per assignment, or the extractor that was trained with LightGlue.
    assignment = rf"log_assignment\.(?!{layers - 1}\.(matchability|final_proj)\.)"
    early = rf"token_confidence\.|confidence_thresholds|{assignment}|extractor\."
    load_into(glue, tensors, unused=early, what=slot)
    return LightGlueMatcher(spec, encode, glue, placement)


def light_glue(layers: int, **shape: Any) -> LightGlue:
    """Build the network without weights; ``shape`` has kornia's settings, such as ``input_dim``."""
    flash = torch.backends.cuda.flash_sdp_enabled()  # type: ignore[no-untyped-call]  # torch's
    try:
        return LightGlue(
            None,  # type: ignore[arg-type]  # no download; missing in kornia's annotation
            n_layers=layers,
            flash=False,  # else kornia casts queries, keys and values on a GPU to float16, even in float32
            depth_confidence=-1,
            width_confidence=-1,
            **shape,
        )
    finally:
        torch.backends.cuda.enable_flash_sdp(flash)  # kornia changes this setting for the whole process


def layer_name(name: str) -> str:
    """Return the current name of a parameter from an older checkpoint or from a training wrapper."""
    return re.sub(r"^(self|cross)_attn\.(\d+)\.", r"transformers.\2.\1_attn.", name.removeprefix("matcher."))
