"""Assembly of a run's parts: recipe, weights, device, matchers.

A matcher is available if its weights are found. Recipe ``auto`` drops the units of other matchers; every
other recipe is refused, with the command that fetches the weights.
"""

import os
import platform
from collections.abc import Container, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias
from uuid import uuid4

import cv2

from mkpc_kaggle.config import from_table
from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.errors import UserError, warn_once
from mkpc_kaggle.geometry.intrinsics import Rows
from mkpc_kaggle.matchers.contract import Matcher, Placement, Precision
from mkpc_kaggle.matchers.devices import AUTO, gpus_of, resolve_placement
from mkpc_kaggle.matchers.registry import MATCHERS, load_matcher, require_matchers, spec_of
from mkpc_kaggle.recipe import (
    Mode,
    Recipe,
    Unit,
    load_recipe,
    recipe_names,
    split_mode,
    with_settings,
)
from mkpc_kaggle.version import __version__
from mkpc_kaggle.weights import FoundFile, WeightStore

PathSource: TypeAlias = str | os.PathLike[str]
Weights: TypeAlias = PathSource | Iterable[PathSource] | Mapping[str, PathSource]

DEFAULT_SIDE_PX = 1024  # of a single matcher that no recipe has
CUDA_MINIBATCH = 8  # pairs at a time; on a CPU, more than one gains nothing and takes memory


@dataclass(frozen=True)
class Assembly:
    """The values from which a worker builds its pipeline."""

    recipe: Recipe
    weights: WeightStore
    placement: Placement
    left_out: tuple[str, ...] = ()  # the recipe's matchers without weights
    # The user's ready matchers
    matchers: Mapping[str, Matcher[Any]] = field(default_factory=dict)
    device: str = AUTO  # as named by the user
    sharing: int = 1  # workers on the placement's device
    masks: Masks = field(default_factory=Masks)
    cameras: Rows = ()  # known ones of scenes, by the user
    # Stands for the version of a matcher without one, so that no later run has the same keys
    nonce: str = field(default_factory=lambda: uuid4().hex)

    @property
    def devices(self) -> tuple[str, ...]:
        """The devices of the placement, one by one: "cuda" means all GPUs."""
        device = self.placement.device
        if device == "cpu":
            return ("cpu",)
        return tuple(f"cuda:{number}" for number in gpus_of(device))

    @property
    def minibatch(self) -> int:
        """The number of pairs to match at a time."""
        return CUDA_MINIBATCH if self.placement.device.startswith("cuda") else 1

    def on(self, device: str, sharing: int = 1) -> "Assembly":
        """Return a copy for one device, shared by ``sharing`` workers."""
        return replace(
            self, placement=replace(self.placement, device=device), sharing=sharing
        )

    def on_cpu(self) -> "Assembly":
        return replace(self, placement=Placement(), sharing=1)

    @property
    def versions(self) -> dict[str, str]:
        """Versions for readers of a report. Keys have only those that change a kind of result for sure."""
        return {
            "mkpc_kaggle": __version__,
            "Python": platform.python_version(),
            "PyTorch": metadata.version("torch"),
            "OpenCV": cv2.__version__,
        }

    def unit_settings(self, unit: Unit) -> dict[str, Any]:
        """Return all settings that determine a unit's points on given views, as JSON values."""
        name = unit.matcher
        fields = asdict(unit)
        del fields["tracks"]  # scenes read the points without changing them
        weights = {}
        for slot in slots_of(self.recipe, {name} - self.matchers.keys()):
            if slot in self.weight_files:
                weights[slot] = f"sha256:{self.weight_files[slot].sha256}"
        # Nothing is known of the options of a user's matcher.
        is_own = name in self.matchers
        settings: dict[str, Any] = {
            "unit": fields,
            "options": None if is_own else asdict(options_of(self.recipe, name)),
            "precision": self.placement.precision,
            "weights": weights,
        }
        # The weights of a matcher of this package have digests, and its code has ``keys.POINTS_VERSION``.
        spec = self.matchers[name].spec if is_own else spec_of(name, f"matcher {name}")
        if is_own:
            settings["version"] = spec.version or self.nonce
        if spec.packages:
            settings["packages"] = {
                package: version_of_package(package) for package in spec.packages
            }
        return settings

    @cached_property
    def weight_files(self) -> dict[str, FoundFile]:
        """The weight files of the recipe's matchers, by slot."""
        names = [name for name in self.recipe.matcher_names if name not in self.matchers]
        files = {}
        for slot in slots_of(self.recipe, names):
            if (file := self.weights.file_of(slot)) is not None:
                files[slot] = file
        return files

    def load(self, name: str, placement: Placement | None = None) -> Matcher[Any]:
        """Load a matcher, on the assembly's placement by default.

        Raises :class:`UserError` that names the weight files if one does not fit its network.
        """
        # The user's matcher has its own precision, and is not loaded twice.
        if name in self.matchers:
            return self.matchers[name]
        options = options_of(self.recipe, name)
        try:
            return load_matcher(name, self.weights, options, placement or self.placement)
        except UserError as error:
            slots = slots_of(self.recipe, [name])
            paths = [str(self.weight_files[slot].path) for slot in slots]
            raise UserError(f"{error} ({', '.join(paths)})") from error


