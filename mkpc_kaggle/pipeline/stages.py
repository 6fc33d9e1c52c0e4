"""The two-stage pipeline on a chunk of pairs.

Stage 1 matches whole images, MKPC finds the critical region of each image, and stage 2 matches the
crops.

A matcher gets uint8 pictures: (H, W, 3) RGB as :func:`mkpc_kaggle.data.images.read_image` decodes it, or (H, W)
gray by OpenCV, as its ``SPEC.colour`` says. :meth:`mkpc_kaggle.recipe.Unit.view` has their size, and
:meth:`mkpc_kaggle.geometry.coordinates.View.render` cuts them, turns them as EXIF says (mirrored ones stay so),
resizes them, and pads them with black below and on the right to ``SPEC.multiple``. Points come back in pixels of
the whole image.
"""

import time
import warnings
from collections.abc import Callable, Container, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, Self

from mkpc_kaggle.data.images import ByteCache, Image
from mkpc_kaggle.data.masks import MaskReader, Masks
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.critical_region import critical_region
from mkpc_kaggle.geometry.crop_need import CropNeed, crop_need, scale_between
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import (
    Colour,
    Matcher,
    NonFiniteError,
    Picture,
    Precision,
    encoding_bytes,
)
from mkpc_kaggle.matchers.devices import require_device
from mkpc_kaggle.matchers.dtypes import check_finite, exact_float32
from mkpc_kaggle.matchers.failures import FailureKind, failure_kind, reason_of
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.setup.assembly import Assembly

ENCODING_CACHE_BYTES = 2 << 30  # on a CPU
CACHE_SHARE = 0.25  # of a GPU's free memory, for the cached encodings of all workers on it


class UnloadableError(UserError):
    """Error for a matcher that could not be loaded; ``__cause__`` is the error of its load."""


