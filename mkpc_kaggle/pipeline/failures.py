"""The kinds of errors of a matcher: memory was short, the device failed, or the matcher cannot do the pair.

They are told apart by their text, since their types differ between versions: until PyTorch 2.7 a failed kernel was
a plain ``RuntimeError``, since 2.8 it is a ``torch.AcceleratorError``. After most errors of the device every
further call in the process fails too, so that only a new process helps; after one of memory it can go on.
"""

import re
from enum import Enum, auto

from mkpc_kaggle.errors import UserError

# Python, PyTorch and the CUDA runtime; PyTorch on a CPU and OpenCV; cuBLAS and cuDNN 9; PyTorch's search for a
# convolution that fits into the memory that is left, and the same until 1.13.
_OUT_OF_MEMORY = re.compile(
    "MemoryError|OutOfMemory|out of memory|can't allocate memory|Insufficient memory|Failed to allocate"
    "|_STATUS_ALLOC_FAILED|ALLOCATION_FAILED|unable to find an engine|Unable to find a valid cuDNN algorithm"
)
# PyTorch passes errors of the CUDA runtime and of cuBLAS on as "CUDA error: ".
_DEVICE = re.compile(
    "AcceleratorError|CUDA (driver )?error|cuDNN error|cuFFT error|cusolver error|No CUDA GPUs are available"
)


class FailureKind(Enum):
    OUT_OF_MEMORY = auto()  # fewer pairs at a time may do
    DEVICE = auto()  # this process can compute nothing more; the pair is not to blame
    ORDINARY = auto()  # the matcher cannot do this pair


class DeviceError(UserError):
    """A device that cannot compute."""


def failure_of(error: BaseException) -> FailureKind:
    reason = reason_of(error)
    if isinstance(error, MemoryError) or _OUT_OF_MEMORY.search(reason):
        return FailureKind.OUT_OF_MEMORY
    return FailureKind.DEVICE if _DEVICE.search(reason) else FailureKind.ORDINARY


def reason_of(error: BaseException) -> str:
    """The error's type, text and notes, without PyTorch's advice for debugging on further lines."""
    text = str(error)
    short = text.partition("\n")[0] if _DEVICE.search(text) else text
    return ", ".join([f"{type(error).__name__}: {short}", *getattr(error, "__notes__", ())])
