"""The paper's Table 1 at equal inference count: whole images against two stages.

python -m benchmarks.table1 --train-dir DIR --weights DIR --out DIR [--pairs-per-scene 6] [--matchers sift,aliked]

All recipes run on a pair together, so that common units run once. Each finished pair is a line of OUT/pairs.jsonl:
after a kill, the same command resumes, also with more pairs. The tables are printed in Markdown at the end;
``--tables`` prints the tables of the finished pairs.
"""

import argparse
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from statistics import mean

from tqdm import tqdm

from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.data.images import ImageStore, Unreadable
from mkpc_kaggle.engine.jobs import visiting_order
from mkpc_kaggle.evaluation.compare import Difference, Paired, paired_difference
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import PoseError, pair_accuracy, pose_auc
from mkpc_kaggle.geometry.robust import RobustConfig, estimate
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Recipe, Unit

LONG_SIDES = {
    "sift": (1536, 1280, 1024, 1440, 1152, 1664),
    "aliked": (1024, 832, 640, 928, 736, 1120),
    "xfeat_lighterglue": (1024, 1280, 800, 1152, 896, 1408),
}
"""Long sides in the order of use; all differ, since equal sizes would give equal matches."""
MAX_MATCHES = {"sift": 8000}
OPTIONS: Mapping[str, Mapping[str, float]] = {"sift": {"features": 8000, "ratio": 0.8}}

LAYOUTS = {
    "one": (1, 0),
    "two": (2, 0),
    "three": (3, 0),
    "one + two": (1, 2),
    "two + one": (2, 1),
    "six": (6, 0),
    "three + three": (3, 3),
}
"""Numbers of a matcher's units on whole images and on critical regions."""
CONTRASTS = (("three", "one + two"), ("three", "two + one"), ("six", "three + three"))
"""The same units, all on whole images and split over the stages."""
ENSEMBLE_LAYOUTS = ("three", "two + one")
COVISIBILITIES = (0.0, 0.3, 0.6, 1.01)
"""Bounds of the ranges of covisibility in the table of gains."""


@dataclass(frozen=True)
class Way:
    """One way to match a pair: some matchers, and the layout of each matcher's units."""

    matchers: tuple[str, ...]
    layout: str

    @property
    def name(self) -> str:
        return f"{' + '.join(self.matchers)}: {self.layout}"

    @property
    def units(self) -> tuple[Unit, ...]:
        """The units, stage 1 first; one size of every matcher, then the next size."""
        whole, crops = LAYOUTS[self.layout]
        return tuple(
            Unit(1 if place < whole else 2, matcher, LONG_SIDES[matcher][place], MAX_MATCHES.get(matcher, 4096))
            for place in range(whole + crops)
            for matcher in self.matchers
        )


def ways_of(matchers: Sequence[str]) -> tuple[Way, ...]:
    """Return every layout of single matchers, and some layouts of two or more matchers."""
    alone = [Way((matcher,), layout) for matcher in matchers for layout in LAYOUTS]
    together = [
        Way(some, layout)
        for count in range(2, len(matchers) + 1)
        for some in combinations(matchers, count)
        for layout in ENSEMBLE_LAYOUTS
    ]
    return (*alone, *together)


def union(ways: Iterable[Way]) -> Recipe:
    """Return a recipe with the distinct units of all ways, stage 1 first."""
    units = sorted({unit: None for way in ways for unit in way.units}, key=lambda unit: unit.stage)
    names = {unit.matcher for unit in units}
    return Recipe(tuple(units), "table1", matchers={name: OPTIONS[name] for name in OPTIONS if name in names})


@dataclass(frozen=True)
class Found:
    """Result of one way on one pair; ``matches`` are MAGSAC's input, ``seconds`` are of work."""

    error: PoseError
    matches: int
    seconds: float


def try_all(
    ways: Sequence[Way], work: PairMatch, true: TruePair, scene: TrainScene, pipeline: Pipeline
) -> dict[str, Found]:
    """Run every way on one pair: units of stage 1 once, units of stage 2 once for each plain way."""
    (whole,) = pipeline.match([work], [unit for unit in pipeline.recipe.units if unit.stage == 1])
    known = {result.unit: result for result in whole.results}
    done: dict[tuple[Unit, ...], PairMatch] = {}
    for way in ways:
        if way.units not in done:
            stage1 = tuple(known[unit] for unit in way.units if unit.stage == 1)
            stage2 = [unit for unit in way.units if unit.stage == 2]
            done[way.units] = pipeline.match([replace(work, results=stage1)], stage2)[0]
    config = pipeline.recipe.magsac
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        conclude = partial(_conclude, true=true, scene=scene, config=config)
        found = pool.map(conclude, ways, [done[way.units] for way in ways])
        return {way.name: result for way, result in zip(ways, found, strict=True)}


