"""The summary of a run, which the terminal and the page show: a headline, counts, what failed."""

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

from mkpc_kaggle.engine.frames import NOT_REACHED, Results
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.errors import plural
from mkpc_kaggle.progress import format_duration
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.scene.records import NOT_RECONSTRUCTED

if TYPE_CHECKING:
    from pandas import DataFrame, Series

MAX_UNITS = 3  # lines of the terminal, whose summary has 15
MAX_FAILURES = 3
MAX_SCENES = 2
MAX_NAMED = 3  # names in a line
# Sources of F, the best first
SOURCES_OF_F = {
    "scene": "from cameras",
    "pair": "from their own matches",
    "fallback": "the fallback",
}


def summary(found: Results) -> str:
    """Return the summary of a run, in up to 15 lines."""
    about = found.about
    title = headline(found)
    title += f"; {plural(about.units_run, 'unit')} run, {about.estimated} F estimated"
    if about.resumed:
        title += f", {plural(about.resumed, 'pair')} from earlier runs"
    means = unit_table(found.units)
    rows = means[:MAX_UNITS].to_string().splitlines() if len(means) else []
    lines = [
        title,
        *counts(found.pairs, found.scenes),
        *rows,
        *first(failures(found), MAX_FAILURES),
        trouble(found) or pending(found),
    ]
    return "\n".join(filter(None, lines))


def headline(found: Results) -> str:
    """Return a line: how the run ended, its duration, and the numbers of F and of cameras."""
    pairs = found.pairs
    scenes = found.scenes
    text = f"{is_solved(pairs).sum()} of {plural(len(pairs), 'pair')} with an F"
    if len(scenes):
        images = plural(int(scenes["images"].sum()), "image")
        text += f", {scenes['cameras'].sum()} of {images} with a camera"
    return f"{found.ending} after {format_duration(found.about.seconds)}: {text}"


def counts(pairs: "DataFrame", scenes: "DataFrame") -> list[str]:
    """Return lines with the numbers of a run: sources of F, inliers, models."""
    sources = Counter(pairs["source"])
    parts = []
    for name, text in SOURCES_OF_F.items():
        if sources[name]:
            parts.append(f"{sources[name]} {text}")
    lines = [f"F: {', '.join(parts)}"]
    inliers = pairs["inliers"][is_solved(pairs)]
    if len(inliers):
        lines.append(
            f"inliers of a pair: median {inliers.median():.0f}, minimum {inliers.min()}"
        )
    has_models = scenes["models"] > 0
    for scene in scenes[has_models][:MAX_SCENES].to_dict("records"):
        models = plural(scene["models"], "model")
        error = f"reprojection error {scene['reprojection_error']:.3g} px"
        lines.append(f"{scene['batch']}: {models}, {scene['points']} points, {error}")
    return lines


def unit_table(units: "DataFrame") -> "DataFrame":
    """Return means of each unit, the index, in the recipe's order, over the pairs that it ran on."""
    # A unit that failed, or that a pair does not need, has no matches and no seconds.
    has_run = (units["failure"] == "") & units["is_needed"]
    by_unit = units[has_run].groupby("unit", sort=False)
    means = by_unit[["matches", "inliers", "seconds"]].mean().round(2)
    means.insert(0, "pairs", by_unit.size())
    return means.rename_axis(None)


def failures(found: Results) -> list[str]:
    """Return a line for each kind of failure: of pairs, batches, images and units; then all faults."""
    pairs = found.pairs
    units = found.units
    scenes = found.scenes
    unsolved = pairs[is_reached(pairs) & ~is_solved(pairs)]
    lines = grouped(unsolved, "pair", "pair", "without an F")
    is_pending = scenes["failure"] == NOT_RECONSTRUCTED
    has_cameras = scenes["failure"] == ""
    lost = scenes[~is_pending & ~has_cameras]
    lines += grouped(lost, "batch", "batch", "without cameras")
    for scene in scenes[has_cameras].to_dict("records"):
        if scene["missing"]:
            lines.append(f"{scene['batch']}: no camera for {named(scene['missing'])}")
    raised = units[units["failure"] != ""]
    for name, rows in raised.groupby("unit", sort=False):
        lines += grouped(rows, "pair", "pair", f"without {name}")
    return [*lines, *found.about.faults]


def grouped(rows: "DataFrame", column: str, noun: str, without: str) -> list[str]:
    """Return a line for each failure, the most frequent first, with names of rows in a column."""
    lines = []
    for reason, count in Counter(rows["failure"]).most_common():
        alike = rows[rows["failure"] == reason]
        names = named(alike[column].tolist())
        lines.append(f"{plural(count, noun)} {without} ({reason}): {names}")
    return lines


def named(names: Sequence[str]) -> str:
    """Return up to ``MAX_NAMED`` names and the number of the others."""
    more = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")


def first(lines: Sequence[str], most: int) -> list[str]:
    """Return up to ``most`` lines, and a line with the number of the others."""
    shown = list(lines[:most])
    if len(lines) > most:
        shown.append(f"... and {len(lines) - most} more in the report")
    return shown


def pending(found: Results) -> str:
    """Return a line on the pairs and batches that the run did not reach; empty without any."""
    pairs = found.pairs
    scenes = found.scenes
    # A pair may have an F from a scene without being matched.
    has_f = pairs["source"].isin(["scene", "pair"])
    waiting = int((~is_reached(pairs) & ~has_f).sum())
    batches = int((scenes["failure"] == NOT_RECONSTRUCTED).sum())
    parts = []
    if waiting:
        parts.append(f"{plural(waiting, 'pair')} left")
    if batches:
        parts.append(f"{plural(batches, 'batch')} left")
    if not parts and found.ending is not Ending.INTERRUPTED:
        return ""
    return "; ".join([*parts, "run the same command to continue"])


def is_solved(pairs: "DataFrame") -> "Series[bool]":
    return pairs["source"] != "fallback"


def is_reached(pairs: "DataFrame") -> "Series[bool]":
    return pairs["failure"] != NOT_REACHED


def trouble(found: Results) -> str:
    """Return why a run with a complete file failed, or an empty string.

    A pair without an F counts only if an error is the cause, rather than few matches or little
    time.
    """
    # Nothing could run, so counts of pairs would say nothing.
    if found.ending in (Ending.NO_WORKER, Ending.NOTHING_RUNS):
        return f"the run failed: {found.ending}, the faults say why; the same command resumes"
    pairs = found.pairs
    reached = pairs[is_reached(pairs)]
    reasons = Counter(filter(None, reached["error"]))
    # Single unreadable images are normal; most pairs without an F are not.
    if 2 * reasons.total() <= len(reached):
        return ""
    ((reason, count),) = reasons.most_common(1)
    share = f"{reasons.total()} of {plural(len(reached), 'pair')}"
    return f"the run failed: {share} got no F because of errors; the most frequent ({count}): {reason}"


def left_out_line(recipe: Recipe, left_out: Sequence[str]) -> str:
    """Return a line on the matchers of the recipe that do not run; empty if all run.

    ``left_out`` has the matchers without weights.
    """
    if not left_out:
        return ""
    # The normal case at first: one way to get some, and not a list of all.
    if set(recipe.matcher_names) == {"sift"}:
        return (
            "RootSIFT only; `mkpc weights fetch light --out weights`, and then the option "
            "`--weights weights`, adds learned matchers"
        )
    return f"left out, no weights: {', '.join(left_out)}"
