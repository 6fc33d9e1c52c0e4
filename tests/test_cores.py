"""The number of cores that a process may use."""

import json
import os
import subprocess
import sys

import pytest

from mkpc_kaggle import cores


def test_cores_are_those_of_the_affinity():
    assert 1 <= cores.available_cores() <= len(os.sched_getaffinity(0))


LIMITS = """
import cv2, json
from threadpoolctl import threadpool_info
from mkpc_kaggle import cores
cores.available_cores = lambda: 6
found = []
if {matching}:
    import torch
    for options in ({{}}, {{"share": 2}}, {{"share": 9}}, {{"threads": 4}}):
        torch.set_num_threads(6)
        cores.limit_matching_threads(**options)
        found.append((torch.get_num_threads(), cv2.getNumThreads()))
else:
    cores.limit_to_one_thread()
    import torch  # as a job may
    found = [torch.get_num_threads(), cv2.getNumThreads()]
    found += [pool["num_threads"] for pool in threadpool_info()]
print(json.dumps(found))
"""


# In a process of its own: limits last until it ends.
@pytest.mark.parametrize("matching", [True, False])
def test_workers_have_their_threads(matching: bool) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LIMITS.format(matching=matching)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "OMP_NUM_THREADS": "3"},
    )
    found = json.loads(done.stdout)
    if matching:
        assert found == [[6, 6], [3, 3], [1, 1], [4, 4]]
    else:
        assert set(found) == {1}
