"""Recipes: those that come with the package work, and a wrong one is refused in words that help."""

import json
import tomllib
from dataclasses import replace

import pytest

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.critical_region import MkpcConfig, Ratio
from mkpc_kaggle.geometry.robust import Method, RobustConfig
from mkpc_kaggle.matchers.registry import options_of, registry
from mkpc_kaggle.recipe import DIRECTORY, Mode, Recipe, Unit, load_recipe, parse_recipe, recipe_names

SIFT = 'units = [{ stage = 1, matcher = "sift", long_side = 640 }]\n'


def parse(text):
    return parse_recipe(text, "mine")


def units(*texts):
    return f"units = [{', '.join(texts)}]\n"


# those of the package


def test_the_known_recipes_are_there():
    assert {"auto", "classical", "light"} <= set(recipe_names())


@pytest.mark.parametrize("name", recipe_names())
def test_a_recipe_of_the_package_loads_with_options_for_every_matcher(name):
    recipe = load_recipe(name)
    assert recipe.name == name
    assert recipe.description
    for matcher in {*recipe.matcher_names, *recipe.matchers}:
        assert isinstance(options_of(recipe, matcher), registry()[matcher].spec.options)
    assert set(recipe.matchers) <= set(recipe.matcher_names)


@pytest.mark.parametrize("name", recipe_names())
@pytest.mark.parametrize("mode", Mode)
def test_a_recipe_of_the_package_runs_in_every_mode(name, mode):
    recipe = load_recipe(name).in_mode(mode)
    assert recipe.units[0] == load_recipe(name).units[0]
    if mode is not Mode.TWO_STAGE:
        assert {unit.stage for unit in recipe.units} == {1}


def test_every_recipe_of_the_package_says_all_it_has_in_toml():
    for name in recipe_names():
        table = tomllib.loads((DIRECTORY / f"{name}.toml").read_text())
        assert len(table["units"]) == len(load_recipe(name).units)


# reading


def test_a_recipe_reads_as_written():
    recipe = parse(
        'description = "two"\n'
        + units(
            '{ stage = 1, matcher = "sift", long_side = 640 }',
            '{ stage = 2, matcher = "x", long_side = 800, max_matches = 5, flip = true, extra = true }',
        )
        + '[mkpc]\neps = 0.1\nmin_samples = 7\nratio = "last-kept"\nexpand_x = 2\n'
        + '[magsac]\nmethod = "ransac"\nthreshold = 1.5\n[upgrade]\nbelow_inliers = 9\n'
        + "[matchers.sift]\nfeatures = 10\n"
    )
    assert recipe.units == (Unit(1, "sift", 640), Unit(2, "x", 800, 5, flip=True, extra=True))
    assert recipe.regular == recipe.units[:1]
    assert recipe.mkpc == MkpcConfig(eps=0.1, min_samples=7, ratio=Ratio.LAST_KEPT, expand_x=2.0)
    assert type(recipe.mkpc.expand_x) is float
    assert recipe.magsac == RobustConfig(Method.RANSAC, threshold=1.5)
    assert recipe.upgrade.below_inliers == 9
    assert (recipe.name, recipe.description) == ("mine", "two")
    assert options_of(recipe, "sift").features == 10
    assert options_of(recipe, "sift").ratio == 0.8


def test_what_is_not_said_is_the_default():
    assert parse(SIFT) == Recipe(units=(Unit(1, "sift", 640),), name="mine")


def test_a_recipe_is_found_by_its_path(tmp_path):
    (tmp_path / "my own.toml").write_text(SIFT)
    recipe = load_recipe(str(tmp_path / "my own.toml"))
    assert (recipe.name, recipe.units) == ("my own", (Unit(1, "sift", 640),))


def test_unit_names_tell_units_apart():
    names = {unit.name for unit in (Unit(1, "a", 640), Unit(2, "a", 640), Unit(1, "a", 800), Unit(1, "b", 640))}
    assert len(names) == 4
    assert Unit(2, "sift", 1280).name == "2:sift@1280"
    assert Unit(1, "a", 640, flip=True).name != Unit(1, "a", 640).name


