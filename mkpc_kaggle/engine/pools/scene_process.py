"""A reconstruction in a process of its own on this machine."""

import multiprocessing
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

from mkpc_kaggle.engine.exits import how_it_ended
from mkpc_kaggle.engine.pools.spawn import signals_blocked
from mkpc_kaggle.engine.scenes import SceneAnswer, SceneJob, reconstruct


class SceneProcess:
    """A job under way; see :class:`mkpc_kaggle.engine.scenes.Reconstruction`."""

    def __init__(self, job: SceneJob) -> None:
        context = multiprocessing.get_context("spawn")
        self._answers, its_answers = context.Pipe(duplex=False)
        self._process: SpawnProcess = context.Process(
            target=serve_scene, args=(job, its_answers), name="mkpc scene", daemon=True
        )
        with signals_blocked():
            self._process.start()
        its_answers.close()

    def answer(self) -> SceneAnswer | str | None:
        if not self._answers.poll() and self._process.is_alive():
            return None
        try:
            answer: SceneAnswer = self._answers.recv()
        except (EOFError, OSError):
            self._process.join(timeout=5.0)  # its pipe closes before it has ended
            return f"its process ended: {how_it_ended(self._process)}"
        return answer

    def kill(self) -> None:
        self._process.kill()
        self._process.join(timeout=1.0)


def serve_scene(job: SceneJob, answers: Connection) -> None:
    """The life of the process."""
    answers.send(reconstruct(job))
