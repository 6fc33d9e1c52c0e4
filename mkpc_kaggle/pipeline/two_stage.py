"""The Python API: two images in, matches and two-view model out."""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from os import PathLike
from types import MappingProxyType
from typing import Any

from mkpc_kaggle.data.images import ImageStore
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.robust import ModelKind
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.pipeline.arguments import ImageSource, as_image, intrinsics_of
from mkpc_kaggle.pipeline.pair import PairMatch, with_estimate
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.setup.assembly import Weights, assemble

Intrinsics = tuple[Matrix3, Matrix3]


class TwoStageMatcher:
    """Matcher of pairs of images: two stages, then a two-view model.

    Parameters
    ----------
    recipe : Recipe, str or path
        A recipe, its name, a path to a TOML file, or the name of a single matcher, such as
        "aliked_lightglue".
    weights : path, iterable of paths, or mapping
        A directory to search for weights, several directories, or files by slot, such as
        ``{"aliked-n16": "mine.pth"}``.
    device : str
        "auto", or torch's name of a device.
    precision : str
        "float32", "bfloat16" or "float16".
    matchers : mapping
        Custom matchers, by their names in the recipe's units.
    settings : mapping
        Replacements of the recipe's settings by dotted key, such as
        ``{"matchers.loftr.threshold": 0.3}``.

    Raises
    ------
    UserError
        For an unknown name, and for missing weights.
    TypeError, ValueError
        For a wrong argument.

    Examples
    --------
    >>> from mkpc_kaggle import TwoStageMatcher
    >>> matcher = TwoStageMatcher("sift")
    >>> match = matcher("a.jpg", "b.jpg")
    >>> match.estimate.matrix.shape, match.estimate.inlier_count > 50
    ((3, 3), True)

    Many pairs with images in common:

    >>> pairs = [("a.jpg", "b.jpg"), ("b.jpg", "a.jpg")]
    >>> [bool(match.estimate) for match in matcher.match_pairs(pairs)]
    [True, True]
    """

    def __init__(
        self,
        recipe: Recipe | str | PathLike[str] = "auto",
        *,
        weights: Weights = (),
        device: str = "auto",
        precision: str = "float32",
        matchers: Mapping[str, Matcher[Any]] | None = None,
        settings: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        assembly = assemble(
            recipe,
            weights=weights,
            device=device,
            precision=precision,
            matchers=matchers,
            settings=settings,
        )
        self.recipe = assembly.recipe
        self._pipeline = Pipeline.of(assembly)
        # A fault of the user's own code is the user's to see.
        self._pipeline.raising = assembly.matchers.keys()

    def __call__(
        self,
        image0: ImageSource,
        image1: ImageSource,
        *,
        model: ModelKind | str = ModelKind.F,
        intrinsics: Intrinsics | None = None,
    ) -> PairMatch:
        """Match two images, and estimate their two-view model.

        Parameters
        ----------
        image0, image1
            Paths, PIL images, arrays (H, W, 3) RGB or (H, W), or tensors (3, H, W); uint8, or
            floats in 0..1.
        model : ModelKind or str
            "F", "E" (needs ``intrinsics``) or "H".
        intrinsics : pair of arrays (3, 3), optional
            The camera matrices, in pixels.

        Returns
        -------
        PairMatch
            Points, boxes and F are in pixels of the stored files; EXIF only turns the matchers'
            views upright. If no model is found, ``match.estimate`` is false, its ``failure`` has
            the reason, and its matrix is the fallback. The result keeps no images.

        Raises
        ------
        TypeError, ValueError
            For a wrong argument, before any matching.
        UserError
            For an unreadable image, before any matching.
        Exception
            Errors of memory, of the device, and of the user's own matchers.

        Warns
        -----
        RuntimeWarning
            For a unit that fails, and if no model is found.
        """
        return self._match((image0, image1), None, ModelKind(model), intrinsics)

    def match_pairs(
        self,
        pairs: Iterable[Sequence[ImageSource]],
        *,
        model: ModelKind | str = ModelKind.F,
        intrinsics: Iterable[Intrinsics | None] | None = None,
    ) -> Iterator[PairMatch]:
        """Yield the match of each pair, as a call does for one pair.

        An image that appears in several pairs is decoded and encoded once, while the caches have
        room: sort the pairs by their first image. ``intrinsics`` has an item for each pair, which may
        be ``None``. A pair is matched when the loop asks for it, and raises what a call raises.
        """
        # Closed also if the caller stops early: its thread would keep the process alive.
        with closing(ImageStore()) as store:
            each: Iterable[tuple[Any, Any]] = ((pair, None) for pair in pairs)
            if intrinsics is not None:
                each = zip(pairs, intrinsics, strict=True)
            for sources, matrices in each:
                yield self._match(sources, store, ModelKind(model), matrices)

    def _match(
        self,
        sources: Sequence[ImageSource],
        store: ImageStore | None,
        kind: ModelKind,
        intrinsics: Intrinsics | None,
    ) -> PairMatch:
        """Check the arguments of a pair, run all units, and estimate the model."""
        matrices = None if intrinsics is None else intrinsics_of(intrinsics)
        if kind is ModelKind.E and matrices is None:
            raise ValueError(
                "model E needs intrinsics=(K0, K1), the camera matrices in pixels"
            )
        source0, source1 = sources
        images = (as_image(source0, store), as_image(source1, store))
        (pair,) = self._pipeline.match([PairMatch(images=images)], self.recipe.units)
        match = with_estimate(pair, self.recipe, kind, matrices)
        for name, reason in match.failures.items():
            warnings.warn(f"unit {name} failed: {reason}", RuntimeWarning, stacklevel=3)
        if not match.estimate:
            text = f"no {kind} was found: {match.estimate.failure}"
            warnings.warn(text, RuntimeWarning, stacklevel=3)
        return replace(
            match,
            images=(),
            sizes=tuple(image.size for image in images),
            focals=tuple(image.focal for image in images),
        )
