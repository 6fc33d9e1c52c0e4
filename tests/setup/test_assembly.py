"""Assembly of a run: the units that a recipe keeps, and the reasons why others are left out."""

import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import save_file
from shared import WEIGHTS, needs_weights, problems_of, run_command
from weight_files import digest_of

from mkpc_kaggle import reconstruct
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.store.keys import Keys
from mkpc_kaggle.errors import UserError, warn_once
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.contract import MatcherSpec
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit, load_recipe
from mkpc_kaggle.scene.view_graph import BatchImage
from mkpc_kaggle.setup import availability
from mkpc_kaggle.setup.assembly import Assembly, assemble
from mkpc_kaggle.setup.availability import Licence
from mkpc_kaggle.weights import WeightFile
from mkpc_kaggle.weights import store as weight_store
from mkpc_kaggle.weights.manifest import manifest

pytestmark = pytest.mark.usefixtures("nowhere_else")


def own(*licences):
    """A user's matcher that is never run."""
    return {"own": SimpleNamespace(spec=MatcherSpec("own", licences=licences))}


@pytest.mark.parametrize(
    "bad", [{"recipe": 5}, {"device": 0}, {"matchers": [1]}, {"matchers": {"own": object()}}]
)
def test_an_argument_of_a_wrong_type_is_named(bad):
    # Such values fail deep in a worker otherwise, minutes later.
    for call in (TwoStageMatcher, partial(reconstruct, [])):
        with pytest.raises(TypeError, match=r"(recipe|device|matcher).* not |has no `spec`"):
            call(**({"recipe": "classical"} | bad))


def test_recipe_auto_leaves_out_the_units_whose_weights_are_missing():
    assembly = assemble("auto")
    others = [name for name in load_recipe("auto").matcher_names if name != "sift"]
    assert assembly.recipe.matcher_names == ("sift",)
    (told,) = assembly.left_out
    assert told.startswith(f"no weights: {', '.join(others)} (")
    assert assembly.weight_files == {}


def test_a_named_recipe_without_its_weights_is_refused_with_the_file_names():
    # The message ends with the command that gets the files.
    says = r"needs weights.*aliked-n16\.pth or .*--weights.*`mkpc weights fetch light --out"
    with pytest.raises(UserError, match=says):
        assemble("light")
    for recipe in ("permissive", "best"):
        with pytest.raises(UserError, match="needs weights"):
            assemble(recipe, licence=Licence.PERMISSIVE)


@needs_weights
def test_recipes_use_the_weights_that_exist_and_fallbacks_replace_the_other_units():
    auto = assemble("auto", weights=[WEIGHTS])
    there = {"xfeat_lighterglue", "sift", "aliked"}
    assert auto.recipe == load_recipe("auto").only(lambda unit: unit.matcher in there)
    assert set(auto.weight_files) == {"xfeat", "xfeat-lighterglue", "aliked-n16"}
    (xfeat,) = (unit for unit in auto.recipe.units if unit.matcher == "xfeat_lighterglue")
    assert set(auto.unit_settings(xfeat)["weights"]) == {"xfeat", "xfeat-lighterglue"}
    light = assemble("light", weights=[WEIGHTS])
    assert light.recipe.matcher_names == ("sift", "aliked")
    command = "`mkpc weights fetch aliked-lightglue --out DIR` gets weights"
    assert light.left_out == (f"no weights: aliked_lightglue ({command})",)
    stages = [unit.stage for unit in light.recipe.units]
    # ALIKED with mutual neighbours is the fallback of ALIKED + LightGlue, at the same stages.
    assert stages == [unit.stage for unit in load_recipe("light").units]
    assert light.recipe == light.recipe.with_fallbacks(())


