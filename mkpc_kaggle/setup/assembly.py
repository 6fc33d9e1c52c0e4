"""Assembly of a run's parts: recipe, weights, device, matchers."""

from collections.abc import Container, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import metadata
from os import PathLike, fspath
from pathlib import Path
from types import MappingProxyType
from typing import Any
from uuid import uuid4

import cv2

from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.errors import UserError, warn_once
from mkpc_kaggle.geometry.intrinsics import Rows
from mkpc_kaggle.matchers.contract import Matcher, MatcherSpec, Placement, Precision
from mkpc_kaggle.matchers.registry import (
    MATCHERS,
    load_matcher,
    require_matchers,
    spec_of,
)
from mkpc_kaggle.recipe import Mode, Recipe, Unit, load_recipe, with_settings
from mkpc_kaggle.setup.arguments import (
    Weights,
    device_of,
    precision_of,
    shown_value,
    weights_of,
)
from mkpc_kaggle.setup.availability import (
    FAULTS,
    Licence,
    UnavailableReason,
    left_out,
    options_of,
    refusal,
    slots_of,
    unavailable,
)
from mkpc_kaggle.setup.devices import AUTO, gpus_of, resolve_placement
from mkpc_kaggle.weights import FileState, FoundFile, WeightStore

DEFAULT_SIDE_PX = 1024  # of a single matcher that no recipe has
CUDA_MINIBATCH = 8  # pairs at a time; on a CPU, more than one gains nothing and takes memory


@dataclass(frozen=True)
class Assembly:
    """The values from which a worker builds its pipeline."""

    recipe: Recipe
    weights: WeightStore
    placement: Placement
    # The recipe's unavailable matchers, grouped by cause, for messages.
    left_out: tuple[str, ...] = ()
    matchers: Mapping[str, Matcher[Any]] = field(default_factory=dict)  # the user's ready matchers
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
        return replace(self, placement=replace(self.placement, device=device), sharing=sharing)

    def on_cpu(self) -> "Assembly":
        return replace(self, placement=Placement(), sharing=1)

    def unit_settings(self, unit: Unit, precision: Precision | None = None) -> dict[str, Any]:
        """Return all settings that determine a unit's points on given views, as JSON values.

        ``precision`` is the one that the points were computed in; default: the placement's.
        """
        name = unit.matcher
        fields = asdict(unit)
        # The matcher is settled, and scenes read the points without changing them.
        del fields["fallback"], fields["tracks"]
        weights = {}
        for slot in slots_of(self.recipe, {name} - self.matchers.keys()):
            if slot in self.weight_files:
                weights[slot] = self.weight_files[slot].digest
        # Nothing is known of the options of a user's matcher.
        is_own = name in self.matchers
        settings: dict[str, Any] = {
            "unit": fields,
            "options": None if is_own else asdict(options_of(self.recipe, name)),
            "precision": precision or self.placement.precision,
            "weights": weights,
        }
        # The weights of a matcher of this package have digests, and its code has ``keys.POINTS_VERSION``.
        spec = self._spec_of(name)
        if is_own:
            settings["version"] = spec.version or self.nonce
        if spec.packages:
            settings["packages"] = {
                package: _version_of_package(package) for package in spec.packages
            }
        return settings

    def _spec_of(self, name: str) -> MatcherSpec:
        given = self.matchers.get(name)
        return given.spec if given is not None else spec_of(name, f"matcher {name}")

    @property
    def unversioned(self) -> list[str]:
        """The recipe's matchers whose results are not kept for later runs."""
        own = [name for name in self.recipe.matcher_names if name in self.matchers]
        return [name for name in own if not self.matchers[name].spec.version]

    @property
    def weight_paths(self) -> tuple[Path, ...]:
        return tuple(file.path for file in self.weight_files.values())

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
        """Load a matcher, on the assembly's placement by default."""
        # The user's matcher has its own precision, and is not loaded twice.
        given = self.matchers.get(name)
        return given or load_matcher(
            name, self.weights, options_of(self.recipe, name), placement or self.placement
        )


