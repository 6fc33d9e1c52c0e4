"""Recipes: which matchers run on which views, in order of importance, and the settings of all that follows.

A recipe is a TOML file: ``mkpc_kaggle/recipes/NAME.toml`` or one of the user's own.
"""

import re
import tomllib
from collections.abc import Callable, Container, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from mkpc_kaggle.config import AT_LEAST_0, AT_LEAST_1, SHARE, Config, Range, check_keys, check_ranges, from_table
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.critical_region import MkpcConfig
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.robust import Method, RobustConfig
from mkpc_kaggle.scene.config import SceneConfig

DIRECTORY = Path(__file__).resolve().parent / "recipes"
LARGEST_FILE = 1 << 24
LONGEST = 99_999
"""Pixels a side."""
AREA = re.compile(r"[1-9]\d{0,4}x[1-9]\d{0,4}", re.ASCII)


class Mode(StrEnum):
    """How a recipe's two stages are run; the last two are what the method is compared with."""

    TWO_STAGE = "two-stage"
    """as written: stage 2 looks at the critical regions"""
    STAGE_1 = "stage-1"
    """the units of stage 1 alone"""
    WHOLE_IMAGES = "whole-images"
    """every unit on whole images, the naive ensemble of equal inference count; a unit that both stages have in
    common runs once, since twice would find the same"""


@dataclass(frozen=True)
class Choice:
    """A recipe by its name or file, and the mode to run it in."""

    recipe: str
    mode: Mode = Mode.TWO_STAGE

    @classmethod
    def parse(cls, text: str) -> "Choice":
        """``NAME:MODE``; without a mode, the recipe as it is written."""
        name, _, mode = text.rpartition(":")
        return cls(name, Mode(mode)) if name and mode in list(Mode) else cls(text)

    @property
    def folder(self) -> str:
        """A name for the directory of its run."""
        text = self.recipe if self.mode is Mode.TWO_STAGE else f"{self.recipe}_{self.mode}"
        return re.sub(r"[^\w.-]+", "_", text)


@dataclass(frozen=True)
class Unit:
    """One piece of work on one pair.

    ``stage`` 1 looks at whole images, 2 at the critical regions. A view's longer side gets ``long_side`` pixels,
    or the view as many pixels as ``area`` has, height by width such as "540x720"; its aspect is kept either way,
    but with ``stretch`` it gets just that height and width. The ``max_matches`` surest matches are kept. ``flip``
    mirrors both views. An ``extra`` unit is left for the upgrade pass. ``fallback``: the matcher that takes the
    place of this one where it cannot run, or not with the weights that are there. Without ``tracks``, a scene is
    made of its matches only where a pair has few others. ``ValueError`` for what makes no unit.
    """

    stage: int
    matcher: str
    long_side: int = 0
    max_matches: int = 4096
    flip: bool = False
    extra: bool = False
    area: str = ""
    stretch: bool = False
    fallback: str = ""
    tracks: bool = True

    def __post_init__(self) -> None:
        check_ranges(self, stage=Range(1, 2), long_side=Range(0, LONGEST), max_matches=AT_LEAST_1)
        if bool(self.long_side) == bool(self.area):
            raise ValueError("one of long_side and area must be given, and not both")
        if self.area and not AREA.fullmatch(self.area):
            raise ValueError(f'area must be height x width such as "540x720", not {self.area!r}')
        if self.stretch and not self.area:
            raise ValueError("stretch needs an area, the height and width to stretch views to")

    @property
    def name(self) -> str:
        """Such as ``2:sift@1280`` or ``1:dkm@540x720``; "!" says stretched, "~" mirrored. Unique in a recipe."""
        marks = ("!" if self.stretch else "") + ("~" if self.flip else "")
        return f"{self.stage}:{self.matcher}@{self.long_side or self.area}{marks}"

    @property
    def with_fallback(self) -> "Unit":
        """The same unit with its fallback in its matcher's place, if it has one."""
        return replace(self, matcher=self.fallback or self.matcher, fallback="")

    def shrunk(self, factor: float) -> "Unit":
        """The same unit on views whose sides are ``factor`` times as long."""
        if not self.area:
            return replace(self, long_side=max(1, round(factor * self.long_side)))
        return replace(
            self, area="x".join(str(max(1, round(factor * int(side)))) for side in self.area.split("x"))
        )

    def view(self, crop: Box, multiple: int) -> View:
        """What this unit shows of a crop, padded to a multiple."""
        if not self.area:
            return View.fit(crop, long_side=self.long_side, multiple=multiple, flip=self.flip)
        height, width = map(int, self.area.split("x"))
        if self.stretch:
            return View.stretched(crop, size=Size(width, height), multiple=multiple, flip=self.flip)
        return View.of_area(crop, area=width * height, multiple=multiple, flip=self.flip)


