"""XFeat keypoints matched by LighterGlue (Potje et al. 2024; kornia's networks)."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from kornia.feature import LightGlue, XFeat
from torch import Tensor

from mkpc_kaggle.config import AT_LEAST_1, SHARE, check_ranges
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture, Placement
from mkpc_kaggle.matchers.networks.placement import autocast
from mkpc_kaggle.matchers.sparse import Keypoints, image_batch, matches_of
from mkpc_kaggle.weights import WeightStore, load_into

XFEAT, LIGHTERGLUE = "xfeat", "xfeat-lighterglue"


@dataclass(frozen=True)
class XFeatLighterGlueOptions:
    """``features``: the strongest kept in each picture. ``threshold``: matches must score above it."""

    features: int = 2048
    threshold: float = 0.1

    def __post_init__(self) -> None:
        check_ranges(self, features=AT_LEAST_1, threshold=SHARE)


SPEC = MatcherSpec(
    "xfeat_lighterglue",
    "XFeat with LighterGlue: fast, learned",
    XFeatLighterGlueOptions,
    multiple=32,
    licences=("Apache-2.0",),
    slots=(XFEAT, LIGHTERGLUE),
)


class XFeatLighterGlueMatcher:
    """A match's score is LighterGlue's."""

    spec = SPEC

    def __init__(
        self, xfeat: XFeat, glue: LightGlue, options: XFeatLighterGlueOptions, placement: Placement
    ) -> None:
        self.options = options
        self.placement = placement
        self._xfeat = xfeat.eval().to(placement.device)
        self._glue = glue.eval().to(placement.device)

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[Keypoints]:
        batch = image_batch(list(pictures), self.placement.device)
        with autocast(self.placement):
            found = self._xfeat.detectAndCompute(batch, top_k=self.options.features)
        return [
            Keypoints.on_content(features["keypoints"], features["descriptors"], picture.content)
            for features, picture in zip(found, pictures, strict=True)
        ]

    @torch.inference_mode()
    def match(self, encodings0: Sequence[Keypoints], encodings1: Sequence[Keypoints]) -> list[Matches]:
        return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _match(self, keypoints0: Keypoints, keypoints1: Keypoints) -> Matches:
        if len(keypoints0) == 0 or len(keypoints1) == 0:
            return Matches.empty()
        with autocast(self.placement):
            found = self._glue({"image0": _glue_input(keypoints0), "image1": _glue_input(keypoints1)})
        pairs, scores = found["matches"][0], found["scores"][0]  # (M, 2), (M,)
        return matches_of(keypoints0, keypoints1, pairs[:, 0], pairs[:, 1], scores)


def _glue_input(keypoints: Keypoints) -> dict[str, Tensor]:
    return {
        "keypoints": keypoints.points[None],
        "descriptors": keypoints.descriptors[None],
        "image_size": keypoints.points.new_tensor([keypoints.content]),
    }


def load(weights: WeightStore, options: XFeatLighterGlueOptions, placement: Placement) -> XFeatLighterGlueMatcher:
    xfeat = XFeat(top_k=options.features)
    # Its fine matcher serves semi-dense matching only; some checkpoints are without it.
    load_into(xfeat.net, weights.load(XFEAT), unused=r"fine_matcher\.", what=XFEAT)
    tensors = {layer_name(name): tensor for name, tensor in weights.load(LIGHTERGLUE).items()}
    layers = 1 + max(int(name.split(".")[1]) for name in tensors if name.startswith("transformers."))
    glue = lighter_glue(layers, options.threshold)
    # Without early stopping and pruning only the last layer's assignment is used.
    early = rf"token_confidence\.|confidence_thresholds|log_assignment\.(?!{layers - 1}\.)"
    load_into(glue, tensors, unused=early, what=LIGHTERGLUE)
    return XFeatLighterGlueMatcher(xfeat, glue, options, placement)


def lighter_glue(layers: int, threshold: float) -> LightGlue:
    """The network without weights; ``threshold`` of a match's score."""
    flash = torch.backends.cuda.flash_sdp_enabled()  # type: ignore[no-untyped-call]  # torch's own
    try:
        return LightGlue(
            None,  # type: ignore[arg-type]  # no download; kornia's annotation leaves it out
            input_dim=64,
            descriptor_dim=96,
            n_layers=layers,
            num_heads=1,
            depth_confidence=-1,
            width_confidence=-1,
            filter_threshold=threshold,
            flash=False,  # which on a GPU is float16, whatever the precision
        )
    finally:
        torch.backends.cuda.enable_flash_sdp(flash)  # kornia sets it for the whole process


def layer_name(name: str) -> str:
    """LightGlue's present parameter name for that of an older checkpoint or of a training wrapper."""
    return re.sub(r"^(self|cross)_attn\.(\d+)\.", r"transformers.\2.\1_attn.", name.removeprefix("matcher."))
