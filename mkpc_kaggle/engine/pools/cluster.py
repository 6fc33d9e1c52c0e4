"""What ``--workers`` means, and what Ray's clusters ask of this process; Ray itself is not imported here."""

import re
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from mkpc_kaggle.errors import UserError

FORMS = "a number of processes, ray (this machine's cluster, or one for this run), ray://HOST:PORT"
REACH_SECONDS = 5.0


@dataclass(frozen=True)
class RayCluster:
    """The Ray cluster to work on.

    ``address``, HOST:PORT, is the one that ``ray start --head`` prints; this machine must be one of the cluster's.
    Empty: the cluster that runs on this machine, or else one that is started for the run and ends with it.
    """

    address: str = ""

    def require_reachable(self) -> None:
        """Raise :class:`UserError` where nothing listens at the address: Ray itself tries for minutes."""
        host, _, port = self.address.rpartition(":")
        try:
            socket.create_connection((host, int(port)), timeout=REACH_SECONDS).close()
        except OSError as error:
            raise UserError(
                f"--workers ray://{self.address}: no cluster answers there ({error.strerror or error}). Start one "
                "with `ray start --head` and join it from the other machines; it prints the address to use."
            ) from error


def parse_workers(text: str) -> int | RayCluster:
    """What the user wrote; ``ValueError`` that lists the forms for anything else."""
    if re.fullmatch(r"\d{1,3}", text):
        return int(text)
    if text == "ray":
        return RayCluster()
    found = re.fullmatch(r"ray://([^/\s]+:\d{1,5})", text)
    if found is None:
        raise ValueError(f"{text!r} is none of: {FORMS}")
    return RayCluster(found[1])


@contextmanager
def own_signals() -> Iterator[None]:
    """Keep this process's answers to signals, which Ray replaces by its own when it starts."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    former = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in former.items():
                signal.signal(number, handler)