# refusing


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("colour = 1\n" + SIFT, r"'colour'; known keys: description, units, mkpc, magsac, upgrade, matchers"),
        (
            units('{ stage = 1, matcher = "sift", longside = 640 }'),
            r"unit 1.*'longside'.*stage, matcher, long_side, max_matches, flip, extra",
        ),
        (SIFT + "[mkpc]\nepsilon = 1\n", r"\[mkpc\].*'epsilon'.*eps, min_samples, share, ratio, expand_x"),
        (SIFT + "[magsac]\nmax_iters = 1\n", r"\[magsac\].*method, threshold, confidence, max_iterations"),
        (SIFT + "[upgrade]\nbelow = 1\n", r"\[upgrade\].*'below'; known keys: below_inliers"),
        (units('{ matcher = "sift", long_side = 640 }'), r"unit 1 lacks 'stage'"),
        ("", "no units"),
        ("units = [", "not valid TOML"),
    ],
)
def test_unknown_and_missing_keys_are_named_with_the_known_ones(text, says):
    with pytest.raises(UserError, match=f"'mine'.*{says}"):
        parse(text)


def test_an_unknown_key_of_a_matcher_lists_its_options():
    recipe = parse(SIFT + "[matchers.sift]\nkeypoints = 1\n")
    with pytest.raises(UserError, match=r"\[matchers.sift\].*'keypoints'.*features, ratio, contrast_threshold"):
        options_of(recipe, "sift")


def test_an_unknown_matcher_lists_the_known_ones():
    recipe = parse(units('{ stage = 1, matcher = "sitf", long_side = 640 }'))
    with pytest.raises(UserError, match=r"unknown matcher 'sitf'; known: .*aliked.*sift"):
        options_of(recipe, "sitf")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (SIFT + "[mkpc]\nmin_samples = 5.0\n", r"\[mkpc\], key 'min_samples': expected int, got 5.0"),
        (SIFT + "[mkpc]\nmin_samples = true\n", r"expected int, got True"),
        (SIFT + "[mkpc]\neps = true\n", r"expected float, got True"),
        (SIFT + '[mkpc]\neps = "0.1"\n', r"expected float, got '0.1'"),
        (SIFT + '[mkpc]\nratio = "first"\n', r"'first' is none of 'largest', 'last-kept'"),
        (SIFT + '[mkpc]\nratio = ["largest"]\n', r"is none of 'largest', 'last-kept'"),
        (SIFT + '[magsac]\nmethod = "MAGSAC"\n', r"'MAGSAC' is none of 'magsac', 'ransac'"),
        (units('{ stage = 1, matcher = "sift", long_side = "640" }'), r"unit 1, key 'long_side': expected int"),
        (units('{ stage = true, matcher = "sift", long_side = 640 }'), r"key 'stage': expected int, got True"),
        (units("{ stage = 1, matcher = 7, long_side = 640 }"), r"key 'matcher': expected str, got 7"),
        (units('{ stage = 1, matcher = "sift", long_side = 640, flip = 1 }'), r"expected bool, got 1"),
        ("units = 3\n", "units"),
        ('units = "sift"\n', "units|unit 1"),
        ("units = [1]\n", "unit 1"),
        (SIFT + "mkpc = 3\n", "mkpc"),
        (SIFT + "magsac = [1]\n", "magsac"),
        (SIFT + "upgrade = true\n", "upgrade"),
    ],
)
def test_a_value_of_another_type_is_refused(text, says):
    with pytest.raises(UserError, match=f"'mine'.*{says}"):
        parse(text)


@pytest.mark.parametrize("text", ["matchers = 3\n", "[matchers]\nsift = 3\n"])
def test_matcher_settings_that_are_no_table_are_refused(text):
    with pytest.raises(UserError, match="matchers"):
        options_of(parse(SIFT + text), "sift")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (units('{ stage = 2, matcher = "sift", long_side = 640 }'), "must have stage 1 and not be extra"),
        (units('{ stage = 1, matcher = "sift", long_side = 640, extra = true }'), "stage 1 and not be extra"),
        (units(*['{ stage = 1, matcher = "sift", long_side = 640 }'] * 2), "1:sift@640 twice"),
        (
            SIFT.replace("}]", '}, { stage = 1, matcher = "sift", long_side = 640, max_matches = 9 }]'),
            "1:sift@640 twice",
        ),
        (SIFT.replace("}]", '}, { stage = 3, matcher = "sift", long_side = 640 }]'), "stage must be 1 or 2"),
        (units('{ stage = 1, matcher = "sift", long_side = 0 }'), "long_side and max_matches positive"),
        (
            units('{ stage = 1, matcher = "sift", long_side = 9, max_matches = 0 }'),
            "long_side and max_matches positive",
        ),
    ],
)
def test_units_that_make_no_run_are_refused(text, says):
    with pytest.raises(UserError, match=f"'mine'.*{says}"):
        parse(text)


