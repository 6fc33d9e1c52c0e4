"""The kinds of errors of a matcher: memory was short, the device failed, or the matcher cannot do the pair.

They are told apart by their text, since their types differ between versions: until PyTorch 2.7 a failed kernel was
a plain ``RuntimeError``, since 2.8 it is a ``torch.AcceleratorError``. The texts come from

- Python (``MemoryError``), OpenCV ("Insufficient memory", "Failed to allocate") and PyTorch's CPU allocator
  ("DefaultCPUAllocator: can't allocate memory");
- PyTorch's CUDA allocator (``torch.OutOfMemoryError``: "CUDA out of memory") and the CUDA runtime, whose errors
  PyTorch passes on as "CUDA error: " and the text of ``cudaGetErrorString``, "out of memory" among them;
- cuBLAS ("CUDA error: CUBLAS_STATUS_..."), cuDNN ("cuDNN error: CUDNN_STATUS_...", from version 9 on with
  "..._ALLOCATION_FAILED" for memory), cuFFT ("cuFFT error: ...") and cuSOLVER ("cusolver error: ...");
- PyTorch's search for a convolution that fits into the memory that is left: "FIND was unable to find an engine"
  and "GET was unable to find an engine", until 1.13 "Unable to find a valid cuDNN algorithm".

After most errors of the device every further call in the process fails too, so that only a new process helps;
after one of memory the process can go on.
"""

from enum import Enum, auto

from mkpc_kaggle.errors import UserError

_OUT_OF_MEMORY = (
    "MemoryError",
    "OutOfMemory",
    "out of memory",
    "can't allocate memory",
    "Insufficient memory",
    "Failed to allocate",
    "_STATUS_ALLOC_FAILED",
    "ALLOCATION_FAILED",
    "unable to find an engine",
    "Unable to find a valid cuDNN algorithm",
)
_DEVICE = (
    "AcceleratorError",
    "CUDA error",
    "CUDA driver error",
    "cuDNN error",
    "cuFFT error",
    "cusolver error",
    "No CUDA GPUs are available",
)


class FailureKind(Enum):
    """What an error means for what comes after it."""

    OUT_OF_MEMORY = auto()  # fewer pairs at a time may do
    DEVICE = auto()  # this process can compute nothing more; the pair is not to blame
    ORDINARY = auto()  # the matcher cannot do this pair


class DeviceError(UserError):
    """A device that cannot compute."""


def failure_of(error: BaseException) -> FailureKind:
    """What the error means, by its type's name and its text."""
    reason = reason_of(error)
    if isinstance(error, MemoryError) or any(sign in reason for sign in _OUT_OF_MEMORY):
        return FailureKind.OUT_OF_MEMORY
    if any(sign in reason for sign in _DEVICE):
        return FailureKind.DEVICE
    return FailureKind.ORDINARY


def reason_of(error: BaseException) -> str:
    """The error's type, text and notes, without PyTorch's advice for debugging on further lines."""
    text = str(error)
    short = text.partition("\n")[0] if any(sign in text for sign in _DEVICE) else text
    return ", ".join([f"{type(error).__name__}: {short}", *getattr(error, "__notes__", ())])
