"""Kinds of matcher errors: out of memory, a failed device, or a pair that fails.

The text of an error decides its kind, since types differ between versions: a failed kernel raises a
plain ``RuntimeError`` up to PyTorch 2.7 and a ``torch.AcceleratorError`` since 2.8. After most
device errors every further call in the process fails, and only a new process helps. After a memory
error the process can continue.
"""

import re
from enum import Enum, auto

from mkpc_kaggle.errors import UserError

# The sources, in order: Python, PyTorch and the CUDA runtime; PyTorch on a CPU and OpenCV; cuBLAS
# and cuDNN 9; PyTorch's search for a convolution that fits into the free memory, in its current
# wording and in that until 1.13.
_OUT_OF_MEMORY = re.compile(
    r"^\w*MemoryError|OutOfMemory|out of memory|can't allocate memory|Insufficient memory|Failed to allocate"
    "|_STATUS_ALLOC_FAILED|ALLOCATION_FAILED|unable to find an engine|Unable to find a valid cuDNN algorithm"
)
# PyTorch prefixes errors of the CUDA runtime and of cuBLAS with "CUDA error: ".
_DEVICE = re.compile(
    "AcceleratorError|CUDA (driver )?error|cuDNN error|cuFFT error|cusolver error|No CUDA GPUs are available"
)


class FailureKind(Enum):
    """The consequence of a matcher's error for the run."""

    OUT_OF_MEMORY = auto()  # fewer pairs at a time may fit
    # This process can no longer compute; the pair or the device may be the cause
    DEVICE = auto()
    RAISED = auto()  # the matcher cannot process this pair


class DeviceError(UserError):
    """Error of a device that cannot compute."""


def failure_kind(error: BaseException) -> FailureKind:
    """Return the kind of an error that a matcher raised."""
    reason = reason_of(error)
    # First: "CUDA error: out of memory" is no failed device.
    if _OUT_OF_MEMORY.search(reason):
        return FailureKind.OUT_OF_MEMORY
    if _DEVICE.search(reason):
        return FailureKind.DEVICE
    return FailureKind.RAISED


def reason_of(error: BaseException) -> str:
    """Return the error's type, text and notes, without PyTorch's debugging advice."""
    text = str(error)
    if _DEVICE.search(text):
        text = text.partition("\n")[0]
    notes = getattr(error, "__notes__", ())
    return ", ".join([f"{type(error).__name__}: {text}", *notes])