class Pipeline:
    """Pipeline that runs a recipe's units on chunks of pairs and loads each matcher on first use.

    ``load(name)`` returns a matcher. If half precision overflows, ``load_float32(name)`` replaces
    the matcher permanently. ``minibatch`` is the number of pairs to match at a time, and of views
    of one shape to encode. A unit that runs out of memory halves its minibatch from then on.
    Encodings of whole images, which many pairs share, are cached up to ``cache_bytes``.
    Matches with a point that ``masks`` leave out are dropped.
    Errors of the matchers in ``raising`` are raised, and do not become failed results.
    ``synchronise()`` is called after an error, and raises if the device has failed.
    """

    def __init__(
        self,
        recipe: Recipe,
        load: Callable[[str], Matcher[Any]],
        *,
        minibatch: int = 1,
        cache_bytes: int = ENCODING_CACHE_BYTES,
        load_float32: Callable[[str], Matcher[Any]] | None = None,
        masks: Masks | None = None,
        synchronise: Callable[[], None] | None = None,
    ) -> None:
        self.raising: Container[str] = ()
        self._masks = MaskReader(masks or Masks())
        self.recipe = recipe
        self.minibatch = minibatch
        self._load = load
        self._load_float32 = load_float32
        self._synchronise = synchronise
        self._minibatches: dict[Unit, int] = {}  # of units that ran out of memory
        self._ran: set[Unit] = set()  # their times no longer include a warm-up
        self._matchers: dict[str, Matcher[Any]] = {}
        self._unloadable: dict[
            str, Exception
        ] = {}  # by matcher; its units fail with the error
        self._notes: dict[str, str] = {}  # on matchers that fell back to float32
        self._encodings = ByteCache(cache_bytes)  # by matcher, content of the image, and view

    @classmethod
    def of(cls, assembly: Assembly) -> Self:
        """Return the pipeline of an assembly, on its device.

        Raises :class:`mkpc_kaggle.matchers.failures.DeviceError` if the device cannot compute.
        """
        placement = assembly.placement
        device = placement.device
        require_device(device)
        # If half precision overflows, a matcher is loaded again with this placement.
        exact = replace(placement, precision=Precision.FLOAT32)
        cache_bytes = ENCODING_CACHE_BYTES
        synchronise = None
        if device != "cpu":
            import torch

            synchronise = partial(torch.cuda.synchronize, device)
            # Of a GPU's own memory: encodings stay where they were computed.
            free, _ = torch.cuda.mem_get_info(device)  # most of the GPU is still free
            cache_bytes = int(free * CACHE_SHARE / assembly.sharing)
        return cls(
            assembly.recipe,
            assembly.load,
            minibatch=assembly.minibatch,
            cache_bytes=cache_bytes,
            load_float32=None
            if exact == placement
            else partial(assembly.load, placement=exact),
            masks=assembly.masks,
            synchronise=synchronise,
        )

    def load(self) -> None:
        """Load all matchers of the recipe now. If a matcher cannot be loaded, only its units fail.

        Raises device and memory errors, and the first matcher's error if none can be loaded.
        """
        for name in self.recipe.matcher_names:
            # Remembered in ``_unloadable``.
            with suppress(UnloadableError):
                self._matcher(name)
        if not self._matchers:
            raise next(iter(self._unloadable.values()))

    @property
    def unloadable(self) -> dict[str, str]:
        """The reason for each matcher that could not be loaded."""
        return {name: _text_of(error) for name, error in self._unloadable.items()}

    def match(
        self,
        pairs: Sequence[PairMatch],
        units: Iterable[Unit],
        may_start: Callable[[Unit, int], bool] = lambda *_: True,
    ) -> list[PairMatch]:
        """Run each unit on the pairs that have no result of it.

        In the order of the recipe: the critical regions of a unit of stage 2 come from the matches of the
        units of stage 1 before it, and it is left out on a pair that lacks one of these for want of time. A
        unit that a pair does not need has a result without matches.
        ``may_start(unit, pairs)`` is called before each minibatch of a unit, with its number of
        pairs. False halves the minibatch, and stops the unit before a single pair. If a
        matcher raises, the minibatch's pairs run one by one, and a pair that raises again gets a
        result with this failure. Raises device errors, memory errors on a single pair (see
        :mod:`mkpc_kaggle.matchers.failures`).
        """
        # The caller's list stays as it is; ``_run`` replaces entries of this one.
        pairs = list(pairs)
        units = sorted(units, key=self.recipe.units.index)
        for number, unit in enumerate(units):
            before = [each for each in units[:number] if each.stage == 1]
            waiting = []
            for index, pair in enumerate(pairs):
                done = {result.unit for result in pair.results}
                if unit in done or (unit.stage == 2 and not done.issuperset(before)):
                    continue
                if unit.stage == 2:
                    pairs[index] = with_regions(pair, self.recipe, unit)
                    need = need_of(unit, pairs[index], self.recipe)
                    if not need.is_needed:
                        result = UnitResult(
                            unit, Matches.empty(), need=need, regions=pairs[index].regions
                        )
                        pairs[index] = replace(pairs[index], results=(*pair.results, result))
                        continue
                waiting.append(index)
            self._run(unit, pairs, waiting, may_start)
        return pairs

    def _run(
        self,
        unit: Unit,
        pairs: list[PairMatch],
        waiting: Sequence[int],
        may_start: Callable[[Unit, int], bool],
    ) -> None:
        """Add the unit's results to the waiting pairs, in place."""
        while waiting:
            size = min(len(waiting), self._minibatches.get(unit, self.minibatch))
            while size and not may_start(unit, size):
                size //= 2
            if not size:
                return
            numbers = waiting[:size]
            results = self._run_minibatch(unit, [pairs[number] for number in numbers])
            if results is None:
                continue
            for number, result in zip(numbers, results, strict=True):
                pairs[number] = replace(
                    pairs[number], results=(*pairs[number].results, result)
                )
            waiting = waiting[size:]

    def _run_minibatch(self, unit: Unit, pairs: list[PairMatch]) -> list[UnitResult] | None:
        """Return the unit's result on each pair; ``None`` to run again: in float32, or fewer pairs at a time."""
        try:
            return self._match(unit, pairs)
        except Exception as error:
            failure = failure_kind(error)
            if failure is FailureKind.RAISED:
                self._require_device(unit)
            # A NaN may also come from the pictures; then float32 raises again, and the pair fails.
            is_overflow = isinstance(error, NonFiniteError)
            if is_overflow and self._fall_back_to_float32(unit.matcher, error):
                return None
            if failure is FailureKind.RAISED and unit.matcher in self.raising:
                error.add_note(f"in {unit.name}")
                raise
            if failure is FailureKind.RAISED and len(pairs) == 1:
                reason = (
                    str(error) if isinstance(error, UnloadableError) else reason_of(error)
                )
                return [UnitResult(unit, Matches.empty(), failure=reason)]
            if failure is FailureKind.RAISED:
                return [self._run_alone(unit, pair) for pair in pairs]
            if failure is FailureKind.DEVICE or len(pairs) == 1:
                error.add_note(f"in {unit.name}")
                raise
        # After the handler, because inside it the traceback keeps the minibatch's tensors in
        # memory.
        import torch

        torch.cuda.empty_cache()  # cuBLAS and cuDNN cannot use PyTorch's cached memory
        self._minibatches[unit] = len(pairs) // 2
        return None

    def _run_alone(self, unit: Unit, pair: PairMatch) -> UnitResult:
        """Return the unit's result on a pair."""
        results = self._run_minibatch(unit, [pair])
        # A matcher falls back to float32 once.
        while results is None:
            results = self._run_minibatch(unit, [pair])
        (result,) = results
        return result

    def _require_device(self, unit: Unit) -> None:
        """Raise the device's error if it has failed.

        Kernels run asynchronously: the values of one that failed may first raise another error.
        The pair would then get the wrong reason, and each later pair of this process would fail.
        """
        if self._synchronise is None:
            return
        try:
            self._synchronise()
        except Exception as error:
            error.add_note(f"in {unit.name}")
            raise

    def _fall_back_to_float32(self, name: str, error: Exception) -> bool:
        """Switch the matcher to float32. Return False if it cannot, or has switched before."""
        if self._load_float32 is None or name in self._notes:
            return False
        # First, since it may fail: then the next pair tries it again.
        self._matchers[name] = self._load_float32(name)
        self._notes[name] = f"{name} runs in float32, for in half precision {error}"
        warnings.warn(self._notes[name], RuntimeWarning, stacklevel=2)
        # Encodings in half precision would be matched in float32.
        self._encodings = ByteCache(self._encodings.limit)
        return True

    def _match(self, unit: Unit, pairs: list[PairMatch]) -> list[UnitResult]:
        """Encode and match the unit's views of the pairs, in one minibatch."""
        matcher = self._matcher(unit.matcher)
        views = [views_of(unit, matcher.spec.multiple, pair) for pair in pairs]
        start = time.perf_counter()
        shown: list[tuple[Image, View]] = []
        for pair, both in zip(pairs, views, strict=True):
            shown += zip(pair.images, both, strict=True)
        encodings = self._encode(unit, shown)
        encoded = time.perf_counter()
        firsts = encodings[::2]
        with exact_float32():
            found = matcher.match(firsts, encodings[1::2])
        matched = time.perf_counter()
        require_answers(found, len(pairs), f"match of {unit.matcher!r}")
        warm_up = unit not in self._ran
        self._ran.add(unit)
        results = []
        for pair, both, encoding, matches in zip(pairs, views, firsts, found, strict=True):
            in_image = self._unmasked(matches.to_image(*both), pair.images)
            best = in_image.best(unit.max_matches)
            result = UnitResult(
                unit,
                best,
                (encoded - start) / len(pairs),
                (matched - encoded) / len(pairs),
                warm_up=warm_up,
                note=self._notes.get(unit.matcher, ""),
                keypoints=len(getattr(encoding, "points", ())),
                need=need_of(unit, pair, self.recipe) if unit.stage == 2 else None,
                regions=pair.regions if unit.stage == 2 else None,
            )
            results.append(result)
        return results

    def _unmasked(self, matches: Matches, images: Sequence[Image]) -> Matches:
        """Return the matches with both points on pixels that the images' masks leave."""
        first, second = images
        shown0 = self._masks.shows(first.name, matches.points0, first.size)
        shown1 = self._masks.shows(second.name, matches.points1, second.size)
        return matches[shown0 & shown1]

    def _encode(self, unit: Unit, wanted: Sequence[tuple[Image, View]]) -> list[Any]:
        """Return the encodings of views: cached, or computed one shape at a time."""
        matcher = self._matcher(unit.matcher)
        is_gray = matcher.spec.colour == Colour.GRAY  # or its text
        # Units of one matcher that see the same view share its encoding. By content: a file that is
        # replaced during a run keeps its name.
        keys = [(unit.matcher, image.version or image.name, view) for image, view in wanted]
        # Held here, as the cache may drop an encoding before it is matched.
        by_key = {key: self._encodings.get(key) for key in keys}
        missing: dict[tuple[str, str, View], Image] = {}  # a view of several pairs once
        for key, (image, _) in zip(keys, wanted, strict=True):
            if by_key[key] is None:
                missing[key] = image
        size = self._minibatches.get(unit, self.minibatch)
        # A minibatch is one tensor, so its views have one shape.
        for shape in dict.fromkeys(view.padded for _, _, view in missing):
            alike = [key for key in missing if key[2].padded == shape]
            for start in range(0, len(alike), size):
                part = alike[start : start + size]
                pictures = []
                for key in part:
                    view = key[2]
                    pixels = missing[key].gray if is_gray else missing[key].pixels
                    pictures.append(Picture(view.render(pixels), view))
                with exact_float32():
                    encodings = matcher.encode(pictures)
                if not hasattr(encodings, "__len__") or len(encodings) != len(pictures):
                    raise TypeError(
                        f"encode of {unit.matcher!r} must return an item for each of "
                        f"{plural(len(pictures), 'picture')}"
                    )
                check_finite(f"features of {unit.matcher}", list(encodings))
                by_key |= zip(part, encodings, strict=True)
        for key, image in missing.items():
            if key[2].crop == Box.whole(image.size):  # a crop serves one pair only
                self._encodings.put(key, by_key[key], encoding_bytes(by_key[key]))
        return [by_key[key] for key in keys]

    def _matcher(self, name: str) -> Matcher[Any]:
        """Return the matcher, loaded on first use.

        Raises :class:`UnloadableError` at every call after a first load that failed. Errors of
        memory and of the device pass unchanged: a new worker may load the matcher.
        """
        if name not in self._matchers and name not in self._unloadable:
            try:
                self._matchers[name] = self._load(name)
            except Exception as error:
                if failure_kind(error) is not FailureKind.RAISED:
                    raise
                # Not tried again: reading gigabytes for each minibatch would fail each time.
                self._unloadable[name] = error
        if name in self._unloadable:
            cause = self._unloadable[name]
            raise UnloadableError(f"{name} cannot be loaded: {_text_of(cause)}") from cause
        return self._matchers[name]


