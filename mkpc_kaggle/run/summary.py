"""One screen of summary: what a run did, what it cost, and which pairs it could not help."""

from collections import Counter
from collections.abc import Iterable, Sequence
from statistics import mean, median

from mkpc_kaggle.competition import Pair
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.run.budget import format_duration
from mkpc_kaggle.run.engine import RunReport
from mkpc_kaggle.run.jobs import Record

MOST_LINES = 8


def summary(pairs: Sequence[Pair], report: RunReport, left_out: Sequence[Unit] = ()) -> str:
    """The screen that ends a run."""
    records = report.records
    solved = [record for record in records if not record.failure]
    lines = [
        f"{report.ending} after {format_duration(report.seconds)}: "
        f"{len(solved)} of {len(records)} pairs have an F"
        + (f", {report.resumed} of them from earlier runs" if report.resumed else "")
    ]
    if solved:
        inliers = [record.inliers for record in solved]
        lines.append(f"inliers: median {median(inliers):.0f}, mean {mean(inliers):.1f}, least {min(inliers)}")
    lines += unit_table(records)
    lines += _counts("critical regions", (str(r.reason) for record in records for r in record.regions or ()))
    lines += _time_lines(records)
    lines += _upgrade_lines(records)
    if left_out:
        names = ", ".join(unit.name for unit in left_out)
        lines.append(f"units left out, their weights are missing or not permitted: {names}")
    failed = [f"{pairs[record.index].id}: {record.failure}" for record in records if record.failure]
    lines += _list("pairs with the fallback row", failed)
    lines += _list("units that failed", _unit_failures(records))
    lines += _list("faults", list(report.faults))
    return "\n".join(lines)


def unit_table(records: Sequence[Record]) -> list[str]:
    """For each unit: on how many pairs it ran, its matches, inliers and seconds on a pair (means)."""
    by_unit: dict[str, list[tuple[int, int, float]]] = {}
    for record in records:
        for unit in record.units:
            seconds = unit.encode_seconds + unit.match_seconds
            by_unit.setdefault(unit.unit, []).append((unit.matches, unit.inliers, seconds))
    if not by_unit:
        return []
    lines = [f"{'unit':<30}{'pairs':>7}{'matches':>9}{'inliers':>9}{'seconds':>9}"]
    for name, rows in sorted(by_unit.items()):
        matches, inliers, seconds = (mean(column) for column in zip(*rows, strict=True))
        lines.append(f"{name:<30}{len(rows):>7}{matches:>9.0f}{inliers:>9.0f}{seconds:>9.2f}")
    return lines


def _time_lines(records: Sequence[Record]) -> list[str]:
    parts = {
        "wait for decoding": sum(record.decode_seconds for record in records),
        "encode": sum(unit.encode_seconds for record in records for unit in record.units),
        "match": sum(unit.match_seconds for record in records for unit in record.units),
        "cluster": sum(record.cluster_seconds for record in records),
        "MAGSAC (beside matching)": sum(record.estimate_seconds for record in records),
    }
    count = max(1, len(records))
    return ["seconds a pair: " + ", ".join(f"{name} {value / count:.3f}" for name, value in parts.items())]


def _upgrade_lines(records: Sequence[Record]) -> list[str]:
    upgraded = [record for record in records if record.before is not None]
    if not upgraded:
        return []
    before, after = sum(r.before or 0 for r in upgraded), sum(r.inliers for r in upgraded)
    return [f"upgraded {len(upgraded)} pairs: {before} inliers before, {after} after"]


def _counts(title: str, values: Iterable[str]) -> list[str]:
    counted = Counter(values).most_common()
    return [f"{title}: " + ", ".join(f"{count} {value}" for value, count in counted)] if counted else []


def _unit_failures(records: Sequence[Record]) -> list[str]:
    counted = Counter(f"{unit.unit}: {unit.failure}" for r in records for unit in r.units if unit.failure)
    return [f"{what} ({count} pairs)" for what, count in counted.most_common()]


def _list(title: str, items: Sequence[str]) -> list[str]:
    if not items:
        return []
    shown = [f"  {item}" for item in items[:MOST_LINES]]
    more = [f"  ... and {len(items) - MOST_LINES} more"] if len(items) > MOST_LINES else []
    return [f"{title}: {len(items)}", *shown, *more]
