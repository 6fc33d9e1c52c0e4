"""Recipes: units (a matcher on one kind of view) by importance, and settings of all later steps.

A recipe is a TOML file: ``mkpc_kaggle/recipes/NAME.toml`` or a custom file.
"""

import re
import tomllib
from collections.abc import Container, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any

from mkpc_kaggle.config import (
    AT_LEAST_0,
    AT_LEAST_1,
    Config,
    Range,
    check_keys,
    check_ranges,
    from_table,
    plain,
)
from mkpc_kaggle.errors import UserError, read_text
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.critical_region import MkpcConfig
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.robust import RobustConfig

DIRECTORY = Path(__file__).resolve().parent / "recipes"
MAX_SIDE_PX = 99_999
TABLES = ("mkpc", "magsac", "focal", "matchers", "scene")  # of settings
AREA = re.compile(r"[1-9]\d{0,4}x[1-9]\d{0,4}", re.ASCII)


class Mode(StrEnum):
    """Ways to run a recipe's two stages; the last two are baselines."""

    TWO_STAGE = "two-stage"  # as written: stage 2 on the critical regions
    STAGE_1 = "stage-1"  # the units of stage 1 alone
    # Every unit on whole images: the naive ensemble of equal inference count.
    WHOLE_IMAGES = "whole-images"


@dataclass(frozen=True)
class Unit:
    """One matcher on one kind of view of a pair.

    Parameters
    ----------
    stage : int
        1: on whole images; 2: on the critical regions.
    matcher : str
        The name of the matcher.
    long_side : int
        Pixels of a view's longer side, or 0 with ``area``.
    max_matches : int
        The number of matches to keep, by the highest scores.
    area : str
        Height x width, such as "540x720": the area of a view, which keeps its aspect ratio.
    stretch : bool
        True: a view gets exactly the height and width of ``area``.
    enlarge : bool
        False: a crop smaller than the view keeps its size.
    antialias : bool
        False: shrink views bilinearly, without averaging areas.
    tracks : bool
        False: scenes use the unit's matches only if the pair's other units have fewer than 50.

    Raises
    ------
    ValueError
        For a value out of range, and for contradictory values.

    Examples
    --------
    >>> from mkpc_kaggle import Unit
    >>> Unit(2, "sift", 1280).name
    '2:sift@1280'
    """

    stage: int
    matcher: str
    long_side: int = 0
    max_matches: int = 4096
    area: str = ""
    stretch: bool = False
    enlarge: bool = True
    antialias: bool = True
    tracks: bool = True

    def __post_init__(self) -> None:
        for name in ("stage", "long_side", "max_matches"):
            number = plain(getattr(self, name))
            if type(number) is not int:  # not ``isinstance``: True is an int
                raise ValueError(f"{name} must be a whole number, not {number!r}")
            object.__setattr__(self, name, number)  # the class is frozen
        check_ranges(
            self, stage=Range(1, 2), long_side=Range(0, MAX_SIDE_PX), max_matches=AT_LEAST_1
        )
        if bool(self.long_side) == bool(self.area):
            raise ValueError("either long_side or area must be given, and not both")
        if self.area and not AREA.fullmatch(self.area):
            raise ValueError(
                f'area must be height x width such as "540x720", not {self.area!r}'
            )
        if self.stretch and not self.area:
            raise ValueError(
                "stretch needs an area, the height and width to stretch views to"
            )
        if self.area and not self.enlarge:
            raise ValueError("enlarge = false needs a long_side")

    @cached_property  # used often by plans
    def name(self) -> str:
        """Name such as ``2:sift@1280`` or ``1:dkm@540x720``, unique in a recipe; "!": stretched."""
        stretched = "!" if self.stretch else ""
        return f"{self.stage}:{self.matcher}@{self.long_side or self.area}{stretched}"

    def view(self, crop: Box, multiple: int, turns: int = 0) -> View:
        """Return this unit's view of a crop, rotated by quarter turns and padded to a multiple."""
        height, width = map(int, (self.area or "1x1").split("x"))
        long_side = self.long_side if self.enlarge else min(self.long_side, max(crop.size))
        if self.stretch:
            view = View.stretched(
                crop, size=Size(width, height), multiple=multiple, turns=turns
            )
        else:
            view = View.fit(
                crop, long_side=long_side, area=width * height, multiple=multiple, turns=turns
            )
        return replace(view, antialias=self.antialias)


class CameraSharing(StrEnum):
    """Camera sharing among the images of one size in a scene."""

    AUTO = "auto"  # images whose focal lengths agree
    IMAGE = "image"  # none
    FOLDER = "folder"  # all: a scene's images are in one folder


class CameraModel(StrEnum):
    """COLMAP's camera models. F of a pair needs one without distortion.

    ``AUTO`` is SIMPLE_RADIAL for cameras, and SIMPLE_PINHOLE for F.
    """

    SIMPLE_PINHOLE = "SIMPLE_PINHOLE"
    PINHOLE = "PINHOLE"
    SIMPLE_RADIAL = "SIMPLE_RADIAL"
    RADIAL = "RADIAL"
    OPENCV = "OPENCV"
    FULL_OPENCV = "FULL_OPENCV"
    SIMPLE_RADIAL_FISHEYE = "SIMPLE_RADIAL_FISHEYE"
    RADIAL_FISHEYE = "RADIAL_FISHEYE"
    OPENCV_FISHEYE = "OPENCV_FISHEYE"
    AUTO = "AUTO"