def assemble(
    recipe: Recipe | PathSource,
    *,
    weights: Weights = (),
    device: str = AUTO,
    precision: str = Precision.FLOAT32,
    scenes: bool | None = None,
    matchers: Mapping[str, Matcher[Any]] | None = None,
    settings: Mapping[str, Any] = MappingProxyType({}),
) -> Assembly:
    """Check recipe, options, weights, device and precision; return the assembly.

    ``recipe`` may be the name of a single matcher; of a text, ``:MODE`` at the end is a :class:`Mode`. ``weights``
    are directories, or files by slot.
    ``device`` and ``precision`` may be torch's. ``scenes`` switches the reconstruction of batches
    on or off; ``None`` follows the recipe. ``settings`` replace the recipe's, see
    :func:`mkpc_kaggle.recipe.with_settings`. Raises :class:`UserError`, also if weights of a
    recipe other than ``auto`` are missing.
    """
    mode = Mode.TWO_STAGE
    if not isinstance(recipe, Recipe):
        recipe, mode = split_mode(os.fspath(recipe))
    own = dict(matchers or {})
    require_matchers(own)
    directories, files = weights_of(weights)
    store = WeightStore(directories, chosen=files)
    chosen = recipe_of_name(recipe, own)
    if changes := dict(settings):
        chosen = with_settings(chosen, changes)
    missing = missing_weights(chosen, store, own)
    if missing and recipe != AUTO:
        raise UserError(
            f"recipe {chosen.name!r} needs weights that were not found: {listed(missing, store)}. Name their "
            f"directory with --weights, get them with `{fetch_command(chosen, missing)}`, or use --recipe auto."
        )
    chosen = chosen.without(missing)
    for name in sorted(chosen.matchers.keys() - own.keys()):
        options_of(chosen, name)  # check the options of unused matchers too
    chosen = chosen.with_scenes(scenes).in_mode(mode)
    placement = resolve_placement(str(device), str(precision).removeprefix("torch."))
    made = Assembly(chosen, store, placement, tuple(missing), own, str(device))
    _warn_of_unverified(made.weight_files.values())
    return made


def missing_weights(
    recipe: Recipe, store: WeightStore, own: Container[str] = ()
) -> dict[str, list[str]]:
    """Return the slots without a file, by matcher, of the matchers that have any.

    ``own`` has the names of the user's matchers, which have their weights. Raises
    :class:`UserError` for an unknown matcher or option.
    """
    missing = {}
    for name in recipe.matcher_names:
        slots = [] if name in own else slots_of(recipe, [name])
        if without := [slot for slot in slots if store.file_of(slot) is None]:
            missing[name] = without
    return missing


