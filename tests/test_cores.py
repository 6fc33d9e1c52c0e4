"""The number of cores that a process may use."""

import os
import subprocess
import sys
from math import inf
from pathlib import Path

import pytest

from mkpc_kaggle import cores


@pytest.mark.parametrize(
    ("own", "files", "quota"),
    [
        ("0::/\n", {"cpu.max": "max 100000\n"}, inf),
        ("0::/\n", {"cpu.max": "250000 100000\n"}, 2.5),
        # A group, and one around it
        ("0::/a/b\n", {"a/cpu.max": "150000 100000", "a/b/cpu.max": "400000 100000"}, 1.5),
        # In a container, the host's path does not exist.
        ("0::/host/path\n", {"cpu.max": "200000 100000"}, 2.0),
        # Version 1, and both together
        (
            "4:cpu,cpuacct:/a\n3:memory:/a\n0::/a\n",
            {
                "cpu,cpuacct/a/cpu.cfs_quota_us": "300000",
                "cpu,cpuacct/a/cpu.cfs_period_us": "100000",
            },
            3.0,
        ),
        (
            "2:cpu:/\n",
            {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"},
            inf,
        ),
        ("3:memory:/\n", {}, inf),
        (None, {}, inf),
    ],
)
def test_the_quota_is_the_smallest_of_all_control_groups(tmp_path, own, files, quota):
    for name, text in files.items():
        path = tmp_path / "cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    if own is not None:
        (tmp_path / "own").write_text(own)
    assert cores.cpu_quota(tmp_path / "own", tmp_path / "cgroup") == quota


@pytest.mark.parametrize(("quota", "expected"), [(inf, 6), (64.0, 6), (2.5, 2), (0.5, 1)])
def test_cores_are_those_of_the_affinity_within_the_quota(monkeypatch, quota, expected):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)), raising=False)
    monkeypatch.setattr(cores, "cpu_quota", lambda: quota)
    assert cores.available_cores() == expected


def test_nothing_else_counts_cores():
    package = Path(cores.__file__).parent
    words = ("cpu_count", "sched_getaffinity", "ThreadPoolExecutor()")
    users = [
        path.name
        for path in package.rglob("*.py")
        if any(word in path.read_text() for word in words)
    ]
    assert users == ["cores.py"]


THREADS = """
import cv2, torch
from threadpoolctl import threadpool_info
from mkpc_kaggle import cores
cores.available_cores = lambda: 6
torch.set_num_threads(6)
{call}
pools = [pool["num_threads"] for pool in threadpool_info()]
print(torch.get_num_threads(), cv2.getNumThreads(), max(pools))
"""


@pytest.mark.parametrize(
    ("call", "threads"),
    [
        ("cores.limit_matching_threads()", {"torch": 6, "cv2": 6}),
        ("cores.limit_matching_threads(share=2)", {"torch": 3, "cv2": 3}),
        ("cores.limit_matching_threads(share=9)", {"torch": 1, "cv2": 1}),
        ("cores.limit_matching_threads(4)", {"torch": 4, "cv2": 4}),
        ("cores.limit_to_one_thread()", {"cv2": 1, "pools": 1}),
    ],
)
def test_workers_have_their_threads(call: str, threads: dict[str, int]) -> None:
    # In a process of its own: limits last until it ends.
    program = THREADS.format(call=call)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    counts = dict(zip(("torch", "cv2", "pools"), map(int, done.stdout.split()), strict=True))
    assert {name: counts[name] for name in threads} == threads


def test_a_library_that_a_worker_of_estimates_loads_later_has_one_thread() -> None:
    # A job that compares features of images loads torch.
    program = "from mkpc_kaggle import cores; cores.limit_to_one_thread(); import torch"
    program += "; print(torch.get_num_threads())"
    environment = {**os.environ, "OMP_NUM_THREADS": "3"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout.split() == ["1"]
