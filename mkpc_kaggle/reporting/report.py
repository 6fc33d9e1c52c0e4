"""``report.html``: a self-contained page about a run, built from its journal, and ``summary.json`` next to it.

Drawings need matplotlib, and pictures of pairs also need the images. The page states why drawings
are missing.
"""

import base64
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.engine.console import Progress
from mkpc_kaggle.errors import UserError, plural, printable, writing
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.two_stage import as_image
from mkpc_kaggle.progress import format_duration
from mkpc_kaggle.reporting.figures import draw_pair, draw_strip, encode
from mkpc_kaggle.reporting.points import clouds_of
from mkpc_kaggle.reporting.run_log import RunLog, read_log
from mkpc_kaggle.reporting.summary import (
    facts,
    headline,
    image_counts,
    is_doubtful,
    is_solved,
    large_models,
    left_out_line,
    seconds_by_part,
    unit_means,
    unit_reasons,
    weakest_cameras,
)
from mkpc_kaggle.reporting.verdict import doubts, inlier_histogram, verdict, write_summary
from mkpc_kaggle.reporting.view import (
    Reader,
    SceneView,
    picture_at,
    style_and_script,
    template,
    templates,
    view_of,
    view_part,
)
from mkpc_kaggle.scene.export import IMAGES

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure
    from pandas import DataFrame

# Time to write a page without drawings
WRITING_S = 0.6
WRITING_S_PER_PAIR = 0.0002
DRAWING_S = 5.0  # drawings start only if more time is left
# Drawn scenes, and drawn models per scene: with all points, each view adds 240 kB to the page.
MAX_SCENES = 12
MAX_ROWS = 2000  # of the table of pairs


def report_run(
    work_dir: Path,
    path: Path,
    ends: float,
    pairs: Sequence[Pair] = (),
    progress: Progress | None = None,
) -> str:
    """Write the report of a run that has just ended. Return a line with the path, or the reason for
    no report.

    The page is first written without drawings, so that it exists even if the program ends while
    drawing. The program's time ends at ``ends``, in seconds of the monotonic clock. ``pairs`` are
    the pairs of the run. Never raises: a failed report must not change the exit status of a
    successful run.
    """
    # The command that makes the report later is part of each line about a report that is missing.
    later = f"mkpc journal {work_dir} --report {path}"
    left = ends - time.monotonic()
    if left < WRITING_S + WRITING_S_PER_PAIR * len(pairs):
        return f"no report, the time is up; later: {later}"
    # Any error, also of matplotlib, of fonts and of a damaged journal
    try:
        log = read_log(work_dir)
        # Drawings fail most easily, so a page without them is written first.
        write_report(
            log, path, pairs, undrawn="little time was left; the journal command draws them"
        )
        write_summary(log, path)
        if left > DRAWING_S:
            write_report(log, path, pairs, progress=progress)
    except Exception as error:
        return f"warning: no report, or a report without drawings ({error}); later: {later}"
    return f"report: {path}"


