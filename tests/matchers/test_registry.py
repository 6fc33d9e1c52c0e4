"""The registry: a matcher is imported when it is asked for, and a broken import costs that matcher
alone.
"""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pictures import write_two_views
from sklearn.datasets import load_sample_image

from mkpc_kaggle import Recipe, TwoStageMatcher
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers import adapters
from mkpc_kaggle.matchers.registry import matcher_names, spec_of
from mkpc_kaggle.recipe import Unit

TEMPLATE = Path(__file__).parents[2] / "docs" / "own_matcher.py"
# In a separate process, because imports of this one cannot be undone.
WITHOUT_KORNIA = """
import sys
sys.modules["kornia"] = None
from mkpc_kaggle.cli import main
from mkpc_kaggle.setup.assembly import assemble
from mkpc_kaggle.recipe import Recipe, Unit

main(["weights", "list"])
main(["recipes", "auto"])
assembly = assemble("auto")
print(assembly.recipe.matcher_names, "xfeat_lighterglue" in str(assembly.left_out))
units = [Unit(1, "sift", 640), Unit(1, "xfeat_lighterglue", 640)]
print(assemble(Recipe(tuple(units), "mine")).recipe.matcher_names)
"""


@pytest.fixture
def more_matchers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    monkeypatch.setattr(adapters, "__path__", [*adapters.__path__, str(tmp_path)])
    matcher_names.cache_clear()
    yield tmp_path
    matcher_names.cache_clear()
    for name in ("broken", "orb"):
        sys.modules.pop(f"{adapters.__name__}.{name}", None)


def test_the_template_of_a_matcher_runs_as_a_file_of_the_package(more_matchers):
    shutil.copy(TEMPLATE, more_matchers / "orb.py")
    image = load_sample_image("china.jpg")
    match = TwoStageMatcher(Recipe((Unit(1, "orb", 640), Unit(2, "orb", 640))))(image, image)
    assert match.estimate.inlier_count > 500
    # Without keypoints, OpenCV returns None instead of descriptors.
    flat = np.zeros_like(image)
    assert not TwoStageMatcher(Recipe((Unit(1, "orb", 640),)))(image, flat).estimate.ok


def test_the_template_of_a_matcher_runs_as_a_program(tmp_path):
    write_two_views(tmp_path)
    command = [sys.executable, TEMPLATE, "a.jpg", "b.jpg"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    count = int(done.stdout.split(" inliers")[0])
    assert count > 100


def test_a_matcher_whose_import_fails_is_refused_with_the_reason_and_others_work(more_matchers):
    (more_matchers / "broken.py").write_text("from json import no_such_thing\nSPEC = None\n")
    says = r"my recipe: matcher broken cannot be used here \(ImportError: .*no_such"
    with pytest.raises(UserError, match=says):
        spec_of("broken", "my recipe")
    assert spec_of("sift", "test").name == "sift"


def test_without_kornia_its_matchers_alone_are_lost(clean_environment):
    command = [sys.executable, "-c", WITHOUT_KORNIA]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "superglue_outdoor.pth" in done.stdout, done.stderr
    reason = "cannot be used here (ModuleNotFoundError"
    # Each command that lists matchers names the missing ones.
    assert f"\nweights: matcher xfeat_lighterglue {reason}" in done.stdout
    assert f"  xfeat_lighterglue: {reason}" in done.stdout
    assert "('sift',) True" in done.stdout
    assert f"recipe auto runs without xfeat_lighterglue: {reason}" in done.stderr
    assert f"recipe mine runs without xfeat_lighterglue: {reason}" in done.stderr
    assert done.stdout.endswith("('sift',)\n")
