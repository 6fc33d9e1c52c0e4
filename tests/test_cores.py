"""The number of cores that a process may use."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mkpc_kaggle import cores


def test_cores_are_those_of_the_affinity():
    assert 1 <= cores.available_cores() <= len(os.sched_getaffinity(0))


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
