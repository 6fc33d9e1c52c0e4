"""What an error says of the process that it was raised in: memory was short, the device failed, or neither.

Errors are told apart by their text, since their types differ between versions: until PyTorch 2.7 a failed kernel
was a plain ``RuntimeError``, since 2.8 it is a ``torch.AcceleratorError``. The texts come from

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
from mkpc_kaggle.pipeline.gpus import ADVICE

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


class Failure(Enum):
    """What an error means for what comes after it."""

    OUT_OF_MEMORY = auto()
    """fewer pairs at a time, or smaller views, may do well"""
    DEVICE = auto()
    """nothing more can be computed in this process; it says nothing against the pair"""
    ORDINARY = auto()
    """the matcher cannot do this pair"""


class DeviceError(UserError):
    """A device on which nothing can be computed."""


def failure_of(error: BaseException) -> Failure:
    """What the error means, by its type's name and its text."""
    reason = reason_of(error)
    if isinstance(error, MemoryError) or any(sign in reason for sign in _OUT_OF_MEMORY):
        return Failure.OUT_OF_MEMORY
    if any(sign in reason for sign in _DEVICE):
        return Failure.DEVICE
    return Failure.ORDINARY


def reason_of(error: BaseException) -> str:
    """Its type and text, and the notes that it was given on its way.

    PyTorch's advice for debugging, on further lines of the errors of a device, is left out.
    """
    text = str(error)
    short = text.partition("\n")[0] if any(sign in text for sign in _DEVICE) else text
    return ", ".join([f"{type(error).__name__}: {short}", *getattr(error, "__notes__", ())])


def require_device(device: str) -> None:
    """Compute something on a device; raises :class:`DeviceError` where that fails.

    PyTorch counts GPUs for which its build has no kernels among the available ones: only a kernel that runs is
    proof.
    """
    if device == "cpu":
        return
    import torch

    try:
        square = torch.ones(8, 8, device=device)
        (square @ square).sum().item()
    except Exception as error:
        if failure_of(error) is Failure.OUT_OF_MEMORY:
            raise
        reason = reason_of(error).partition("\n")[0]
        raise DeviceError(f"{device} cannot be used ({reason}); {ADVICE}") from error