def assemble(
    recipe: Recipe | str | PathLike[str],
    *,
    weights: Weights = (),
    device: str = AUTO,
    precision: str = Precision.FLOAT32,
    mode: Mode = Mode.TWO_STAGE,
    scenes: bool | None = None,
    licence: Licence = Licence.ANY,
    matchers: Mapping[str, Matcher[Any]] | None = None,
    settings: Mapping[str, Any] = MappingProxyType({}),
) -> Assembly:
    """Check recipe, options, licences, weights, device and precision; return the assembly.

    ``recipe`` may be the name of a single matcher. ``weights`` are directories, or files by slot.
    A fallback replaces an unavailable matcher. Without one, recipe ``auto`` drops its units, and so
    does every recipe if the matcher cannot be loaded. ``scenes`` switches the reconstruction of
    batches on or off; ``None`` follows the recipe. ``settings`` replace the recipe's, see
    :func:`mkpc_kaggle.recipe.with_settings`. Raises :class:`UserError`, also if weights of a
    recipe other than ``auto`` are missing or not permitted, and if no unit of stage 1 remains.
    """
    own = require_matchers({} if matchers is None else matchers)
    directories, files = weights_of(weights)
    store = WeightStore(directories, chosen=files)
    written = recipe_of_name(recipe, own)
    if not isinstance(settings, Mapping):
        raise TypeError(f"settings is {shown_value(settings)}; expected a mapping from dotted keys")
    if settings:
        written = with_settings(written, settings)
    reasons = unavailable(written, store, licence, own)
    chosen = _without_unavailable(written, reasons, is_auto=recipe == AUTO)
    for name in sorted(chosen.matchers.keys() - own.keys() - reasons.keys()):
        options_of(chosen, name)  # check the options of unused matchers too
    omitted = {name: reasons[name] for name in written.matcher_names if name in reasons}
    texts = left_out(written, omitted, is_auto=recipe == AUTO)
    chosen = chosen.with_scenes(scenes).in_mode(mode)
    placement = resolve_placement(device_of(device), precision_of(precision))
    made = Assembly(chosen, store, placement, texts, own, device_of(device))
    _warn_of_unverified(made.weight_files.values())
    return made


def recipe_of_name(recipe: Recipe | str | PathLike[str], own: Container[str] = ()) -> Recipe:
    """Return the recipe of a name or file, or the recipe of a single matcher.

    ``own`` has the names of the user's matchers. Raises :class:`UserError` for an unknown name.
    """
    if isinstance(recipe, Recipe):
        return recipe
    if not isinstance(recipe, str | PathLike):
        raise TypeError(
            f"recipe must be a Recipe, a name or the path of a TOML file, not {shown_value(recipe)}"
        )
    name = fspath(recipe)
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


def _without_unavailable(
    written: Recipe, reasons: Mapping[str, UnavailableReason], *, is_auto: bool
) -> Recipe:
    """Return the recipe with fallbacks, without the units of unavailable matchers.

    Raises :class:`UserError` if that would not be the recipe that the user asked for, or if no unit
    of stage 1 remains.
    """
    chosen = written.with_fallbacks(reasons)
    missing = {name: reasons[name] for name in chosen.matcher_names if name in reasons}
    faulty = {name for name, reason in reasons.items() if reason.kind in FAULTS}
    # A run runs without a faulty matcher. Missing weights, and a licence that is not permitted, are
    # the user's to settle, except for ``auto``, which takes the available weights.
    refused = {}
    for asked, unit in zip(written.units, chosen.units, strict=True):
        if unit.matcher in reasons and not faulty & {asked.matcher, unit.matcher}:
            refused[unit.matcher] = reasons[unit.matcher]
    if refused and not is_auto:
        raise refusal(chosen, refused)
    if not any(unit.stage == 1 and unit.matcher not in missing for unit in chosen.units):
        raise refusal(chosen, missing)
    for name in dict.fromkeys((*written.matcher_names, *chosen.matcher_names)):
        if name in faulty:
            warn_once(f"recipe {written.name} runs without {name}: {reasons[name]}")
    return chosen.without(missing)


def _version_of_package(name: str) -> str:
    # OpenCV has several distributions.
    if name == "opencv":
        return cv2.__version__
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:  # named by a user's matcher: a module without a version
        return ""


def _warn_of_unverified(files: Iterable[FoundFile]) -> None:
    """Warn of weights without a digest, if there are any."""
    names = sorted(file.path.name for file in files if file.state is FileState.UNVERIFIED)
    if names:
        listed = ", ".join(names)
        warn_once(f"weights not verified: {listed}; `mkpc weights verify` says why")
