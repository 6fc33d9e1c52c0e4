"""A worker in the engine's own process: for one's own matchers, notebooks and tests."""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import ClassVar

from mkpc_kaggle.engine.jobs import Job
from mkpc_kaggle.engine.worker import Answer, Worker
from mkpc_kaggle.pipeline.stages import Pipeline


class LocalWorker:
    """Works in its supervisor's thread.

    A matcher that never returns cannot be stopped here, nor one that brings the process down, and a device that
    failed does not come back: that takes processes.
    """

    killable: ClassVar = False

    def __init__(self, make_pipeline: Callable[[], Pipeline]) -> None:
        self._worker = Worker(make_pipeline)

    def load(self) -> str:
        self._worker.load()
        return ""

    def run(self, job: Job) -> Answer:
        return self._worker.run(job, job.deadline - time.monotonic())

    def prefetch(self, paths: Iterable[Path]) -> None:
        self._worker.prefetch(paths)

    def stop(self) -> None:
        self._worker.stop()

    def kill(self) -> None:
        self._worker.close()
