"""One unit on a batch of pairs: views, encodings, matches; and what to do where memory or numbers do not hold."""

import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

from mkpc_kaggle.data.cache import ByteCache
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import (
    Colour,
    Matcher,
    MatcherSpec,
    NonFiniteError,
    Picture,
    encoding_bytes,
)
from mkpc_kaggle.matchers.dtypes import check_finite, exact_float32
from mkpc_kaggle.pipeline.failures import Failure, failure_of, reason_of
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Unit

ENCODING_CACHE_BYTES = 2 << 30

ViewKey = tuple[str, str, View]
"""Matcher, image and view: what an encoding is of."""


class UnitRunner:
    """Runs units with matchers that are loaded when first needed.

    ``load(name)`` gives the matcher of that name, ``load_float32(name)`` the same in float32, if that is another:
    where half precision does not hold a matcher's numbers, it takes over for good. Pairs are matched, and views of
    one shape encoded, ``batch`` at a time; fewer by a unit for which memory was short, from then on. Encodings of
    whole images, which come back in many pairs, are kept in ``cache_bytes``.
    """

    def __init__(
        self,
        load: Callable[[str], Matcher[Any]],
        batch: int = 1,
        cache_bytes: int = ENCODING_CACHE_BYTES,
        load_float32: Callable[[str], Matcher[Any]] | None = None,
    ) -> None:
        self._load = load
        self._load_float32 = load_float32
        self._batch = batch
        self._batches: dict[Unit, int] = {}
        self._ran: set[Unit] = set()
        self._matchers: dict[str, Matcher[Any]] = {}
        self._notes: dict[str, str] = {}
        self._encodings: ByteCache[ViewKey, Any] = ByteCache(cache_bytes)

    def matcher(self, name: str) -> Matcher[Any]:
        """The matcher of that name; raises :class:`UserError` where it cannot be loaded."""
        if name not in self._matchers:
            self._matchers[name] = self._load(name)
        return self._matchers[name]

    def batch_of(self, unit: Unit) -> int:
        """How many pairs the unit takes at a time."""
        return self._batches.get(unit, self._batch)

    def run(self, unit: Unit, pairs: list[PairMatch]) -> list[UnitResult]:
        """The unit's result on each of the pairs; none where memory was short and fewer pairs may fit.

        Whatever a matcher raises costs these pairs this unit, not the run: all but errors of the device, and of
        memory that does not suffice for one pair, are results with a reason.
        """
        try:
            return self._run_finite(unit, pairs)
        except Exception as error:
            failure = failure_of(error)
            if failure is Failure.ORDINARY:
                return [UnitResult(unit, Matches.empty(), failure=reason_of(error))] * len(pairs)
            if failure is Failure.DEVICE or len(pairs) == 1:
                error.add_note(f"in {unit.name}")
                raise
        # Not in the handler: until it is left, the error's traceback holds the tensors of the batch.
        release_memory()
        self._batches[unit] = len(pairs) // 2
        return []

    def _run_finite(self, unit: Unit, pairs: list[PairMatch]) -> list[UnitResult]:
        name = unit.matcher
        try:
            results = self._match(unit, pairs)
        except NonFiniteError as error:
            if self._load_float32 is None or name in self._notes:
                raise
            self._notes[name] = f"{name} runs in float32, for in half precision {error}"
            warnings.warn(self._notes[name], RuntimeWarning, stacklevel=2)
            self._encodings = ByteCache(self._encodings.limit)
            self._matchers[name] = self._load_float32(name)
            results = self._match(unit, pairs)
        return [replace(result, failure=self._notes.get(name, "")) for result in results]

    def _match(self, unit: Unit, pairs: list[PairMatch]) -> list[UnitResult]:
        matcher = self.matcher(unit.matcher)
        views = [views_of(unit, matcher.spec, pair) for pair in pairs]
        start = time.perf_counter()
        shown = [zip(pair.images, both, strict=True) for pair, both in zip(pairs, views, strict=True)]
        encodings = self._encode(unit, list(chain.from_iterable(shown)))
        encoded = time.perf_counter()
        with exact_float32():
            found = matcher.match(encodings[::2], encodings[1::2])
        matched = time.perf_counter()
        warm_up = unit not in self._ran
        self._ran.add(unit)
        return [
            UnitResult(
                unit,
                matches.to_image(*both).best(unit.max_matches),
                (encoded - start) / len(pairs),
                (matched - encoded) / len(pairs),
                warm_up=warm_up,
            )
            for matches, both in zip(found, views, strict=True)
        ]

    def _encode(self, unit: Unit, wanted: Sequence[tuple[Image, View]]) -> list[Any]:
        """The encodings of views by the unit's matcher, from the cache or made now, one shape together."""
        keys = [(unit.matcher, image.name, view) for image, view in wanted]
        known = {key: self._encodings.get(key) for key in keys}
        missing = {key: item for key, item in zip(keys, wanted, strict=True) if known[key] is None}
        by_shape: dict[Size, list[ViewKey]] = {}
        for key in missing:
            by_shape.setdefault(key[2].padded, []).append(key)
        size = self.batch_of(unit)
        for alike in by_shape.values():
            for start in range(0, len(alike), size):
                batch = {key: missing[key] for key in alike[start : start + size]}
                known |= self._encode_batch(unit.matcher, batch)
        return [known[key] for key in keys]

    def _encode_batch(self, name: str, batch: dict[ViewKey, tuple[Image, View]]) -> dict[ViewKey, Any]:
        matcher, encoded = self.matcher(name), {}
        pictures = [picture_of(image, view, matcher.spec.colour) for image, view in batch.values()]
        with exact_float32():
            encodings = matcher.encode(pictures)
        check_finite(f"features of {name}", list(encodings))
        for (key, (image, view)), encoding in zip(batch.items(), encodings, strict=True):
            encoded[key] = encoding
            if view.crop == Box.whole(image.size):  # a crop is one pair's own: no other will ask for it
                self._encodings.put(key, encoding, encoding_bytes(encoding))
        return encoded


def release_memory() -> None:
    """Give the GPU the memory back that PyTorch keeps for later: cuBLAS and cuDNN cannot use it."""
    if "torch" in sys.modules:
        import torch

        torch.cuda.empty_cache()


def views_of(unit: Unit, spec: MatcherSpec, pair: PairMatch) -> tuple[View, View]:
    """What a unit looks at: whole images in stage 1, critical regions in stage 2."""
    if unit.stage == 1 or pair.regions is None:
        boxes = [Box.whole(image.size) for image in pair.images]
    else:
        boxes = [region.box for region in pair.regions]
    view0, view1 = (unit.view(box, spec.multiple) for box in boxes)
    return view0, view1


def picture_of(image: Image, view: View, colour: Colour) -> Picture:
    return Picture(view.render(image.gray if colour is Colour.GRAY else image.pixels), view)
