"""Devices: names, GPUs, and a check that a device works."""

from typing import Any

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Placement, Precision
from mkpc_kaggle.matchers.failures import DeviceError, FailureKind, failure_kind, reason_of

AUTO = "auto"
ADVICE = "on Kaggle choose the accelerator GPU T4 x2, elsewhere try --device cpu"
TENSOR_CORES = (7, 0)  # the lowest compute capability that is faster in half precision


def resolve_placement(device: str, precision: str) -> Placement:
    """Return the placement that the user named.

    ``auto`` means all GPUs ("cuda"), or "cpu" if PyTorch has none. Raises :class:`UserError` for an
    unknown name or a missing GPU.
    """
    if device == AUTO:
        import torch

        device = "cuda" if torch.cuda.is_available() else "cpu"
    elif device != "cpu":
        gpus_of(device)
    if precision == AUTO:
        return Placement(device, fastest_precision(device))
    return Placement(device, Precision(precision))


def fastest_precision(device: str) -> Precision:
    """Return half precision if the CPU, or every GPU, has units for it, else float32."""
    import torch

    if device.startswith("cuda"):
        # One precision for the whole run.
        capabilities = map(torch.cuda.get_device_capability, gpus_of(device))
        able = all(capability >= TENSOR_CORES for capability in capabilities)
        return Precision.FLOAT16 if able else Precision.FLOAT32
    # Older versions of PyTorch do not report capabilities; then float32 is safe.
    flags: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    is_able = flags.get("avx512_bf16") or flags.get("amx_bf16")
    return Precision.BFLOAT16 if is_able else Precision.FLOAT32


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
        raise UserError(f"--device {device}: this machine has {count} GPU(s)")
    return [int(number)] if number else list(range(count))


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
        reason = reason_of(error).splitlines()[0]
        raise DeviceError(f"{device} cannot be used ({reason}); {ADVICE}") from error
