"""The benchmark of the paper's Table 1: the same units whole and split."""

from pathlib import Path

import pytest

from benchmarks import table1
from benchmarks.table1 import CONTRASTS, Found, ResultsFile, Tables, Way, run_all, union, ways_of
from mkpc_kaggle.data.competition import read_train_side
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Interrupt, Session
from mkpc_kaggle.evaluation.validate import validate
from mkpc_kaggle.geometry.metrics import PoseError
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.recipe import Mode


@pytest.mark.parametrize(("naive", "split"), CONTRASTS)
def test_contrasts_have_the_same_units_and_as_many(naive: str, split: str) -> None:
    for matchers in (("sift",), ("aliked", "xfeat_lighterglue")):
        whole, split_units = Way(matchers, naive).units, Way(matchers, split).units
        assert {unit.stage for unit in split_units} == {1, 2}
        assert {unit.stage for unit in whole} == {1}
        recipe = union([Way(matchers, split)])
        assert {unit.name for unit in recipe.in_mode(Mode.WHOLE_IMAGES).units} == {unit.name for unit in whole}
        assert len(whole) == len(split_units)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> tuple[Way, ...]:
    monkeypatch.setattr(table1, "LONG_SIDES", {"sift": (320, 400, 480)})
    layouts = {"one": (1, 0), "three": (3, 0), "one + two": (1, 2)}
    monkeypatch.setattr(table1, "LAYOUTS", layouts)
    return ways_of(["sift"])


def test_it_gives_what_the_engine_gives_and_goes_on_where_it_was(
    demo: DemoSet, small: tuple[Way, ...], tmp_path: Path
) -> None:
    (scene,) = read_train_side(demo.train_dir, pairs_per_scene=3)
    assembly = assemble(union(small))
    path = tmp_path / "out" / "pairs.jsonl"
    run_all([scene], small, assembly.pipeline(), ResultsFile(path, {"a": 1}))
    results = ResultsFile(path, {"a": 1})
    assert set(results.found) == {true.pair.id for true in scene.pairs}

    way = next(way for way in small if way.name == "sift: one + two")
    recipe = assemble(union([way]))
    session = Session(tmp_path / "work", Budget(0.0), Interrupt(), progress=False)
    validation = validate([scene], recipe, session)
    for score in validation.scenes[0].pairs:
        assert score.record is not None
        found = results.found[score.id][way.name]
        assert found.matches == score.record.matches
        assert found.error == score.error

    whole = path.read_bytes()
    last = whole.splitlines(keepends=True)[-1]
    path.write_bytes(whole[: -len(last) // 2])  # the last line was cut off
    again = ResultsFile(path, {"a": 1})
    assert len(again.found) == len(scene.pairs) - 1
    run_all([scene], small, assembly.pipeline(), again)
    assert ResultsFile(path, {"a": 1}).found.keys() == results.found.keys()
    with pytest.raises(SystemExit, match="other settings"):
        ResultsFile(path, {"a": 2})

    lines = list(Tables.of([scene], again).markdown(small))
    assert lines[0] == "Pairs: courtyard 3."
    rows = [line.split(" | ")[0] for line in lines if line.startswith("| sift")]
    assert rows == [
        "| sift: one",
        "| sift: three",
        "| sift: one + two",
        "| sift: one + two",
        "| sift: one + two",
    ]


def test_gains_by_covisibility_are_those_of_the_pairs_within() -> None:
    first, second = Way(("sift",), "three"), Way(("sift",), "one + two")
    good, bad = (Found(PoseError(angle, angle, 0.0), 100, 1.0) for angle in (0.5, 90.0))
    pairs = [{first.name: bad, second.name: good}, {first.name: good, second.name: good}]
    tables = Tables({"a": pairs, "b": pairs[:1]}, {"a": [0.2, 0.7], "b": [0.29]})
    head, _, row = tables.gains_by_covisibility([(first, second)])
    assert "0.0 to 0.3 (2 pairs) | 0.6 to 1.01 (1 pairs)" in head
    assert "| +1.0000 [+1.0000, +1.0000] | +0.0000 [+0.0000, +0.0000] |" in row
