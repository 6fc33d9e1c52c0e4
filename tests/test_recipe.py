"""Recipes of the package load, and a wrong recipe is refused with advice."""

import os
from dataclasses import replace
from itertools import combinations

import pytest

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.critical_region import MkpcConfig
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.matchers.registry import MATCHERS, spec_of
from mkpc_kaggle.recipe import (
    Mode,
    Recipe,
    Unit,
    load_recipe,
    parse_recipe,
    recipe_names,
)
from mkpc_kaggle.setup.assembly import options_of, slots_of
from mkpc_kaggle.weights.manifest import manifest

SIFT = 'units = [{ stage = 1, matcher = "sift", long_side = 640 }]\n'


def parse(text):
    return parse_recipe(text, "mine")


def units(*texts):
    return f"units = [{', '.join(texts)}]\n"


@pytest.mark.parametrize("name", recipe_names())
def test_a_recipe_of_the_package_loads_with_options_for_every_matcher(name):
    recipe = load_recipe(name)
    assert recipe.name == name
    assert recipe.description
    for matcher in {*recipe.matcher_names, *recipe.matchers}:
        assert isinstance(options_of(recipe, matcher), spec_of(matcher, "test").options)
    assert set(recipe.matchers) <= set(recipe.matcher_names)
    for mode in Mode:
        assert recipe.in_mode(mode).units[0] == recipe.units[0]
        assert mode is Mode.TWO_STAGE or {
            unit.stage for unit in recipe.in_mode(mode).units
        } == {1}
    # The paper's recipes estimate as the paper does; ours have a prior.
    assert (recipe.focal is None) == name.startswith("imc2022")


def test_any_remaining_matchers_of_recipe_auto_begin_with_a_unit_of_stage_1():
    # Users have any subset of the weights, and a run without a sweep has no F for any pair.
    recipe = load_recipe("auto")
    names = recipe.matcher_names
    assert set(MATCHERS) == set(names)
    for count in range(1, len(names) + 1):
        for kept in combinations(names, count):
            remaining = recipe.without(set(names).difference(kept))
            assert set(remaining.matcher_names) == set(kept)
            assert remaining.units[0].stage == 1


@pytest.mark.parametrize("name", recipe_names())
def test_recipes_with_weights_for_noncommercial_use_are_those_that_the_readme_names(name):
    recipe = load_recipe(name)
    licences = {file.slot: file.licence for file in manifest()}
    bound = [
        "noncommercial" in licences[slot] for slot in slots_of(recipe, recipe.matcher_names)
    ]
    assert any(bound) == name.startswith(("imc2022", "auto", "best"))


def test_a_recipe_reads_as_written():
    second = unit(stage=2, matcher='"x"', long_side=800, max_matches=5)
    third = unit(stage=2, matcher='"dkm"', long_side=None, area='"540x720"', stretch="true")
    text = f'description = "two"\n{units(unit(), second, third)}'
    text += "[mkpc]\neps = 0.1\nmin_samples = 7\nexpand_x = 2\n"
    text += "[magsac]\nthreshold = 1.5\n"
    text += "[focal]\nscale = 0.2\n[matchers.sift]\nfeatures = 10\n"
    recipe = parse(text)
    dkm = Unit(2, "dkm", area="540x720", stretch=True)
    assert recipe.units == (Unit(1, "sift", 640), Unit(2, "x", 800, 5), dkm)
    assert recipe.mkpc == MkpcConfig(eps=0.1, min_samples=7, expand_x=2.0)
    # "2" and "2.0" are one setting: as an int it would have another key.
    assert type(recipe.mkpc.expand_x) is float
    assert recipe.magsac == RobustConfig(threshold=1.5)
    assert recipe.focal == FocalConfig(scale=0.2)
    assert (recipe.name, recipe.description) == ("mine", "two")
    options = options_of(recipe, "sift")
    assert (options.features, options.ratio) == (10, 0.8)


def test_a_unit_shows_a_crop_at_its_size():
    crop = Box(10, 20, 110, 220)
    assert Unit(1, "a", 640).view(crop, 32) == View.fit(crop, long_side=640, multiple=32)
    native = View.fit(crop, long_side=200, multiple=32, turns=1)
    assert Unit(1, "a", 640, enlarge=False).view(crop, 32, turns=1) == native
    shrunk = Unit(1, "a", 150, enlarge=False)
    assert shrunk.view(crop, 32) == replace(shrunk, enlarge=True).view(crop, 32)
    assert Unit(1, "a", area="54x72").view(crop, 8) == View.fit(
        crop, area=54 * 72, multiple=8
    )
    assert Unit(1, "a", area="54x72", stretch=True).view(crop, 1).content == Size(72, 54)