def test_an_unknown_recipe_lists_the_known_ones():
    with pytest.raises(UserError, match=r"'clasical'; known: auto, classical, light.*\.toml"):
        load_recipe("clasical")


def test_a_recipe_name_does_not_lead_out_of_the_directory():
    with pytest.raises(UserError, match="unknown recipe"):
        load_recipe("../recipes/auto")


def test_a_recipe_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(UserError, match=r"none\.toml cannot be read: No such file"):
        load_recipe(str(tmp_path / "none.toml"))
    (tmp_path / "a.toml").mkdir()
    with pytest.raises(UserError, match=r"a\.toml cannot be read"):
        load_recipe(str(tmp_path / "a.toml"))
    (tmp_path / "b.toml").write_bytes(SIFT.encode() + b"# caf\xe9\n")
    with pytest.raises(UserError, match=r"b\.toml"):
        load_recipe(str(tmp_path / "b.toml"))


# modes


ALL = Recipe(
    units=(
        Unit(1, "sift", 640),
        Unit(2, "sift", 640),
        Unit(2, "aliked", 800),
        Unit(1, "aliked", 640),
        Unit(2, "sift", 320, extra=True),
    ),
    name="all",
    mkpc=MkpcConfig(eps=0.1),
)


def test_the_two_stage_mode_changes_nothing():
    assert ALL.in_mode(Mode.TWO_STAGE) is ALL


def test_the_stage_1_mode_keeps_the_units_of_stage_1():
    recipe = ALL.in_mode(Mode.STAGE_1)
    assert [unit.name for unit in recipe.units] == ["1:sift@640", "1:aliked@640"]
    assert (recipe.name, recipe.mkpc) == ("all (stage-1)", ALL.mkpc)


def test_the_whole_images_mode_shows_every_unit_the_whole_image_and_none_twice():
    recipe = ALL.in_mode(Mode.WHOLE_IMAGES)
    assert [unit.name for unit in recipe.units] == ["1:sift@640", "1:aliked@800", "1:aliked@640", "1:sift@320"]
    assert [unit.extra for unit in recipe.units] == [False, False, False, True]


@pytest.mark.parametrize("second", [Unit(2, "sift", 640, max_matches=9), Unit(2, "sift", 640, extra=True)])
def test_the_whole_images_mode_takes_stages_that_differ_in_more_than_the_stage(second):
    recipe = Recipe(units=(Unit(1, "sift", 640), second)).in_mode(Mode.WHOLE_IMAGES)
    assert recipe.units[0] == Unit(1, "sift", 640)


# the fingerprint


def test_the_fingerprint_survives_json():
    recipe = parse(SIFT + '[mkpc]\nratio = "last-kept"\n[matchers.sift]\nfeatures = 10\n')
    assert json.loads(json.dumps(recipe.fingerprint()))["matchers"] == {"sift": {"features": 10}}
    assert "last-kept" in json.dumps(recipe.fingerprint())


def test_the_fingerprint_leaves_out_name_and_description():
    other = replace(ALL, name="other", description="something")
    assert other.fingerprint() == ALL.fingerprint()


@pytest.mark.parametrize(
    "other",
    [
        replace(ALL, units=ALL.units[:-1]),
        replace(ALL, units=(ALL.units[0], *reversed(ALL.units[1:]))),
        replace(ALL, units=(replace(ALL.units[0], max_matches=7), *ALL.units[1:])),
        replace(ALL, mkpc=replace(ALL.mkpc, share=0.06)),
        replace(ALL, magsac=RobustConfig(threshold=0.21)),
        replace(ALL, magsac=RobustConfig(Method.RANSAC)),
        replace(ALL, matchers={"sift": {"features": 9}}),
    ],
)
def test_the_fingerprint_changes_with_whatever_decides_the_numbers(other):
    assert json.dumps(other.fingerprint()) != json.dumps(ALL.fingerprint())
