"""The options of the benchmark that all parts share, and its machine."""

import platform
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import joblib
import torch

from benchmarks.gpu.record import Row
from mkpc_kaggle.demo import DemoSet, write_demo

LIBRARIES = ("torch", "numpy", "kornia", "pycolmap")
QUICK_SCALE = 0.3  # of the images of the demo set


@dataclass(frozen=True)
class Setup:
    """The device, the folders, and whether this is a short rehearsal."""

    device: str
    quick: bool
    out: Path
    weights: tuple[Path, ...]

    @property
    def is_gpu(self) -> bool:
        return self.device != "cpu"

    def demo(self) -> DemoSet:
        """Return the demo set, rendered on first use: one scene for a rehearsal, else all."""
        directory = self.out / "demo"
        if (directory / "test" / "test.csv").is_file():
            return DemoSet(
                directory / "train", directory / "test", directory / "test_truth.csv"
            )
        if self.quick:
            return write_demo(directory, scenes=["courtyard"], image_scale=QUICK_SCALE)
        return write_demo(directory, scenes=["courtyard", "market"])

    def synchronise(self) -> None:
        """Wait until the device has finished."""
        if self.is_gpu:
            torch.cuda.synchronize(self.device)


def machine(setup: Setup) -> Row:
    """Return the facts about the machine that figures depend on."""
    facts: Row = {"device": setup.device}
    if setup.is_gpu:
        properties = torch.cuda.get_device_properties(setup.device)
        facts["GPU"] = properties.name
        facts["GPU memory"] = f"{properties.total_memory / 2**30:.1f} GiB"
        facts["compute capability"] = f"{properties.major}.{properties.minor}"
        facts["CUDA of torch"] = torch.version.cuda
        facts["cuDNN"] = torch.backends.cudnn.version()  # type: ignore[no-untyped-call]
    facts["cores"] = joblib.cpu_count()
    facts["Python"] = platform.python_version()
    for name in LIBRARIES:
        facts[name] = version(name)
    facts["quick"] = setup.quick
    facts["time"] = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    return facts