@pytest.fixture
def known_files(monkeypatch, tmp_path):
    """SuperGlue's, LoFTR's and DKM's weights exist, DKM's also for indoors, of unclear terms."""
    known = [
        ("sp.pth", "superpoint", "Magic-Leap-noncommercial"),
        ("sg.pth", "superglue-outdoor", "Magic-Leap-noncommercial"),
        ("loftr.ckpt", "loftr-outdoor", "Apache-2.0"),
        ("dkm.pth", "dkm-outdoor", "MIT"),
        ("dkm_in.pth", "dkm-indoor", "unclear"),
    ]
    files = []
    for name, slot, licence in known:
        data = name.encode()
        (tmp_path / name).write_bytes(data)
        files.append(WeightFile(name, -1, digest_of(data), licence, slot, "here"))
    taken = {file.slot for file in files}
    others = [file for file in manifest() if file.slot not in taken]
    monkeypatch.setattr(weight_store, "manifest", lambda: (*files, *others))
    monkeypatch.setattr(availability, "misfit", lambda *_: "")  # the files are only names
    return tmp_path


def test_the_advice_of_recipe_auto_is_the_light_recipe_unless_its_weights_are_there(
    monkeypatch, tmp_path
):
    (told,) = assemble("auto").left_out
    assert told.endswith("(`mkpc weights fetch light --out DIR` gets weights)")
    light = load_recipe("light")
    lines = []
    for slot in availability.slots_of(light, light.matcher_names):
        (tmp_path / slot).write_text(slot)
        lines.append(WeightFile(slot, -1, digest_of(slot.encode()), "MIT", slot, "here"))
    monkeypatch.setattr(weight_store, "manifest", lambda: (*lines, *manifest()))
    monkeypatch.setattr(availability, "misfit", lambda *_: "")
    (told,) = assemble("auto", weights=[tmp_path]).left_out
    assert told.startswith("no weights: loma, ")
    assert "fetch" not in told


def test_a_permissive_run_drops_units_under_other_licences_from_recipe_auto(known_files):
    every = assemble("auto", weights=[known_files])
    assert every.recipe.matcher_names == ("superglue", "loftr", "sift", "dkm")
    some = assemble("auto", weights=[known_files], licence=Licence.PERMISSIVE)
    assert some.recipe.matcher_names == ("loftr", "sift", "dkm")
    assert some.left_out[1].startswith(
        "weights not permitted: superglue, superpoint_lightglue, aspanformer"
    )
    assert set(some.weight_files) == {"loftr-outdoor", "dkm-outdoor"}


@pytest.mark.filterwarnings("ignore:weights not verified")
def test_a_fallback_replaces_a_matcher_whose_weights_are_missing_or_not_permitted(
    known_files,
):
    recipe = Recipe((Unit(1, "superglue", 640, fallback="loftr"), Unit(2, "dkm", area="90x120")))
    every = assemble(recipe, weights=[known_files])
    assert every.recipe.matcher_names == ("superglue", "dkm")
    assert every.left_out == ()
    some = assemble(recipe, weights=[known_files], licence=Licence.PERMISSIVE)
    assert some.recipe.matcher_names == ("loftr", "dkm")
    assert some.left_out == ("weights not permitted: superglue",)
    # SuperGlue cannot run without SuperPoint.
    (known_files / "sp.pth").unlink()
    assert assemble(recipe, weights=[known_files]).recipe == some.recipe


def test_a_permissive_run_refuses_a_recipe_by_matcher_and_licence_and_says_what_to_do():
    says = r"permissive refuses recipe '\w+' .*superglue \(Magic-Leap-noncommercial\).*recipe auto"
    with pytest.raises(UserError, match=says):
        TwoStageMatcher("imc2022", licence="permissive")


def test_a_file_whose_licence_is_unclear_is_refused_where_others_of_its_matcher_are_not(
    known_files,
):
    recipe = Recipe((Unit(1, "dkm", area="90x120"),), matchers={"dkm": {"training": "outdoor"}})
    assert assemble(recipe, weights=[known_files], licence=Licence.PERMISSIVE).left_out == ()
    indoors = replace(recipe, matchers={"dkm": {"training": "indoor"}})
    assert set(assemble(indoors, weights=[known_files]).weight_files) == {"dkm-indoor"}
    with pytest.raises(UserError, match=r"dkm \(unclear\)"):
        assemble(indoors, weights=[known_files], licence=Licence.PERMISSIVE)


