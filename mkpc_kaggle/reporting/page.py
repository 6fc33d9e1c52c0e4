"""``report.html``: one page about a run, from its results."""

import base64
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.engine.frames import Results, results
from mkpc_kaggle.errors import UserError, printable, writing
from mkpc_kaggle.pipeline.arguments import as_image
from mkpc_kaggle.pipeline.drawing import draw_strip
from mkpc_kaggle.progress import counted
from mkpc_kaggle.reporting.figures import encode
from mkpc_kaggle.reporting.summary import (
    counts,
    failures,
    headline,
    left_out_line,
    unit_table,
)

if TYPE_CHECKING:
    from pandas import DataFrame

# Time to write a page without pictures
WRITING_S = 0.6
WRITING_S_PER_PAIR = 0.0002
DRAWING_S = 5.0  # pictures are drawn only if more time is left
MAX_PICTURES = 12
MAX_VIEWS = 12  # scenes in 3D: each adds its points to the page
MAX_ROWS = 1000  # of a table; browsers are slow with more
SHOWN_OF_PAIRS = ["pair", "group", "matches", "inliers", "source", "choice", "failure"]
SHOWN_OF_CAMERAS = ["batch", "model", "image", "points", "focal", "camera_model"]
STYLE = """
body { margin: 1rem auto; max-width: 76rem; padding: 0 1rem; font: 1rem/1.5 system-ui, sans-serif;
  overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; }
h2 { font-size: 1.2rem; margin-top: 2rem; }
img { max-width: 100%; }
.dim, figcaption { color: #5b616b; font-size: .9rem; }
figure { margin: 1rem 0; }
.rows { max-height: 30rem; overflow: auto; }
table { border-collapse: collapse; font-size: .9rem; }
th, td { text-align: left; padding: .2rem .8rem .2rem 0; border-bottom: 1px solid #d5d8de; }
th { position: sticky; top: 0; background: #fff; white-space: nowrap; }
"""


def report_run(work_dir: Path, path: Path, ends: float, pairs: Sequence[Pair] = ()) -> str:
    """Write the page of a run that has just ended. Return a line with the path, or the reason for
    no page.

    The page is first written without pictures, so that it exists even if the program ends while
    drawing. The program's time ends at ``ends``, in seconds of the monotonic clock. Never raises: a
    failed page must not change the exit status of a successful run.
    """
    left = ends - time.monotonic()
    if left < WRITING_S + WRITING_S_PER_PAIR * len(pairs):
        return "no report, the time is up; the same command with more time writes it"
    # Any error, also of matplotlib, of fonts and of a damaged journal
    try:
        found = results(work_dir)
        write_page(found, path)
        if left > DRAWING_S:
            write_page(found, path, pairs)
    except Exception as error:
        return f"warning: no report, or a report without pictures: {error}"
    return f"report: {path}"


def write_page(found: Results, path: Path, pairs: Sequence[Pair] = ()) -> None:
    """Write the page, with pictures of the weakest of ``pairs``. Raise :class:`UserError` if
    ``path`` cannot be written.
    """
    # The page is complete before the former one is replaced.
    text = page(found, pairs)
    with writing(f"the report {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as stream:
            stream.write(printable(text))


def page(found: Results, pairs: Sequence[Pair] = ()) -> str:
    """Return an HTML document that needs no network. All text from files is escaped."""
    about = found.about
    title = headline(found)
    versions = ", ".join(f"{name} {version}" for name, version in about.versions.items())
    settings = f"recipe {found.recipe.name}, {about.device}; {versions}"
    left_out = left_out_line(found.recipe, about.left_out)
    body = [
        f"<h1>{escape(title)}</h1>",
        *paragraphs(counts(found.pairs, found.scenes)),
        *paragraphs(filter(None, [settings, left_out]), "dim"),
        *section("What failed", paragraphs(failures(found))),
        *section("Cameras", cameras_of(found)),
        *section("Pairs with the fewest inliers", pictures(found, pairs)),
        *section(
            "Pairs", table(found.pairs.sort_values("inliers", kind="stable"), SHOWN_OF_PAIRS)
        ),
        *section("Units", table(unit_table(found.units).reset_index(names="unit"))),
    ]
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
    text = "\n".join(body)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{text}\n</body></html>\n'


def section(title: str, parts: Iterable[str]) -> Iterator[str]:
    """Yield a heading and its parts, or nothing without parts."""
    for number, part in enumerate(parts):
        if not number:
            yield f"<h2>{title}</h2>"
        yield part


def paragraphs(lines: Iterable[str], kind: str = "") -> Iterator[str]:
    for line in lines:
        yield f'<p class="{kind}">{escape(line)}</p>'


def table(rows: "DataFrame", columns: Sequence[str] = ()) -> Iterator[str]:
    """Yield the first rows of a table, if it has any."""
    if len(rows):
        shown = rows[:MAX_ROWS][list(columns or rows.columns)]
        text = shown.to_html(
            index=False, border=0, float_format="{:.4g}".format, justify="left"
        )
        yield f'<div class="rows">{text}</div>'
    if len(rows) > MAX_ROWS:
        yield f'<p class="dim">The first {MAX_ROWS} of {len(rows)} rows.</p>'


def cameras_of(found: Results) -> Iterator[str]:
    """Yield the view of each model, and the tables of scenes and cameras."""
    shown = found.scenes.drop(columns=["missing", "seconds"])
    yield from table(shown)
    if find_spec("plotly") is None and len(found.cameras):
        yield '<p class="dim">With plotly (extra `plots`), cameras and points are shown here.</p>'
    elif len(found.cameras):
        yield from views(found)
    yield from table(found.cameras.sort_values("points", kind="stable"), SHOWN_OF_CAMERAS)


def views(found: Results) -> Iterator[str]:
    """Yield the largest models in 3D; the first brings plotly's script along."""
    from mkpc_kaggle.reporting.view import view

    by_model = found.cameras.groupby(["batch", "model"])
    largest = sorted(found.points, key=lambda key: -len(by_model.get_group(key)))
    for number, (batch, model) in enumerate(largest[:MAX_VIEWS]):
        figure = view(by_model.get_group((batch, model)), found.points[batch, model])
        yield f"<h3>{escape(batch)}, model {model}</h3>"
        yield figure.to_html(full_html=False, include_plotlyjs=number == 0)


def pictures(found: Results, pairs: Sequence[Pair]) -> Iterator[str]:
    """Yield pictures of the matched pairs with the fewest inliers, as far as their images are known."""
    if not pairs or find_spec("matplotlib") is None:
        return
    known = {pair.id: pair for pair in pairs}
    rows = found.pairs[(found.pairs["units"] > 0) & found.pairs["pair"].isin(known)]
    rows = rows.sort_values("inliers", kind="stable")[:MAX_PICTURES]
    yield '<p class="dim">Green: inliers; orange: other matches; yellow: critical regions.</p>'
    # Reading and drawing large photographs takes a second for each pair.
    names = rows["pair"].tolist()
    matches = found.matches(*names)
    for name in counted(names, "drawing", "pair"):
        match = next(matches)
        pair = known[name]
        caption = (
            f"{name}: {match.estimate.inlier_count} inliers of {len(match.matches)} matches"
        )
        # An image may have been removed since.
        with suppress(UserError):
            first, second = (
                as_image(path).turned(turns)
                for path, turns in zip(pair.images, pair.turns, strict=True)
            )
            data = base64.b64encode(encode(draw_strip((first, second), match))).decode()
            image = f'<img src="data:image/jpeg;base64,{data}" alt="{escape(caption)}">'
            yield f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"
