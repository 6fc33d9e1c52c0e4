"""Processes that a test's own processes have left."""

from pathlib import Path


def started_with(mark: str) -> dict[int, str]:
    """The commands of the processes, by id, that have that text in their environment, which
    children inherit.
    """
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (process / "environ").read_bytes():
                found[int(process.name)] = (
                    (process / "cmdline").read_text().replace("\0", " ")
                )
        except OSError:  # another user's, or it has ended meanwhile
            continue
    return found
