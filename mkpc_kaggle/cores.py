"""CPU cores that this process may use, and the threads of its workers.

- A process of matching has all cores, or PyTorch's own number if that is less (``OMP_NUM_THREADS``), divided by
  the number of these processes: for PyTorch and OpenCV (:func:`limit_matching_threads`). There is one for each
  device, unless ``--workers`` has another number.
- A Ray actor has as many as one process alone on its machine; without GPUs, the CPUs that Ray has there.
- A process of estimates and features has one thread, in all libraries (:func:`limit_to_one_thread`).
- A process of a scene, or of an estimate that the others gave up, limits no library. It verifies pairs on all
  cores. Its mapper has ``threads`` of [scene], one by default, and its last adjustment one.
- A thread of the user's process (``--workers 0``) leaves the limits of the process as they are.

The number of processes is decided in :mod:`mkpc_kaggle.engine.workers.places`.
"""

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


def limit_matching_threads(threads: int = 0, share: int = 1) -> None:
    """Limit PyTorch and OpenCV to ``threads``, or to the cores of one of ``share`` processes."""
    import cv2
    import torch

    # PyTorch counts the machine's cores, and knows OMP_NUM_THREADS.
    available = min(torch.get_num_threads(), available_cores())
    threads = threads or max(1, available // share)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


def limit_to_one_thread() -> None:
    """Limit OpenCV, the libraries of NumPy and SciPy, and PyTorch to one thread."""
    import cv2
    from threadpoolctl import threadpool_limits  # comes with scikit-learn

    # For libraries that a job may load later: PyTorch, to compare features
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    cv2.setNumThreads(1)
    threadpool_limits(1)


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
