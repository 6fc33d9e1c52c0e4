"""``report.html``: one page on a run, from its journal, that needs nothing but itself.

Figures need matplotlib and pictures the images; where either or the time is lacking, the page says so.
"""

import time
from collections.abc import Sequence
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import printable
from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.reporting.run_log import RunLog, read_log
from mkpc_kaggle.reporting.sections import Artist, sections_of

WRITING_SECONDS, WRITING_SECONDS_PER_PAIR = 0.3, 0.0002
"""Time that must be left to write a report without figures."""
LEAVING_SECONDS = 0.3
"""Time that a program needs to end."""


def report_run(work_dir: Path, path: Path, ends: float, pairs: Sequence[Pair] = ()) -> str:
    """Write the report of a run that has just ended; the line that says so, or why there is none.

    ``ends`` is when the program must have ended, in seconds of the monotonic clock; ``pairs`` are the run's, to
    be drawn. Never raises: a report must not cost a run that went well its exit status.
    """
    later = f"python -m mkpc_kaggle journal {work_dir} --report {path}"
    needed = WRITING_SECONDS + WRITING_SECONDS_PER_PAIR * len(pairs) + LEAVING_SECONDS
    if time.monotonic() + needed > ends:
        return f"no report, the time is up; later: {later}"
    try:
        write_report(read_log(work_dir), path, Artist(pairs, ends - LEAVING_SECONDS))
    except Exception as error:
        return f"warning: no report ({error}); later: {later}"
    return f"report: {path}"


def write_report(log: RunLog, path: Path, artist: Artist) -> None:
    """Write the page; raises :class:`UserError` where ``path`` cannot be written."""
    text = report_page(log, artist)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as stream:
            stream.write(printable(text))
    except OSError as error:
        raise UserError(f"the report {path} cannot be written: {error.strerror}") from error


def report_page(log: RunLog, artist: Artist) -> str:
    """The whole document; all that comes from files is escaped by the template's engine."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    pages = Environment(loader=PackageLoader("mkpc_kaggle.reporting"), autoescape=True, undefined=StrictUndefined)
    sections = sections_of(log, artist)
    return pages.get_template("report.html").render(
        title=f"{log.about.recipe}: {len(log.pairs)} pairs",
        heading=f"Recipe {log.about.recipe} on {len(log.pairs)} pairs",
        device=log.about.device,
        facts=_facts(log),
        missing=artist.missing,
        sections=sections,
    )


def _facts(log: RunLog) -> list[tuple[str, str, str]]:
    """What a reader wants to know first: name, value, remark."""
    solved = log.tables.solved
    limit = f"of {format_duration(log.about.limit)}" if log.about.limit is not None else "no time limit"
    return [
        ("pairs with an F", str(len(solved)), f"of {len(log.pairs)}"),
        ("time", format_duration(log.seconds), limit),
        ("inliers", f"{solved['inliers'].median():.0f}" if len(solved) else "-", "median of a pair"),
        ("ending", log.ending, f"session {log.sessions}" if log.sessions > 1 else "in one session"),
    ]
