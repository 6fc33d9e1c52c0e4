"""One-screen summary of a run: results, costs, failed pairs."""

import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from statistics import median
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from mkpc_kaggle.engine.request import Ending, RunReport
from mkpc_kaggle.engine.store.dataframes import NOT_REACHED, SECONDS
from mkpc_kaggle.engine.store.tables import MIN_PAIRS, NOT_RECONSTRUCTED, SceneRecord
from mkpc_kaggle.errors import plural
from mkpc_kaggle.geometry.critical_region import RegionReason
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.progress import format_duration
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.reporting.contradictions import adopted_lenses, file_labels, named
from mkpc_kaggle.reporting.run_log import RunLog
from mkpc_kaggle.scene.candidates import title_of
from mkpc_kaggle.scene.models import MAX_SIGMA_IMAGES, Sigmas
from mkpc_kaggle.setup.availability import UnavailableKind

if TYPE_CHECKING:
    from pandas import DataFrame, Series

MAX_LINES = 8  # per list; the summary is one screen
WIDTH = 100  # of a line, in characters
MAX_NAMED = 3  # matchers or cameras in one line

AnyRun: TypeAlias = RunReport | RunLog


def summary(report: RunReport) -> str:
    """Return the summary at the end of a run."""
    resumed = f", {report.resumed} of them from earlier runs" if report.resumed else ""
    done = f"; {plural(report.units_run, 'unit')} run, {report.estimated} F estimated"
    if report.units_failed:
        done += f", {plural(report.units_failed, 'unit')} failed"
    # Of libjpeg, CUDA and others: they would tear the progress bar.
    printed = f"messages of image and device libraries: {report.log}" if report.log else ""
    lines = [headline(report) + resumed + done, *_lines(report), printed, trouble(report)]
    return "\n".join(filter(None, lines))


def overview(log: RunLog) -> str:
    """Return the summary of a journal."""
    about = f"recipe {log.recipe.name}, {log.about.device}, {plural(len(log.events), 'event')}"
    left_out = left_out_line(log.recipe, log.about.left_out)
    return "\n".join(filter(None, [headline(log), about, left_out, *_lines(log)]))


def headline(run: AnyRun) -> str:
    """Return a line: how the run ended, its duration, and the number of pairs with an F."""
    return f"{run.ending} after {format_duration(run.seconds)}: {solved_pairs(run.tables.pairs)}"


def solved_pairs(pairs: "DataFrame") -> str:
    """Return the number of pairs with an F, as text."""
    return f"{is_solved(pairs).sum()} of {plural(len(pairs), 'pair')} with an F"


def is_solved(pairs: "DataFrame") -> "Series[bool]":
    return pairs["source"] != "fallback"


def is_of_this_run(pairs: "DataFrame") -> "Series[bool]":
    """Return which pairs have an F, or none, by this run, and not the F of an earlier one."""
    return pairs["source"] != "earlier"


def is_reached(pairs: "DataFrame") -> "Series[bool]":
    return pairs["failure"] != NOT_REACHED


def trouble(run: AnyRun) -> str:
    """Return why a run with a complete file failed, or an empty string.

    A pair without an F counts only if an error is the cause, rather than few matches or little
    time.
    """
    # Nothing could run, so counts of pairs would say nothing.
    if run.ending in (Ending.NO_WORKER, Ending.NOTHING_RUNS):
        return f"the run failed: {run.ending}, the faults say why; the same command resumes"
    pairs = run.tables.pairs
    reached = pairs[is_reached(pairs)]
    reasons = Counter(filter(None, reached["error"]))
    # Single unreadable images are normal; most pairs without an F are not.
    if 2 * reasons.total() <= len(reached):
        return ""
    ((reason, count),) = reasons.most_common(1)
    share = f"{reasons.total()} of {plural(len(reached), 'pair')}"
    return (
        f"the run failed: {share} got no F because of errors; the most frequent ({count}): {reason}"
    )


def unreadable_images(pairs: "DataFrame") -> list[str]:
    """Return the reason of each image that could not be decoded, sorted."""
    # An image that cannot be read fails in all of its pairs, with one text.
    failures = set(pairs["failure"][is_reached(pairs) & (pairs["units"] == 0)])
    # An F may be of an earlier run, without a unit of this one.
    return sorted(failures - {""})


