"""Which settings decide which keys."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.keys import Keys
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.contract import MatcherSpec
from mkpc_kaggle.recipe import SceneConfig, Unit, load_recipe
from mkpc_kaggle.scene.view_graph import BatchImage
from mkpc_kaggle.setup import assembly
from mkpc_kaggle.setup.assembly import Assembly, assemble

CLASSICAL = load_recipe("classical")


IMAGES = (
    BatchImage("0.png", "d", Size(80, 60)),
    BatchImage("1.png", "c", Size(80, 60)),
)


@pytest.mark.parametrize(
    ("changes", "estimates_differ", "scenes_differ"),
    [
        # A user's copy of a recipe under another name
        ({"name": "other", "description": "the same"}, False, False),
        ({"magsac": replace(CLASSICAL.magsac, threshold=0.21)}, True, True),
        ({"focal": None}, True, True),
        ({"scene": SceneConfig(pairs_per_image=1)}, False, True),
        ({"scene": None}, False, True),
        # It changes the points of stage 2, and by their keys the estimates.
        ({"mkpc": replace(CLASSICAL.mkpc, eps=0.1)}, False, False),
    ],
)
def test_estimates_and_scenes_have_a_digest_of_their_settings(
    changes, estimates_differ, scenes_differ
):
    former = Keys.of(assemble(CLASSICAL))
    new = Keys.of(assemble(replace(CLASSICAL, **changes)))
    assert (former.estimate != new.estimate) == estimates_differ
    assert (former.scene != new.scene) == scenes_differ


@pytest.mark.parametrize(
    ("slot", "changed"),
    [
        ("xfeat", [True, False, True]),
        ("aliked-n16", [False, True, True]),
    ],
)
def test_other_weights_change_the_points_of_their_units_and_of_stage_2(
    monkeypatch, slot, changed
):
    units = (
        Unit(1, "xfeat_lighterglue", 640),
        Unit(1, "aliked_lightglue", 640),
        Unit(2, "sift", 640),
    )
    made = replace(assemble(CLASSICAL), recipe=replace(CLASSICAL, units=units))

    def digests(**other: str) -> tuple[str, ...]:
        names = ("xfeat", "xfeat-lighterglue", "aliked-n16", "aliked-lightglue")
        slots = dict.fromkeys(names, "same") | other
        files = {name: SimpleNamespace(sha256=digest) for name, digest in slots.items()}
        monkeypatch.setattr(Assembly, "weight_files", files)
        keys = Keys.of(made)
        pair = Pair("p", "b", "0.png", "1.png")
        first = [keys.of_points(unit, pair, IMAGES, []) for unit in (0, 1)]
        # Stage 2 looks at crops from all of stage 1, so it depends on both matchers' weights.
        second = keys.of_points(2, pair, IMAGES, [keys.mkpc, *first])
        return (*first, second)

    pairs = zip(digests(), digests(**{slot: "other"}), strict=True)
    assert [former != new for former, new in pairs] == changed


@pytest.mark.parametrize(
    ("package", "changed"),
    [
        ("opencv", [True, True, False, False, False]),
        ("kornia", [False, False, True, True, False]),
    ],
)
def test_another_version_of_a_library_changes_the_points_that_come_from_it(
    monkeypatch, package, changed
):
    names = (
        "sift",
        "sift_lightglue",
        "disk_lightglue",
        "xfeat_lighterglue",
        "aliked_lightglue",
    )
    units = tuple(Unit(1, name, 640) for name in names)
    made = replace(assemble(CLASSICAL), recipe=replace(CLASSICAL, units=units))
    monkeypatch.setattr(Assembly, "weight_files", {})
    former = Keys.of(made).units
    version_of = assembly.version_of_package
    other = {package: "another"}
    monkeypatch.setattr(
        assembly, "version_of_package", lambda name: other.get(name) or version_of(name)
    )
    pairs = zip(former, Keys.of(made).units, strict=True)
    assert [before != after for before, after in pairs] == changed


# Another input, and whether the points of stage 1, those of stage 2, the estimate and the scene then
# have other keys
OTHERS = {
    "nothing": ({}, (False, False, False, False)),
    "content": ({"digest": "other"}, (True, True, True, True)),
    "turns": ({"turns": (0, 1)}, (True, True, True, True)),
    "crops": ({"mkpc": "other"}, (False, True, True, True)),
    "points of stage 1": ({"first": "other"}, (False, True, True, True)),
    # MAGSAC's result depends on the order of the matches.
    "order": ({"first_is_last": True}, (False, False, True, True)),
    "scene": ({"scene": "other"}, (False, False, False, True)),
}


@pytest.mark.parametrize(("other", "changed"), OTHERS.values(), ids=OTHERS)
def test_a_key_is_the_digest_of_all_inputs_of_a_result(other, changed):
    def chain(
        digest="d", first="", turns=(0, 0), first_is_last=False, **settings
    ) -> list[str]:
        keys = Keys(("u", "v"), **{"mkpc": "m", "estimate": "e", "scene": "s"} | settings)
        pair = Pair("p", "b", "0.png", "1.png", turns)
        first_image, second_image = IMAGES
        images = (replace(first_image, digest=digest), second_image)
        one = keys.of_points(0, pair, images, [])
        two = keys.of_points(1, pair, images, [keys.mkpc, first or one])
        points = [two, one] if first_is_last else [one, two]
        estimate = keys.of_estimate(points)
        return [one, two, estimate, keys.of_scene([["names", points, estimate]])]

    keys = zip(chain(), chain(**other), strict=True)
    assert tuple(former != new for former, new in keys) == changed


def test_another_version_of_a_matcher_given_in_python_makes_other_points():
    recipe = replace(CLASSICAL, units=(Unit(1, "mine", 640),))

    def key(version: str) -> str:
        given = {"mine": SimpleNamespace(spec=MatcherSpec("mine", version=version))}
        return Keys.of(replace(assemble(CLASSICAL), recipe=recipe, matchers=given)).units[0]

    assert key("1.4") == key("1.4")
    assert key("1.4") != key("1.5")
    # Without a version, it may be any.
    assert key("") != key("")
