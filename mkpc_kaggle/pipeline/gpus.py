"""What a run asks of the machine's GPUs before any work, without becoming a process that computes on them.

A CUDA context takes some hundred MB of a GPU's memory: the parent of workers must have none.
"""

import json
import subprocess
import sys
from functools import cache

from mkpc_kaggle.errors import UserError

ADVICE = "on Kaggle choose the accelerator GPU T4 x2, elsewhere try --device cpu"

Capability = tuple[int, int]
CACHE_SHARE = 0.25
"""Of a GPU's free memory, for the encodings that all workers on it keep."""
# PyTorch counts GPUs for which its build has no kernels as available: only a kernel that runs is proof.
ASK = """
import json, torch
gpus, errors = range(torch.cuda.device_count()), []
for gpu in gpus:
    try:
        torch.ones(8, device=gpu).sum().item()
    except RuntimeError as error:
        errors.append(str(error).partition("\\n")[0])
if errors and len(errors) == len(gpus):
    raise SystemExit(errors[-1])
print(json.dumps([torch.cuda.get_device_capability(gpu) for gpu in gpus]))
"""


@cache
def capabilities() -> list[Capability]:
    """The compute capability of each GPU, such as (7, 5); asked in a process of its own, as it makes a context.

    Raises :class:`UserError` where none of them can compute.
    """
    asked = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=False)
    if asked.returncode:
        reason = asked.stderr.strip()[-300:]
        raise UserError(f"PyTorch cannot compute on this machine's GPUs ({reason}); {ADVICE}")
    return [(major, minor) for major, minor in json.loads(asked.stdout.splitlines()[-1])]


def gpus_of(device: str) -> list[int]:
    """The numbers of the GPUs that ``cuda`` or ``cuda:N`` stands for; counting them makes no context."""
    import torch

    kind, _, number = device.partition(":")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if kind != "cuda" or (device != kind and not number.isdecimal()):
        raise UserError(f"unknown device {device!r}; known: auto, cpu, cuda, cuda:N")
    if not count:
        raise UserError(f"--device {device}: this machine has no GPU that PyTorch can use; {ADVICE}")
    if number and int(number) >= count:
        known = ", ".join(f"cuda:{index}" for index in range(count))
        raise UserError(f"--device {device}: this machine has only {known}")
    return [int(number)] if number else list(range(count))


def encoding_cache_bytes(device: str, workers: int) -> int:
    """For each of so many workers on a GPU; to be asked by them, when little is on it yet."""
    import torch

    free, _ = torch.cuda.mem_get_info(device)
    return int(free * CACHE_SHARE / workers)