def _conclude(way: Way, work: PairMatch, *, true: TruePair, scene: TrainScene, config: RobustConfig) -> Found:
    start = time.thread_time()  # several threads work in parallel
    matches = Matches.concatenate(result.matches for result in work.results)
    result = estimate(matches, config)
    seconds = time.thread_time() - start + work.cluster_seconds + _seconds(work.results)
    error = error_of(result.matrix, true, scene) if result.ok else PoseError.failed()
    return Found(error, len(matches), seconds)


def _seconds(results: Iterable[UnitResult]) -> float:
    return sum(result.seconds for result in results)


class ResultsFile:
    """Results of pairs in a file of JSON lines. The first line has the settings."""

    def __init__(self, path: Path, settings: Mapping[str, object]) -> None:
        self.path = path
        self.found: dict[str, dict[str, Found]] = {}
        header = json.dumps(settings, sort_keys=True)
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        whole = text[: text.rfind("\n") + 1]  # the pair of a truncated line runs again
        head, *lines = whole.splitlines() or [header]
        if head != header:
            raise SystemExit(f"{path} was made with other settings; name another --out")
        for line in lines:
            pair, found = json.loads(line)
            self.found[pair] = {way: Found(PoseError(*error), *rest) for way, (error, *rest) in found.items()}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(whole or header + "\n", encoding="utf-8")

    def add(self, pair: str, found: Mapping[str, Found]) -> None:
        values = {
            way: [
                [result.error.rotation, result.error.translation_angle, result.error.translation],
                result.matches,
                result.seconds,
            ]
            for way, result in found.items()
        }
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps([pair, values]) + "\n")
        self.found[pair] = dict(found)


def run_all(scenes: Sequence[TrainScene], ways: Sequence[Way], pipeline: Pipeline, results: ResultsFile) -> None:
    """Run every way on every pair that is not in the file. Every way fails on unreadable images."""
    todo = [(scene, true) for scene in scenes for true in _in_order(scene) if true.pair.id not in results.found]
    images = ImageStore()
    try:
        for place, (scene, true) in enumerate(tqdm(todo, unit="pair", smoothing=0.05)):
            images.prefetch(path for _, coming in todo[place : place + 2] for path in coming.pair.images)
            image0, image1 = (images.get(path) for path in true.pair.images)
            if isinstance(image0, Unreadable) or isinstance(image1, Unreadable):
                results.add(true.pair.id, {way.name: Found(PoseError.failed(), 0, 0.0) for way in ways})
                continue
            results.add(true.pair.id, try_all(ways, PairMatch(images=(image0, image1)), true, scene, pipeline))
    finally:
        images.close()


def _in_order(scene: TrainScene) -> list[TruePair]:
    return [scene.pairs[index] for index in visiting_order([true.pair for true in scene.pairs])]