def test_a_permissive_run_refuses_a_users_matcher_by_its_licence_tags():
    recipe = Recipe((Unit(1, "own", 480),))
    # No tag is no claim: a user's own code needs no licence to be run by its author.
    for tags in ((), ("MIT",)):
        assert assemble(recipe, matchers=own(*tags), licence=Licence.PERMISSIVE).recipe == recipe
    with pytest.raises(UserError, match=r"own \(GPL\)"):
        assemble(recipe, matchers=own("GPL", "MIT"), licence=Licence.PERMISSIVE)


@pytest.mark.filterwarnings("ignore:weights not verified")
@pytest.mark.parametrize("name", ["xfeat_sparse_bnfolded.safetensors", "DKMv3_outdoor.pth"])
def test_recipe_auto_leaves_out_matchers_with_damaged_weights(tmp_path, name):
    """The second has no digest in the manifest: it is found out when it is read."""
    (tmp_path / name).write_bytes(b"cut off")
    with pytest.warns(UserWarning, match=rf"(passed over|runs without dkm): .*{name}"):
        assembly = assemble("auto", weights=[tmp_path])
    assert not {"dkm", "xfeat_lighterglue"} & set(assembly.recipe.matcher_names)


@pytest.fixture
def misfits(monkeypatch, tmp_path):
    """A folder with files that have the manifest's digests, and that no network takes."""
    warn_once.cache_clear()  # another test may have had the same warning
    names = {
        "aliked-n16": "a.safetensors",
        "superpoint": "p.safetensors",
        "superglue-outdoor": "g.safetensors",
    }
    files = []
    for slot, name in names.items():
        save_file({"surplus.weight": torch.zeros(2)}, tmp_path / name)
        data = (tmp_path / name).read_bytes()
        files.append(WeightFile(name, len(data), digest_of(data), "MIT", slot, "here"))
    others = [file for file in manifest() if file.slot not in names]
    monkeypatch.setattr(weight_store, "manifest", lambda: (*files, *others))
    return tmp_path


DOES_WITHOUT = (
    r"runs without aliked: weights cannot be loaded "
    r"\(the weights for 'aliked-n16' do not fit the network"
)


@pytest.mark.filterwarnings("ignore:.* runs without superglue")
def test_recipe_auto_leaves_out_weights_that_have_the_digest_and_do_not_fit(misfits):
    with pytest.warns(UserWarning, match=DOES_WITHOUT):
        assembly = assemble("auto", weights=[misfits])
    assert assembly.recipe.matcher_names == ("sift",)
    assert "weights cannot be loaded: superglue, aliked" in assembly.left_out


@pytest.mark.filterwarnings("ignore:.* runs without superglue")
@pytest.mark.parametrize(
    ("units", "expected"),
    [
        (
            [Unit(1, "aliked", 640, fallback="sift"), Unit(2, "sift", 640)],
            ["1:sift@640", "2:sift@640"],
        ),
        (
            [Unit(1, "aliked", 640), Unit(2, "sift", 640), Unit(1, "sift", 640)],
            ["1:sift@640", "2:sift@640"],
        ),
        ([Unit(1, "sift", 640), Unit(2, "aliked", 640, fallback="superglue")], ["1:sift@640"]),
        (
            [Unit(1, "sift", 640), Unit(2, "aliked", 640, fallback="aliked_lightglue")],
            ["1:sift@640"],
        ),
    ],
    ids=[
        "fallback",
        "another unit sweeps",
        "a fallback that does not fit, either",
        "a fallback without weights",
    ],
)
def test_a_named_recipe_runs_the_fallback_of_weights_that_do_not_fit_or_omits_the_unit(
    misfits, units, expected
):
    with pytest.warns(UserWarning, match=DOES_WITHOUT):
        assembly = assemble(Recipe(tuple(units)), weights=[misfits])
    assert [unit.name for unit in assembly.recipe.units] == expected


