"""The verdict on a run: one sentence at the head of its report, and ``summary.json`` for programs."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.engine.console import EventKind
from mkpc_kaggle.engine.store.json_values import to_text
from mkpc_kaggle.engine.store.tables import MIN_PAIRS, SceneRecord
from mkpc_kaggle.errors import UserError, plural, printable, writing
from mkpc_kaggle.reporting.contradictions import contradictions, file_labels, has_moved, named
from mkpc_kaggle.reporting.run_log import RunLog
from mkpc_kaggle.reporting.summary import (
    headline,
    image_counts,
    is_doubtful,
    is_of_this_run,
    is_reached,
    is_solved,
    seconds_by_part,
    solved_pairs,
    total_counts,
    trouble,
    unit_means,
    unit_reasons,
    unpaired_images,
    unpaired_sentences,
    unreadable_images,
)
from mkpc_kaggle.scene.candidates import title_of
from mkpc_kaggle.scene.choose import Reason
from mkpc_kaggle.scene.models import (
    HARDLY_MOVED,
    MAX_CENTRE_SIGMA,
    MAX_SIGMA_IMAGES,
    RegisteredImage,
    SfmModel,
)
from mkpc_kaggle.version import __version__

if TYPE_CHECKING:
    from pandas import DataFrame

FORMAT = "mkpc summary 1"  # increase the number if a key changes its meaning or disappears
MAX_UNREADABLE = 3  # reasons in a sentence
# Bounds of the histogram of inliers; the last bin is open.
INLIER_BINS = (0, 1, 10, 20, 50, 100, 200, 500, 1000, 2000)


@dataclass(frozen=True)
class Verdict:
    """The facts of a run in a sentence, and each problem with its remedy."""

    text: str
    problems: tuple[str, ...]

    def __str__(self) -> str:
        return "; ".join((self.text, *(self.problems or ("nothing looks wrong",))))


def verdict(log: RunLog) -> Verdict:
    """Return the verdict: about cameras if images were to be reconstructed together, else about
    pairs.
    """
    # A failed run first: all other problems may follow from it.
    problems = list(filter(None, [trouble(log)]))
    # A mean over scenes without models would divide by zero.
    reconstructed = [scene for scene in log.scenes if scene.models]
    problems += _small_batches(log)
    # Without scenes, pairs are all that the run was asked for.
    if not log.scenes:
        problems += _pair_problems(log.tables.pairs)
        return Verdict(solved_pairs(log.tables.pairs), tuple(problems))
    # Cameras that are unknown to within the size of their model are none.
    counts = total_counts(log)
    # Also without any camera: this line answers the user's question.
    text = f"{counts.cameras - counts.loose} of {plural(counts.images, 'image')} with a camera"
    if reconstructed:
        text += f"; reprojection {_reprojection(reconstructed):.2f} px"
    problems += [problem for scene in log.scenes for problem in _scene_problems(scene, log)]
    problems += [f"{_where(batch, log)}{text}" for batch, text in unpaired_sentences(log)]
    return Verdict(text, tuple(problems))


def doubts(pairs: "DataFrame") -> list[str]:
    """Return why each pair may show different things, or an empty string.

    Matches that contradict the cameras are doubtful, too.
    """
    # The cameras agree with many pairs, this pair's matches with themselves alone.
    contradicts = pairs["choice"] == Reason.CONTRADICTION
    is_weak = is_solved(pairs) & is_doubtful(pairs)
    return [_doubt(*row) for row in zip(contradicts, is_weak, pairs["support"], strict=True)]


def _doubt(contradicts: bool, is_weak: bool, support: float) -> str:
    if contradicts:
        return "its matches contradict the cameras"
    return f"{support:.1f} times the inliers by chance" if is_weak else ""


def inlier_histogram(pairs: "DataFrame") -> list[tuple[str, int]]:
    """Return the number of reached pairs in each range of inliers, as (range, count)."""
    # A pair that was not reached has no inliers yet, and is no weak pair.
    counts, _ = np.histogram(pairs["inliers"][is_reached(pairs)], [*INLIER_BINS, np.inf])
    names = ["0", *(f"{low} to {high - 1}" for low, high in pairwise(INLIER_BINS[1:]))]
    return list(zip([*names, f"{INLIER_BINS[-1]} or more"], counts.tolist(), strict=True))


def _pair_problems(pairs: "DataFrame") -> Iterator[str]:
    reached = is_reached(pairs)
    if late := int((~reached).sum()):
        yield f"not reached in time: {plural(late, 'pair')}; give the run more time, or a smaller recipe"
    if lost := int((reached & ~is_solved(pairs)).sum()):
        yield f"with the fallback: {plural(lost, 'pair')}; the reasons are below"
    if doubtful := sum(map(bool, doubts(pairs))):
        yield f"{plural(doubtful, 'pair')} may show different things; see below"


def _where(batch: str, log: RunLog) -> str:
    """Return the beginning of a sentence about a batch."""
    # A folder without subfolders has one scene, whose name says nothing.
    return f"{batch}: " if len(log.scenes) > 1 else ""


def _scene_problems(scene: SceneRecord, log: RunLog) -> Iterator[str]:
    where = _where(scene.batch, log)
    if HARDLY_MOVED in scene.failure:
        # More photographs from there would not help.
        yield f"{where}no cameras: {HARDLY_MOVED}"
        return
    causes = causes_of(scene.batch, log)
    if not scene.models:
        remedy = "; ".join(causes) or "photographs that overlap more are needed"
        yield f"{where}no cameras, {scene.failure}: {remedy}"
        return
    # Remedies for single images would not help.
    if not has_moved(scene):
        yield from (f"{where}{sentence}" for sentence in contradictions(scene))
        return
    cameras = [image.image for model in scene.models for image in model.images]
    names = {image.name for image in cameras}
    # Identical files share the camera of one of them.
    contents = {image.digest for image in cameras}
    pairs = log.tables.pairs
    pairs = pairs[pairs["group"] == scene.batch]
    # Images in no pair have another sentence.
    files = {*pairs["image0"], *pairs["image1"]}
    lost = {file for file in files - names if log.digests.get(file) not in contents}
    labels = file_labels({*files, *log.files.get(scene.batch, ())})
    missing = sorted(labels[file] for file in lost)
    if missing:
        remedies = "; ".join(_remedies(missing, unreadable_images(pairs), causes))
        yield f"{where}no camera for {named(missing)}: {remedies}"
    if len(scene.models) > 1:
        sizes = ", ".join(str(len(model.images)) for model in scene.models)
        near = nearest_to_joining(scene, pairs, log.digests)
        between = f", between {near} for example" if near else ""
        yield (
            f"{where}the images form {len(scene.models)} models of {sizes}: "
            f"add photographs that connect them{between}"
        )
    uncertain = sorted(
        {
            labels.get(image.image.name, Path(image.image.name).name)
            for model in scene.models
            # A loose model has its own line.
            if not model.is_loose
            for image in model.images
            if _is_uncertain(image, model)
        }
    )
    if uncertain:
        yield f"{where}uncertain cameras: {named(uncertain)}; add photographs of the same things"
    for model in scene.models:
        if model.is_loose:
            count = plural(len(model.images), "camera")
            yield (
                f"{where}a model of {count} hangs together loosely: its cameras are unknown to within "
                f"{_looseness(model)}; add photographs that connect its parts"
            )
    yield from (f"{where}{sentence}" for sentence in contradictions(scene))


def _remedies(
    missing: Sequence[str], unreadable: Sequence[str], causes: Sequence[str]
) -> Iterator[str]:
    """Yield why images have no camera: unreadable files, causes in files, and the remedy for the
    other images.
    """
    yield from unreadable[:MAX_UNREADABLE]
    if len(unreadable) > MAX_UNREADABLE:
        yield f"{len(unreadable) - MAX_UNREADABLE} more cannot be read"
    yield from causes
    # Photographs between these and the others do not help images with another cause.
    if not all(_is_explained(name, unreadable, causes) for name in missing):
        yield "add photographs between these and the others"


def _is_explained(name: str, unreadable: Sequence[str], causes: Sequence[str]) -> bool:
    """Return whether a reason is about an image, and not about another whose name contains its name."""
    # Unreadable files have the form "path: reason".
    if any(f"/{name}: " in f"/{reason}" for reason in unreadable):
        return True
    # Causes end with the names of their images, and perhaps with a number of files.
    ends = [cause.rpartition(": ")[2].partition("; ")[0] for cause in causes]
    return any(f"/{name}".endswith(f"/{other}") for end in ends for other in end.split(", "))


def causes_of(batch: str, log: RunLog) -> list[str]:
    """Return why images of a batch have no camera, as the last session has found in their files."""
    prefix = f"{batch}: "
    # The files of an earlier session may have been corrected since.
    faults = [event.text for event in log.events if event.kind == EventKind.FAULT]
    return [fault.removeprefix(prefix) for fault in faults if fault.startswith(prefix)]


def _small_batches(log: RunLog) -> Iterator[str]:
    """Yield a sentence for each batch of a folder that is too small for cameras."""
    scene = log.recipe.scene
    # A submission has batches of one pair, and extra pairs; a folder has cameras alone.
    if scene is None or scene.pairs_per_image:
        return
    counts = Counter(log.tables.pairs["group"])
    for batch in dict.fromkeys([*log.files, *counts]):
        if counts[batch] < MIN_PAIRS:
            yield (
                f"{batch}: no cameras, {plural(counts[batch], 'pair')}: at least three matched images are "
                "needed"
            )


def nearest_to_joining(scene: SceneRecord, pairs: "DataFrame", digests: Mapping[str, str]) -> str:
    """Return the pair of images of two models with the most inliers, as text; empty
    without inliers.

    ``digests`` are of the contents of the images, by name.
    """
    models = [{found.image.digest for found in model.images} for model in scene.models]

    def models_of(file: str) -> set[int]:
        return {number for number, images in enumerate(models) if digests.get(file) in images}

    def would_join(row: tuple[str, str, int]) -> bool:
        first = models_of(row[0])
        second = models_of(row[1])
        # Two images of one model join nothing.
        return bool(row[2] and first and second and first.isdisjoint(second))

    rows = zip(pairs["image0"], pairs["image1"], pairs["inliers"], strict=True)
    # The first of several equal ones, so that equal runs name the same pair
    best = max(filter(would_join, rows), key=lambda row: row[2], default=None)
    if best is None:
        return ""
    image0, image1, inliers = best
    labels = file_labels([*pairs["image0"], *pairs["image1"]])
    return f"{labels[image0]} and {labels[image1]} ({plural(inliers, 'inlier')})"


def _looseness(model: SfmModel) -> str:
    """Return the median expected error of a model's centres, as text."""
    sigmas = [found.sigmas.centre if found.sigmas else np.inf for found in model.images]
    found = median(sigmas)
    return f"{100 * found:.2g} % of its size" if np.isfinite(found) else "any distance"


