"""``report.html``: a self-contained page about a run, built from its journal, and ``summary.json`` next to it.

Drawings need matplotlib, and pictures of pairs also need the images. The page states why drawings
are missing.
"""

import base64
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.errors import UserError, printable, writing
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.two_stage import to_image
from mkpc_kaggle.reporting.figures import draw_cameras, draw_pair, draw_strip, encode
from mkpc_kaggle.reporting.points import clouds_of
from mkpc_kaggle.reporting.run_log import RunLog, read_log
from mkpc_kaggle.reporting.summary import (
    facts,
    headline,
    is_doubtful,
    left_out_line,
    seconds_by_part,
    unit_means,
    unit_reasons,
    weakest_cameras,
)
from mkpc_kaggle.reporting.verdict import doubt, inlier_histogram, verdict, write_summary
from mkpc_kaggle.reporting.view import (
    Reader,
    View,
    picture_at,
    style_and_script,
    template,
    view_of,
    view_part,
)
from mkpc_kaggle.scene.export import IMAGES

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure

WRITING_S, WRITING_S_PER_PAIR = 0.6, 0.0002  # time to write a page without drawings
DRAWING_S = 5.0  # drawings start only if more time is left
MAX_SCENES, MAX_MODELS = 12, 8  # number of drawn scenes, and of drawn models per scene
MAX_ROWS = 2000  # of the table of pairs


def report_run(work_dir: Path, path: Path, ends: float, pairs: Sequence[Pair] = ()) -> str:
    """Write the report of a run that has just ended. Return a line with the path, or the reason for
    no report.

    The page is first written without drawings, so that it exists even if the program ends while
    drawing. The program's time ends at ``ends``, in seconds of the monotonic clock. ``pairs`` are
    the pairs of the run. Never raises: a failed report must not change the exit status of a
    successful run.
    """
    later = f"mkpc journal {work_dir} --report {path}"
    left = ends - time.monotonic()
    if left < WRITING_S + WRITING_S_PER_PAIR * len(pairs):
        return f"no report, the time is up; later: {later}"
    try:
        log = read_log(work_dir)
        write_report(
            log, path, pairs, undrawn="little time was left; the journal command draws them"
        )
        write_summary(log, path)
        if left > DRAWING_S:
            write_report(log, path, pairs)
    except Exception as error:
        return f"warning: no report, or a report without drawings ({error}); later: {later}"
    return f"report: {path}"


