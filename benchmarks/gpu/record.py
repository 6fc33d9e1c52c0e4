"""The results: parts with rows, written as JSON after each part."""

import json
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

Row = dict[str, Any]
TRACEBACK_LINES = 6  # of an error, the last ones
EXPECTED = "as expected"


class Status(StrEnum):
    """The state of a part."""

    NOT_REACHED = "not reached"
    DONE = "done"
    CUT = "cut by the time limit"
    SKIPPED = "skipped"
    FAILED = "failed"


class SkippedError(Exception):
    """A part, or a row, that cannot be measured here; the message is the reason."""


class TimeIsUpError(Exception):
    """The time of a part is over; its remaining rows are not reached."""


@dataclass
class Part:
    """A part of the benchmark: its rows so far, and how it ended.

    ``until`` is the end of its time, on the monotonic clock.
    """

    name: str
    title: str
    status: Status = Status.NOT_REACHED
    reason: str = ""
    seconds: float = 0.0
    rows: list[Row] = field(default_factory=list)
    until: float = 0.0

    def left(self) -> float:
        """Return the seconds left for the part."""
        return self.until - time.monotonic()

    def check_time(self, needed: float = 0.0) -> None:
        """Raise :class:`TimeIsUpError` if less than ``needed`` seconds are left."""
        if self.left() <= needed:
            raise TimeIsUpError

    def add(self, **row: Any) -> None:
        """Add a row, and print it."""
        self.rows.append(row)
        shown = ", ".join(f"{key} {text_of(value)}" for key, value in row.items())
        say(f"  {shown}")

    @contextmanager
    def row(self, **names: Any) -> Iterator[Row]:
        """Add a row that begins with ``names``. An error in its block is the row's ``error``."""
        values: Row = dict(names)
        try:
            yield values
        except (TimeIsUpError, KeyboardInterrupt):
            raise
        except SkippedError as skipped:
            values["error"] = f"skipped: {skipped}"
        except Exception as error:
            values["error"] = last_lines(error)
            values["verdict"] = "failed"
        self.add(**values)

    @property
    def surprises(self) -> list[Row]:
        """The rows whose verdict is not the expected one."""
        return [row for row in self.rows if row.get("verdict", EXPECTED) != EXPECTED]


def run_part(part: Part, work: Callable[[Part], None]) -> None:
    """Run a part. An error is recorded, and other parts continue."""
    say(f"{part.title} (at most {part.left():.0f} s)")
    start = time.monotonic()
    try:
        part.check_time()
        work(part)
        part.status = Status.DONE
    except TimeIsUpError:
        part.status = Status.CUT if part.rows else Status.NOT_REACHED
    except SkippedError as skipped:
        part.status = Status.SKIPPED
        part.reason = str(skipped)
    except Exception as error:
        part.status = Status.FAILED
        part.reason = last_lines(error)
    part.seconds = time.monotonic() - start
    reason = f": {part.reason}" if part.reason else ""
    say(f"  {part.status} after {part.seconds:.1f} s{reason}")


def last_lines(error: BaseException) -> str:
    """Return the last lines of an error's traceback."""
    lines = "".join(traceback.format_exception(error)).splitlines()
    return "\n".join(lines[-TRACEBACK_LINES:])


def say(text: str) -> None:
    print(text, flush=True)


def write(directory: Path, machine: Row, parts: list[Part]) -> None:
    """Write ``gpu.json``, which replaces its former version at once."""
    table = {"machine": machine, "parts": [asdict(part) for part in parts]}
    # A killed benchmark leaves the former version.
    unfinished = directory / ".gpu.json.part"
    unfinished.write_text(json.dumps(table, indent=1, default=str) + "\n", encoding="utf-8")
    unfinished.replace(directory / "gpu.json")


def text_of(value: Any) -> str:
    """Return a value as one line, floats with four significant digits."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return " / ".join(str(value).splitlines())
