"""What the engine wants of those who do its jobs, wherever they are."""

from typing import Protocol

from mkpc_kaggle.engine.jobs import Finished, Job, Lost


class Pool(Protocol):
    """Does jobs; each that was submitted comes back once, finished or lost, in any order.

    All that crosses to a worker is plain values: a :class:`mkpc_kaggle.engine.jobs.Job` there, a tuple of
    :class:`mkpc_kaggle.engine.jobs.Matched` back.
    """

    @property
    def workers(self) -> int:
        """How many work at a time; fewer where some could not be kept alive."""
        ...

    @property
    def capacity(self) -> int:
        """How many jobs may be out: enough that no worker waits for its next one."""
        ...

    def start(self) -> str:
        """Get ready to work; empty, or what the user should know of it.

        Raises :class:`mkpc_kaggle.errors.UserError` where that cannot be.
        """
        ...

    def submit(self, job: Job) -> None:
        """Queue a job; its images may be decoded ahead from now on."""
        ...

    def next(self, until: float) -> Finished | Lost | None:
        """A job that has come back, waiting for it if need be; ``None`` at ``until``, of the engine's clock."""
        ...

    def stop(self) -> None:
        """Begin no further unit: jobs under way and those that wait end with what they have."""
        ...

    def close(self) -> bool:
        """Let go of everything; false where something is still running and cannot be stopped."""
        ...
