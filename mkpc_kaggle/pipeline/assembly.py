"""Puts a run's parts together: a recipe by name, the weights it finds, the device, the matchers."""

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Matcher, Placement, Precision
from mkpc_kaggle.matchers.registry import load_matcher
from mkpc_kaggle.pipeline.failures import require_device
from mkpc_kaggle.pipeline.gpus import capabilities, encoding_cache_bytes, gpus_of
from mkpc_kaggle.pipeline.obstacles import Check, Hindrance, Licence, Obstacle, require_none
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.pipeline.units import ENCODING_CACHE_BYTES
from mkpc_kaggle.pipeline.uses import options_of, slots_of
from mkpc_kaggle.recipe import Mode, Recipe, Unit, load_recipe
from mkpc_kaggle.weights import FoundFile, WeightStore
from mkpc_kaggle.weights.notices import warn_once

AUTO = "auto"
CUDA_BATCH = 8


@dataclass(frozen=True)
class Assembly:
    """All that a worker needs to build its pipeline.

    ``left_out`` are the units of recipe ``auto`` that cannot run here, or not with these weights, and those of any
    recipe that a fallback replaces; ``unavailable`` says of each of their matchers why. ``matchers`` are the
    user's own. ``device`` is what the user asked for, be it here or elsewhere; ``sharing``: how many workers there
    are on the placement's device.
    """

    recipe: Recipe
    weights: WeightStore
    placement: Placement
    left_out: tuple[Unit, ...] = ()
    unavailable: Mapping[str, str] = field(default_factory=dict)
    matchers: Mapping[str, Matcher[Any]] = field(default_factory=dict)
    device: str = AUTO
    sharing: int = 1

    @property
    def devices(self) -> tuple[str, ...]:
        """The devices to work on: every GPU where the placement names none of them."""
        if self.placement.device != "cuda":
            return (self.placement.device,)
        return tuple(f"cuda:{number}" for number in gpus_of("cuda"))

    @property
    def batch(self) -> int:
        """How many pairs a unit takes at a time: batches pay on a GPU; on a CPU they only cost memory."""
        return CUDA_BATCH if self.placement.device.startswith("cuda") else 1

    def on(self, device: str, sharing: int = 1) -> "Assembly":
        """The same on one device, which so many workers share."""
        return replace(self, placement=replace(self.placement, device=device), sharing=sharing)

    def on_cpu(self) -> "Assembly":
        """The same on the CPU, in float32."""
        return replace(self, placement=Placement(), sharing=1)

    def with_weights_in(self, directory: Path, fetch: Callable[[Path], bytes]) -> "Assembly":
        """The same with its weight files in an empty directory: links to those here, or fetched copies."""
        for found in self.weight_files.values():
            found.link_or_copy(directory, fetch)
        return replace(self, weights=WeightStore([directory], self.weights.files))

    def pipeline(self) -> Pipeline:
        """A pipeline whose matchers are loaded when they are first needed.

        Raises :class:`mkpc_kaggle.pipeline.failures.DeviceError` where nothing can be computed on the device.
        """
        require_device(self.placement.device)
        device, half = self.placement.device, self.placement.precision is not Precision.FLOAT32
        on_gpu = device.startswith("cuda")
        return Pipeline(
            self.recipe,
            self._matcher,
            batch=self.batch,
            cache_bytes=encoding_cache_bytes(device, self.sharing) if on_gpu else ENCODING_CACHE_BYTES,
            load_float32=self._float32_matcher if half else None,
        )

    def fingerprint(self) -> dict[str, Any]:
        """What decides the numbers that come out: the recipe, the precision and the digests of the weights."""
        return {
            "recipe": self.recipe.fingerprint(),
            "precision": self.placement.precision,
            "weights": {slot: file.digest for slot, file in self.weight_files.items()},
        }

    @property
    def weight_files(self) -> dict[str, FoundFile]:
        """The files that the recipe's matchers load, by slot."""
        slots = slots_of(self.recipe, not_own(self.recipe.matcher_names, self.matchers))
        found = {slot: self.weights.find(slot) for slot in slots}
        return {slot: file for slot, file in found.items() if file is not None}

    def _matcher(self, name: str) -> Matcher[Any]:
        return self._placed(name, self.placement)

    def _float32_matcher(self, name: str) -> Matcher[Any]:
        return self._placed(name, replace(self.placement, precision=Precision.FLOAT32))

    def _placed(self, name: str, placement: Placement) -> Matcher[Any]:
        own = self.matchers.get(name)
        return own or load_matcher(name, self.weights, options_of(self.recipe, name), placement)


