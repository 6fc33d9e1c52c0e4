"""Which settings decide which derived table."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from mkpc_kaggle.engine.settings import Settings
from mkpc_kaggle.pipeline.assembly import Assembly, assemble
from mkpc_kaggle.recipe import SceneConfig, Unit, load_recipe

CLASSICAL = load_recipe("classical")


@pytest.mark.parametrize(
    ("changes", "estimates_differ", "scenes_differ"),
    [
        ({"name": "other", "description": "the same"}, False, False),
        ({"magsac": replace(CLASSICAL.magsac, threshold=0.21)}, True, True),
        ({"focal": None}, True, True),
        ({"scene": SceneConfig(pairs_per_image=1)}, False, True),
        ({"scene": None}, False, True),
        ({"mkpc": replace(CLASSICAL.mkpc, eps=0.1)}, False, False),
    ],
)
def test_estimates_and_scenes_have_a_digest_of_their_settings(changes, estimates_differ, scenes_differ):
    former, new = (Settings.of(assemble(recipe)) for recipe in (CLASSICAL, replace(CLASSICAL, **changes)))
    assert (former.estimate != new.estimate) == estimates_differ
    assert (former.scene != new.scene) == scenes_differ


@pytest.mark.parametrize(
    ("slot", "changed"), [("xfeat", [True, False, True]), ("aliked-n16", [False, True, True])]
)
def test_other_weights_of_a_matcher_change_its_units_and_stage_2(monkeypatch, slot, changed):
    units = Unit(1, "xfeat_lighterglue", 640), Unit(1, "aliked_lightglue", 640), Unit(2, "sift", 640)
    assembly = replace(assemble(CLASSICAL), recipe=replace(CLASSICAL, units=units))

    def digests(**other: str) -> tuple[str, ...]:
        slots = dict.fromkeys(("xfeat", "xfeat-lighterglue", "aliked-n16", "aliked-lightglue"), "same") | other
        files = {name: SimpleNamespace(digest=digest) for name, digest in slots.items()}
        monkeypatch.setattr(Assembly, "weight_files", files)
        return Settings.of(assembly).units

    pairs = zip(digests(), digests(**{slot: "other"}), strict=True)
    assert [former != new for former, new in pairs] == changed