@dataclass(frozen=True)
class Tables:
    """Results on the finished pairs, by scene."""

    scenes: Mapping[str, Sequence[Mapping[str, Found]]]
    pairs: Mapping[str, Sequence[TruePair]]

    @classmethod
    def of(cls, scenes: Sequence[TrainScene], results: ResultsFile) -> "Tables":
        done = {scene.name: [true for true in scene.pairs if true.pair.id in results.found] for scene in scenes}
        done = {name: pairs for name, pairs in done.items() if pairs}
        return cls(
            {name: [results.found[true.pair.id] for true in pairs] for name, pairs in done.items()},
            done,
        )

    def markdown(self, ways: Sequence[Way]) -> Iterator[str]:
        counts = ", ".join(f"{name} {len(pairs)}" for name, pairs in self.scenes.items())
        yield f"Pairs: {counts}."
        yield from ("", "### Accuracy", "", *self.accuracy(ways))
        plain = {way.name: way for way in ways}
        contrasts = [
            (replace(way, layout=naive), way)
            for naive, split in CONTRASTS
            for way in plain.values()
            if way.layout == split and replace(way, layout=naive).name in plain
        ]
        yield from ("", "### The same units, split over the stages or all on whole images", "")
        yield from self.gains(contrasts)
        yield from ("", "### The same by covisibility, pairs of all scenes together", "")
        yield from self.gains_by_covisibility(contrasts)

    def accuracy(self, ways: Sequence[Way]) -> Iterator[str]:
        """Yield a row per way: mAA by scene and their mean, AUC at 5 and 10 degrees, matches, seconds a pair."""
        yield from _head(["way", *self.scenes, "mAA", "AUC 5", "AUC 10", "matches", "seconds"])
        for way in ways:
            found = {name: [pair[way.name] for pair in pairs] for name, pairs in self.scenes.items()}
            errors = {name: [result.error for result in results] for name, results in found.items()}
            maas = [mean(map(pair_accuracy, of_scene)) for of_scene in errors.values()]
            aucs = [mean(pose_auc(of_scene, threshold) for of_scene in errors.values()) for threshold in (5, 10)]
            every = [result for results in found.values() for result in results]
            cells = [f"{value:.4f}" for value in (*maas, mean(maas), *aucs)]
            cells += [f"{mean(each.matches for each in every):.0f}", f"{mean(each.seconds for each in every):.2f}"]
            yield _row([way.name, *cells])

    def gains(self, contrasts: Iterable[tuple[Way, Way]]) -> Iterator[str]:
        """Yield a row per contrast: gains in mAA of the second way over the first, with intervals."""
        yield from _head(["way", "against", *self.scenes, "mean over scenes"])
        for first, second in contrasts:
            overall = self.difference(first, second, tuple(self.scenes))
            by_scene = [str(self.difference(first, second, (name,))) for name in self.scenes]
            yield _row([second.name, first.name, *by_scene, f"**{overall}**"])

    def gains_by_covisibility(self, contrasts: Iterable[tuple[Way, Way]]) -> Iterator[str]:
        """Yield a row per contrast and a column per range of covisibility: gains in mAA with intervals."""
        every = [item for name, found in self.scenes.items() for item in zip(found, self.pairs[name], strict=True)]
        ranges = [
            (f"{low} to {high}", [item for item in every if low <= item[1].covisibility < high])
            for low, high in pairwise(COVISIBILITIES)
        ]
        ranges = [(name, some) for name, some in ranges if some]
        yield from _head(["way", "against", *(f"{name} ({len(some)} pairs)" for name, some in ranges)])
        for first, second in contrasts:
            parts = [([found for found, _ in some], [true for _, true in some]) for _, some in ranges]
            cells = [str(paired_difference([_accuracies(*part, first, second)])) for part in parts]
            yield _row([second.name, first.name, *cells])

    def difference(self, first: Way, second: Way, scenes: Sequence[str]) -> Difference:
        return paired_difference(
            [_accuracies(self.scenes[name], self.pairs[name], first, second) for name in scenes]
        )


def _accuracies(
    found: Sequence[Mapping[str, Found]], pairs: Sequence[TruePair], first: Way, second: Way
) -> Paired:
    """Return the accuracies of the same pairs in two ways, and the pairs' images."""
    accuracies, others = ([pair_accuracy(each[way.name].error) for each in found] for way in (first, second))
    return accuracies, others, [(true.pair.file0, true.pair.file1) for true in pairs]


def _head(cells: Sequence[str]) -> list[str]:
    return [_row(cells), _row(["---"] * len(cells))]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", type=Path, action="append", default=[])
    parser.add_argument("--device", default="auto")
    parser.add_argument("--matchers", default=",".join(LONG_SIDES), help="default: %(default)s")
    parser.add_argument("--scenes", default="", help="default: all")
    parser.add_argument("--pairs-per-scene", type=int, help="evenly spread; default: all")
    parser.add_argument("--min-covisibility", type=float, default=0.1)
    parser.add_argument("--tables", action="store_true", help="match nothing, print what there is")
    arguments = parser.parse_args()
    scenes = read_train_side(
        arguments.train_dir,
        scenes=filter(None, arguments.scenes.split(",")),
        min_covisibility=arguments.min_covisibility,
        pairs_per_scene=arguments.pairs_per_scene,
    )
    ways = ways_of(arguments.matchers.split(","))
    assembly = assemble(union(ways), weights=arguments.weights, device=arguments.device)
    settings = {
        **assembly.fingerprint(),
        "estimation": assembly.recipe.estimation(),
        "ways": [way.name for way in ways],
    }
    results = ResultsFile(arguments.out / "pairs.jsonl", settings)
    if not arguments.tables:
        run_all(scenes, ways, assembly.pipeline(), results)
    print("\n".join(Tables.of(scenes, results).markdown(ways)))


if __name__ == "__main__":
    main()