def write_report(
    log: RunLog,
    path: Path,
    pairs: Sequence[Pair] = (),
    *,
    undrawn: str = "",
    progress: Progress | None = None,
) -> None:
    """Write the page of :func:`report_page`. Raise :class:`UserError` if ``path`` cannot be
    written.
    """
    # The page is complete before the former one is replaced.
    text = report_page(log, pairs, undrawn=undrawn, progress=progress)
    with writing(f"the report {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as stream:
            stream.write(printable(text))


def report_page(
    log: RunLog,
    pairs: Sequence[Pair] = (),
    *,
    undrawn: str = "",
    progress: Progress | None = None,
) -> str:
    """Return the HTML document. The template escapes all text from files.

    ``pairs`` have the image paths for drawings. ``undrawn`` is the reason for a page without
    drawings. ``progress`` shows the pictures of pairs that are drawn.
    """
    # An optional dependency: tables and views need no matplotlib.
    if not undrawn and find_spec("matplotlib") is None:
        undrawn = "matplotlib is not installed: pip install 'mkpc-kaggle[plots]'"
    sections = {
        **_head(log),
        **_missing(log),
        **_scene_section(log, () if undrawn else pairs),
        **_weakest_section(log, {} if undrawn else {pair.id: pair for pair in pairs}, progress),
        **_pair_section(log),
        **_seconds_section(log),
    }
    page = templates().get_template("report.html")
    return page.render(
        log=log, duration=format_duration, plural=plural, undrawn=undrawn, **sections
    )


def _head(log: RunLog) -> dict[str, Any]:
    """Return the values of the page's head: the verdict, and the facts as tiles."""
    return {
        "assets": assets(),
        "headline": headline(log),
        "found": verdict(log),
        "facts": facts(log),
        "left_out": left_out_line(log.recipe, log.about.left_out),
    }


def _missing(log: RunLog) -> dict[str, Any]:
    """Return the pairs without an F, and the units that failed, with the reasons."""
    # The template lists all of them, and counts their reasons only where several share one.
    pairs = log.tables.pairs
    unsolved = pairs[~is_solved(pairs)]
    failed = [tuple(row) for row in unsolved[["pair", "group", "failure"]].values]
    return {
        "failed": failed,
        "failures": Counter(reason for *_, reason in failed).most_common(),
        "unit_failures": [(reason,) for reason in unit_reasons(log)],
    }


def _scene_section(log: RunLog, pairs: Sequence[Pair]) -> dict[str, Any]:
    """Return the views and tables of scenes. ``pairs`` have the paths of images, if any are read."""

    def read_in(batch: str) -> Reader:
        files = [file for pair in pairs if pair.group == batch for file in pair.images]
        return reader_of({str(file): file for file in files})

    # Rows whose F is not the scene's have a reason, such as images without a camera.
    choices = Counter(filter(None, log.tables.pairs["choice"]))
    return {
        # Lists, because the template asks for their lengths
        "scenes": [*_scenes(log)],
        "choices": choices.most_common(),
        "sigmas": [
            (name, 100 * of.centre, of.rotation, of.focal) if of else (name, "unknown", "", "")
            for name, of in weakest_cameras(log.scenes)
        ],
        "large_models": large_models(log.scenes),
        "views": [*_views(log, read_in)],
    }


def _weakest_section(
    log: RunLog, sources: Mapping[str, Pair], progress: Progress | None
) -> dict[str, Any]:
    """Return the weakest pairs with their pictures; ``sources`` has the pairs with paths, by id."""
    weakest = []
    for count, (number, match) in enumerate(log.weakest, start=1):
        row = log.tables.pairs.loc[[number]]
        name = row["pair"].item()
        weakest.append((_picture(sources.get(name), match), name, weakness(row)))
        # Reading and drawing large photographs takes a second for each pair.
        if progress is not None and sources:
            progress.count("drawing", count, len(log.weakest))
    # The next text begins a new line.
    if progress is not None:
        progress.close()
    return {
        "weakest": weakest,
        "sources": sources,
        "min_support": MIN_SUPPORT,
    }


def _pair_section(log: RunLog) -> dict[str, Any]:
    """Return the rows of the table of pairs, and the histogram of their inliers."""
    pairs = log.tables.pairs
    histogram = inlier_histogram(pairs)
    return {
        # More rows make browsers slow; the journal command exports all.
        "pair_rows": pair_rows(pairs)[:MAX_ROWS],
        "more_pairs": max(0, len(pairs) - MAX_ROWS),
        "histogram": histogram,
        # At least 1, since widths are relative to it
        "histogram_most": max(1, *(count for _, count in histogram)),
    }


def _seconds_section(log: RunLog) -> dict[str, Any]:
    """Return the mean and total seconds of units, and of the parts of the work."""
    return {
        "units": [(*means, means[1] * means[-1]) for means in unit_means(log)],
        "parts": [
            (name, total, total / len(log.tables.pairs))
            for name, total in seconds_by_part(log).items()
            # A part that no pair has needs no row.
            if total
        ],
    }


def assets() -> "Markup":
    """Return the styles and scripts of a page, which are the same in all pages."""
    from markupsafe import Markup

    # All from this package, so nothing in it needs escaping
    return Markup(f"<script>\n{template('report.js')}</script>\n") + style_and_script()


def pair_rows(pairs: "DataFrame") -> list[tuple[str | int | float, ...]]:
    """Return id, matches, inliers, overlap, source of F and doubt of each pair, the fewest inliers
    first.
    """
    # The first rows of a long table are those to look at.
    rows = pairs.assign(support=pairs["support"].round(1), remark=remarks(pairs))
    rows = rows.sort_values("inliers", kind="stable")
    columns = ["pair", "matches", "inliers", "support", "source", "remark"]
    # Python's numbers: the template formats them by their type.
    return list(zip(*(rows[column].tolist() for column in columns), strict=True))


def remarks(pairs: "DataFrame") -> list[str]:
    """Return why each pair has no F, or why its F is doubtful, or an empty string."""
    found = []
    for has_f, failure, doubt in zip(
        is_solved(pairs), pairs["failure"], doubts(pairs), strict=True
    ):
        found.append(doubt if has_f else failure)
    return found


def weakness(row: "DataFrame") -> str:
    """Return the facts about a weak pair, a table of one row."""
    pair = row.iloc[0]
    facts = [f"{pair['inliers']} inliers of {pair['matches']} matches", pair["failure"]]
    if is_doubtful(row).item():
        facts.append(f"may show different things: support {pair['support']:.1f}")
    if pair["source"] == "scene":
        facts.append("F from the scene")
    return "; ".join(filter(None, facts))


def _views(log: RunLog, read_in: Callable[[str], Reader]) -> Iterator[tuple[str, "Markup"]]:
    """Yield the title and the view of each of the largest scenes.

    ``read_in`` returns the reader of a batch's images.
    """
    largest = sorted(log.scenes, key=lambda scene: -scene.registered)[:MAX_SCENES]
    for scene in largest:
        # Its reason is in the table of scenes.
        if not scene.models:
            continue
        models = scene.models
        # COLMAP's files have more points than the journal, and their colours.
        clouds = clouds_of(scene, log.path.parent.parent)
        if clouds:
            models = tuple(
                replace(each, points=cloud.points)
                for each, cloud in zip(models, clouds, strict=True)
            )
        # A click on a camera lists the pairs of its image.
        pairs = log.tables.pairs
        part = view_part(
            models,
            scene.batch,
            read=read_in(scene.batch),
            partners=partners_of(pairs[pairs["group"] == scene.batch]),
            colours=[cloud.colours for cloud in clouds],
        )
        yield scene.batch, part


def reader_of(paths: Mapping[str, Path]) -> Reader:
    """Return a reader of images by the ends of their paths; an image without a path is unknown.

    ``paths`` has the file to read for each original path.
    """
    keys: dict[str, list[str]] = {}
    for key in paths:
        keys.setdefault(Path(key).name, []).append(key)

    def read(name: str) -> Image | None:
        # A scene names its images by file names, or by paths below the folder. Photographs in
        # several folders may have one name.
        alike = keys.get(Path(name).name, [])
        fitting = [key for key in alike if f"/{key}".endswith(f"/{name}")] or alike
        return picture_at(str(paths[fitting[0]])) if fitting else None

    return read


def show_run(work_dir: Path, root: Path | None = None) -> SceneView:
    """Return the view of the scenes of a run. Its images lie below ``root``.

    Without ``root``, only ``reconstruct`` has images: the links next to its models. Raises
    :class:`UserError` if the journal is missing or damaged.
    """
    log = read_log(work_dir)

    def read_in(batch: str) -> Reader:
        if root is None:
            # The journal is in OUT/work.
            return reader_of(linked_images(log.path.parent.parent, batch))
        pairs = log.tables.pairs[log.tables.pairs["group"] == batch]
        files = {*pairs["image0"], *pairs["image1"]}
        return reader_of({file: root / file for file in files})

    return view_of(_views(log, read_in))


def linked_images(out: Path, batch: str) -> dict[str, Path]:
    """Return the images of a dataset in the results of ``reconstruct``, by original path."""
    # The images that lie directly in DIR have their folder in OUT itself.
    for folder in (out / batch / IMAGES, out / IMAGES):
        if folder.is_dir():
            # A link may have another name than the photograph: names of links are ASCII.
            return {
                str(file.readlink() if file.is_symlink() else file): file
                for file in folder.iterdir()
            }
    return {}


def partners_of(pairs: "DataFrame") -> dict[str, list[tuple[str, int, int]]]:
    """Return the partners of each image, by its path below the images: name, inliers and matches of
    the pair, the most inliers first.
    """
    partners: dict[str, list[tuple[str, int, int]]] = {}
    columns = ["image0", "image1", "inliers", "matches"]
    for image0, image1, inliers, matches in pairs[columns].itertuples(index=False):
        # A pair counts for both of its images.
        for file, other in ((image0, image1), (image1, image0)):
            partners.setdefault(file, []).append((Path(other).name, inliers, matches))
    return {
        name: sorted(others, key=lambda partner: -partner[1]) for name, others in partners.items()
    }


def _picture(source: Pair | None, match: PairMatch) -> str:
    """Return a pair's picture as a data URI, empty if an image is unknown or unreadable."""
    if source is not None:
        # The table then says that the image cannot be read any more.
        with suppress(UserError):
            return _data_uri(draw_strip(_images(source), match), "jpeg")
    return ""


def weak_figure(log: RunLog, match: PairMatch, source: Pair) -> "Figure":
    """Draw the matches, clusters and critical regions of a weak pair of the log.

    ``source`` is the pair with image paths. Raises :class:`UserError` for an unreadable image.
    """
    return draw_pair(*_images(source), match, log.recipe.mkpc)


def _images(pair: Pair) -> tuple[Image, Image]:
    # As the run turned them, so that points fit
    first, second = (
        as_image(path).turned(turns) for path, turns in zip(pair.images, pair.turns, strict=True)
    )
    return first, second


def _scenes(log: RunLog) -> Iterator[tuple[object, ...]]:
    """Yield a row per batch: name, images, registered, points, focals, reprojection, seconds,
    pairs, failure.
    """
    pairs = log.tables.pairs
    counts = Counter(pairs["group"][pairs["source"] == "scene"])
    for scene in log.scenes:
        focals = [image.focal for model in scene.models for image in model.images]
        # A wide spread of focal lengths in photographs of one camera is a sign of wrong cameras.
        spread = f"{median(focals):.0f} ({min(focals):.0f} to {max(focals):.0f})" if focals else ""
        # Of each model: one of several may be wrong.
        errors = ", ".join(f"{model.reprojection_error:.2f}" for model in scene.models)
        images = image_counts(log, scene)
        placed = scene.batch, images.images, images.cameras, scene.points, spread, errors
        yield (*placed, scene.seconds, counts[scene.batch], scene.failure)


def _data_uri(figure: "Figure", kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(encode(figure, kind)).decode()}"
