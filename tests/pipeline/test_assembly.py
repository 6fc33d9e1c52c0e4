"""Putting a run together: which units a recipe keeps here, and why others go or are refused."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
from shared import WEIGHTS, needs_weights
from weight_files import digest_of

from mkpc_kaggle import reconstruct
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.keys import Keys
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.contract import MatcherSpec
from mkpc_kaggle.pipeline.assembly import Assembly, assemble
from mkpc_kaggle.pipeline.availability import Licence
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit, load_recipe
from mkpc_kaggle.scene.view_graph import BatchImage
from mkpc_kaggle.weights import WeightFile
from mkpc_kaggle.weights import store as weight_store
from mkpc_kaggle.weights.manifest import manifest

pytestmark = pytest.mark.usefixtures("nowhere_else")


def own(*licences):
    """A user's matcher that is never run."""
    return {"own": SimpleNamespace(spec=MatcherSpec("own", licences=licences))}


@pytest.mark.parametrize("bad", [{"recipe": 5}, {"device": 0}, {"matchers": [1]}, {"matchers": {"own": object()}}])
def test_what_is_of_a_wrong_type_is_named(bad):
    for call in (TwoStageMatcher, partial(reconstruct, [])):
        with pytest.raises(TypeError, match=r"(recipe|device|matcher).* not |has no `spec`"):
            call(**({"recipe": "classical"} | bad))


def test_recipe_auto_leaves_out_the_units_whose_weights_are_missing():
    assembly = assemble("auto")
    others = [name for name in load_recipe("auto").matcher_names if name != "sift"]
    assert assembly.recipe.matcher_names == ("sift",)
    assert assembly.left_out == (f"no weights: {', '.join(others)}",)
    assert assembly.weight_files == {}


def test_a_named_recipe_without_its_weights_is_refused_with_the_file_names():
    with pytest.raises(UserError, match=r"needs weights.*xfeat\.pt or xfeat_sparse.*aliked-n16\.pth.*--weights"):
        assemble("light")
    for recipe in ("permissive", "best"):
        with pytest.raises(UserError, match="needs weights"):
            assemble(recipe, licence=Licence.PERMISSIVE)


@needs_weights
def test_recipes_take_what_is_there_and_fallbacks_stand_in_for_the_rest():
    auto, there = assemble("auto", weights=[WEIGHTS]), {"xfeat_lighterglue", "sift", "aliked"}
    assert auto.recipe == load_recipe("auto").only(lambda unit: unit.matcher in there)
    assert set(auto.weight_files) == {"xfeat", "xfeat-lighterglue", "aliked-n16"}
    first, sift = (auto.unit_settings(unit)["weights"] for unit in auto.recipe.units[:2])
    assert set(first) == {"xfeat", "xfeat-lighterglue"} or set(sift) == {"xfeat", "xfeat-lighterglue"}
    light = assemble("light", weights=[WEIGHTS])
    assert light.recipe.matcher_names == ("xfeat_lighterglue", "sift", "aliked")
    assert light.left_out == ("no weights: sift_lightglue, aliked_lightglue",)
    assert [unit.stage for unit in light.recipe.units] == [unit.stage for unit in load_recipe("light").units]
    assert light.recipe == light.recipe.with_fallbacks(())


@pytest.fixture
def known_files(monkeypatch, tmp_path):
    """SuperGlue's, LoFTR's and DKM's weights are there, DKM's also for indoors, of unclear terms."""
    files = [
        WeightFile(name, -1, digest_of(name.encode()), licence, slot, "here")
        for name, slot, licence in (
            ("sp.pth", "superpoint", "Magic-Leap-noncommercial"),
            ("sg.pth", "superglue-outdoor", "Magic-Leap-noncommercial"),
            ("loftr.ckpt", "loftr-outdoor", "Apache-2.0"),
            ("dkm.pth", "dkm-outdoor", "MIT"),
            ("dkm_in.pth", "dkm-indoor", "unclear"),
        )
    ]
    for file in files:
        (tmp_path / file.name).write_bytes(file.name.encode())
    others = [file for file in manifest() if file.slot not in {known.slot for known in files}]
    monkeypatch.setattr(weight_store, "manifest", lambda: (*files, *others))
    return tmp_path


def test_a_permissive_run_leaves_out_of_recipe_auto_what_is_licensed_otherwise(known_files):
    every = assemble("auto", weights=[known_files])
    assert every.recipe.matcher_names == ("superglue", "loftr", "sift", "dkm")
    some = assemble("auto", weights=[known_files], licence=Licence.PERMISSIVE)
    assert some.recipe.matcher_names == ("loftr", "sift", "dkm")
    assert some.left_out[1].startswith("weights not permitted: superglue, aspanformer")
    assert set(some.weight_files) == {"loftr-outdoor", "dkm-outdoor"}


