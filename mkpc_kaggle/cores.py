"""The number of CPU cores that this process may use."""

import os
from collections.abc import Iterator
from contextlib import suppress
from math import inf
from pathlib import Path, PurePosixPath

CGROUPS = Path("/sys/fs/cgroup")
OWN_CGROUPS = Path("/proc/self/cgroup")


def available_cores() -> int:
    """Return the number of cores that this process may use: by its affinity, and by the CPU quota
    of its container, rounded down. Both may be fewer than the machine has.
    """
    cores = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        cores = len(os.sched_getaffinity(0))
    return max(1, int(min(cores, cpu_quota())))


def cpu_quota(own: Path = OWN_CGROUPS, root: Path = CGROUPS) -> float:
    """Return the CPU seconds per second that Linux's control groups allow; infinite without a limit.

    Formats: ``cpu.max`` of version 2, ``cpu.cfs_quota_us`` of version 1.
    """
    quotas = [inf]
    with suppress(OSError):  # no Linux, or no control groups
        for line in own.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if not controllers:
                quotas += _quotas(root, path, "cpu.max")
            elif "cpu" in controllers.split(","):
                for name in (controllers, "cpu"):
                    quotas += _quotas(root / name, path, "cpu.cfs_quota_us", "cpu.cfs_period_us")
    return min(quotas)


def _quotas(root: Path, path: str, *files: str) -> Iterator[float]:
    """Yield the quotas of a group and of the groups around it."""
    # In a container, the path may be the host's, and only the root exists.
    for group in (PurePosixPath(path), *PurePosixPath(path).parents):
        directory = root / str(group).lstrip("/")
        with suppress(OSError, ValueError, ZeroDivisionError):
            quota, period = " ".join((directory / file).read_text() for file in files).split()
            # No limit is "max" in version 2, and -1 in version 1.
            if quota != "max" and int(quota) > 0:
                yield int(quota) / int(period)