# F of two cameras exists for these models only; distortion bends its lines.
PINHOLES = frozenset({CameraModel.SIMPLE_PINHOLE, CameraModel.PINHOLE, CameraModel.AUTO})


@dataclass(frozen=True)
class SceneConfig:
    """Settings of :mod:`mkpc_kaggle.scene`, table ``[scene]`` of a recipe."""

    # A batch with fewer gets extra pairs, used only for its scene; 0: none.
    pairs_per_image: float = 10.0
    cameras: CameraSharing = CameraSharing.AUTO
    camera_model: CameraModel = CameraModel.AUTO
    # Reconstructions of a batch to choose from, see :mod:`mkpc_kaggle.scene.candidates`
    candidates: int = 1
    # Minimum share of inliers of an edge, see :func:`mkpc_kaggle.scene.view_graph.supported`; 0: all edges.
    min_support: float = 0.0
    # Images up to which the mapper starts from all tracks, and ends with points of two views. Larger scenes start
    # from the longest tracks of each image.
    all_tracks: int = 100
    threads: int = 1  # of the mapper; with more, the last digits vary from run to run

    def __post_init__(self) -> None:
        check_ranges(
            self,
            pairs_per_image=AT_LEAST_0,
            candidates=AT_LEAST_1,
            min_support=Range(0, 1),
            all_tracks=AT_LEAST_0,
            threads=AT_LEAST_1,
        )


@dataclass(frozen=True)
class Recipe:
    """Units in order of importance, and the settings of MKPC, MAGSAC, the matchers and scenes.

    Parameters
    ----------
    units : sequence of Unit
        The first one is of stage 1, because it sweeps all pairs.
    name, description : str
        For messages and reports.
    mkpc : MkpcConfig
        Settings of critical regions.
    magsac : RobustConfig
        Settings of the estimation of F, E and H.
    focal : FocalConfig, optional
        The prior on the focal lengths. ``None``: F is MAGSAC's.
    matchers : mapping
        The options of each matcher, by its name.
    scene : SceneConfig, optional
        Settings of structure from motion. ``None``: batches are not reconstructed.

    Raises
    ------
    UserError
        If there are no units, a unit is repeated, or the first one is not of stage 1.
    TypeError
        If a unit is not a :class:`Unit`.

    Examples
    --------
    >>> from mkpc_kaggle import MkpcConfig, Recipe, Unit
    >>> units = [Unit(1, "sift", 1024), Unit(2, "sift", 1280)]
    >>> recipe = Recipe(units, "mine", mkpc=MkpcConfig(expand_x=1.2))
    >>> [unit.name for unit in recipe.units]
    ['1:sift@1024', '2:sift@1280']
    """

    units: tuple[Unit, ...]
    name: str = "unnamed"
    description: str = ""
    mkpc: MkpcConfig = field(default_factory=MkpcConfig)
    magsac: RobustConfig = field(default_factory=RobustConfig)
    focal: FocalConfig | None = None
    matchers: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    scene: SceneConfig | None = None

    def __post_init__(self) -> None:
        where = f"recipe {self.name!r}"
        object.__setattr__(self, "units", tuple(self.units))  # the class is frozen
        for unit in self.units:
            if not isinstance(unit, Unit):
                raise TypeError(
                    f"{where}: expected units such as Unit(1, 'sift', 640), got {unit!r}"
                )
        if not self.units:
            raise UserError(f"{where} has no units")
        if self.units[0].stage != 1:
            raise UserError(
                f"{where}: the first unit sweeps all pairs, so it must have stage 1"
            )
        names = [unit.name for unit in self.units]
        # The name is the unit's key in journals.
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"{where} has the unit {name} twice")

    @property
    def matcher_names(self) -> tuple[str, ...]:
        """Distinct matchers, in order of first use."""
        return tuple(dict.fromkeys(unit.matcher for unit in self.units))

    def without(self, matchers: Container[str]) -> "Recipe":
        """Return the recipe without the units of these matchers.

        The first remaining unit of stage 1 becomes the first of all, since it sweeps all pairs.
        Raises :class:`UserError` if no unit of stage 1 remains.
        """
        units = [unit for unit in self.units if unit.matcher not in matchers]
        sweeps = [unit for unit in units if unit.stage == 1][:1]
        others = [unit for unit in units if unit not in sweeps]
        return replace(self, units=(*sweeps, *others))

    def in_mode(self, mode: Mode) -> "Recipe":
        """Return the recipe for a :class:`Mode`."""
        if mode is Mode.TWO_STAGE:
            return self
        name = f"{self.name} ({mode})"
        if mode is Mode.STAGE_1:
            units = tuple(unit for unit in self.units if unit.stage == 1)
            return replace(self, name=name, units=units)
        # A unit of both stages runs once: a second run would find the same matches.
        whole: dict[str, Unit] = {}
        for unit in self.units:
            of_stage_1 = replace(unit, stage=1)
            whole.setdefault(of_stage_1.name, of_stage_1)
        return replace(self, name=name, units=tuple(whole.values()))

    def with_scenes(self, on: bool | None) -> "Recipe":
        """Return the recipe with scenes switched on or off; ``None``: no change."""
        if on is None or on == (self.scene is not None):
            return self
        return replace(self, scene=SceneConfig() if on else None)

    def table(self) -> dict[str, Any]:
        """Return the table that :func:`recipe_of` reads, as JSON values."""
        values = asdict(self)
        values["units"] = list(values["units"])
        return {name: values[name] for name in ("description", "units", *TABLES)}