def _is_uncertain(found: RegisteredImage, model: SfmModel) -> bool:
    if found.sigmas:
        return found.sigmas.centre > MAX_CENTRE_SIGMA
    # Bundle adjustment does not determine a camera without sigmas. Large models have none.
    return len(model.images) <= MAX_SIGMA_IMAGES


def _reprojection(scenes: Sequence[SceneRecord]) -> float:
    """Return the mean reprojection error of all models in pixels, each weighted by its
    observations.
    """
    models = [model for scene in scenes for model in scene.models]
    # A model without points has no error, and a weight that is not 0: the sum must not vanish.
    weights = [max(1, sum(found.points for found in model.images)) for model in models]
    return float(np.average([model.reprojection_error for model in models], weights=weights))


def write_summary(log: RunLog, page: Path) -> Path | None:
    """Write the facts of :func:`summary_table` as JSON next to the report ``page``. Return the
    path.

    ``report.html`` has ``summary.json``, another page NAME.html has NAME.summary.json; a page without the suffix
    of HTML, such as a device, has none. Raises :class:`UserError` if a file of another kind is in the way.
    """
    # A device such as /dev/stdout takes the page alone.
    if page.suffix.lower() not in (".html", ".htm"):
        return None
    # Several reports may lie in one folder, each with its summary.
    path = page.with_name("summary.json" if page.stem == "report" else f"{page.stem}.summary.json")
    if (path.exists() or path.is_symlink()) and not _is_summary(path):
        raise UserError(f"{path} is in the way and is not a summary of a run; move it")
    with writing(f"the summary {path}"), replacing(path) as stream:
        stream.write(
            printable(json.dumps(summary_table(log), indent=1, ensure_ascii=False, allow_nan=False))
        )
        stream.write("\n")
    return path


