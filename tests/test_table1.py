"""The benchmark of the paper's Table 1: the same units whole and split."""

from pathlib import Path

import pytest

from benchmarks import table1
from benchmarks.table1 import ResultsFile, Tables, Way, run_all, union, ways_of
from mkpc_kaggle.data.competition import read_train_side
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Interrupt, Session
from mkpc_kaggle.evaluation.validate import validate
from mkpc_kaggle.pipeline.assembly import assemble


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
    assert sum(line.startswith("| sift") for line in lines) == 5
