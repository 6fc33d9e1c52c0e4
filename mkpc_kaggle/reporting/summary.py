"""One screen of summary: what a run did, what it cost, and which pairs it could not help."""

from collections import Counter
from collections.abc import Sequence

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.engine import Ending, RunReport
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.reporting.run_log import RunLog
from mkpc_kaggle.reporting.tables import RunTables, run_tables, seconds_by_part, unit_failures, unit_means

MOST_LINES = 8


def summary(pairs: Sequence[Pair], report: RunReport, left_out: Sequence[Unit] = ()) -> str:
    """The screen that ends a run."""
    tables = run_tables(pairs, report.records)
    resumed = f", {report.resumed} of them from earlier runs" if report.resumed else ""
    names = [unit.name for unit in left_out]
    lines = [_headline(tables, report.ending, report.seconds) + resumed, *_counts(tables)]
    lines += _scenes(tables, report.scenes)
    lines += _upgrades(report.records) + _troubles(tables, names, report.faults)
    return "\n".join([*lines, *filter(None, [trouble(report)])])


def trouble(report: RunReport) -> str:
    """Why a run is no success, though its file is whole; empty if it is one.

    Pairs without an F count where an error is the reason, be it that of a unit which found nothing; not where the
    matches or the time did not suffice.
    """
    if report.ending is Ending.NO_WORKER:
        return f"the run failed: {report.ending}, the faults say why; the same command goes on"
    reached = [record for record in report.records if record.reached]
    reasons = Counter(filter(None, map(_error, reached)))
    if 2 * reasons.total() <= len(reached):
        return ""
    ((reason, count),) = reasons.most_common(1)
    share = f"{reasons.total()} of {len(reached)} pairs"
    return f"the run failed: errors left {share} without an F, {count} of them with this one: {reason}"


def _error(record: PairRecord) -> str:
    """The error that left a pair without an F, if it was one."""
    if record.source != "fallback":
        return ""
    if not record.units:
        return record.failure
    return next((unit.failure for unit in record.units if unit.failure and not unit.matches), "")


def overview(log: RunLog) -> str:
    """The same of a journal."""
    lines = [
        _headline(log.tables, log.ending, log.seconds),
        f"recipe {log.about.recipe}, {log.about.device}, {len(log.events)} events",
        *_counts(log.tables),
        *_scenes(log.tables, log.scenes),
    ]
    return "\n".join(lines + _upgrades(log.records) + _troubles(log.tables, log.about.left_out, log.faults))


def _unit_table(tables: RunTables) -> list[str]:
    """The means of each unit on a pair, as lines."""
    rows = [
        f"{one.Index:<30}{one.pairs:>7}{one.matches:>9.0f}{one.inliers:>9.0f}{one.seconds:>9.2f}"
        for one in unit_means(tables).itertuples()
    ]
    return [f"{'unit':<30}{'pairs':>7}{'matches':>9}{'inliers':>9}{'seconds':>9}", *rows] if rows else []


def _headline(tables: RunTables, ending: str, seconds: float) -> str:
    count = f"{len(tables.solved)} of {len(tables.pairs)} pairs have an F"
    return f"{ending} after {format_duration(seconds)}: {count}"


def _counts(tables: RunTables) -> list[str]:
    """What was found, and what it cost."""
    lines = []
    inliers = tables.solved["inliers"]
    if len(inliers):
        least = f"median {inliers.median():.0f}, mean {inliers.mean():.1f}, least {inliers.min()}"
        lines.append(f"inliers: {least}")
    lines += _unit_table(tables)
    reasons = tables.regions["reason"].value_counts()
    if len(reasons):
        lines.append("critical regions: " + ", ".join(f"{count} {reason}" for reason, count in reasons.items()))
    pairs = max(1, len(tables.pairs))
    parts = [f"{name} {seconds / pairs:.3f}" for name, seconds in seconds_by_part(tables).items()]
    return [*lines, "seconds a pair: " + ", ".join(parts)]


def _scenes(tables: RunTables, scenes: Sequence[SceneRecord]) -> list[str]:
    """How many batches and images were reconstructed, whose F is from there, and why the others were not."""
    if not scenes:
        return []
    made = [scene for scene in scenes if scene.placed]
    images = f"{sum(scene.placed for scene in scenes)} of {sum(scene.images for scene in scenes)} images"
    pairs = f"F of {sum(tables.pairs['source'] == 'scene')} of {len(tables.pairs)} pairs is from them"
    reasons = Counter(scene.failure for scene in scenes if scene.failure)
    lines = [f"scenes: {len(made)} of {len(scenes)} batches reconstructed with {images}; {pairs}"]
    return lines + [
        f"  {count} batches without a scene: {reason}" for reason, count in reasons.most_common(MOST_LINES)
    ]


def _upgrades(records: Sequence[PairRecord]) -> list[str]:
    upgraded = [record for record in records if record.before is not None]
    if not upgraded:
        return []
    before, after = sum(r.before or 0 for r in upgraded), sum(r.inliers for r in upgraded)
    return [f"upgraded {len(upgraded)} pairs: {before} inliers before, {after} after"]


def _troubles(tables: RunTables, left_out: Sequence[str], faults: Sequence[str]) -> list[str]:
    """What was left out, and what failed."""
    lines = []
    if left_out:  # names of units, such as 1:loftr@840
        matchers = dict.fromkeys(name.partition(":")[2].partition("@")[0] for name in left_out)
        lines.append(f"left out: {', '.join(matchers)}; `python -m mkpc_kaggle weights list` says why")
    failed, first = tables.failed, tables.failed.head(MOST_LINES)
    lines += _list("pairs with the fallback row", list(first["id"] + ": " + first["failure"]), len(failed))
    lines += _list("units that failed", unit_failures(tables))
    return lines + _list("faults", faults)


def _list(title: str, items: Sequence[str], count: int | None = None) -> list[str]:
    """The first of the items, and how many there are: ``count``, if not all of them are given."""
    count = len(items) if count is None else count
    if not count:
        return []
    shown = [f"  {item}" for item in items[:MOST_LINES]]
    more = [f"  ... and {count - MOST_LINES} more"] if count > MOST_LINES else []
    return [f"{title}: {count}", *shown, *more]
