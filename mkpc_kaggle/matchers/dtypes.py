"""Numerical safety of networks: float32 without TF32, finite values."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mkpc_kaggle.matchers.contract import NonFiniteError, arrays_of


@contextmanager
def exact_float32() -> Iterator[None]:
    """Make NVIDIA GPUs multiply float32 as float32, not as TF32 with its 10 bits of mantissa.

    PyTorch's default for convolutions is TF32. The settings apply to the process, and are restored at the end.
    If PyTorch is not imported yet, nothing is changed: the import takes seconds.
    """
    if "torch" not in sys.modules:
        yield
        return
    import torch

    cudnn, product = torch.backends.cudnn, torch.backends.cuda.matmul
    settings: tuple[Any, ...] = (cudnn.conv, product) if hasattr(cudnn, "conv") else (cudnn, product)
    # PyTorch's names since 2.9, and before.
    name, exact = ("fp32_precision", "ieee") if hasattr(cudnn, "conv") else ("allow_tf32", False)
    former = [getattr(setting, name) for setting in settings]
    try:
        for setting in settings:
            setattr(setting, name, exact)
        yield
    finally:
        for setting, value in zip(settings, former, strict=True):
            setattr(setting, name, value)


def check_finite(what: str, *values: Any) -> None:
    """Raise :class:`NonFiniteError` if a tensor in the values has NaN or infinity.

    ``what`` names the values, which may be nested dataclasses and sequences. The check costs one pass over the
    tensors and one synchronisation with the device.
    """
    arrays = arrays_of(values)
    tensors = [array for array in arrays if hasattr(array, "is_floating_point") and array.is_floating_point()]
    if not tensors:
        return
    import torch

    # A sum is infinite or NaN if a value is. Half precision is summed in float32 to prevent overflow.
    sums = [tensor.sum(dtype=torch.float32) for tensor in tensors]
    if not bool(torch.stack(sums).isfinite().all()):
        raise NonFiniteError(f"{what} are not finite")
