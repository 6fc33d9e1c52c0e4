"""One screen of summary: what a run did, what it cost, and which pairs it could not help."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import mean, median

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.engine import RunReport
from mkpc_kaggle.engine.jobs import Record
from mkpc_kaggle.recipe import Unit

MOST_LINES = 8


def summary(pairs: Sequence[Pair], report: RunReport, left_out: Sequence[Unit] = ()) -> str:
    """The screen that ends a run."""
    records = report.records
    resumed = f", {report.resumed} of them from earlier runs" if report.resumed else ""
    names = [unit.name for unit in left_out]
    first = headline(records, report.ending, report.seconds) + resumed
    return "\n".join([first, *account(pairs, records, names, report.faults)])


def headline(records: Sequence[Record], ending: str, seconds: float) -> str:
    solved = sum(not record.failure for record in records)
    return f"{ending} after {format_duration(seconds)}: {solved} of {len(records)} pairs have an F"


def account(
    pairs: Sequence[Pair], records: Sequence[Record], left_out: Sequence[str], faults: Sequence[str]
) -> list[str]:
    """Lines on what was found, what it cost and what failed; ``left_out`` are names of units."""
    inliers = [record.inliers for record in records if not record.failure]
    lines = []
    if inliers:
        lines.append(f"inliers: median {median(inliers):.0f}, mean {mean(inliers):.1f}, least {min(inliers)}")
    lines += unit_table(records)
    lines += _counts("critical regions", (str(r.reason) for record in records for r in record.regions or ()))
    lines += _time_lines(records)
    lines += _upgrade_lines(records)
    if left_out:
        lines.append(
            f"units left out (weights missing or not permitted, or matcher unusable): {', '.join(left_out)}"
        )
    failed = [f"{pairs[record.index].id}: {record.failure}" for record in records if record.failure]
    lines += _list("pairs with the fallback row", failed)
    lines += _list("units that failed", unit_failures(records))
    lines += _list("faults", list(faults))
    return lines


@dataclass(frozen=True)
class UnitMeans:
    """One unit over the ``pairs`` that it ran on: means of matches, inliers and seconds on a pair."""

    unit: str
    pairs: int
    matches: float
    inliers: float
    seconds: float


def unit_means(records: Sequence[Record]) -> list[UnitMeans]:
    """One for each unit that ran, by name."""
    by_unit: dict[str, list[tuple[int, int, float]]] = {}
    for record in records:
        for unit in record.units:
            seconds = unit.encode_seconds + unit.match_seconds
            by_unit.setdefault(unit.unit, []).append((unit.matches, unit.inliers, seconds))
    return [
        UnitMeans(name, len(rows), *(mean(column) for column in zip(*rows, strict=True)))
        for name, rows in sorted(by_unit.items())
    ]


def unit_table(records: Sequence[Record]) -> list[str]:
    """:func:`unit_means` as lines."""
    rows = [
        f"{one.unit:<30}{one.pairs:>7}{one.matches:>9.0f}{one.inliers:>9.0f}{one.seconds:>9.2f}"
        for one in unit_means(records)
    ]
    return [f"{'unit':<30}{'pairs':>7}{'matches':>9}{'inliers':>9}{'seconds':>9}", *rows] if rows else []


def seconds_by_part(records: Sequence[Record]) -> dict[str, float]:
    """What the parts of the work took in all: the first four one after the other, MAGSAC beside them."""
    return {
        "wait for decoding": sum(record.decode_seconds for record in records),
        "encode": sum(unit.encode_seconds for record in records for unit in record.units),
        "match": sum(unit.match_seconds for record in records for unit in record.units),
        "cluster": sum(record.cluster_seconds for record in records),
        "MAGSAC (beside matching)": sum(record.estimate_seconds for record in records),
    }


def unit_failures(records: Sequence[Record]) -> list[str]:
    """Why units failed, and on how many pairs; the most frequent reason first."""
    counted = Counter(f"{unit.unit}: {unit.failure}" for r in records for unit in r.units if unit.failure)
    return [f"{what} ({count} pairs)" for what, count in counted.most_common()]


def _time_lines(records: Sequence[Record]) -> list[str]:
    count = max(1, len(records))
    parts = seconds_by_part(records).items()
    return ["seconds a pair: " + ", ".join(f"{name} {value / count:.3f}" for name, value in parts)]


def _upgrade_lines(records: Sequence[Record]) -> list[str]:
    upgraded = [record for record in records if record.before is not None]
    if not upgraded:
        return []
    before, after = sum(r.before or 0 for r in upgraded), sum(r.inliers for r in upgraded)
    return [f"upgraded {len(upgraded)} pairs: {before} inliers before, {after} after"]


def _counts(title: str, values: Iterable[str]) -> list[str]:
    counted = Counter(values).most_common()
    return [f"{title}: " + ", ".join(f"{count} {value}" for value, count in counted)] if counted else []


def _list(title: str, items: Sequence[str]) -> list[str]:
    if not items:
        return []
    shown = [f"  {item}" for item in items[:MOST_LINES]]
    more = [f"  ... and {len(items) - MOST_LINES} more"] if len(items) > MOST_LINES else []
    return [f"{title}: {len(items)}", *shown, *more]
