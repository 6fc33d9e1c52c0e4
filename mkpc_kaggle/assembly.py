"""Puts a run's parts together: a recipe by name, the weights it finds, the device, the matchers."""

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.matchers.registry import load_matcher, options_of, slots_of
from mkpc_kaggle.pipeline import Pipeline
from mkpc_kaggle.recipe import Mode, Recipe, Unit, load_recipe
from mkpc_kaggle.weights import WeightStore

AUTO = "auto"
CUDA_BATCH = 8


@dataclass(frozen=True)
class Assembly:
    """All that a worker needs to build its pipeline.

    ``left_out`` are the units of recipe ``auto`` whose weights are missing; ``matchers`` are ready ones of
    the user's own.
    """

    recipe: Recipe
    weights: WeightStore
    device: str
    left_out: tuple[Unit, ...] = ()
    matchers: Mapping[str, Matcher[Any]] = field(default_factory=dict)

    def pipeline(self) -> Pipeline:
        """A pipeline whose matchers are loaded when they are first needed."""
        # Batches pay on a GPU; on a CPU they only cost memory.
        return Pipeline(self.recipe, self._matcher, batch=CUDA_BATCH if self.device.startswith("cuda") else 1)

    def fingerprint(self) -> dict[str, Any]:
        """What decides the numbers that come out: the recipe and the digests of its weights."""
        slots = slots_of(name for name in self.recipe.matcher_names if name not in self.matchers)
        found = {slot: self.weights.find(slot) for slot in slots}
        return {
            "recipe": self.recipe.fingerprint(),
            "weights": {slot: file.digest for slot, file in found.items() if file is not None},
        }

    def _matcher(self, name: str) -> Matcher[Any]:
        return self.matchers.get(name) or load_matcher(self.recipe, name, self.weights, self.device)


def assemble(
    recipe: Recipe | str,
    *,
    weights: Iterable[Path] = (),
    device: str = AUTO,
    mode: Mode = Mode.TWO_STAGE,
    matchers: Mapping[str, Matcher[Any]] | None = None,
) -> Assembly:
    """Everything checked before any work: recipe, options, weights and their digests, device.

    Recipe ``auto`` drops the units whose weights are missing; for any other, missing weights raise
    :class:`UserError`, as do unknown names and damaged files.
    """
    own = matchers or {}
    store = WeightStore(weights)
    wanted = load_recipe(recipe) if isinstance(recipe, str) else recipe
    for name in {*wanted.matcher_names, *wanted.matchers} - own.keys():
        options_of(wanted, name)
    missing = missing_slots(wanted, store, own)
    if missing and recipe != AUTO:
        raise UserError(
            f"recipe {wanted.name!r} needs weights that were not found ({what_is_missing(missing, store)}). "
            "Name their directory with --weights, or use --recipe auto, which does with what there is."
        )
    chosen = wanted.only(lambda unit: unit.matcher in own or not set(slots_of([unit.matcher])) & set(missing))
    left_out = tuple(unit for unit in wanted.units if unit not in chosen.units)
    return Assembly(chosen.in_mode(mode), store, resolve_device(device), left_out, own)


def missing_slots(recipe: Recipe, store: WeightStore, own: Container[str] = ()) -> list[str]:
    """What the recipe's matchers need of the manifest and the store has not."""
    return [slot for slot in slots_of(n for n in recipe.matcher_names if n not in own) if store.find(slot) is None]


def what_is_missing(slots: Iterable[str], store: WeightStore) -> str:
    """The file names that would fill the slots."""
    return "; ".join(f"{slot}: {' or '.join(file.name for file in store.alternatives(slot))}" for slot in slots)


def resolve_device(device: str) -> str:
    """``auto`` becomes the first GPU or the CPU; :class:`UserError` for a GPU that is not there."""
    import torch

    if device == AUTO:
        return "cuda:0" if torch.cuda.is_available() else "cpu"
    if device != "cpu" and not device.startswith("cuda"):
        raise UserError(f"unknown device {device!r}; known: auto, cpu, cuda, cuda:N")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"--device {device}: this machine has no GPU that torch can use; try --device cpu")
    return device