def with_settings(recipe: Recipe, settings: Mapping[str, Any]) -> Recipe:
    """Return the recipe with other settings, by dotted key, such as ``matchers.loftr.threshold``.

    A missing table is added, as in a file. Raises :class:`UserError` for a key or a value that a
    file may not have.
    """
    table = recipe.table()
    for key, value in settings.items():
        if not isinstance(key, str):
            raise UserError(
                f"settings: expected a key such as 'magsac.threshold', got {key!r}"
            )
        *names, last = key.split(".")
        if not names or names[0] not in TABLES:
            known = ", ".join(TABLES)
            raise UserError(f"--set {key}: expected TABLE.KEY=VALUE; the tables are {known}")
        inner = table
        for name in names:
            if inner.get(name) is None:
                inner[name] = {}
            inner = inner[name]
            if not isinstance(inner, dict):
                raise UserError(f"--set {key}: {name} is a key, not a table of keys")
        inner[last] = plain(value)
    # The same checks as for a file.
    return recipe_of(table, recipe.name)


def parse_setting(text: str) -> tuple[str, Any]:
    """Return the key and the value of ``TABLE.KEY=VALUE``; a value that is not TOML is a text."""
    key, separator, value = text.partition("=")
    if not separator:
        raise UserError(
            f"--set {text}: expected TABLE.KEY=VALUE, such as magsac.threshold=0.3"
        )
    try:
        parsed = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        # Names need no quotes: matchers.aliked.variant=n32.
        return key.strip(), value.strip()
    return key.strip(), parsed["value"]


def split_mode(text: str) -> tuple[str, Mode]:
    """Split ``RECIPE:MODE`` into the recipe's name or file, and the mode, by default two-stage."""
    name, _, mode = text.rpartition(":")
    # A path may contain a colon.
    if not name or mode not in list(Mode):
        return text, Mode.TWO_STAGE
    return name, Mode(mode)


def parse_recipe(text: str, name: str) -> Recipe:
    """Parse a recipe from TOML text. Raise :class:`UserError` if it is invalid."""
    try:
        return recipe_of(tomllib.loads(text), name)
    # Numbers of thousands of digits, deeply nested tables.
    except (ValueError, RecursionError) as error:
        raise UserError(f"recipe {name!r} is not valid TOML: {error}") from error


def recipe_of(table: Mapping[str, Any], name: str) -> Recipe:
    """Return the recipe of a TOML file's or a journal's table.

    Raises :class:`UserError` if it is invalid.
    """
    where = f"recipe {name!r}"
    check_keys(table, ("description", "units", *TABLES), where)
    units = table.get("units", [])
    matchers = table.get("matchers", {})
    if not isinstance(units, list) or not isinstance(matchers, dict):
        raise UserError(f"{where}: units must be a list of tables, and matchers a table")

    def settings(cls: type[Config], key: str) -> Config | None:
        value = table.get(key)  # a journal has None for a missing table
        return None if value is None else from_table(cls, value, f"{where}, table [{key}]")

    parsed = []
    for number, unit in enumerate(units, start=1):
        parsed.append(from_table(Unit, unit, f"{where}, unit {number}"))
    return Recipe(
        tuple(parsed),
        name,
        description=str(table.get("description", "")),
        mkpc=settings(MkpcConfig, "mkpc") or MkpcConfig(),
        magsac=settings(RobustConfig, "magsac") or RobustConfig(),
        focal=settings(FocalConfig, "focal"),
        matchers=matchers,
        scene=settings(SceneConfig, "scene"),
    )


def recipe_names() -> list[str]:
    """Return the names of the package's recipes."""
    return sorted(path.stem for path in DIRECTORY.glob("*.toml"))


def load_recipe(name: str) -> Recipe:
    """Return the recipe of this name or ``.toml`` file.

    Raises :class:`UserError` if it does not exist.
    """
    known = recipe_names()
    if name not in known and not name.endswith(".toml"):
        raise UserError(
            f"unknown recipe {name!r}; known: {', '.join(known)}, or a path that ends in .toml"
        )
    path = DIRECTORY / f"{name}.toml" if name in known else Path(name)
    return parse_recipe(read_text(path), path.stem)