def left_out_line(recipe: Recipe, left_out: Sequence[str]) -> str:
    """Return a line on the matchers of the recipe that do not run, with advice; empty if all run.

    ``left_out`` has a text for each cause. Missing weights are the normal case: more than a few
    matchers without them are counted, and `mkpc recipes NAME` lists them.
    """
    others = [cause for cause in left_out if not cause.startswith(UnavailableKind.NO_WEIGHTS)]
    missing = [cause for cause in left_out if cause.startswith(UnavailableKind.NO_WEIGHTS)]
    parts = [f"left out, {cause}" for cause in others]
    # A list of the recipe's other matchers would give no advice.
    if missing and set(recipe.matcher_names) == {"sift"}:
        parts.append(
            "RootSIFT only; `mkpc weights fetch light --out weights` adds learned matchers"
        )
    elif missing and missing[0].count(",") < MAX_NAMED:
        parts += [f"left out, {cause}" for cause in missing]
    elif missing:
        name = recipe.name.partition(" ")[0]  # without the mode
        count = plural(sum(cause.count(",") + 1 for cause in missing), "matcher")
        parts.append(f"{count} without weights; `mkpc recipes {name}` lists them")
    return "; ".join(parts)


def advice(log: RunLog) -> list[str]:
    """Return sentences on what to add: weights, if only RootSIFT ran, or images, if no pair
    overlaps.
    """
    found = []
    # The units that ran, which may be fewer than the recipe's: a matcher may have failed to load.
    ran = set(log.tables.units["unit"])
    has_missing = any(cause.startswith(UnavailableKind.NO_WEIGHTS) for cause in log.about.left_out)
    if has_missing and all(name.partition(":")[2].startswith("sift@") for name in ran):
        found.append(
            "No weights were found, so only RootSIFT ran. Add weights to the dataset "
            "(`mkpc package --weights DIR`), or ALIKED and LightGlue from Kaggle Models."
        )
    pairs = log.tables.pairs
    if not (is_solved(pairs) & ~is_doubtful(pairs)).any():
        found.append(
            "No pair overlaps. Check that the input is the right test set and that its images can be read."
        )
    return found


def unit_means(run: AnyRun) -> list[tuple[str, int, float, float, float]]:
    """Return a row per unit: name, number of pairs, and mean matches, inliers and seconds.

    Without the pairs on which the unit failed, whose matches and seconds were not measured.
    """
    units = run.tables.units
    ran = units[(units["failure"] == "") & units["is_needed"]]
    ran = ran.assign(seconds=ran["encode_seconds"] + ran["match_seconds"])
    means = []
    # In the order in which units first appear: that of the recipe
    for name, rows in ran.groupby("unit", sort=False):
        columns = rows[["matches", "inliers", "seconds"]].mean().tolist()
        means.append((str(name), len(rows), *columns))
    return means


def unit_reasons(run: AnyRun, field: str = "failure") -> list[str]:
    """Return the units' failures, or another ``field``, with numbers of pairs, the most frequent
    first.
    """
    units = run.tables.units
    counts = Counter(f"{name}: {text}" for name, text in units[["unit", field]].values if text)
    return [f"{reason} ({plural(count, 'pair')})" for reason, count in counts.most_common()]


def seconds_by_part(run: AnyRun) -> dict[str, float]:
    """Return the total seconds of all pairs for each part of the work."""
    return {name: float(run.tables.pairs[column].sum()) for column, name in SECONDS.items()}


def facts(run: AnyRun) -> Iterator[tuple[str, str, str]]:
    """Yield the most important facts as (name, value, remark)."""
    pairs, units, regions, _ = run.tables
    scenes = run.scenes
    solved = pairs[is_solved(pairs)]
    sources = Counter(pairs["source"])
    # The best source first
    parts = (
        ("scene", "from scenes"),
        ("pair", "from their own matches"),
        ("earlier", "of an earlier run"),
        ("fallback", "fallback"),
    )
    from_where = ", ".join(
        f"{sources[source]} {what}" for source, what in parts if source in sources
    )
    yield "pairs with an F", f"{len(solved)} of {len(pairs)}", from_where
    # Of the F of an earlier run, this one knows no inliers.
    solved = solved[is_of_this_run(solved)]
    if len(solved):
        inliers = solved["inliers"]
        yield (
            "inliers of a pair",
            f"{inliers.median():.0f}",
            f"the median; the minimum is {inliers.min()}",
        )
        overlapping = (~is_doubtful(solved)).sum()
        threshold = (
            f"{MIN_SUPPORT:g} times the inliers expected by chance, or two cameras that agree"
        )
        yield "overlapping pairs", f"{overlapping} of {len(solved)}", threshold
    if reasons := Counter(regions["reason"]):
        counts = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        yield "critical regions", f"{reasons[RegionReason.CROPPED]} of {len(regions)}", counts
    # Of pairs with a result of a unit of stage 2 under the rule
    needs = units.dropna(subset=["scale"]).groupby("pair")["is_needed"].any()
    if not needs.all():
        remark = "scales differ, or the crop restores detail"
        yield "pairs that need their crops", f"{needs.sum()} of {len(needs)}", remark
    if scenes:
        total = total_counts(run)
        remark = f"in {plural(len(scenes), 'batch')}"
        if total.loose:
            remark += f"; {total.loose} of them unknown to within the size of their model"
        yield "images with a camera", f"{total.cameras} of {total.images}", remark
        yield from chosen_candidates(scenes)
        yield from adopted_lenses(scenes)


