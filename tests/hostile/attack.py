"""One hostile case: a room with an input, the real command in it as a process of its own, what must come of it."""

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from processes import started_with

from mkpc_kaggle.data.competition import read_test_side, submission_problems

ROOT = Path(__file__).resolve().parents[2]
# Of data, for each process; not of address space, of which CUDA builds of PyTorch reserve more.
MEMORY_KIB = 4 << 20
HANGS_S = 600
REFUSED = (2,)
EITHER = (0, 1, 2)  # a valid result, a result that says what it lacks, or a clear refusal
CRASHES = ("Traceback (most recent call last)", "Fatal Python error", "Segmentation fault", "core dumped")
LEFT_BY_ITSELF = (0, 1, 128 + signal.SIGINT, 128 + signal.SIGTERM)
TOO_LATE = "the time limit passed before the first results"
MARK = "MKPC_HOSTILE_CASE"

Make = Callable[[Path], None]
Act = Callable[["subprocess.Popen[bytes]"], None]


def nothing(_: object) -> None:
    """Leave the room as it is."""


@dataclass(frozen=True)
class Case:
    """``make`` changes the room; ``command`` runs in it, ``act`` disturbs it.

    It must end with one of ``statuses``, and its output have ``says``. It may write to the room's folder ``out``
    alone. Where it makes a submission, ``out/s.csv`` must be valid and complete unless the command was refused or
    ``submission`` says no. ``then`` is a second command, judged as the first.
    """

    group: str
    name: str
    command: str
    make: Make = nothing
    statuses: tuple[int, ...] = (0,)
    says: str = ""
    act: Act | None = None
    then: str = ""
    env: dict[str, str] = field(default_factory=dict)
    submission: bool = True
    stderr: Callable[[], int] | None = None  # opens the descriptor that the command writes to; else the log

    @property
    def id(self) -> str:
        return f"{self.group}: {self.name}"


def attack(case: Case, room: Path) -> None:
    """Run the case in the room; the test fails with all that was wrong."""
    case.make(room)
    before = _snapshot(room)
    mark = uuid.uuid4().hex
    faults = []
    for number, command in enumerate(filter(None, (case.command, case.then))):
        process = _start(command, room, {**case.env, MARK: mark}, case.stderr)
        if number == 0 and case.act is not None:
            case.act(process)
        status, output = _wait(process, room)
        faults += _faults(case, status, output, room)
        faults += [f"left running: {line}" for line in _orphans(mark)]
        # Before the table was read.
        interrupted = status not in (0, 1) and output.strip() in ("", "error: interrupted")
        if case.submission and not interrupted and "submit" in command and status in LEFT_BY_ITSELF:
            faults += _submission_faults(room)
        too_late = status == 1 and TOO_LATE in output  # before its directory was looked at
        if status in (0, 1) and not too_late and "reconstruct" in command and (number or not case.then):
            faults += _result_faults(room / "out" / "o", status)
    faults += [f"changed: {name}" for name in _changed(before, _snapshot(room))]
    if faults:
        pytest.fail("\n".join([case.id, case.command, *faults, f"output:\n{output[-3000:]}"]), pytrace=False)


def prepared(command: str, room: Path) -> int:
    """The exit status of a command that nobody disturbs."""
    return _start(command, room, {}).wait()


def _start(
    command: str, room: Path, env: dict[str, str], stderr: Callable[[], int] | None = None
) -> "subprocess.Popen[bytes]":
    words = [word.format(room=room) for word in shlex.split(command)]
    limited = ["sh", "-c", f'ulimit -d {MEMORY_KIB}; ulimit -c 0; exec "$@"', "sh"]
    own = {
        "PATH": os.defpath,
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
        "HOME": str(room / "home"),
        "TMPDIR": str(room / "tmp"),
        "PYTHONDONTWRITEBYTECODE": "1",
        "MPLCONFIGDIR": str(Path(tempfile.gettempdir()) / "hostile-matplotlib"),  # its list of fonts takes seconds
        "no_proxy": "*",
    }
    with (room / "out" / "log").open("ab") as log:
        return subprocess.Popen(
            [*limited, sys.executable, "-m", "mkpc_kaggle", *words],
            cwd=room,
            env=own | env,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=stderr() if stderr else subprocess.STDOUT,
            start_new_session=True,
        )


def _wait(process: "subprocess.Popen[bytes]", room: Path) -> tuple[int | None, str]:
    """The status, ``None`` where it had to be killed, and the output."""
    try:
        status: int | None = process.wait(HANGS_S)
    except subprocess.TimeoutExpired:
        status = None
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return status, (room / "out" / "log").read_text(errors="replace")


def _faults(case: Case, status: int | None, output: str, room: Path) -> list[str]:
    faults = [f"the output has {crash!r}" for crash in CRASHES if crash in output]
    if status is None:
        faults.append(f"it hangs: not over after {HANGS_S} s")
    elif status not in case.statuses:
        faults.append(f"exit status {status}, not one of {case.statuses}")
    if status in REFUSED and "error:" not in output:
        faults.append("refused without a word")
    if case.says not in output:
        faults.append(f"the output lacks {case.says!r}")
    if status in (0, 1, 2) and (left := sorted(path.name for path in (room / "tmp").iterdir())):
        faults.append(f"left in the folder for temporary files: {left}")
    return faults


def _submission_faults(room: Path) -> list[str]:
    ids = [pair.id for pair in read_test_side(room / "D")]
    return [f"submission: {problem}" for problem in submission_problems(room / "out" / "s.csv", ids)]


def _result_faults(out: Path, status: int) -> list[str]:
    """What is wrong with the results of a folder of images."""
    table = out / "cameras.csv"
    with suppress(OSError):
        lines = table.read_text().splitlines()
        faults = [] if lines[0].startswith("image,model,K,R,t,") else [f"{table} begins with {lines[0]!r}"]
        faults += (
            [] if (len(lines) > 1) == (status == 0) else [f"exit status {status} with {len(lines) - 1} cameras"]
        )
        return faults + [f"left: {path}" for path in out.rglob(".*") if path.name != ".png"]
    return [f"there is no {table}"]


def _orphans(mark: str) -> list[str]:
    """Command lines of processes of the case that are still there; they are killed."""
    for _ in range(600):
        if not (left := started_with(mark)):
            break
        time.sleep(0.1)
    for process in left:
        with suppress(OSError):  # it has ended meanwhile
            os.kill(process, signal.SIGKILL)
    return [f"{process} {command[:200]}" for process, command in left.items()]


def _snapshot(room: Path) -> dict[str, tuple[object, ...]]:
    """What identifies the state of each file of the room, except what a command may write."""
    states: dict[str, tuple[object, ...]] = {}
    for folder, folders, names in os.walk(os.fsencode(room)):
        if folder == os.fsencode(room):
            folders[:] = [name for name in folders if name not in (b"out", b"tmp")]
        for name in folders + names:
            path = os.path.join(folder, name)  # noqa: PTH118  bytes: a name may be no text
            status = os.lstat(path)
            contents = (status.st_size, status.st_mtime_ns, status.st_ino) if name in names else ()
            states[repr(path)] = (status.st_mode, *contents)
    return states


def _changed(before: dict[str, tuple[object, ...]], after: dict[str, tuple[object, ...]]) -> list[str]:
    return [name for name in sorted(before.keys() | after.keys()) if before.get(name) != after.get(name)]