def test_a_recipe_without_a_unit_left_to_sweep_is_refused_with_the_reason(misfits):
    # Without stage 1 there are no points from which a crop could come.
    recipe = Recipe((Unit(1, "aliked", 640), Unit(2, "sift", 640)), name="mine")
    says = (
        "recipe 'mine' has no unit left that can sweep all pairs: "
        "weights cannot be loaded: aliked .*'aliked-n16'"
    )
    with pytest.raises(UserError, match=says):
        assemble(recipe, weights=[misfits])


TWO_UNITS = """
units = [
    { stage = 1, matcher = "aliked", long_side = 320 },
    { stage = 1, matcher = "sift", long_side = 320 },
]
"""


def submitted(demo, tmp_path, recipe, weights):
    """Submit with a recipe; "own" has ALIKED and SIFT. Return the exit status and the problems of
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
    return status, problems_of(output, test_dir)


@pytest.mark.filterwarnings("default:.* runs without")  # the command prints it
@pytest.mark.parametrize("recipe", ["auto", "own"])
def test_a_checkpoint_that_does_not_fit_does_not_end_the_run(
    misfits, demo, tmp_path, recipe, capsys
):
    # It did: a file with the manifest's digest was trusted to fit, and the run ended with status 2.
    assert submitted(demo, tmp_path, recipe, misfits) == (0, [])
    told = capsys.readouterr()
    # Once for a run, not once for each worker.
    assert len(re.findall(DOES_WITHOUT, told.err)) == 1
    assert "left out, " in told.out


@pytest.mark.filterwarnings("default:.* runs without")
def test_match_omits_a_checkpoint_that_does_not_fit_as_submit_does(misfits, demo, tmp_path, capsys):
    (tmp_path / "own.toml").write_text(TWO_UNITS)
    images = sorted((demo.test_dir / "test_images").rglob("*.png"))[:2]
    options = ["--recipe", tmp_path / "own.toml", "--weights", misfits]
    assert run_command("match", *images, *options) == 0
    told = capsys.readouterr()
    assert re.search(DOES_WITHOUT, told.err)
    assert "1:sift@320" in told.out
    assert "aliked" not in told.out


def test_a_matcher_that_fails_to_load_in_a_worker_fails_its_units_and_is_reported_once(
    misfits, demo, tmp_path, monkeypatch, capsys
):
    """As with a damaged record, which shows when its numbers are read."""
    monkeypatch.setattr(availability, "misfit", lambda *_: "")
    assert submitted(demo, tmp_path, "own", misfits) == (0, [])
    told = capsys.readouterr()
    assert told.err.count("aliked is left out: the weights for 'aliked-n16'") == 1
    assert "faults: 1\n  aliked is left out: the weights for 'aliked-n16'" in told.out


def points_keys(assembly: Assembly) -> tuple[str, ...]:
    """The keys of the units' points on a pair."""
    keys = Keys.of(assembly)
    pair = Pair("p", "b", "0.png", "1.png")
    images = tuple(BatchImage(name, name, Size(80, 60)) for name in ("0.png", "1.png"))
    stages = [unit.stage for unit in assembly.recipe.units]
    first = [keys.of_points(n, pair, images, []) for n, stage in enumerate(stages) if stage == 1]
    crops = keys.crops_of(first)
    found = []
    for n, stage in enumerate(stages):
        found.append(keys.of_points(n, pair, images, crops if stage == 2 else []))
    return tuple(found)


def test_the_key_of_points_changes_with_every_setting_that_decides_them_and_no_other():
    plain = load_recipe("classical")
    first, second, third = plain.units
    units = [points_keys(assemble(plain))]
    for other in (
        # No point depends on it
        replace(plain, units=(replace(first, tracks=False), second, third)),
        replace(plain, magsac=replace(plain.magsac, threshold=1.0)),
        # The regions of stage 2 depend on all units of stage 1
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
    # Stage 1, stage 2, stage 1: fewer units of stage 1 and another eps change the crops alone.
    assert changed == [[False, True], [False, True, False], [True] * 3]
    assert not set(units[0]) & set(points_keys(assemble(plain, precision="bfloat16")))