def assemble(
    recipe: Recipe | str,
    *,
    weights: Iterable[Path] = (),
    device: str = AUTO,
    precision: str = Precision.FLOAT32,
    mode: Mode = Mode.TWO_STAGE,
    scenes: bool | None = None,
    licence: Licence = Licence.ANY,
    matchers: Mapping[str, Matcher[Any]] | None = None,
) -> Assembly:
    """Everything checked before any work: recipe, options, licences, weights and their digests, device, precision.

    Recipe ``auto`` drops the units whose matcher cannot be imported here, with a warning, and those whose weights
    are missing, damaged or not permitted; of any other recipe such units take their fallback, and without one
    raise :class:`UserError`, as do unknown names. ``scenes`` switches the reconstruction of batches on or off;
    ``None``: as the recipe has it.
    """
    own = matchers or {}
    check = Check(WeightStore(weights), licence, own)
    written = load_recipe(recipe) if isinstance(recipe, str) else recipe
    whole, replaced = with_fallbacks(written, check)
    obstacles = check.obstacles(whole, whole.matcher_names, load=recipe == AUTO)
    if recipe == AUTO:
        warn_of(obstacles)
    else:
        require_none(whole, obstacles, check.store)
    left = {one.matcher for one in obstacles}
    for name in sorted(whole.matchers.keys() - own.keys() - left):
        options_of(whole, name)  # those of a matcher that no unit names are checked too
    chosen = whole.only(lambda unit: unit.matcher not in left).with_scenes(scenes)
    left_out = tuple(unit for unit in written.units if replace(unit, fallback="") not in chosen.units)
    unavailable = {one.matcher: str(one.hindrance) for one in (*replaced, *obstacles)}
    placement = resolve_placement(device, precision)
    made = Assembly(chosen.in_mode(mode), check.store, placement, left_out, unavailable, own, device)
    warn_of_unverified(made.weight_files.values())
    return made


def with_fallbacks(recipe: Recipe, check: Check) -> tuple[Recipe, list[Obstacle]]:
    """The recipe with its fallbacks for matchers that cannot run here, and why these cannot."""
    fallbacks = {unit.matcher: unit.fallback for unit in recipe.units if unit.fallback}
    for name in not_own(fallbacks.values(), check.own):
        options_of(recipe, name)  # an unknown one is an error even where it is not needed
    replaced = check.obstacles(recipe, not_own(fallbacks, check.own))
    return recipe.decided({one.matcher for one in replaced}), replaced


def warn_of(obstacles: Iterable[Obstacle]) -> None:
    """Recipe ``auto`` says what is broken; that weights are not there is in its summary."""
    for one in obstacles:
        if one.hindrance is Hindrance.BROKEN:
            warn_once(f"recipe auto does without it: {one.details[0]}")
        elif one.hindrance is Hindrance.UNREADABLE:
            warn_once(f"recipe auto does without {one.matcher}: {one.details[0]}")


def warn_of_unverified(files: Iterable[FoundFile]) -> None:
    """Name the files that nobody can vouch for in one line, before any work."""
    names = sorted(found.file.name for found in files if not found.verified)
    if names:
        listed = ", ".join(names)
        warn_once(f"weights not verified: {listed}; `python -m mkpc_kaggle weights verify` says why")


def not_own(names: Iterable[str], own: Container[str]) -> list[str]:
    """The names but those of the user's own matchers, which bring their weights along."""
    return [name for name in names if name not in own]


def resolve_placement(device: str, precision: str) -> Placement:
    """The placement that the user's words mean; :class:`UserError` for what is unknown or not there."""
    where = resolve_device(device)
    if precision == AUTO:
        return Placement(where, fastest_precision(where))
    if precision not in list(Precision):
        raise UserError(f"unknown precision {precision!r}; known: auto, {', '.join(Precision)}")
    return Placement(where, Precision(precision))


def fastest_precision(device: str) -> Precision:
    """Half precision where the device has units for it; of several GPUs, where each of them has."""
    import torch

    if device.startswith("cuda"):
        able_gpus = [capability >= (7, 0) for capability in capabilities()]  # with tensor cores
        return Precision.FLOAT16 if all(able_gpus[gpu] for gpu in gpus_of(device)) else Precision.FLOAT32
    # Older versions of PyTorch do not tell; then float32 is safe.
    able: Mapping[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return Precision.BFLOAT16 if able.get("avx512_bf16") or able.get("amx_bf16") else Precision.FLOAT32


def _gpus_compute() -> bool:
    try:
        return bool(capabilities())
    except UserError as error:
        warn_once(f"the CPU does the work: {error}")
        return False


def resolve_device(device: str) -> str:
    """``auto`` becomes the GPUs, "cuda", or the CPU where none computes; :class:`UserError` for one not there."""
    import torch

    if device == AUTO:
        return "cuda" if torch.cuda.is_available() and _gpus_compute() else "cpu"
    if device != "cpu":
        gpus_of(device)
    return device