def _is_summary(path: Path) -> bool:
    # Before it is opened: a pipe would block, and a link may lead anywhere.
    if path.is_symlink() or not path.is_file():
        return False
    # A file that is not JSON is not ours.
    with suppress(OSError, ValueError, AttributeError, RecursionError):
        return str(json.loads(path.read_text(encoding="utf-8")).get("format", "")).startswith(
            "mkpc summary "
        )
    return False


def summary_table(log: RunLog) -> dict[str, Any]:
    """Return the facts of the report as JSON values; ``format`` names the version of the keys."""
    found = verdict(log)
    return {
        "format": FORMAT,
        "program": __version__,
        "recipe": log.recipe.name,
        "verdict": str(found),
        "problems": [*found.problems],
        "headline": headline(log),
        "ending": str(log.ending),
        "seconds": _number(log.seconds),
        "pairs": _pairs_table(log.tables.pairs),
        "files": {
            batch: {"count": len(log.files[batch]), "in_no_pair": names}
            for batch, names in unpaired_images(log).items()
        },
        "scenes": [_scene_table(scene, log) for scene in log.scenes],
        "units": _units_table(log),
        "seconds_by_part": {
            name: _number(seconds) for name, seconds in seconds_by_part(log).items()
        },
        "unit_failures": unit_reasons(log),
        "left_out": [*log.about.left_out],
        "faults": log.faults,
        "versions": dict(log.about.versions),
    }


