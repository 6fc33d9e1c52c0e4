"""The sections of a run's report: each is a function from the run's log to blocks.

A new one is a function here and its line in :func:`sections_of`.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from math import inf
from statistics import median
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pandas as pd

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Unreadable, read_image
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.journal_tables import EventKind
from mkpc_kaggle.engine.records import SceneRecord
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, ModelKind, sampson_distances
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.two_stage import to_image
from mkpc_kaggle.reporting import figures
from mkpc_kaggle.reporting.blocks import (
    MOST_ROWS,
    Block,
    Picture,
    Pictures,
    Plot,
    Section,
    Table,
    Text,
    first_rows,
)
from mkpc_kaggle.reporting.run_log import RunLog, WeakPair
from mkpc_kaggle.reporting.tables import seconds_by_part, unit_failures, unit_means

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_GROUPS = 30
MOST_CHANGES = 5
MOST_SCENES = 4
DRAWING_SECONDS = 4.0
"""Time that must be left to begin to draw: matplotlib alone takes one or two to load."""

Drawn = TypeVar("Drawn")


@dataclass
class Artist:
    """Draws until ``deadline`` (seconds of the monotonic clock); ``sources`` are pairs with paths to images.

    ``missing`` is empty, or says why some figures are not there.
    """

    sources: Sequence[Pair] = ()
    deadline: float = inf
    missing: str = ""
    _longest: float = field(default=DRAWING_SECONDS / 2, init=False)

    def __post_init__(self) -> None:
        if find_spec("matplotlib") is None:
            self.missing = "matplotlib is not installed: pip install 'mkpc-kaggle[plots]'"

    def draw(self, make: Callable[[], Drawn]) -> list[Drawn]:
        """What ``make`` draws; nothing where it cannot, or where there may not be time enough."""
        start = time.monotonic()
        if not self.missing and start + 2 * self._longest > self.deadline:
            self.missing = "little time was left; the journal command draws them"
        if self.missing:
            return []
        drawn = make()
        self._longest = max(self._longest, time.monotonic() - start)
        return [drawn]

    def plot(self, make: "Callable[[], Figure]") -> list[Plot]:
        return self.draw(lambda: Plot(figures.to_svg(make())))


def sections_of(log: RunLog, artist: Artist) -> list[Section]:
    """All sections, in order."""
    return [
        Section("Where the time went", [*_time(log, artist)]),
        Section("The budget over time", [*_budget(log, artist)]),
        Section("Units given up, and faults", [*_plan(log)]),
        Section("What upgrades changed", [*_upgrades(log, artist)]),
        Section("Inliers by batch", [*_groups(log, artist)]),
        Section("Critical regions", [*_regions(log, artist)]),
        Section("Scenes", [*_scenes(log, artist)]),
        Section("The weakest pairs", [*_weakest(log, artist)]),
        Section("Failures", [*_failures(log)]),
        Section("What made this", [*_origin(log)]),
    ]


def _time(log: RunLog, artist: Artist) -> Iterator[Block]:
    parts = seconds_by_part(log.tables)
    yield from artist.plot(lambda: figures.draw_parts(parts))
    count = max(1, len(log.pairs))
    yield Table(("part", "seconds", "a pair"), [(n, f"{s:.1f}", f"{s / count:.3f}") for n, s in parts.items()])
    rows = [
        (one.Index, one.pairs, f"{one.matches:.0f}", f"{one.inliers:.0f}", f"{one.seconds:.2f}")
        for one in unit_means(log.tables).itertuples()
    ]
    if rows:
        yield Table(("unit (means)", "pairs", "matches", "inliers", "seconds"), rows)
    if log.about.left_out:
        yield Text(f"Left out: {'; '.join(log.about.left_out)}.")


def _budget(log: RunLog, artist: Artist) -> Iterator[Block]:
    ended = _jobs_ended(log)
    if not ended:
        yield Text("No job has ended in the last session.", dim=True)
        return
    yield from artist.plot(lambda: budget_figure(log))
    rows = [(phase, len(times), f"{min(times):.1f}", f"{max(times):.1f}") for phase, times in ended.items()]
    yield Table(("phase", "jobs", "first (s)", "last (s)"), rows)


def budget_figure(log: RunLog) -> "Figure":
    """The jobs that ended over the time of the last session; see :func:`figures.draw_budget`."""
    marks = {
        name: [event.seconds for event in log.session if event.kind == kind]
        for name, kind in (("plan changed", EventKind.PLAN), ("fault", EventKind.FAULT))
    }
    return figures.draw_budget(_jobs_ended(log), marks, log.about.limit)


def _jobs_ended(log: RunLog) -> dict[str, list[float]]:
    """When the jobs of each phase ended, in seconds since the start of the last session."""
    ended: dict[str, list[float]] = {}
    for event in log.session:
        if event.kind == EventKind.BUDGET:
            ended.setdefault(event.text, []).append(event.seconds)
    return ended


def _plan(log: RunLog) -> Iterator[Block]:
    events = [event for event in log.events if event.kind in (EventKind.PLAN, EventKind.FAULT)]
    rows = [(format_duration(event.seconds), event.kind, event.text) for event in events]
    yield from first_rows(("when", "what", "why"), rows) if rows else [Text("None.", dim=True)]


def _upgrades(log: RunLog, artist: Artist) -> Iterator[Block]:
    """What pairs gained by extra units, and by regular ones that had not fitted before."""
    upgraded = [(record, record.before) for record in log.records if record.before is not None]
    if not upgraded:
        yield Text("No pair was upgraded.", dim=True)
        return
    before = [before for _, before in upgraded]
    after = [record.inliers for record, _ in upgraded]
    yield from artist.plot(lambda: figures.draw_upgrades(before, after))
    ids = [log.pairs[record.index].id for record, _ in upgraded]
    changes = [(id_, a, b, b - a) for id_, a, b in zip(ids, before, after, strict=True)]
    changes.sort(key=lambda change: -change[3])
    ends = changes if len(changes) <= 2 * MOST_CHANGES else changes[:MOST_CHANGES] + changes[-MOST_CHANGES:]
    yield Table(("pair", "before", "after", "gain"), [(*rest, f"{gain:+d}") for *rest, gain in ends])
    signs = Counter(int(np.sign(gain)) for *_, gain in changes)
    counts = f"{signs[1]} have more, {signs[0]} have as many, {signs[-1]} have fewer"
    yield Text(f"{len(changes)} pairs went from {sum(before)} to {sum(after)} inliers: {counts}.")
    if len(ends) < len(changes):
        yield Text(f"The {MOST_CHANGES} greatest gains and the {MOST_CHANGES} smallest.", dim=True)


def _groups(log: RunLog, artist: Artist) -> Iterator[Block]:
    pairs = log.tables.pairs
    if pairs.empty:
        yield Text("No pairs.", dim=True)
        return
    inliers = pairs.groupby("group")["inliers"]
    counts = inliers.agg(["size", "median", "min", "max"])
    counts["failed"] = (pairs["failure"] != "").groupby(pairs["group"]).sum()
    counts = counts.sort_values("median", kind="stable")
    weakest = {str(name): inliers.get_group(name).tolist() for name in counts.index[:MOST_GROUPS]}
    yield from artist.plot(lambda: figures.draw_groups(weakest))
    if len(counts) > MOST_GROUPS:
        yield Text(f"Drawn are the {MOST_GROUPS} weakest of {len(counts)} batches.", dim=True)
    columns = counts[["size", "failed", "median", "min", "max"]].round().astype(int)
    yield from first_rows(("batch", "pairs", "no F", "median", "least", "most"), [*columns.itertuples(name=None)])


def _regions(log: RunLog, artist: Artist) -> Iterator[Block]:
    regions = log.tables.regions
    if regions.empty:
        yield Text("No unit of stage 2 has looked for one.", dim=True)
        return
    sizes = pd.DataFrame(
        {"width": regions["right"] - regions["left"], "height": regions["bottom"] - regions["top"]}
    )
    reasons = regions["reason"].value_counts().index
    by_reason = {str(reason): sizes[regions["reason"] == reason] for reason in reasons}
    yield from artist.plot(
        lambda: figures.draw_crops(
            {reason: list(some.itertuples(index=False)) for reason, some in by_reason.items()}
        )
    )
    rows = [(reason, len(some), *(f"{side:.0f}" for side in some.median())) for reason, some in by_reason.items()]
    yield Table(("reason", "regions", "width", "height"), rows)
    yield Text("Width and height are medians. For any reason but “cropped” the whole image stands in.")


def _scenes(log: RunLog, artist: Artist) -> Iterator[Block]:
    """The batches that were reconstructed: cameras and points, and which pairs have their F from there."""
    if not log.scenes:
        yield Text("No batch was reconstructed: recipe or command say so, or none has three images.", dim=True)
        return
    largest = sorted((scene for scene in log.scenes if scene.placed), key=lambda scene: -scene.placed)
    for scene in largest[:MOST_SCENES]:
        yield from artist.plot(partial(figures.draw_cameras, scene))
    pairs = log.tables.pairs
    counts = pairs[pairs["source"] == "scene"].groupby("group").size()
    rows = [
        (
            *(scene.batch, f"{scene.placed} of {scene.images}", scene.points),
            _focals(scene),
            *(f"{scene.seconds:.1f}", int(counts.get(scene.batch, 0)), scene.failure),
        )
        for scene in log.scenes
    ]
    heads = ("batch", "images", "points", "focals (px): least / median / most", "seconds", "pairs", "failure")
    yield from first_rows(heads, rows)
    reasons = Counter(str(record.scene.reason) for record in log.records if record.scene is not None)
    yield Table(("which F a pair has, and why", "pairs"), list(reasons.most_common()))
    alone = sum(record.source == "scene" and bool(record.failure) for record in log.records)
    yield Text(f"{alone} pairs would have no F without their scene.")


def _focals(scene: SceneRecord) -> str:
    focals = [camera.focal for camera in scene.cameras]
    return f"{min(focals):.0f} / {median(focals):.0f} / {max(focals):.0f}" if focals else "-"


def _weakest(log: RunLog, artist: Artist) -> Iterator[Block]:
    if not log.weakest:
        yield Text("No pair was matched.", dim=True)
        return
    yield Text(
        "The pairs with the fewest inliers of those that were matched. "
        "Green: inliers; orange: other matches; yellow: critical regions."
    )
    sources = {pair.id: pair for pair in artist.sources}
    shown: list[Picture] = []
    rows = []
    for weak in log.weakest:
        pair, record = log.pairs[weak.record.index], weak.record
        drawn = _draw_weak(log, weak, sources[pair.id], artist) if pair.id in sources else "not drawn"
        if isinstance(drawn, Picture):
            shown.append(drawn)
        else:
            rows.append((pair.id, record.matches, record.inliers, record.failure or drawn))
    if shown:
        yield Pictures(shown)
    if not sources:
        yield Text("No pictures: where the images are is not known (--test-dir).", dim=True)
    if rows:
        yield Table(("pair", "matches", "inliers", "why"), rows)


def _draw_weak(log: RunLog, weak: WeakPair, source: Pair, artist: Artist) -> Picture | str:
    """The pair with its matches; or why it is not drawn."""

    def make() -> Picture | str:
        record = weak.record
        image0, image1 = map(read_image, source.images)
        if isinstance(image0, Unreadable) or isinstance(image1, Unreadable):
            return "an image cannot be read any more"
        match = match_of(weak, log.recipe.magsac.threshold)
        caption = f"{source.id}: {record.inliers} inliers of {record.matches} matches"
        if record.failure:
            caption += f"; {record.failure}"
        if len(match.matches) < record.matches:
            caption += "; the points are no longer known"
        jpeg = figures.to_jpeg(figures.draw_strip((image0, image1), match))
        return Picture(jpeg, caption, f"the images of {source.id}, matches and critical regions")

    drawn = artist.draw(make)
    return drawn[0] if drawn else "not drawn"


def weak_figure(log: RunLog, weak: WeakPair, source: Pair) -> "Figure":
    """Matches, clusters and critical regions of one of the weakest pairs, as the journal has them.

    ``source`` is the pair with the paths of its images; raises :class:`UserError` where one cannot be read.
    """
    image0, image1 = map(to_image, source.images)
    return figures.draw_pair(image0, image1, match_of(weak, log.recipe.magsac.threshold), log.recipe.mkpc)


def match_of(weak: WeakPair, threshold: float) -> PairMatch:
    """The pair as MAGSAC left it, without running it again; inliers are within ``threshold`` pixels."""
    record = weak.record
    matches = Matches.concatenate(result.matches for result in weak.results)
    inliers = sampson_distances(record.F, matches) < threshold
    if record.failure:
        inliers = np.zeros(len(matches), bool)
    return PairMatch(weak.results, record.regions, Estimate(ModelKind.F, record.F, inliers, record.failure))


def _failures(log: RunLog) -> Iterator[Block]:
    failed, units = log.tables.failed, unit_failures(log.tables)
    if failed.empty and not units:
        yield Text("None.", dim=True)
    if len(failed):
        yield Text(f"{len(failed)} pairs have the fallback row.")
        # Reasons that name a file differ in that only: the row says which pair it was.
        reasons = failed["failure"].value_counts()
        if len(reasons) < len(failed):
            yield Table(("pairs", "reason"), [(n, reason) for reason, n in reasons[:MOST_ROWS].items()])
        rows = list(failed[["id", "group", "failure"]].itertuples(index=False))
        yield from first_rows(("pair", "batch", "reason"), rows)
    if units:
        yield Table(("units that failed",), [(what,) for what in units[:MOST_ROWS]])


def _origin(log: RunLog) -> Iterator[Block]:
    yield Table(("software", "version"), [*log.about.versions.items()])
    yield Table(("digest of", "SHA-256"), [*log.digests.items()])
    units = ", ".join(unit.name for unit in log.recipe.units)
    yield Text(f"Units of the recipe, in order of importance: {units}.", dim=True)
    yield Text(f"Journal: {log.path}", dim=True)
