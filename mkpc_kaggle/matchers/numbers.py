"""Numerical checks of networks: float32 without TF32, and finite values."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.matchers.contract import NonFiniteError

if TYPE_CHECKING:
    from torch.nn import Module


@contextmanager
def exact_float32() -> Iterator[None]:
    """A context in which NVIDIA GPUs multiply float32 as float32, not as TF32 with its 10 bits of mantissa.

    PyTorch's default for convolutions is TF32. The settings are those of the process, and are restored at the end.
    Where nothing has imported PyTorch, which takes seconds, nothing computes with it.
    """
    if "torch" not in sys.modules:
        yield
        return
    import torch

    backends = torch.backends
    if not hasattr(backends.cudnn, "conv"):  # before PyTorch 2.9
        former = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("highest")
        cudnn = backends.cudnn
        try:
            with cudnn.flags(cudnn.enabled, cudnn.benchmark, deterministic=cudnn.deterministic, allow_tf32=False):
                yield
        finally:
            torch.set_float32_matmul_precision(former)
        return
    settings: tuple[Any, ...] = (backends.cudnn.conv, backends.cuda.matmul)
    formerly = [setting.fp32_precision for setting in settings]
    try:
        for setting in settings:
            setting.fp32_precision = "ieee"
        yield
    finally:
        for setting, precision in zip(settings, formerly, strict=True):
            setting.fp32_precision = precision


def check_finite(what: str, *values: Any) -> None:
    """Raises :class:`NonFiniteError` where a tensor in the values has NaN or infinity.

    ``what`` names the values, which may be nested dataclasses and sequences. It costs one pass over the
    tensors and one wait for the device.
    """
    tensors = list(float_tensors(values))
    if not tensors:
        return
    import torch

    # A sum is infinite or NaN if a value is; half precision is summed in float32, so that nothing overflows.
    sums = [tensor.sum(dtype=torch.float32) for tensor in tensors]
    if not bool(torch.stack(sums).isfinite().all()):
        raise NonFiniteError(f"{what} are not finite")


def check_results(what: str, network: "Module") -> None:
    """From now on the network checks what it returns: one of a library's, whose caller would not."""
    network.register_forward_hook(lambda network, given, found: check_finite(what, found))


def float_tensors(value: Any) -> Iterator[Any]:
    if hasattr(value, "is_floating_point"):
        if value.is_floating_point():
            yield value
    elif is_dataclass(value):
        for field in fields(value):
            yield from float_tensors(getattr(value, field.name))
    elif isinstance(value, tuple | list):
        for one in value:
            yield from float_tensors(one)
