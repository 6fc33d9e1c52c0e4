"""Summary of a run on one screen: results, costs, failed pairs."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.engine.request import Ending, RunReport
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.reporting.run_log import RunLog, RunTables, run_tables
from mkpc_kaggle.scene.reconstruction import Sigmas

MAX_LINES = 8  # of each list


def summary(pairs: Sequence[Pair], report: RunReport) -> str:
    """Return the summary at the end of a run."""
    tables = run_tables(pairs, report.records)
    resumed = f", {report.resumed} of them from earlier runs" if report.resumed else ""
    done = f"; {report.units_run} units run, {report.estimated} F estimated"
    lines = [headline(tables, report) + resumed + done, *_lines(tables, report), trouble(report)]
    return "\n".join(filter(None, lines))


def overview(log: RunLog) -> str:
    """Return the summary of a journal."""
    about = f"recipe {log.recipe.name}, {log.about.device}, {len(log.events)} events"
    lines = [headline(log.tables, log), about, left_out_line(log.about.left_out), *_lines(log.tables, log)]
    return "\n".join(filter(None, lines))


def headline(tables: RunTables, run: RunReport | RunLog) -> str:
    """Return the run's ending and the number of pairs with an F."""
    count = f"{len(tables.solved)} of {len(tables.pairs)} pairs have an F"
    return f"{run.ending} after {format_duration(run.seconds)}: {count}"


def trouble(run: RunReport | RunLog) -> str:
    """Return why a run failed although its file is complete, or an empty string.

    Pairs without an F count only if an error is the cause, not too few matches or too little time.
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
    """Return the error that left a pair without an F, if any."""
    if record.source != "fallback":
        return ""
    if not record.units:
        return record.failure
    return next((unit.failure for unit in record.units if unit.failure and not unit.matches), "")


def left_out_line(left_out: Sequence[str]) -> str:
    """Return the matchers that did not run, by cause, with advice on weights; empty if all ran."""
    advice = " (`python -m mkpc_kaggle weights fetch --out DIR` gets weights)"
    has_advice = any(cause.startswith("no weights") for cause in left_out)
    return f"left out, {'; '.join(left_out)}{advice * has_advice}" if left_out else ""


def _lines(tables: RunTables, run: RunReport | RunLog) -> Iterator[str]:
    """Yield inliers, means of units, regions, seconds and scenes, then lists of failures, units and faults."""
    inliers, means, failed, scenes = tables.solved["inliers"], tables.unit_means, tables.failed, run.scenes
    if len(inliers):
        yield f"inliers: median {inliers.median():.0f}, mean {inliers.mean():.1f}, least {inliers.min()}"
        if doubtful := (~tables.solved["overlaps"]).sum():
            yield f"pairs that may show different things: {doubtful} (support below {MIN_SUPPORT:g})"
    if len(means):
        yield f"{'unit':<30}{'pairs':>7}{'matches':>9}{'inliers':>9}{'seconds':>9}"
    for unit in means.itertuples():
        yield f"{unit.unit:<30}{unit.pairs:>7}{unit.matches:>9.0f}{unit.inliers:>9.0f}{unit.seconds:>9.2f}"
    if len(tables.regions):
        yield f"critical regions: {', '.join(tables.region_reasons)}"
    pairs = max(1, len(tables.pairs))
    parts = (f"{name} {seconds / pairs:.3f}" for name, seconds in tables.seconds_by_part.items())
    yield f"seconds a pair: {', '.join(parts)}"
    if scenes:
        made = f"{sum(scene.registered > 0 for scene in scenes)} of {len(scenes)} batches reconstructed"
        images = f"{sum(scene.registered for scene in scenes)} of {sum(scene.images for scene in scenes)} images"
        chosen = f"F of {sum(tables.pairs['source'] == 'scene')} of {len(tables.pairs)} pairs is from them"
        yield f"scenes: {made} with {images}; {chosen}"
        yield from weakest_line(scenes)
    no_scene = [f"{scene.batch}: {scene.failure}" for scene in scenes if scene.failure]
    reasons = list(failed["id"][:MAX_LINES] + ": " + failed["failure"][:MAX_LINES])
    yield from _list("batches without a scene", no_scene)
    yield from _list("pairs with the fallback row", reasons, len(failed))
    yield from _list("units that failed", tables.unit_reasons())
    yield from _list("units that ran otherwise than written", tables.unit_reasons("note"))
    yield from _list("faults", run.faults)


def weakest_line(scenes: Sequence[SceneRecord]) -> Iterator[str]:
    """Yield a line with the weakest cameras, if any is known."""
    named = [f"{Path(name).name} ({100 * sigmas.centre:.2g} %)" for name, sigmas in weakest_cameras(scenes)[:3]]
    if named:
        yield f"weakest cameras, with the error of the centre: {', '.join(named)}"


def weakest_cameras(scenes: Sequence[SceneRecord]) -> list[tuple[str, Sigmas]]:
    """Return images and expected errors of their cameras, the largest expected error of the centre first."""
    placed = (found for scene in scenes for model in scene.models for found in model.images)
    known = [(found.image.name, found.sigmas) for found in placed if found.sigmas]
    return sorted(known, key=lambda each: -each[1].centre)


def _list(title: str, items: Sequence[str], count: int | None = None) -> Iterator[str]:
    """Yield the first items and their number: ``count``, if ``items`` is only a part."""
    count = len(items) if count is None else count
    if count:
        yield f"{title}: {count}"
        yield from (f"  {item}" for item in items[:MAX_LINES])
    if count > MAX_LINES:
        yield f"  ... and {count - MAX_LINES} more"
