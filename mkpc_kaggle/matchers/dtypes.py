"""Numerical safety of networks: float32 whatever the default dtype is, without TF32; finite values."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mkpc_kaggle.matchers.contract import NonFiniteError, arrays_of


@contextmanager
def exact_float32() -> Iterator[None]:
    """Make float32 the default dtype, which a notebook may have changed, and make NVIDIA GPUs multiply
    in full float32, not in TF32, which has a mantissa of 10 bits.

    PyTorch's default for convolutions is TF32. The settings apply to the whole process until the
    block ends. If PyTorch is not imported yet, change nothing: the import takes seconds.
    """
    if "torch" not in sys.modules:
        yield
        return
    import torch

    cudnn: Any = torch.backends.cudnn
    product = torch.backends.cuda.matmul
    # Since PyTorch 2.9, and before.
    is_new = hasattr(cudnn, "conv")
    settings = (cudnn.conv if is_new else cudnn, product)
    name, exact = ("fp32_precision", "ieee") if is_new else ("allow_tf32", False)
    former = [getattr(setting, name) for setting in settings]
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        for setting in settings:
            setattr(setting, name, exact)
        yield
    finally:
        torch.set_default_dtype(dtype)
        for setting, value in zip(settings, former, strict=True):
            setattr(setting, name, value)


def check_finite(what: str, *values: Any) -> None:
    """Raise :class:`NonFiniteError` if a tensor in the values contains NaN or infinity.

    ``what`` names the values in the message. They may be nested dataclasses and sequences. The
    check costs one pass over the tensors and one synchronisation with the device.
    """
    tensors = []
    for array in arrays_of(values):
        # NumPy's arrays do not have this method; integers are always finite.
        if hasattr(array, "is_floating_point") and array.is_floating_point():
            tensors.append(array)
    if not tensors:
        return
    import torch

    # A sum is infinite or NaN if any of its terms is. Half precision is summed in float32 to
    # prevent overflow.
    sums = [tensor.sum(dtype=torch.float32) for tensor in tensors]
    if not bool(torch.stack(sums).isfinite().all()):
        raise NonFiniteError(f"{what} are not finite")
