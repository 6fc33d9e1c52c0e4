"""Progress of waits outside of a run: rendering, pip and digests.

A run draws its own bar (:mod:`mkpc_kaggle.engine.console`), by the same rule.
"""

import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TypeVar

LINE_INTERVAL_S = 30.0  # between lines where a line cannot be redrawn in place
MAX_SILENCE_S = 1.0  # before a bar appears: shorter waits need none

Item = TypeVar("Item")


def is_redrawn(*, is_terminal: bool) -> bool:
    """Return whether a bar replaces its former state on a stream.

    A notebook's ``!command`` has a terminal, but Jupyter stores every state of a redrawn line. It
    sets JPY_PARENT_PID for these processes.
    """
    return is_terminal and "JPY_PARENT_PID" not in os.environ


def _is_on_terminal() -> bool:
    try:
        return sys.stderr is not None and sys.stderr.isatty()
    except ValueError:  # a closed stream
        return False


def counted(items: Sequence[Item], what: str, unit: str) -> Iterator[Item]:
    """Yield the items and show how many are done, with the rate and the remaining time.

    On a terminal this is a bar, elsewhere a line every half minute.
    """
    if is_redrawn(is_terminal=_is_on_terminal()):
        from tqdm import tqdm

        # tqdm prints nothing on a terminal that states no size, such as `script`'s.
        columns, rows = shutil.get_terminal_size()
        yield from tqdm(
            items,
            desc=what,
            unit=unit,
            delay=MAX_SILENCE_S,
            leave=False,
            ncols=columns,
            nrows=rows,
        )
        return
    written = time.monotonic()
    for done, item in enumerate(items):
        if time.monotonic() - written >= LINE_INTERVAL_S:
            print(f"{what}: {done}/{len(items)}", file=sys.stderr, flush=True)
            written = time.monotonic()
        yield item
