"""Numerical safety of networks: float32 without TF32, and finite values."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mkpc_kaggle.matchers.contract import NonFiniteError, arrays_of


@contextmanager
def exact_float32() -> Iterator[None]:
    """A context in which NVIDIA GPUs multiply float32 as float32, not as TF32 with its 10 bits of mantissa.

    PyTorch's default for convolutions is TF32. The settings are those of the process, and are restored at the end.
    Importing PyTorch takes seconds; where nothing has imported it, nothing computes with it.
    """
    if "torch" not in sys.modules:
        yield
        return
    import torch

    cudnn, product = torch.backends.cudnn, torch.backends.cuda.matmul
    settings: tuple[Any, ...] = (cudnn.conv, product) if hasattr(cudnn, "conv") else (cudnn, product)
    # By the names that PyTorch has for it since 2.9, and before.
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

    ``what`` names the values, which may be nested dataclasses and sequences. It costs one pass over the
    tensors and one wait for the device.
    """
    arrays = arrays_of(values)
    tensors = [array for array in arrays if hasattr(array, "is_floating_point") and array.is_floating_point()]
    if not tensors:
        return
    import torch

    # A sum is infinite or NaN if a value is; half precision is summed in float32, so that nothing overflows.
    sums = [tensor.sum(dtype=torch.float32) for tensor in tensors]
    if not bool(torch.stack(sums).isfinite().all()):
        raise NonFiniteError(f"{what} are not finite")
