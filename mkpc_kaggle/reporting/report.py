"""``report.html``: one page on a run, from its journal, that needs nothing but itself.

Figures need matplotlib and pictures the images; where either or the time is lacking, the page says so.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from math import inf
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Unreadable, read_image
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.journal import EventKind
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, Model, sampson_distances
from mkpc_kaggle.pipeline.stages import PairMatch
from mkpc_kaggle.pipeline.two_stage import to_image
from mkpc_kaggle.reporting import figures
from mkpc_kaggle.reporting.markup import Markup, element, join, page, picture, table
from mkpc_kaggle.reporting.run_log import RunLog, WeakPair, read_log
from mkpc_kaggle.reporting.summary import seconds_by_part, unit_failures, unit_means

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_ROWS = 100
MOST_GROUPS = 30
MOST_CHANGES = 5
DRAWING_SECONDS = 4.0
"""Time that must be left to begin to draw: matplotlib alone takes one or two to load."""
WRITING_SECONDS, WRITING_SECONDS_PER_PAIR = 0.3, 0.0002
"""Time that must be left to write a report without figures."""
LEAVING_SECONDS = 0.3
"""Time that a program needs to end."""


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

    def draw(self, make: Callable[[], Markup]) -> Markup:
        """What ``make`` draws; nothing where it cannot, or where there may not be time enough."""
        start = time.monotonic()
        if not self.missing and start + 2 * self._longest > self.deadline:
            self.missing = "little time was left; the journal command draws them"
        if self.missing:
            return Markup()
        drawn = make()
        self._longest = max(self._longest, time.monotonic() - start)
        return drawn

    def plot(self, make: Callable[[], "Figure"]) -> Markup:
        return self.draw(lambda: element("figure", Markup(figures.to_svg(make())), class_="plot"))


def report_run(work_dir: Path, path: Path, ends: float, pairs: Sequence[Pair] = ()) -> str:
    """Write the report of a run that has just ended; the line that says so, or why there is none.

    ``ends`` is when the program must have ended, in seconds of the monotonic clock; ``pairs`` are the run's, to
    be drawn. Never raises: a report must not cost a run that went well its exit status.
    """
    later = f"python -m mkpc_kaggle journal {work_dir} --report {path}"
    needed = WRITING_SECONDS + WRITING_SECONDS_PER_PAIR * len(pairs) + LEAVING_SECONDS
    if time.monotonic() + needed > ends:
        return f"no report, the time is up; later: {later}"
    try:
        write_report(read_log(work_dir), path, Artist(pairs, ends - LEAVING_SECONDS))
    except Exception as error:
        return f"warning: no report ({error}); later: {later}"
    return f"report: {path}"


def write_report(log: RunLog, path: Path, artist: Artist) -> None:
    """Write the page; raises :class:`UserError` where ``path`` cannot be written."""
    text = report_page(log, artist)
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8", errors="replace")
        part.replace(path)
    except OSError as error:
        raise UserError(f"the report {path} cannot be written: {error.strerror}") from error


def report_page(log: RunLog, artist: Artist) -> Markup:
    """The whole document."""
    sections = [
        _headline(log),
        _section("Where the time went", _time(log, artist)),
        _section("The budget over time", _budget(log, artist)),
        _section("Units given up, and faults", _plan(log)),
        _section("What upgrades changed", _upgrades(log, artist)),
        _section("Inliers by batch", _groups(log, artist)),
        _section("Critical regions", _regions(log, artist)),
        _section("The weakest pairs", _weakest(log, artist)),
        _section("Failures", _failures(log)),
        _section("What made this", _origin(log)),
    ]
    if artist.missing:
        sections.insert(1, element("p", f"Figures are missing: {artist.missing}.", class_="dim"))
    return page(f"{log.about.recipe}: {len(log.pairs)} pairs", *sections)


def _section(title: str, content: Iterable[object]) -> Markup:
    return element("section", element("h2", title), element("div", *content, class_="side"))


def _headline(log: RunLog) -> Markup:
    solved = [record for record in log.records if not record.failure]
    sessions = sum(event.kind == EventKind.START for event in log.events)
    limit = f"of {format_duration(log.about.limit)}" if log.about.limit is not None else "no time limit"
    facts = [
        ("pairs with an F", str(len(solved)), f"of {len(log.records)}"),
        ("time", format_duration(log.seconds), limit),
        ("inliers", f"{median(r.inliers for r in solved):.0f}" if solved else "-", "median of a pair"),
        ("ending", log.ending, f"session {sessions}" if sessions > 1 else "in one session"),
    ]
    boxes = [
        element(
            "div", element("span", name, class_="dim"), element("b", value), element("span", more, class_="dim")
        )
        for name, value, more in facts
    ]
    title = element("h1", f"Recipe {log.about.recipe} on {len(log.pairs)} pairs")
    return element(
        "header", title, element("p", log.about.device, class_="dim"), element("div", *boxes, class_="facts")
    )


def _time(log: RunLog, artist: Artist) -> Iterator[object]:
    parts = seconds_by_part(log.records)
    yield artist.plot(lambda: figures.draw_parts(parts))
    count = max(1, len(log.records))
    yield table(("part", "seconds", "a pair"), [(n, f"{s:.1f}", f"{s / count:.3f}") for n, s in parts.items()])
    means = unit_means(log.records)
    if means:
        heads = ("unit (means)", "pairs", "matches", "inliers", "seconds")
        yield table(
            heads, [(m.unit, m.pairs, f"{m.matches:.0f}", f"{m.inliers:.0f}", f"{m.seconds:.2f}") for m in means]
        )
    if log.about.left_out:
        names = ", ".join(log.about.left_out)
        yield element("p", f"Left out (weights missing or not permitted, or matcher unusable): {names}.")


def _budget(log: RunLog, artist: Artist) -> Iterator[object]:
    ended = _jobs_ended(log)
    if not ended:
        yield element("p", "No job has ended in the last session.", class_="dim")
        return
    yield artist.plot(lambda: budget_figure(log))
    rows = [(phase, len(times), f"{min(times):.1f}", f"{max(times):.1f}") for phase, times in ended.items()]
    yield table(("phase", "jobs", "first (s)", "last (s)"), rows)


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


def _plan(log: RunLog) -> Iterator[object]:
    told = [event for event in log.events if event.kind in (EventKind.PLAN, EventKind.FAULT)]
    if not told:
        yield element("p", "None.", class_="dim")
        return
    rows = [(format_duration(event.seconds), event.kind, event.text) for event in told]
    yield from _capped(("when", "what", "why"), rows)


def _upgrades(log: RunLog, artist: Artist) -> Iterator[object]:
    """What pairs gained by extra units, and by regular ones that had not fitted before."""
    changed = [(record, record.inliers - record.before) for record in log.records if record.before is not None]
    if not changed:
        yield element("p", "No pair was upgraded.", class_="dim")
        return
    after = [record.inliers for record, _ in changed]
    before = [record.inliers - gain for record, gain in changed]
    yield artist.plot(lambda: figures.draw_upgrades(before, after))
    signs = Counter("more" if gain > 0 else "fewer" if gain < 0 else "as many" for _, gain in changed)
    told = ", ".join(f"{signs[what]} have {what}" for what in ("more", "as many", "fewer"))
    changed.sort(key=lambda one: (-one[1], one[0].index))
    ends = changed if len(changed) <= 2 * MOST_CHANGES else changed[:MOST_CHANGES] + changed[-MOST_CHANGES:]
    rows = [
        (log.pairs[record.index].id, record.inliers - gain, record.inliers, f"{gain:+d}") for record, gain in ends
    ]
    yield table(("pair", "before", "after", "gain"), rows)
    yield element("p", f"{len(changed)} pairs went from {sum(before)} to {sum(after)} inliers: {told}.")
    if len(ends) < len(changed):
        yield element("p", f"The {MOST_CHANGES} greatest gains and the {MOST_CHANGES} smallest.", class_="dim")


def _groups(log: RunLog, artist: Artist) -> Iterator[object]:
    by_group: dict[str, list[int]] = {}
    failed: Counter[str] = Counter()
    for pair, record in zip(log.pairs, log.records, strict=True):
        by_group.setdefault(pair.group, []).append(record.inliers)
        failed[pair.group] += bool(record.failure)
    groups = dict(sorted(by_group.items(), key=lambda item: (median(item[1]), item[0])))
    if not groups:
        yield element("p", "No pairs.", class_="dim")
        return
    weakest = dict(list(groups.items())[:MOST_GROUPS])
    yield artist.plot(lambda: figures.draw_groups(weakest))
    if len(groups) > MOST_GROUPS:
        yield element("p", f"Drawn are the {MOST_GROUPS} weakest of {len(groups)} batches.", class_="dim")
    rows = [(name, len(v), failed[name], f"{median(v):.0f}", min(v), max(v)) for name, v in groups.items()]
    yield from _capped(("batch", "pairs", "no F", "median", "least", "most"), rows)


def _regions(log: RunLog, artist: Artist) -> Iterator[object]:
    sizes: dict[str, list[tuple[int, int]]] = {}
    for record in log.records:
        for region in record.regions or ():
            sizes.setdefault(str(region.reason), []).append((region.box.size.width, region.box.size.height))
    if not sizes:
        yield element("p", "No unit of stage 2 has looked for one.", class_="dim")
        return
    sizes = dict(sorted(sizes.items(), key=lambda item: -len(item[1])))
    yield artist.plot(lambda: figures.draw_crops(sizes))
    rows = [(reason, len(v), *(f"{side:.0f}" for side in np.median(v, axis=0))) for reason, v in sizes.items()]
    yield table(("reason", "regions", "width", "height"), rows)
    yield element("p", "Width and height are medians. For any reason but “cropped” the whole image stands in.")


def _weakest(log: RunLog, artist: Artist) -> Iterator[object]:
    if not log.weakest:
        yield element("p", "No pair was matched.", class_="dim")
        return
    sources = {pair.id: pair for pair in artist.sources}
    yield element(
        "p",
        "The pairs with the fewest inliers of those that were matched. "
        "Green: inliers; orange: other matches; yellow: critical regions.",
    )
    drawn = [_draw_weak(log, weak, sources.get(log.pairs[weak.record.index].id), artist) for weak in log.weakest]
    if any(drawn):
        yield element("div", *drawn, class_="pictures")
    if not all(drawn):
        if not sources:
            yield element("p", "No pictures: where the images lie was not told (--test-dir).", class_="dim")
        rows = [
            (log.pairs[weak.record.index].id, weak.record.matches, weak.record.inliers, weak.record.failure)
            for weak, shown in zip(log.weakest, drawn, strict=True)
            if not shown
        ]
        yield table(("pair", "matches", "inliers", "failure"), rows)


def _draw_weak(log: RunLog, weak: WeakPair, source: Pair | None, artist: Artist) -> Markup:
    if source is None:
        return Markup()
    record = weak.record
    caption = f"{source.id}: {record.inliers} inliers of {record.matches} matches"
    if record.failure:
        caption += f"; {record.failure}"

    def make() -> Markup:
        image0, image1 = map(read_image, source.images)
        if isinstance(image0, Unreadable) or isinstance(image1, Unreadable):
            return element("p", f"{caption}; an image cannot be read any more", class_="dim")
        match = match_of(weak, log.recipe.magsac.threshold)
        told = caption if len(match.matches) == record.matches else f"{caption}; the points are no longer known"
        data = figures.to_jpeg(figures.draw_strip((image0, image1), match))
        return picture(data, "image/jpeg", told, f"the images of {source.id}, matches and critical regions")

    return artist.draw(make)


def weak_figure(log: RunLog, weak: WeakPair, source: Pair) -> "Figure":
    """Matches, clusters and critical regions of one of the weakest pairs, as the journal has them.

    ``source`` is the pair with the paths of its images; raises :class:`UserError` where one cannot be read.
    """
    image0, image1 = map(to_image, source.images)
    return figures.draw_pair(image0, image1, match_of(weak, log.recipe.magsac.threshold), log.recipe.mkpc)


def match_of(weak: WeakPair, threshold: float) -> PairMatch:
    """The pair as MAGSAC left it, without running it again; ``threshold`` in pixels tells the inliers."""
    record = weak.record
    matches = Matches.concatenate(result.matches for result in weak.results)
    inliers = sampson_distances(record.F, matches) < threshold
    if record.failure:
        inliers = np.zeros(len(matches), bool)
    return PairMatch(weak.results, record.regions, Estimate(Model.F, record.F, inliers, record.failure))


def _failures(log: RunLog) -> Iterator[object]:
    failed = [record for record in log.records if record.failure]
    units = unit_failures(log.records)
    if not failed and not units:
        yield element("p", "None.", class_="dim")
    if failed:
        # Reasons that name a file differ in that only: the row says which pair it was.
        reasons = Counter(record.failure for record in failed).most_common(MOST_ROWS)
        yield element("p", element("b", f"{len(failed)} pairs have the fallback row."))
        if len(reasons) < len(failed):
            yield table(("pairs", "reason"), [(count, reason) for reason, count in reasons])
        rows = [(log.pairs[record.index].id, log.pairs[record.index].group, record.failure) for record in failed]
        yield from _capped(("pair", "batch", "reason"), rows)
    if units:
        yield element("p", element("b", "Units that failed:"))
        yield element("ul", *(element("li", what) for what in units[:MOST_ROWS]))


def _origin(log: RunLog) -> Iterator[object]:
    yield table(("software", "version"), [(element("span", name), v) for name, v in log.about.versions.items()])
    yield table(("digest of", "SHA-256"), [(name, element("code", d)) for name, d in log.digests.items()])
    units = ", ".join(unit.name + (" (extra)" if unit.extra else "") for unit in log.recipe.units)
    yield element("p", join(["Units of the recipe, in order of importance: ", units, "."]), class_="dim")
    yield element("p", join(["Journal: ", element("code", log.path)]), class_="dim")


def _capped(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> Iterator[Markup]:
    """A table of the first rows, and how many there are besides."""
    yield table(heads, rows[:MOST_ROWS])
    if len(rows) > MOST_ROWS:
        yield element("p", f"... and {len(rows) - MOST_ROWS} more; the journal command exports all.", class_="dim")
