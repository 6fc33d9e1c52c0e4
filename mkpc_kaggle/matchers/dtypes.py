"""Numerical safety of networks: float32 without TF32, and finite values."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.matchers.contract import NonFiniteError, arrays_of

if TYPE_CHECKING:
    from torch.nn import Module


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

    backends = torch.backends
    if not hasattr(backends.cudnn, "conv"):  # before PyTorch 2.9
        precision = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("highest")
        cudnn = backends.cudnn
        try:
            with cudnn.flags(cudnn.enabled, cudnn.benchmark, deterministic=cudnn.deterministic, allow_tf32=False):
                yield
        finally:
            torch.set_float32_matmul_precision(precision)
        return
    settings: tuple[Any, ...] = (backends.cudnn.conv, backends.cuda.matmul)
    precisions = [setting.fp32_precision for setting in settings]
    try:
        for setting in settings:
            setting.fp32_precision = "ieee"
        yield
    finally:
        for setting, precision in zip(settings, precisions, strict=True):
            setting.fp32_precision = precision


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


def check_results(what: str, network: "Module") -> None:
    """Make a library's network check what it returns from now on."""
    network.register_forward_hook(lambda network, inputs, found: check_finite(what, found))