def listed(missing: Mapping[str, Iterable[str]], store: WeightStore) -> str:
    """Return the missing slots with the names of their files."""
    files = {}
    for slots in missing.values():
        for slot in slots:
            files[slot] = " or ".join(file.name for file in store.alternatives(slot))
    return "; ".join(f"{slot}: {names}" for slot, names in files.items())


def fetch_command(recipe: Recipe, missing: Mapping[str, Iterable[str]]) -> str:
    """Return the command that gets a recipe's missing weights."""
    # A recipe from a file has no name that ``weights fetch`` knows.
    slots = dict.fromkeys(slot for names in missing.values() for slot in names)
    what = recipe.name if recipe.name in recipe_names() else " ".join(slots)
    return f"mkpc weights fetch {what} --out DIR"


def options_of(recipe: Recipe, name: str) -> Any:
    """Return the matcher's options: defaults, overridden by the recipe's ``[matchers.NAME]``."""
    where = f"recipe {recipe.name!r}"
    table = recipe.matchers.get(name, {})
    return from_table(
        spec_of(name, where).options, table, f"{where}, table [matchers.{name}]"
    )


def slots_of(recipe: Recipe, names: Iterable[str]) -> tuple[str, ...]:
    """Return the distinct slots of a recipe's named matchers."""
    slots: list[str] = []
    for name in names:
        slots += spec_of(name, f"recipe {recipe.name!r}").slots_for(options_of(recipe, name))
    return tuple(dict.fromkeys(slots))


def weights_of(weights: Weights | None) -> tuple[list[Path], dict[str, Path]]:
    """Return the directories to search, and the files that the user gives for slots."""
    if isinstance(weights, Mapping):
        return [], {slot: Path(file) for slot, file in weights.items()}
    if isinstance(weights, str | os.PathLike):
        return [Path(weights)], {}
    return [Path(each) for each in weights or ()], {}


def recipe_of_name(recipe: Recipe | PathSource, own: Container[str] = ()) -> Recipe:
    """Return the recipe of a name or file, or the recipe of a single matcher.

    ``own`` has the names of the user's matchers. Raises :class:`UserError` for an unknown name.
    """
    if isinstance(recipe, Recipe):
        return recipe
    name = os.fspath(recipe)
    if name in own or name in MATCHERS:
        return recipe_of_matcher(name)
    try:
        return load_recipe(name)
    except UserError as error:
        if name.endswith(".toml"):
            raise
        raise UserError(f"{error}, or a matcher: {', '.join(MATCHERS)}") from error


def recipe_of_matcher(name: str) -> Recipe:
    """Return the recipe of one matcher on whole images: its first unit in ``auto``, if any, and
    the settings of ``auto``.
    """
    auto = load_recipe(AUTO)
    units = [unit for unit in auto.units if unit.matcher == name and unit.stage == 1]
    unit = units[0] if units else Unit(1, name, DEFAULT_SIDE_PX)
    own = {key: table for key, table in auto.matchers.items() if key == name}
    return replace(
        auto,
        name=name,
        description=f"{name} on whole images",
        units=(replace(unit, tracks=True),),
        matchers=own,
    )


def version_of_package(name: str) -> str:
    """Return the version of an installed distribution; empty without it."""
    # OpenCV has several distributions.
    if name == "opencv":
        return cv2.__version__
    try:
        return metadata.version(name)
    except (
        metadata.PackageNotFoundError
    ):  # named by a user's matcher: a module without a version
        return ""


def _warn_of_unverified(files: Iterable[FoundFile]) -> None:
    """Warn of weights without a digest, if there are any."""
    names = sorted(file.path.name for file in files if not file.is_verified)
    if names:
        warn_once(f"weights not verified, no digest is known: {', '.join(names)}")