def _pairs_table(pairs: "DataFrame") -> dict[str, Any]:
    inliers = pairs["inliers"][is_solved(pairs) & is_of_this_run(pairs)].tolist()
    return {
        "count": len(pairs),
        "with_f": int(is_solved(pairs).sum()),
        # Sorted, so that equal runs give equal files
        "sources": dict(sorted(Counter(pairs["source"]).items())),
        "doubtful": [
            name for name, doubt in zip(pairs["pair"], doubts(pairs), strict=True) if doubt
        ],
        # Not 0, which would be a measurement
        "inliers_median": _number(median(inliers)) if inliers else None,
        "inliers_minimum": min(inliers, default=None),
        "inliers_histogram": dict(inlier_histogram(pairs)),
    }


def _units_table(log: RunLog) -> list[dict[str, Any]]:
    """Return the means of each unit over the pairs that it ran on."""
    return [
        {
            "unit": name,
            "pairs": pairs,
            "matches": _number(matches),
            "inliers": _number(inliers),
            "seconds": _number(seconds),
        }
        for name, pairs, matches, inliers, seconds in unit_means(log)
    ]


def _scene_table(scene: SceneRecord, log: RunLog) -> dict[str, Any]:
    counts = image_counts(log, scene)
    return {
        "batch": scene.batch,
        "images": counts.images,
        "cameras": counts.cameras,
        "points": scene.points,
        "seconds": _number(scene.seconds),
        "failure": scene.failure,
        # Whose tracks made the cameras, and the other candidates, the best first
        "candidate": title_of(scene.candidate),
        "disagreement_degrees": _number(scene.disagreement),
        "rivals": [
            {
                "candidate": title_of(rival.candidate),
                "disagreement_degrees": _number(rival.disagreement),
                "cameras": rival.registered,
            }
            for rival in scene.rivals
        ],
        "models": [
            {
                "reprojection_px": _number(model.reprojection_error),
                "contradictions": json.loads(to_text(model.comparison)),
                "cameras": [
                    {
                        "image": found.image.name,
                        "focal_px": _number(found.focal),
                        "points": found.points,
                        # Keys with units are in docs/folder.md
                        "sigmas": found.sigmas._asdict() if found.sigmas else None,
                    }
                    for found in model.images
                ],
            }
            for model in scene.models
        ],
    }


def _number(value: float) -> float | None:
    """Return a number with six digits; JSON has neither infinity nor NaN."""
    return float(f"{value:.6g}") if np.isfinite(value) else None