@pytest.mark.filterwarnings("ignore:weights not verified")
def test_a_fallback_stands_in_for_a_matcher_whose_weights_are_not_permitted_or_not_there(known_files):
    recipe = Recipe((Unit(1, "superglue", 640, fallback="loftr"), Unit(2, "dkm", area="90x120")))
    every = assemble(recipe, weights=[known_files])
    assert (every.recipe.matcher_names, every.left_out) == (("superglue", "dkm"), ())
    some = assemble(recipe, weights=[known_files], licence=Licence.PERMISSIVE)
    assert (some.recipe.matcher_names, some.left_out) == (("loftr", "dkm"), ("weights not permitted: superglue",))
    (known_files / "sp.pth").unlink()
    assert assemble(recipe, weights=[known_files]).recipe == some.recipe


def test_a_permissive_run_refuses_a_recipe_by_matcher_and_licence_and_says_what_to_do():
    says = r"permissive refuses recipe '\w+' .*superglue \(Magic-Leap-noncommercial\).*recipe auto"
    with pytest.raises(UserError, match=says):
        TwoStageMatcher("imc2022", licence="permissive")


def test_the_licence_of_the_file_counts_too(known_files):
    recipe = Recipe((Unit(1, "dkm", area="90x120"),), matchers={"dkm": {"training": "outdoor"}})
    assert assemble(recipe, weights=[known_files], licence=Licence.PERMISSIVE).left_out == ()
    indoors = replace(recipe, matchers={"dkm": {"training": "indoor"}})
    assert set(assemble(indoors, weights=[known_files]).weight_files) == {"dkm-indoor"}
    with pytest.raises(UserError, match=r"dkm \(unclear\)"):
        assemble(indoors, weights=[known_files], licence=Licence.PERMISSIVE)


def test_the_licence_of_a_matcher_of_the_users_counts():
    recipe = Recipe((Unit(1, "own", 480),))
    for tags in ((), ("MIT",)):
        assert assemble(recipe, matchers=own(*tags), licence=Licence.PERMISSIVE).recipe == recipe
    with pytest.raises(UserError, match=r"own \(GPL\)"):
        assemble(recipe, matchers=own("GPL", "MIT"), licence=Licence.PERMISSIVE)


@pytest.mark.filterwarnings("ignore:weights not verified")
@pytest.mark.parametrize("name", ["xfeat_sparse_bnfolded.safetensors", "DKMv3_outdoor.pth"])
def test_recipe_auto_passes_damaged_weights_over(tmp_path, name):
    """The second has no digest in the manifest: it is found out when it is read."""
    (tmp_path / name).write_bytes(b"cut off")
    with pytest.warns(UserWarning, match=rf"(passed over|does without dkm): .*{name}"):
        assembly = assemble("auto", weights=[tmp_path])
    assert not {"dkm", "xfeat_lighterglue"} & set(assembly.recipe.matcher_names)


def points_keys(assembly: Assembly) -> tuple[str, ...]:
    """The keys of the units' points on a pair."""
    keys, pair = Keys.of(assembly), Pair("p", "b", "0.png", "1.png")
    images = tuple(BatchImage(name, name, Size(80, 60)) for name in ("0.png", "1.png"))
    stages = [unit.stage for unit in assembly.recipe.units]
    first = [keys.of_points(n, pair, images, []) for n, stage in enumerate(stages) if stage == 1]
    crops = keys.crops_of(pair, first)
    return tuple(keys.of_points(n, pair, images, crops * (stage - 1)) for n, stage in enumerate(stages))


def test_a_units_digest_has_all_that_decides_its_points():
    plain = load_recipe("classical")
    first, second, third = plain.units
    units = [points_keys(assemble(plain))]
    for other in (
        replace(plain, units=(replace(first, tracks=False), second, third)),  # no point depends on it
        replace(plain, magsac=replace(plain.magsac, threshold=1.0)),
        replace(plain, units=(first, second)),  # the regions of stage 2 depend on all units of stage 1
        replace(plain, mkpc=replace(plain.mkpc, eps=0.1)),
        replace(plain, matchers={"sift": {"ratio": 0.7}}),
    ):
        units.append(points_keys(assemble(other)))
    assert units[0] == units[1] == units[2]
    changed = [[one != two for one, two in zip(units[0][: len(other)], other, strict=True)] for other in units[3:]]
    assert changed == [[False, True], [False, True, False], [True] * 3]
    assert not set(units[0]) & set(points_keys(assemble(plain, precision="bfloat16")))
