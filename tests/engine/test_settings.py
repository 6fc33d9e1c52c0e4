"""Which settings decide which derived table."""

from dataclasses import replace

import pytest

from mkpc_kaggle.engine.settings import Settings
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.recipe import SceneConfig, load_recipe

CLASSICAL = load_recipe("classical")


@pytest.mark.parametrize(
    ("changes", "estimates_differ", "scenes_differ"),
    [
        ({"name": "other", "description": "the same"}, False, False),
        ({"magsac": replace(CLASSICAL.magsac, threshold=0.21)}, True, True),
        ({"focal": None}, True, True),
        ({"scene": SceneConfig(exif=False)}, False, True),
        ({"scene": None}, False, True),
        ({"mkpc": replace(CLASSICAL.mkpc, eps=0.1)}, False, False),
    ],
)
def test_estimates_and_scenes_have_a_digest_of_their_settings(changes, estimates_differ, scenes_differ):
    former, new = (Settings.of(assemble(recipe)) for recipe in (CLASSICAL, replace(CLASSICAL, **changes)))
    assert (former.estimate != new.estimate) == estimates_differ
    assert (former.scene != new.scene) == scenes_differ