def write_report(log: RunLog, path: Path, pairs: Sequence[Pair] = (), *, undrawn: str = "") -> None:
    """Write the page of :func:`report_page`. Raise :class:`UserError` if ``path`` cannot be
    written.
    """
    text = report_page(log, pairs, undrawn=undrawn)
    with writing(f"the report {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as stream:
            stream.write(printable(text))


def report_page(log: RunLog, pairs: Sequence[Pair] = (), *, undrawn: str = "") -> str:
    """Return the HTML document. The template escapes all text from files.

    ``pairs`` have the image paths for drawings. ``undrawn`` is the reason for a page without drawings.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    readable = () if undrawn else pairs  # a late page reads no images

    def read_in(batch: str) -> Reader:
        files = [file for pair in readable if pair.group == batch for file in pair.images]
        return reader_of({file.name: file for file in files})

    if not undrawn and find_spec("matplotlib") is None:
        undrawn = "matplotlib is not installed: pip install 'mkpc-kaggle[plots]'"
    sources = {} if undrawn else {pair.id: pair for pair in pairs}
    failed = [
        (record.pair.id, record.pair.group, record.failure)
        for record in log.records
        if not record.is_solved
    ]
    histogram = inlier_histogram(log.records)
    pages = Environment(
        loader=PackageLoader("mkpc_kaggle.reporting"), autoescape=True, undefined=StrictUndefined
    )
    return pages.get_template("report.html").render(
        log=log,
        duration=format_duration,
        assets=assets(),
        headline=headline(log),
        found=verdict(log),
        facts=facts(log),
        left_out=left_out_line(log.recipe, log.about.left_out),
        failed=failed,
        failures=Counter(reason for *_, reason in failed).most_common(),
        unit_failures=[(reason,) for reason in unit_reasons(log)],
        sources=sources,
        weakest=[
            (_picture(sources.get(record.pair.id), match), record) for record, match in log.weakest
        ],
        scenes=[*_scenes(log)],
        choices=Counter(
            str(record.scene.reason) for record in log.records if record.scene
        ).most_common(),
        sigmas=[
            (name, 100 * of.centre, of.rotation, of.focal) if of else (name, "unknown", "", "")
            for name, of in weakest_cameras(log.scenes)
        ],
        is_doubtful=is_doubtful,
        min_support=MIN_SUPPORT,
        views=[*_views(log, read_in, is_drawn=not undrawn)],
        pair_rows=pair_rows(log.records)[:MAX_ROWS],
        more_pairs=max(0, len(log.records) - MAX_ROWS),
        histogram=histogram,
        histogram_most=max(1, *(count for _, count in histogram)),
        units=[(*means, means[1] * means[-1]) for means in unit_means(log)],
        parts=[
            (name, total, total / len(log.records))
            for name, total in seconds_by_part(log).items()
            if total
        ],
        undrawn=undrawn,
    )


def assets() -> "Markup":
    """Return the styles and scripts of a page, which are the same in all pages."""
    from markupsafe import Markup

    return Markup(f"<script>\n{template('report.js')}</script>\n") + style_and_script()


def pair_rows(records: Sequence[PairRecord]) -> list[tuple[str | int | float, ...]]:
    """Return id, matches, inliers, overlap, source of F and doubt of each pair, the fewest inliers
    first.
    """
    weakest_first = sorted(records, key=lambda record: (record.inliers, record.index))
    return [
        (
            record.pair.id,
            record.matches,
            record.inliers,
            round(record.stats.support, 1),
            record.source,
            doubt(record) or ("" if record.is_solved else record.failure),
        )
        for record in weakest_first
    ]


def _views(
    log: RunLog, read_in: Callable[[str], Reader], *, is_drawn: bool
) -> Iterator[tuple[str, "Markup"]]:
    """Yield the title and the view of each of the largest scenes.

    ``read_in`` returns the reader of a batch's images. If ``is_drawn``, pictures replace a view
    without scripts.
    """
    largest = sorted(log.scenes, key=lambda scene: -scene.registered)[:MAX_SCENES]
    for scene in (scene for scene in largest if scene.models):
        pictures = []
        for number in range(min(len(scene.models), MAX_MODELS) if is_drawn else 0):
            figure = draw_cameras(scene, number)
            pictures.append((f"{scene.batch}, model {number}", _data_uri(figure, "png")))
        models = scene.models
        # COLMAP's files have more points than the journal, and their colours.
        clouds = clouds_of(scene, log.path.parent.parent)
        if clouds:
            models = tuple(
                replace(each, points=cloud.points)
                for each, cloud in zip(models, clouds, strict=True)
            )
        records = [record for record in log.records if record.pair.group == scene.batch]
        part = view_part(
            models,
            scene.batch,
            read=read_in(scene.batch),
            partners=partners_of(records),
            pictures=pictures,
            colours=[cloud.colours for cloud in clouds],
        )
        yield scene.batch, part


def reader_of(paths: Mapping[str, Path]) -> Reader:
    """Return a reader of images by their file names; an image without a path is unknown."""

    def read(name: str) -> Image | None:
        path = paths.get(Path(name).name)
        return None if path is None else picture_at(str(path))

    return read


def show_run(work_dir: Path, root: Path | None = None) -> View:
    """Return the view of the scenes of a run. Its images lie below ``root``.

    Without ``root``, only ``reconstruct`` has images: the links next to its models. Raises
    :class:`UserError` if the journal is missing or damaged.
    """
    log = read_log(work_dir)

    def read_in(batch: str) -> Reader:
        if root is None:
            return reader_of(linked_images(log.path.parent.parent, batch))
        files = {
            file
            for record in log.records
            if record.pair.group == batch
            for file in (record.pair.file0, record.pair.file1)
        }
        return reader_of({Path(file).name: root / file for file in files})

    return view_of(_views(log, read_in, is_drawn=False))


def linked_images(out: Path, batch: str) -> dict[str, Path]:
    """Return the images of a dataset in the results of ``reconstruct``, by file name."""
    # The images that lie directly in DIR have their folder in OUT itself.
    for folder in (out / batch / IMAGES, out / IMAGES):
        if folder.is_dir():
            return {file.name: file for file in folder.iterdir()}
    return {}


def partners_of(records: Iterable[PairRecord]) -> dict[str, list[tuple[str, int, int]]]:
    """Return the partners of each image: name, inliers and matches of the pair, the most inliers
    first.
    """
    partners: dict[str, list[tuple[str, int, int]]] = {}
    for record in records:
        for name, other in (record.pair.names, record.pair.names[::-1]):
            partners.setdefault(name, []).append((other, record.inliers, record.matches))
    return {name: sorted(found, key=lambda each: -each[1]) for name, found in partners.items()}


def _picture(source: Pair | None, match: PairMatch) -> str:
    """Return a pair's picture as a data URI, empty if an image is unknown or unreadable."""
    if source is not None:
        with suppress(UserError):
            return _data_uri(draw_strip(_images(source), match), "jpeg")
    return ""


def weak_figure(log: RunLog, match: PairMatch, source: Pair) -> "Figure":
    """Draw the matches, clusters and critical regions of a weak pair of the log.

    ``source`` is the pair with image paths. Raises :class:`UserError` for an unreadable image.
    """
    return draw_pair(*_images(source), match, log.recipe.mkpc)


def _images(pair: Pair) -> tuple[Image, Image]:
    first, second = (
        to_image(path).turned(turns) for path, turns in zip(pair.images, pair.turns, strict=True)
    )
    return first, second


def _scenes(log: RunLog) -> Iterator[tuple[object, ...]]:
    """Yield a row per batch: name, images, registered, points, focals, reprojection, seconds,
    pairs, failure.
    """
    counts = Counter(record.pair.group for record in log.records if record.source == "scene")
    for each in log.scenes:
        focals = [found.focal for model in each.models for found in model.images]
        spread = f"{median(focals):.0f} ({min(focals):.0f} to {max(focals):.0f})" if focals else ""
        errors = ", ".join(f"{model.reprojection_error:.2f}" for model in each.models)
        placed = each.batch, each.images, each.registered, each.points, spread, errors
        yield (*placed, each.seconds, counts[each.batch], each.failure)


def _data_uri(figure: "Figure", kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(encode(figure, kind)).decode()}"
