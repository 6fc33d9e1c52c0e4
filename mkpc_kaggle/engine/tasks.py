"""What has to be known of images before there are pairs: tasks for worker processes, answers for the journal."""

import os
import sqlite3
import sys
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from math import inf

from mkpc_kaggle.engine.console import Progress, warn
from mkpc_kaggle.engine.jobs import Answer, TaskJob
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.places import Place, Site
from mkpc_kaggle.engine.process import ProcessWorker
from mkpc_kaggle.engine.session import Session
from mkpc_kaggle.engine.worker import TaskRunner
from mkpc_kaggle.errors import UserError

MAX_WORKERS = 4
MAX_TRIES = 2  # of a task whose worker is lost
MAX_TASK_S, HANG_SHARE = 600.0, 0.25  # after which a task hangs, and that as a share of the time left

Tasks = Mapping[str, Callable[[], bytes]]


def run_tasks(phase: str, tasks: Tasks, journal: Journal, session: Session) -> bool:
    """Put the answers of all tasks that are not known yet into the ``journal``; a task that fails has a warning.

    Returns whether all were tried before an interrupt and the limit. Raises :class:`UserError` where no worker can
    be started.
    """
    budget, site = session.budget, Site(session.budget.clock)
    queue = TaskQueue(phase, tasks, journal)
    make = partial(ProcessWorker, "images", TaskRunner, site.ring)
    count = min(MAX_WORKERS, os.cpu_count() or 1, len(queue.waiting))
    places = [Place(f"process {number}", make) for number in range(count)]
    progress = Progress(budget, sys.stderr if session.progress else None, unit="image")
    try:
        while queue.left and not session.interrupt.is_set() and (now := budget.clock()) < budget.stop_waiting:
            for place in places:
                job, answer = place.job, place.poll(now)
                if place.closed:
                    raise UserError(f"no worker could be started: {place.closed}")
                if answer is not None and isinstance(job, TaskJob):
                    place.job, place.losses = None, 0  # the task is to blame
                    queue.take(job, answer)
                if queue.waiting and place.may_start(now):
                    place.start(now)
                elif queue.waiting and place.is_idle:
                    hangs = max(budget.silence, min(MAX_TASK_S, HANG_SHARE * budget.left()))
                    place.submit(queue.waiting.popleft(), inf, hangs, now)
            progress.show(phase, len(tasks) - len(queue.left), len(tasks))
            site.wait(min(budget.stop_waiting, *(place.limit for place in places if place.limit > now), inf))
    finally:
        for place in places:
            place.kill()
        progress.close()
    return not queue.left


class TaskQueue:
    """The tasks that are ``left``, and those of them that are ``waiting`` for a worker."""

    def __init__(self, phase: str, tasks: Tasks, journal: Journal) -> None:
        self.left = set(tasks) - journal.tasks()
        self.waiting = deque(TaskJob(key, do) for key, do in tasks.items() if key in self.left)
        self._phase, self._journal, self._tries = phase, journal, Counter[str]()

    def take(self, job: TaskJob, answer: Answer) -> None:
        """Keep an answer; a task that came to nothing is tried once more."""
        self._tries[job.key] += 1
        if isinstance(answer, bytes):
            with suppress(sqlite3.Error):  # it stays in memory
                self._journal.save_task(job.key, answer)
        elif self._tries[job.key] < MAX_TRIES:
            self.waiting.append(job)
            return
        else:
            warn(f"{self._phase}: {job.key} failed: {answer}")
        self.left.discard(job.key)