@dataclass(frozen=True)
class UpgradeConfig:
    """Which pairs are weak, and get the recipe's extra units when time is left.

    Those with fewer inliers than ``below_inliers``, those whose inliers are a smaller share of the matches than
    ``below_share``, and, with ``uncertain``, those with an image that no critical region could be found in. It
    ends when the pairs of a round together gained less than ``least_gain`` of the inliers that they had.
    """

    below_inliers: int = 100
    below_share: float = 0.0
    uncertain: bool = True
    least_gain: float = 0.01

    def __post_init__(self) -> None:
        check_ranges(self, below_inliers=AT_LEAST_0, below_share=SHARE, least_gain=AT_LEAST_0)


@dataclass(frozen=True)
class Recipe:
    """Units in order of importance and the settings of MKPC, MAGSAC, the upgrade pass and the matchers.

    The first unit is the sweep's: it has stage 1 and is not extra. Raises :class:`UserError` otherwise. Without
    ``focal``, the table ``[focal]``, F is MAGSAC's alone, and nothing is supposed of focal lengths. With
    ``scene``, the table ``[scene]``, the pairs of a batch are reconstructed together.
    """

    units: tuple[Unit, ...]
    name: str = "unnamed"
    description: str = ""
    mkpc: MkpcConfig = field(default_factory=MkpcConfig)
    magsac: RobustConfig = field(default_factory=RobustConfig)
    focal: FocalConfig | None = None
    upgrade: UpgradeConfig = field(default_factory=UpgradeConfig)
    matchers: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    scene: SceneConfig | None = None

    def __post_init__(self) -> None:
        where = f"recipe {self.name!r}"
        if not self.units:
            raise UserError(f"{where} has no units")
        if self.units[0].stage != 1 or self.units[0].extra:
            raise UserError(f"{where}: the first unit sweeps all pairs, so it must have stage 1 and not be extra")
        names = [unit.name for unit in self.units] + [
            unit.with_fallback.name for unit in self.units if unit.fallback
        ]
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"{where} has the unit {name} twice")

    @property
    def regular(self) -> tuple[Unit, ...]:
        """The units that every pair gets if time allows."""
        return tuple(unit for unit in self.units if not unit.extra)

    @property
    def matcher_names(self) -> tuple[str, ...]:
        """Each matcher once, in order of first use."""
        return tuple(dict.fromkeys(unit.matcher for unit in self.units))

    def only(self, wanted: Callable[[Unit], bool]) -> "Recipe":
        """The same recipe with the units that ``wanted`` lets through."""
        return replace(self, units=tuple(filter(wanted, self.units)))

    def decided(self, unfit: Container[str]) -> "Recipe":
        """The recipe that is run: fallbacks have taken the places of ``unfit`` matchers, or are forgotten."""
        units = (u.with_fallback if u.matcher in unfit else replace(u, fallback="") for u in self.units)
        return replace(self, units=tuple(units))

    def with_magsac(self, method: str | None = None, threshold: float | None = None) -> "Recipe":
        """The recipe with another robust method and threshold in pixels, where they are given.

        Raises ``ValueError`` for what :class:`RobustConfig` does not take.
        """
        given = {"method": method and Method(method), "threshold": threshold}
        changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        return replace(self, magsac=replace(self.magsac, **changes))

    def in_mode(self, mode: Mode) -> "Recipe":
        """The recipe run another way, see :class:`Mode`."""
        if mode is Mode.TWO_STAGE:
            return self
        name = f"{self.name} ({mode})"
        if mode is Mode.STAGE_1:
            return replace(self.only(lambda unit: unit.stage == 1), name=name)
        whole: dict[str, Unit] = {}
        for unit in (replace(unit, stage=1) for unit in self.units):
            whole.setdefault(unit.name, unit)
        return replace(self, name=name, units=tuple(whole.values()))

    def with_scenes(self, on: bool | None) -> "Recipe":
        """The recipe with the reconstruction of batches switched on or off; ``None``: as it is."""
        if on is None or on == (self.scene is not None):
            return self
        return replace(self, scene=SceneConfig() if on else None)

    def fingerprint(self) -> dict[str, Any]:
        """All that decides what a run computes, as JSON-able values; name and description are no part of it."""
        values = asdict(self)
        del values["name"], values["description"]
        return values


