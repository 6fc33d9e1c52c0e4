"""Devices: names, available GPUs, and a check that a device works."""

import json
import subprocess
import sys
from functools import cache
from typing import Any

from mkpc_kaggle.errors import UserError, warn_once
from mkpc_kaggle.matchers.contract import Placement, Precision
from mkpc_kaggle.matchers.failures import DeviceError, FailureKind, failure_kind, reason_of

AUTO = "auto"
ADVICE = "on Kaggle choose the accelerator GPU T4 x2, elsewhere try --device cpu"
PROBE_TIMEOUT_S = 120.0  # for a process that computes on each GPU
TENSOR_CORES = (7, 0)  # the lowest compute capability that is faster in half precision
# Runs in a separate process: a CUDA context takes hundreds of MB of a GPU, and the workers' parent
# needs none.
ASK_CAPABILITIES = """
import json, torch
gpus, errors = range(torch.cuda.device_count()), []
for gpu in gpus:
    try:
        image = torch.ones(1, 1, 8, 8, device=gpu)
        torch.nn.functional.conv2d(image @ image, image[..., :3, :3]).sum().item()
    except RuntimeError as error:
        errors.append(str(error).partition("\\n")[0])
if errors and len(errors) == len(gpus):
    raise SystemExit(errors[-1])
print(json.dumps([torch.cuda.get_device_capability(gpu) for gpu in gpus]))
"""


def resolve_placement(device: str, precision: str) -> Placement:
    """Return the placement that the user named.

    ``auto`` means all GPUs ("cuda"), or "cpu" if no GPU computes. Raises :class:`UserError` for an
    unknown name or a missing GPU, ``TypeError`` if ``device`` is not a string.
    """
    if not isinstance(device, str):
        raise TypeError(f"a device is text such as 'cuda:0', not {device!r}")
    import torch

    if device == AUTO:
        # PyTorch may see a GPU that its build cannot use, so one must compute first.
        try:
            device = "cuda" if torch.cuda.is_available() and gpu_capabilities() else "cpu"
        except UserError as error:
            warn_once(f"the CPU does the work: {error}")
            device = "cpu"
    elif device != "cpu":
        gpus_of(device)
    if precision == AUTO:
        return Placement(device, fastest_precision(device))
    if precision not in list(Precision):
        raise UserError(f"unknown precision {precision!r}; known: auto, {', '.join(Precision)}")
    return Placement(device, Precision(precision))


def fastest_precision(device: str) -> Precision:
    """Return half precision if the CPU, or every GPU, has units for it, else float32."""
    import torch

    if device.startswith("cuda"):
        # One precision for the whole run.
        capabilities = gpu_capabilities()
        able = all(capabilities[gpu] >= TENSOR_CORES for gpu in gpus_of(device))
        return Precision.FLOAT16 if able else Precision.FLOAT32
    # Older versions of PyTorch do not report capabilities; then float32 is safe.
    flags: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    able = bool(flags.get("avx512_bf16") or flags.get("amx_bf16"))
    return Precision.BFLOAT16 if able else Precision.FLOAT32


def gpus_of(device: str) -> list[int]:
    """Return the numbers of the GPUs that ``cuda`` or ``cuda:N`` names."""
    import torch

    kind, _, number = device.partition(":")
    # Counting creates no CUDA context: the workers' parent needs none.
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if kind != "cuda" or (device != kind and not number.isdecimal()):
        raise UserError(f"unknown device {device!r}; known: auto, cpu, cuda, cuda:N")
    if not count:
        raise UserError(
            f"--device {device}: this machine has no GPU that PyTorch can use; {ADVICE}"
        )
    if number and int(number) >= count:
        known = ", ".join(f"cuda:{index}" for index in range(count))
        raise UserError(f"--device {device}: this machine has only {known}")
    return [int(number)] if number else list(range(count))


@cache
def gpu_capabilities() -> list[tuple[int, int]]:
    """Return the compute capability of each GPU, such as (7, 5).

    Raises :class:`UserError` if no GPU computes.
    """
    command = [sys.executable, "-c", ASK_CAPABILITIES]
    timeout = PROBE_TIMEOUT_S
    try:
        asked = subprocess.run(
            command, input="", capture_output=True, text=True, check=True, timeout=timeout
        )
        answer = asked.stdout.splitlines()[-1]  # libraries may print lines before it
        return [(major, minor) for major, minor in json.loads(answer)]
    except subprocess.CalledProcessError as error:
        reason = error.stderr.strip()[-300:] or f"exit status {error.returncode}"
    except subprocess.TimeoutExpired:
        reason = f"no answer for {PROBE_TIMEOUT_S:.0f} s"
    raise UserError(f"PyTorch cannot compute on this machine's GPUs ({reason}); {ADVICE}")


def require_device(device: str) -> None:
    """Run a product and a convolution on the device. Raise :class:`DeviceError` if either fails.

    PyTorch also lists GPUs for which its build or cuDNN has no kernels, so only a kernel that runs
    is proof.
    """
    if device == "cpu":
        return
    import torch

    try:
        image = torch.ones(1, 1, 8, 8, device=device)
        torch.nn.functional.conv2d(image @ image, image[..., :3, :3]).sum().item()
    except Exception as error:
        if failure_kind(error) is FailureKind.OUT_OF_MEMORY:
            raise
        reason = reason_of(error).partition("\n")[0]
        raise DeviceError(f"{device} cannot be used ({reason}); {ADVICE}") from error