class ImageCounts(NamedTuple):
    """Numbers of images in a scene or in all scenes."""

    images: int
    cameras: int  # images with a camera
    loose: int  # images whose camera is unknown to within the size of its model


def image_counts(run: AnyRun, scene: SceneRecord) -> ImageCounts:
    """Return the counts of a scene: of the files of its dataset, or of distinct images if these are
    unknown, as in a submission.
    """
    files = run.files.get(scene.batch)
    if files is None:
        return ImageCounts(scene.images, scene.registered, scene.loose)
    # Identical files share the camera of one of them.
    placed = {found.image.digest for model in scene.models for found in model.images}
    sure = {
        found.image.digest for model in scene.models if not model.is_loose for found in model.images
    }
    contents = [run.digests.get(name) for name in files]
    cameras = sum(content in placed for content in contents)
    return ImageCounts(len(files), cameras, cameras - sum(content in sure for content in contents))


def total_counts(run: AnyRun) -> ImageCounts:
    """Return the counts of all scenes, and of the datasets that are too small for one."""
    counts = [ImageCounts(0, 0, 0), *(image_counts(run, scene) for scene in run.scenes)]
    batches = {scene.batch for scene in run.scenes}
    counts += [ImageCounts(len(run.files[batch]), 0, 0) for batch in run.files.keys() - batches]
    return ImageCounts(*(sum(column) for column in zip(*counts, strict=True)))


def unpaired_images(run: AnyRun) -> dict[str, list[str]]:
    """Return the images of each dataset of a folder that are in none of its pairs."""
    pairs = run.tables.pairs
    paired = {*pairs["image0"], *pairs["image1"]}
    return {
        batch: [name for name in names if name not in paired] for batch, names in run.files.items()
    }


def unpaired_sentences(run: AnyRun) -> Iterator[tuple[str, str]]:
    """Yield the batch and a sentence for each dataset with images in no pair."""
    pairs = Counter(run.tables.pairs["group"])
    for batch, names in unpaired_images(run).items():
        # A dataset without cameras has another sentence.
        if names and pairs[batch] >= MIN_PAIRS:
            labels = file_labels(run.files[batch])
            yield (
                batch,
                f"no pair has {named([labels[name] for name in names])}: no other image resembles these, or "
                "--pairs omits them; add photographs between these and the others, or pairs",
            )


def chosen_candidates(scenes: Sequence[SceneRecord]) -> Iterator[tuple[str, str, str]]:
    """Yield a fact on the candidates that were chosen, if scenes had a choice."""
    compared = [scene for scene in scenes if scene.rivals]
    if not compared:
        return
    if len(compared) == 1:
        (scene,) = compared
        others = [f"{title_of(each.candidate)} {each.disagreement:.2f}" for each in scene.rivals]
        remark = (
            f"rotations {scene.disagreement:.2f} degrees from the rotations of single pairs; "
            f"others: {'; '.join(others)}"
        )
        yield "cameras by the tracks of", title_of(scene.candidate), remark
        return
    # The most frequent first; each batch is in summary.json.
    counts = Counter(title_of(scene.candidate) for scene in compared).most_common()
    parts = [f"{name} in {plural(count, 'batch')}" for name, count in counts]
    margin = median(scene.rivals[0].disagreement - scene.disagreement for scene in compared)
    yield "cameras by the tracks of", ", ".join(parts), f"median margin {margin:.2f} degrees"


def _lines(run: AnyRun) -> Iterator[str]:
    """Yield the facts, means of units, seconds and weakest cameras, then lists of failures, units
    and faults.
    """
    yield from (f"{name}: {value} ({remark})" for name, value, remark in facts(run))
    if means := unit_means(run):
        yield f"{'unit':<30}{'pairs':>7}{'matches':>9}{'inliers':>9}{'seconds':>9}"
    for name, pairs, matches, inliers, seconds in means:
        yield f"{name:<30}{pairs:>7}{matches:>9.0f}{inliers:>9.0f}{seconds:>9.2f}"
    table = run.tables.pairs
    count = max(1, len(table))  # a run without pairs has a summary, too
    # A mean per pair compares runs of different lengths.
    parts = (f"{name} {seconds / count:.3f}" for name, seconds in seconds_by_part(run).items())
    yield from wrapped(f"seconds a pair: {', '.join(parts)}")
    yield from weakest_line(run.scenes)
    yield from pending_lines(run)
    # Batches that were not reached are in the line before.
    no_scene = [
        f"{scene.batch}: {scene.failure}"
        for scene in run.scenes
        if scene.failure and scene.failure != NOT_RECONSTRUCTED
    ]
    unsolved = table[is_reached(table) & ~is_solved(table)]
    failed = [f"{name}: {failure}" for name, failure in unsolved[["pair", "failure"]].values]
    yield from _list("batches without a scene", no_scene)
    yield from _list("pairs with the fallback row", failed)
    # Last, since they may be many
    yield from _list("units that failed", unit_reasons(run))
    yield from _list("units that ran otherwise than written", unit_reasons(run, "note"))
    yield from _list("faults", run.faults)