def unit(**changes):
    keys = {"stage": 1, "matcher": '"sift"', "long_side": 640} | changes
    lines = [f"{key} = {value}" for key, value in keys.items() if value is not None]
    return f"{{ {', '.join(lines)} }}"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "colour = 1\n" + SIFT,
            r"'colour'; known keys: description, units, mkpc, magsac, focal, matchers, scene",
        ),
        (
            units(unit(longside=640)),
            r"unit 1.*'longside'.*stage, matcher, long_side, max_matches, area",
        ),
        # A mistyped key would otherwise leave the default in use, unseen.
        (
            SIFT + "[mkpc]\nepsilon = 1\n",
            r"\[mkpc\].*'epsilon'.*eps, min_samples, share, expand_x",
        ),
        ("", "no units"),
        ("units = [", "not valid TOML"),
        (
            SIFT + "[mkpc]\nmin_samples = 5.0\n",
            r"\[mkpc\], key 'min_samples': expected int, got 5.0",
        ),
        (SIFT + '[mkpc]\nwhen = "ALWAYS"\n', r"'ALWAYS' is none of 'always', 'scale'"),
        ('units = "sift"\n', "units|unit 1"),
        # The first unit sweeps all pairs, and no crop exists before it.
        (units(unit(stage=2)), "so it must have stage 1"),
        # A unit's name is its name in tables and journals.
        (units(unit(), unit(max_matches=9)), "1:sift@640 twice"),
        (units(unit(long_side=-9)), r"unit 1: long_side must be in \[0, 99999\]"),
        (units(unit(area='"9x9"')), "and not both"),
        (units(unit(stretch="true")), "stretch needs an area"),
        (
            units(unit(long_side=None, area='"54x72"', enlarge="false")),
            "enlarge = false needs a long_side",
        ),
        *[
            (
                units(unit(long_side=None, area=f'"{area}"')),
                f'height x width such as "540x720", not {area!r}',
            )
            for area in ("540x0", "540 x 720")
        ],
        (
            SIFT + "[mkpc]\neps = nan\n",
            r"table \[mkpc\]: .*eps must be in \[1e-06, inf\), not nan",
        ),
        (SIFT + "[magsac]\nthreshold = 0\n", r"threshold must be in \(0, inf\), not 0"),
    ],
)
def test_a_wrong_recipe_is_refused_with_the_key_and_the_known_ones(text, says):
    with pytest.raises(UserError, match=f"'mine'.*{says}"):
        parse(text)


def test_options_that_a_matcher_does_not_have_are_refused():
    for text, says in (
        (
            "[matchers.sift]\nkeypoints = 1\n",
            r"\[matchers.sift\].*'keypoints'.*features, ratio, contrast",
        ),
        ("[matchers]\nsift = 3\n", "matchers"),
    ):
        with pytest.raises(UserError, match=says):
            options_of(parse(SIFT + text), "sift")
    with pytest.raises(UserError, match=r"unknown matcher 'sitf'; known: .*aliked.*sift"):
        options_of(parse(SIFT), "sitf")


def test_a_recipe_is_found_by_its_name_or_path_and_nowhere_else(tmp_path):
    # Editors on Windows write a byte order mark.
    (tmp_path / "my own.toml").write_bytes(b"\xef\xbb\xbf" + SIFT.encode())
    found = load_recipe(str(tmp_path / "my own.toml"))
    assert found == Recipe((Unit(1, "sift", 640),), name="my own")
    (tmp_path / "a.toml").mkdir()
    (tmp_path / "b.toml").write_bytes(SIFT.encode() + b"# caf\xe9\n")
    os.mkfifo(tmp_path / "pipe.toml")
    for name, says in (
        ("clasical", r"'clasical'; known: auto, best, classical, imc2022, light.*\.toml"),
        ("../recipes/auto", "unknown recipe"),
        (tmp_path / "none.toml", r"none\.toml cannot be read: No such file"),
        (tmp_path / "a.toml", r"a\.toml cannot be read"),
        (tmp_path / "b.toml", r"b\.toml"),
        (tmp_path / "pipe.toml", "not a regular file"),
    ):
        with pytest.raises(UserError, match=says):
            load_recipe(str(name))


NAMES = (
    (1, "sift", 640),
    (2, "sift", 640),
    (2, "aliked", 800),
    (1, "aliked", 640),
    (2, "sift", 320),
)
ALL = Recipe(tuple(Unit(*name) for name in NAMES), name="all", mkpc=MkpcConfig(eps=0.1))


def test_modes_keep_stage_1_or_show_every_unit_the_whole_image_and_none_twice():
    assert ALL.in_mode(Mode.TWO_STAGE) is ALL
    stage_1 = ALL.in_mode(Mode.STAGE_1)
    whole = ALL.in_mode(Mode.WHOLE_IMAGES)
    assert [unit.name for unit in stage_1.units] == ["1:sift@640", "1:aliked@640"]
    assert (stage_1.name, stage_1.mkpc) == ("all (stage-1)", ALL.mkpc)
    # Both units of SIFT at 640 pixels would see the same pictures.
    names = [unit.name for unit in whole.units]
    assert names == ["1:sift@640", "1:aliked@800", "1:aliked@640", "1:sift@320"]
