"""One-screen summary of a run: results, costs, failed pairs."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.engine.request import Ending, RunReport
from mkpc_kaggle.geometry.critical_region import RegionReason
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.reporting.run_log import SECONDS, RunLog
from mkpc_kaggle.scene.reconstruction import Sigmas

MAX_LINES = 8  # per list

Run: TypeAlias = RunReport | RunLog


def summary(report: RunReport) -> str:
    """Return the summary at the end of a run."""
    resumed = f", {report.resumed} of them from earlier runs" if report.resumed else ""
    done = f"; {report.units_run} units run, {report.estimated} F estimated"
    printed = f"messages of image and device libraries: {report.log}" if report.log else ""
    lines = [headline(report) + resumed + done, *_lines(report), printed, trouble(report)]
    return "\n".join(filter(None, lines))


def overview(log: RunLog) -> str:
    """Return the summary of a journal."""
    about = f"recipe {log.recipe.name}, {log.about.device}, {len(log.events)} events"
    return "\n".join(filter(None, [headline(log), about, left_out_line(log.about.left_out), *_lines(log)]))


def headline(run: Run) -> str:
    """Return a line: how the run ended, its duration, and the number of pairs with an F."""
    count = f"{sum(record.is_solved for record in run.records)} of {len(run.records)} pairs have an F"
    return f"{run.ending} after {format_duration(run.seconds)}: {count}"


def trouble(run: Run) -> str:
    """Return why a run with a complete file failed, or an empty string.

    A pair without an F counts only if an error is the cause, rather than few matches or little time.
    """
    if run.ending in (Ending.NO_WORKER, Ending.NOTHING_RUNS):
        return f"the run failed: {run.ending}, the faults say why; the same command resumes"
    reached = [record for record in run.records if record.reached]
    reasons = Counter(filter(None, map(_error, reached)))
    if 2 * reasons.total() <= len(reached):
        return ""
    ((reason, count),) = reasons.most_common(1)
    share = f"{reasons.total()} of {len(reached)} pairs"
    return f"the run failed: errors left {share} without an F, {count} of them with this one: {reason}"


def _error(record: PairRecord) -> str:
    """Return the error that left a pair without an F, or an empty string."""
    if record.is_solved:
        return ""
    if not record.units:
        return record.failure
    return next((unit.failure for unit in record.units if unit.failure and not unit.matches), "")


def left_out_line(left_out: Sequence[str]) -> str:
    """Return a line with the matchers that did not run, by cause; empty if all ran."""
    return f"left out, {'; '.join(left_out)}" if left_out else ""


def unit_means(run: Run) -> list[tuple[str, int, float, float, float]]:
    """Return a row per unit: name, number of pairs, and mean matches, inliers and seconds."""
    results: dict[str, list[tuple[float, float, float]]] = {}
    for unit in (unit for record in run.records for unit in record.units):
        values = unit.matches, unit.inliers, unit.encode_seconds + unit.match_seconds
        results.setdefault(unit.unit, []).append(values)
    return [(name, len(rows), *np.mean(rows, axis=0)) for name, rows in results.items()]


def unit_reasons(run: Run, field: str = "failure") -> list[str]:
    """Return the units' failures, or another ``field``, with numbers of pairs, the most frequent first."""
    units = (unit for record in run.records for unit in record.units)
    counts = Counter(f"{unit.unit}: {getattr(unit, field)}" for unit in units if getattr(unit, field))
    return [f"{reason} ({count} pairs)" for reason, count in counts.most_common()]


def seconds_by_part(run: Run) -> dict[str, float]:
    """Return the total seconds of all pairs for each part of the work."""
    return {name: sum(getattr(record, field) for record in run.records) for field, name in SECONDS.items()}


def facts(run: Run) -> Iterator[tuple[str, str, str]]:
    """Yield the most important facts as (name, value, remark)."""
    records, scenes = run.records, run.scenes
    solved, sources = [record for record in records if record.is_solved], Counter(each.source for each in records)
    parts = (("scene", "from scenes"), ("pair", "from their own matches"), ("fallback", "fallback"))
    from_where = ", ".join(f"{sources[source]} {what}" for source, what in parts if source in sources)
    yield "pairs with an F", f"{len(solved)} of {len(records)}", from_where
    if inliers := [record.inliers for record in solved]:
        yield "inliers of a pair", f"{median(inliers):.0f}", f"the median; the minimum is {min(inliers)}"
        overlapping = sum(record.overlaps for record in solved)
        threshold = f"at least {MIN_SUPPORT:g} times the inliers expected by chance"
        yield "overlapping pairs", f"{overlapping} of {len(solved)}", threshold
    if regions := Counter(region.reason for record in records for region in record.regions or ()):
        counts = ", ".join(f"{count} {reason}" for reason, count in regions.most_common())
        yield "critical regions", f"{regions[RegionReason.CROPPED]} of {regions.total()}", counts
    if scenes:
        placed, images = sum(scene.registered for scene in scenes), sum(scene.images for scene in scenes)
        yield "images with a camera", f"{placed} of {images}", f"in {len(scenes)} batches"


def _lines(run: Run) -> Iterator[str]:
    """Yield the facts, means of units, seconds and weakest cameras, then lists of failures, units and faults."""
    yield from (f"{name}: {value} ({remark})" for name, value, remark in facts(run))
    if means := unit_means(run):
        yield f"{'unit':<30}{'pairs':>7}{'matches':>9}{'inliers':>9}{'seconds':>9}"
    for name, pairs, matches, inliers, seconds in means:
        yield f"{name:<30}{pairs:>7}{matches:>9.0f}{inliers:>9.0f}{seconds:>9.2f}"
    count = max(1, len(run.records))
    parts = (f"{name} {seconds / count:.3f}" for name, seconds in seconds_by_part(run).items())
    yield f"seconds a pair: {', '.join(parts)}"
    yield from weakest_line(run.scenes)
    no_scene = [f"{scene.batch}: {scene.failure}" for scene in run.scenes if scene.failure]
    failed = [f"{record.pair.id}: {record.failure}" for record in run.records if not record.is_solved]
    yield from _list("batches without a scene", no_scene)
    yield from _list("pairs with the fallback row", failed)
    yield from _list("units that failed", unit_reasons(run))
    yield from _list("units that ran otherwise than written", unit_reasons(run, "note"))
    yield from _list("faults", run.faults)


def weakest_line(scenes: Sequence[SceneRecord]) -> Iterator[str]:
    """Yield a line with the weakest cameras, if any is known."""
    named = [f"{Path(name).name} ({100 * sigmas.centre:.2g} %)" for name, sigmas in weakest_cameras(scenes)[:3]]
    if named:
        yield f"weakest cameras, with the error of the centre: {', '.join(named)}"


def weakest_cameras(scenes: Sequence[SceneRecord]) -> list[tuple[str, Sigmas]]:
    """Return (image name, sigmas) of each camera, the largest expected error of the centre first."""
    placed = (found for scene in scenes for model in scene.models for found in model.images)
    known = [(found.image.name, found.sigmas) for found in placed if found.sigmas]
    return sorted(known, key=lambda each: -each[1].centre)


def _list(title: str, items: Sequence[str]) -> Iterator[str]:
    """Yield a line with the number of items, and up to ``MAX_LINES`` items."""
    if items:
        yield f"{title}: {len(items)}"
        yield from (f"  {item}" for item in items[:MAX_LINES])
    if len(items) > MAX_LINES:
        yield f"  ... and {len(items) - MAX_LINES} more"