def wrapped(text: str) -> list[str]:
    """Return the text as lines of up to ``WIDTH`` characters; names of files stay whole."""
    # A number stays with its unit.
    joined = text.replace(" %", "\N{NO-BREAK SPACE}%")
    lines = textwrap.wrap(
        joined, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )
    return [line.replace("\N{NO-BREAK SPACE}%", " %") for line in lines]


def pending_lines(run: AnyRun) -> Iterator[str]:
    """Yield a line on pairs and batches that the run did not reach, and how to continue."""
    # A pair may have an F from a scene without being matched.
    pairs = run.tables.pairs
    has_f = is_solved(pairs) & is_of_this_run(pairs)
    waiting = int((~is_reached(pairs) & ~has_f).sum())
    batches = sum(scene.failure == NOT_RECONSTRUCTED for scene in run.scenes)
    left = [plural(count, noun) for count, noun in ((waiting, "pair"), (batches, "batch")) if count]
    what = f"{' and '.join(left)} left" if left else ""
    # Also with nothing left: a publication may have been interrupted.
    if run.ending == Ending.INTERRUPTED:
        yield "; ".join(filter(None, ["interrupted", what, "run the same command to continue"]))
    elif what:
        yield f"{what}; run the same command to continue"


def is_doubtful(pairs: "DataFrame") -> "Series[bool]":
    """Return whether the two images of each pair may show different things.

    Few inliers decide only where the scene does not: two cameras that agree have settled it.
    """
    return ~pairs["overlaps"] & (pairs["source"] != "scene") & is_of_this_run(pairs)


def large_models(scenes: Sequence[SceneRecord]) -> str:
    """Return a sentence on the models that are too large for expected errors; empty without any."""
    counts = [len(model.images) for scene in scenes for model in scene.models]
    large = [str(count) for count in counts if count > MAX_SIGMA_IMAGES]
    if not large:
        return ""
    return (
        f"no expected errors of cameras in {plural(len(large), 'model')} of more than "
        f"{MAX_SIGMA_IMAGES} images ({', '.join(large)}), where they would take too long"
    )


def weakest_line(scenes: Sequence[SceneRecord]) -> Iterator[str]:
    """Yield a line with the weakest cameras, if any is known, and one on :func:`large_models`."""
    if large := large_models(scenes):
        yield from wrapped(large)
    named = []
    # Enough to see whether one camera is worse than all others; the report has them all.
    cameras = weakest_cameras(scenes)
    labels = file_labels(name for name, _ in cameras)
    for name, sigmas in cameras[:MAX_NAMED]:
        error = f"{100 * sigmas.centre:.2g} %" if sigmas else "unknown"
        named.append(f"{labels[name]} ({error})")
    if named:
        yield from wrapped(f"weakest cameras, with the error of the centre: {', '.join(named)}")


def weakest_cameras(scenes: Sequence[SceneRecord]) -> list[tuple[str, Sigmas | tuple[()]]]:
    """Return (image name, sigmas) of each camera, the largest expected error of the centre first.

    Cameras with unknown sigmas are the most doubtful ones, so they come before all others. Those of a
    model that is too large for expected errors are left out.
    """
    models = [model for scene in scenes for model in scene.models]
    # An image of several models has a camera in each.
    placed = [
        image for model in models if len(model.images) <= MAX_SIGMA_IMAGES for image in model.images
    ]
    unknown = [(image.image.name, image.sigmas) for image in placed if not image.sigmas]
    certain = [(image.image.name, image.sigmas) for image in placed if image.sigmas]
    return [*unknown, *sorted(certain, key=lambda camera: -camera[1].centre)]


def _list(title: str, items: Sequence[str]) -> Iterator[str]:
    """Yield a line with the number of items, and up to ``MAX_LINES`` items."""
    if items:
        yield f"{title}: {len(items)}"
        yield from (f"  {item}" for item in items[:MAX_LINES])
    if len(items) > MAX_LINES:
        yield f"  ... and {len(items) - MAX_LINES} more"