def parse_recipe(text: str, name: str) -> Recipe:
    """A recipe from TOML text; raises :class:`UserError` for what it cannot accept."""
    try:
        return recipe_of(tomllib.loads(text), name)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, tables in tables in tables
        raise UserError(f"recipe {name!r} is not valid TOML: {error}") from error


def recipe_of(table: Mapping[str, Any], name: str) -> Recipe:
    """A recipe from a TOML file's table, or from a fingerprint; :class:`UserError` for what it cannot accept."""
    where = f"recipe {name!r}"
    known = ("description", "units", "mkpc", "magsac", "focal", "upgrade", "matchers", "scene")
    check_keys(table, known, where)
    units, matchers = table.get("units", []), table.get("matchers", {})
    if not isinstance(units, list):
        raise UserError(f"{where}: units must be a list of tables, not {units!r}")
    if not isinstance(matchers, dict):
        raise UserError(f"{where}: matchers must be a table, not {matchers!r}")
    return Recipe(
        units=tuple(
            from_table(Unit, unit, f"{where}, unit {number}") for number, unit in enumerate(units, start=1)
        ),
        name=name,
        description=str(table.get("description", "")),
        mkpc=from_table(MkpcConfig, table.get("mkpc", {}), f"{where}, table [mkpc]"),
        magsac=from_table(RobustConfig, table.get("magsac", {}), f"{where}, table [magsac]"),
        focal=_optional(FocalConfig, table.get("focal"), f"{where}, table [focal]"),
        upgrade=from_table(UpgradeConfig, table.get("upgrade", {}), f"{where}, table [upgrade]"),
        matchers=matchers,
        scene=_optional(SceneConfig, table.get("scene"), f"{where}, table [scene]"),
    )


def _optional(cls: type[Config], table: Mapping[str, Any] | None, where: str) -> Config | None:
    """``None`` where there is no such table; a fingerprint says so by ``None``."""
    return None if table is None else from_table(cls, table, where)


def recipe_names() -> list[str]:
    """The recipes that come with the package."""
    return sorted(path.stem for path in DIRECTORY.glob("*.toml"))


def load_recipe(name: str) -> Recipe:
    """The recipe of that name, or in that ``.toml`` file; raises :class:`UserError` where there is none."""
    path = Path(name) if name.endswith(".toml") else DIRECTORY / f"{name}.toml"
    if not name.endswith(".toml") and name not in recipe_names():
        raise UserError(
            f"unknown recipe {name!r}; known: {', '.join(recipe_names())}, or a path that ends in .toml"
        )
    try:
        if path.exists() and (not path.is_file() or path.stat().st_size > LARGEST_FILE):
            raise UserError(
                f"recipe file {path} cannot be read: not a regular file of at most {LARGEST_FILE} bytes"
            )
        return parse_recipe(path.read_text(encoding="utf-8-sig"), path.stem)
    except OSError as error:
        raise UserError(f"recipe file {path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"recipe file {path} is not UTF-8 text") from error
