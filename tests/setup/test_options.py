"""Every option of a published method affects results, so it is part of the settings of its units."""

from typing import Any

import pytest

from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.recipe import Recipe, Unit, with_settings
from mkpc_kaggle.setup.assembly import Assembly
from mkpc_kaggle.weights import WeightStore

# A key of points is made of these settings: an option that is missing from them would leave old
# points in use. All values differ from the published defaults.
OPTIONS = [
    ("sift", "ratio", 0.7),
    ("sift", "features", 500),
    ("sift", "contrast_threshold", 0.03),
    ("superglue", "max_keypoints", 500),
    ("superglue", "keypoint_threshold", 0.01),
    ("superglue", "nms_radius", 5),
    ("superglue", "sinkhorn_iterations", 50),
    ("superglue", "match_threshold", 0.3),
    ("loftr", "threshold", 0.3),
    ("loftr", "training", "indoor"),
    ("quadtree", "threshold", 0.3),
    ("aspanformer", "threshold", 0.3),
    ("dkm", "matches", 1000),
    ("dkm", "threshold", 0.1),
    ("dkm", "passes", 2),
    ("dkm", "first_pass", 0.5),
    ("roma", "matches", 1000),
    ("roma", "threshold", 0.1),
    ("roma", "passes", 1),
    ("roma", "first_pass", 0.5),
    ("loma", "max_keypoints", 500),
    ("loma", "threshold", 0.2),
    ("loma", "descriptor_scale", 0.5),
]


def settings_of(recipe: Recipe) -> dict[str, Any]:
    (unit,) = recipe.units
    return Assembly(recipe, WeightStore([]), Placement()).unit_settings(unit)


@pytest.mark.parametrize(("matcher", "option", "value"), OPTIONS)
def test_an_option_changes_the_settings_of_its_unit(
    clean_environment, matcher, option, value
):
    recipe = Recipe((Unit(1, matcher, 640),))
    changed = with_settings(recipe, {f"matchers.{matcher}.{option}": value})
    former = settings_of(recipe)
    new = settings_of(changed)
    assert former["options"][option] != new["options"][option] == value
    # And nothing else: other results stay up to date.
    assert {**new, "options": former["options"]} == former
