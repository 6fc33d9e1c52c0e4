"""Assembly of a run: the units that a recipe keeps, and the refusal of a recipe without weights."""

from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file
from shared import WEIGHTS, needs_weights, problem_of, run_command
from weight_files import digest_of

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.keys import Keys
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.recipe import Recipe, Unit, load_recipe
from mkpc_kaggle.scene.view_graph import BatchImage
from mkpc_kaggle.setup.assembly import Assembly, assemble
from mkpc_kaggle.weights import WeightFile
from mkpc_kaggle.weights import store as weight_store
from mkpc_kaggle.weights.manifest import manifest

pytestmark = pytest.mark.usefixtures("nowhere_else")


def test_recipe_auto_leaves_out_the_units_whose_weights_are_missing():
    assembly = assemble("auto")
    others = [name for name in load_recipe("auto").matcher_names if name != "sift"]
    assert assembly.recipe.matcher_names == ("sift",)
    assert assembly.left_out == tuple(others)
    assert assembly.weight_files == {}


def test_another_recipe_without_its_weights_is_refused_with_the_command_that_gets_them():
    says = r"'light' needs .*aliked-n16: aliked-n16\.pth or .*--weights.*`mkpc weights fetch light --out"
    with pytest.raises(UserError, match=says):
        assemble("light")
    # A recipe of the user has no name that the command knows.
    mine = Recipe((Unit(1, "sift", 640), Unit(1, "superglue", 640)), name="mine")
    with pytest.raises(
        UserError, match="`mkpc weights fetch superpoint superglue-outdoor --out"
    ):
        assemble(mine)


@needs_weights
def test_recipe_auto_uses_the_weights_that_exist():
    auto = assemble("auto", weights=[WEIGHTS])
    there = {"xfeat_lighterglue", "sift", "aliked"}
    every = load_recipe("auto")
    assert auto.recipe == every.without(set(every.matcher_names) - there)
    assert set(auto.weight_files) == {"xfeat", "xfeat-lighterglue", "aliked-n16"}
    (xfeat,) = (unit for unit in auto.recipe.units if unit.matcher == "xfeat_lighterglue")
    assert set(auto.unit_settings(xfeat)["weights"]) == {"xfeat", "xfeat-lighterglue"}


def test_a_damaged_file_is_passed_over_and_counts_as_missing(tmp_path):
    name = "xfeat_sparse_bnfolded.safetensors"
    (tmp_path / name).write_bytes(b"cut off")
    with pytest.warns(UserWarning, match=rf"passed over: .*{name}"):
        assembly = assemble("auto", weights=[tmp_path])
    assert "xfeat_lighterglue" in assembly.left_out


@pytest.fixture
def misfits(monkeypatch, tmp_path):
    """A folder with files that have the manifest's digests, and that no network takes."""
    names = {
        "aliked-n16": "a.safetensors",
        "superpoint": "p.safetensors",
        "superglue-outdoor": "g.safetensors",
    }
    files = []
    for slot, name in names.items():
        save_file({"surplus.weight": torch.zeros(2)}, tmp_path / name)
        data = (tmp_path / name).read_bytes()
        files.append(WeightFile(slot, "MIT", sha256=digest_of(data), name=name))
    others = [file for file in manifest() if file.slot not in names]
    monkeypatch.setattr(weight_store, "manifest", lambda: (*files, *others))
    return tmp_path


TWO_UNITS = """
units = [
    { stage = 1, matcher = "aliked", long_side = 320 },
    { stage = 1, matcher = "sift", long_side = 320 },
]
"""


def submitted(demo, tmp_path, recipe, weights):
    """Submit with a recipe; "own" has ALIKED and SIFT. Return the exit status and the problem of
    the file.
    """
    (tmp_path / "own.toml").write_text(TWO_UNITS)
    # One pair: whether a matcher can be loaded does not depend on their number.
    test_dir = tmp_path / "test"
    test_dir.mkdir()
    rows = (demo.test_dir / "test.csv").read_text().splitlines()
    (test_dir / "test.csv").write_text("\n".join(rows[:2]))
    (test_dir / "test_images").symlink_to(demo.test_dir / "test_images")
    output = tmp_path / "out" / "submission.csv"
    chosen = tmp_path / "own.toml" if recipe == "own" else recipe
    options = ["--output", output, "--recipe", chosen, "--weights", weights, "--workers", 0]
    options += ["--no-report", "--no-scenes"]
    status = run_command("submit", "--test-dir", test_dir, *options)
    return status, problem_of(output, test_dir)


@pytest.mark.parametrize("recipe", ["auto", "own"])
def test_weights_of_another_network_cost_their_matcher_and_are_reported_once(
    misfits, demo, tmp_path, recipe, capsys
):
    assert submitted(demo, tmp_path, recipe, misfits) == (0, "")
    told = capsys.readouterr()
    assert told.err.count("aliked is left out: the weights for 'aliked-n16'") == 1
    assert "aliked is left out: the weights for 'aliked-n16'" in told.out


def points_keys(assembly: Assembly) -> tuple[str, ...]:
    """The keys of the units' points on a pair."""
    keys = Keys.of(assembly)
    pair = Pair("p", "b", "0.png", "1.png")
    images = tuple(BatchImage(name, name, Size(80, 60)) for name in ("0.png", "1.png"))
    first: list[str] = []
    found = []
    for n, unit in enumerate(assembly.recipe.units):
        crops = [keys.mkpc, *first] if unit.stage == 2 else []
        found.append(keys.of_points(n, pair, images, crops))
        first += found[-1:] * (unit.stage == 1)
    return tuple(found)


def test_the_key_of_points_changes_with_every_setting_that_decides_them_and_no_other():
    plain = load_recipe("classical")
    first, second, third = plain.units
    units = [points_keys(assemble(plain))]
    for other in (
        # No point depends on it
        replace(plain, units=(replace(first, tracks=False), second, third)),
        replace(plain, magsac=replace(plain.magsac, threshold=1.0)),
        # The regions of stage 2 depend on the units of stage 1 before it, not on a later one
        replace(plain, units=(first, second)),
        replace(plain, mkpc=replace(plain.mkpc, eps=0.1)),
        replace(plain, matchers={"sift": {"ratio": 0.7}}),
    ):
        units.append(points_keys(assemble(other)))
    assert units[0] == units[1] == units[2]
    changed = []
    for other in units[3:]:
        both = zip(units[0][: len(other)], other, strict=True)
        changed.append([one != two for one, two in both])
    # The second unit is the one of stage 2: another eps changes the crops alone.
    assert changed == [[False, False], [False, True, False], [True] * 3]
    assert not set(units[0]) & set(points_keys(assemble(plain, precision="bfloat16")))