def require_answers(answers: Any, count: int, what: str) -> None:
    """Raise ``TypeError`` unless ``answers`` is a sequence of ``count`` :class:`Matches`."""
    is_sequence = isinstance(answers, Sequence) and len(answers) == count
    if not is_sequence or not all(isinstance(answer, Matches) for answer in answers):
        raise TypeError(
            f"{what} must return a list of Matches, one for each of {plural(count, 'pair')}, "
            f"not {answers!r:.80}"
        )


def _text_of(error: Exception) -> str:
    """Return the reason of a load that failed; a message for users needs no type before it."""
    return str(error) if isinstance(error, UserError) else reason_of(error)


def views_of(unit: Unit, multiple: int, pair: PairMatch) -> tuple[View, ...]:
    """Return the unit's views of both images: whole in stage 1, critical regions in stage 2."""
    crops = [region.box for region in pair.regions or ()] if unit.stage == 2 else []
    boxes = crops or [Box.whole(image.size) for image in pair.images]
    both = zip(boxes, pair.images, strict=True)
    return tuple(unit.view(box, multiple, image.turns) for box, image in both)


def need_of(unit: Unit, pair: PairMatch, recipe: Recipe) -> CropNeed:
    """Return whether a pair with critical regions needs a unit of stage 2."""
    assert pair.regions is not None
    image0, image1 = pair.images
    region0, region1 = pair.regions
    seen = [result.unit for result in _before(pair, recipe, unit)]

    def whole(size: Size) -> float:
        # The finest view of stage 1; without one, the image as it is stored.
        return max((_scale_of(first, Box.whole(size)) for first in seen), default=1.0)

    return crop_need(
        (region0, region1),
        pair.scale,
        (whole(image0.size), whole(image1.size)),
        (_scale_of(unit, region0.box), _scale_of(unit, region1.box)),
        recipe.mkpc,
    )


def _scale_of(unit: Unit, crop: Box) -> float:
    """Return the view pixels per image pixel of a unit's view of a crop, the smaller of both axes."""
    # Padding does not change it, nor do turns, unless the view is stretched.
    return min(unit.view(crop, multiple=1).scale)


def with_regions(pair: PairMatch, recipe: Recipe, crop: Unit) -> PairMatch:
    """Return the pair with each image's critical region for a unit of stage 2."""
    found = _before(pair, recipe, crop)
    matches = Matches.concatenate(result.matches for result in found)
    image0, image1 = pair.images
    region0 = critical_region(matches.points0, image0.size, recipe.mkpc)
    region1 = critical_region(matches.points1, image1.size, recipe.mkpc)
    scale = scale_between(matches, (image0.size, image1.size))
    return replace(pair, regions=(region0, region1), scale=scale)


def _before(pair: PairMatch, recipe: Recipe, crop: Unit) -> list[UnitResult]:
    """Return the pair's results of stage 1 before a unit of stage 2, in the recipe's order."""
    order = recipe.units.index
    found = [result for result in pair.results if result.unit.stage == 1]
    return sorted(
        (result for result in found if order(result.unit) < order(crop)),
        key=lambda result: order(result.unit),
    )
