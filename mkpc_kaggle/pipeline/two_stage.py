"""The Python API: two images in, matches and two-view model out."""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import repeat
from os import PathLike
from types import MappingProxyType
from typing import Any

from mkpc_kaggle.data.images import Image, ImageStore
from mkpc_kaggle.errors import plural
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.resolution import doubt_about_resolution
from mkpc_kaggle.geometry.robust import FailedEstimate, ModelKind
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.matchers.registry import require_methods
from mkpc_kaggle.pipeline.pair import PairMatch, with_estimate
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.progress import counted
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.setup.arguments import (
    ImageSource,
    Weights,
    as_image,
    files_of,
    intrinsics_of,
    member_of,
    shown_value,
)
from mkpc_kaggle.setup.assembly import assemble
from mkpc_kaggle.setup.availability import Licence

__all__ = ["TwoStageMatcher", "as_image"]

Intrinsics = tuple[Matrix3, Matrix3]


class TwoStageMatcher:
    """Matcher of pairs of images: two stages, then a two-view model.

    A matcher can be pickled if the user's own matchers can. A copy loads its networks again.

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
    licence : str
        "permissive" refuses weights that forbid some uses.
    matchers : mapping
        Custom matchers, by their names in the recipe's units.
    settings : mapping
        Replacements of the recipe's settings by dotted key, such as
        ``{"matchers.loftr.threshold": 0.3}``.
    progress : bool
        Count the units of a call on the standard error stream.

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
        licence: Licence | str = Licence.ANY,
        matchers: Mapping[str, Matcher[Any]] | None = None,
        settings: Mapping[str, Any] = MappingProxyType({}),
        progress: bool = False,
    ) -> None:
        self._assembly = assemble(
            recipe,
            weights=weights,
            device=device,
            precision=precision,
            licence=member_of(Licence, licence, "licence"),
            matchers=matchers,
            settings=settings,
        )
        self.recipe = self._assembly.recipe
        self._progress = progress
        self._pipeline = self._new_pipeline()

    def _new_pipeline(self) -> Pipeline:
        require_methods(self._assembly.matchers)
        pipeline = Pipeline.of(self._assembly)
        # A fault of the user's own code is the user's to see.
        pipeline.raising = self._assembly.matchers.keys()
        pipeline.keeps_keypoints = True
        return pipeline

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the loaded matchers."""
        return {name: value for name, value in vars(self).items() if name != "_pipeline"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._pipeline = self._new_pipeline()

    def __call__(
        self,
        image0: ImageSource,
        image1: ImageSource,
        *,
        model: ModelKind | str = ModelKind.F,
        intrinsics: Intrinsics | None = None,
        descriptors: bool = False,
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
        descriptors : bool
            Keep the descriptors of matchers that detect keypoints, in ``match.keypoints``.

        Returns
        -------
        PairMatch
            Points, boxes and F are in pixels of the stored files; EXIF only turns the matchers'
            views upright. If no model is found, ``match.estimate`` is false, its ``failure`` has
            the reason, and the use of its matrix raises it. The result keeps no images.

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
            For a unit that fails; ``match.failures`` has its reason.
        """
        kind = member_of(ModelKind, model, "model")
        sources = (image0, image1)
        images = (as_image(image0, name="image0"), as_image(image1, name="image1"))
        self._pipeline.keeps_descriptors = descriptors
        match = self._match(images, kind, intrinsics, progress=self._progress)
        return replace(match, files=files_of(sources))

    def match_pairs(
        self,
        pairs: Iterable[Sequence[ImageSource]],
        *,
        model: ModelKind | str = ModelKind.F,
        intrinsics: Iterable[Intrinsics | None] | None = None,
        descriptors: bool = False,
    ) -> Iterator[PairMatch]:
        """Yield the match of each pair, as a call does for one pair.

        An image that appears in several pairs is decoded and encoded once, while the caches have
        room: sort the pairs by their first image.

        Parameters
        ----------
        pairs : iterable of two images
            Images as for a call.
        model, descriptors
            As for a call.
        intrinsics : iterable, optional
            An item for each pair, as for a call; it may be ``None``.

        Yields
        ------
        PairMatch
            In the order of the pairs; a pair is matched when the loop asks for it.

        Raises
        ------
        TypeError, ValueError, UserError
            As a call does; for wrong arguments of a pair when its turn comes.
        """
        kind = member_of(ModelKind, model, "model")
        if isinstance(pairs, str | bytes) or not hasattr(pairs, "__iter__"):
            raise TypeError(f"pairs is {shown_value(pairs)}; expected pairs of images")
        # Checked when they are iterated, because they may be generators.
        each = (
            pairs,
            _of_each_pair(intrinsics, "intrinsics"),
        )
        return self._match_each(zip(*each, strict=False), kind, descriptors=descriptors)

    def _match_each(
        self, given: Iterable[tuple[Any, Any]], kind: ModelKind, *, descriptors: bool
    ) -> Iterator[PairMatch]:
        # Closed also if the caller stops early: its thread would keep the process alive.
        with closing(ImageStore()) as store:
            for number, (pair, intrinsics) in enumerate(given):
                name = f"pairs[{number}]"
                if isinstance(pair, str) or not hasattr(pair, "__len__") or len(pair) != 2:
                    raise TypeError(f"{name} is {shown_value(pair)}; expected two images")
                first, second = pair
                images = (
                    as_image(first, store, f"{name}[0]"),
                    as_image(second, store, f"{name}[1]"),
                )
                # Set for each pair: another call may come between.
                self._pipeline.keeps_descriptors = descriptors
                match = self._match(images, kind, intrinsics)
                yield replace(match, files=files_of(pair))

    def _match(
        self,
        images: tuple[Image, Image],
        kind: ModelKind,
        intrinsics: Intrinsics | None,
        *,
        progress: bool = False,
    ) -> PairMatch:
        """Check the arguments of a pair, run all units, and estimate the model."""
        matrices = intrinsics_of(intrinsics)
        if kind is ModelKind.E and matrices is None:
            raise ValueError(
                "model E needs intrinsics=(K0, K1), the camera matrices of both images in pixels"
            )
        for number, K in enumerate(matrices or ()):
            if doubt := doubt_about_resolution(K, images[number].size):
                warnings.warn(f"intrinsics[{number}]: {doubt}", RuntimeWarning, stacklevel=3)
        (pair,) = self._run(images, progress=progress)
        match = _for_programs(with_estimate(pair, self.recipe, kind, matrices))
        match = replace(match, mkpc=self.recipe.mkpc)
        for name, reason in match.failures.items():
            warnings.warn(f"unit {name} failed: {reason}", RuntimeWarning, stacklevel=3)
        return match

    def _run(self, images: tuple[Image, Image], *, progress: bool) -> list[PairMatch]:
        """Run all units on a pair, with a bar if the user wants one."""
        pair = PairMatch(images=images)
        units = self.recipe.units
        if not progress:
            return self._pipeline.match([pair], units)
        bar = counted(units, f"matching by recipe {self.recipe.name}", "unit")
        begun: set[Unit] = set()

        def may_start(unit: Unit, _: int) -> bool:
            # A unit that is tried again, in float32, counts once.
            if unit not in begun:
                begun.add(unit)
                next(bar)
            return True

        # Closed even if a unit raises: its error is printed below the bar.
        with closing(bar):
            return self._pipeline.match([pair], units, may_start)


def _of_each_pair(values: Iterable[Any] | None, name: str) -> Iterator[Any]:
    """Yield an argument's item for each pair. Raise ``ValueError`` for a pair without one."""
    if values is None:
        yield from repeat(None)
    else:
        count = 0
        for value in values:
            yield value
            count += 1
        raise ValueError(f"{name} has items for {plural(count, 'pair')} only")


def _for_programs(match: PairMatch) -> PairMatch:
    """Return a match without its images, whose failed estimate cannot be used by mistake."""
    sizes = tuple(image.size for image in match.images)
    focals = tuple(image.focal for image in match.images)
    estimate = match.estimate
    if not estimate:
        reasons = dict.fromkeys(match.failures.values())
        has_points = len(match.failures) < len(match.results)
        reason = estimate.failure if has_points else f"every unit failed: {'; '.join(reasons)}"
        estimate = FailedEstimate.of(estimate, reason)
    return replace(match, estimate=estimate, images=(), sizes=sizes, focals=focals)
