"""Real runs of ``submit`` on the demo set, undisturbed and with faults: who is blamed, what is lost.

Each run is the command itself, in a process, with worker processes. Its results are read from its
journal afterwards, and the workers' calls from a file that they write.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.gpu.faults import EVENTS, Fault
from benchmarks.gpu.record import EXPECTED, Part
from benchmarks.gpu.setup import Setup
from benchmarks.gpu.trained import SLOTS
from mkpc_kaggle.data.competition import read_test_side, submission_problem
from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.weights import WeightStore

UNITS = 2
LONG_SIDE = 1024
QUICK_SIDE = 192
FEATURES = 2048
QUICK_FEATURES = 256
LAYERS = 9  # of LightGlue with seeded weights
QUICK_LAYERS = 1
LIMIT_S = 100.0  # of a run
END_S = 20.0  # for a run to end after its limit, before it is killed
POLL_S = 0.02
# Between the peak of one picture at a time and that of a minibatch: halving it makes it fit.
MEMORY_SHARE = 0.75
QUICK = (
    "device-side assert on one pair, one place",
    "device-side assert on one pair, two places",
)
CLOSED = "no worker is started any more"
CONTINUES = "matching continues on the"
LOST = "a job was lost"
TIME_IS_UP = "time is up after"


@dataclass(frozen=True)
class Outcome:
    """The end of a run: its exit status, its text, its seconds, its calls of matchers."""

    status: int
    text: str
    seconds: float
    events: list[dict[str, Any]]
    good: int  # results of a unit on a pair
    wanted: int
    short: int  # pairs without one of their results
    rows_without: str  # of a complete submission: empty

    def problems(self, *, bad: int = 0) -> list[str]:
        """Return what no run may do, if results of ``bad`` pairs must be missing."""
        # What a run did not reach says nothing about its faults.
        if TIME_IS_UP in self.text:
            return [f"the time was up, with {self.good} of {self.wanted} results"]
        found = []
        if self.status != 0:
            found.append(f"exit status {self.status}")
        if self.rows_without:
            found.append(self.rows_without)
        if self.short != bad:
            found.append(f"results of {self.short} pairs are missing, not of {bad}")
        if CLOSED in self.text:
            found.append("a place was closed")
        if CONTINUES in self.text:
            found.append("the CPU took over")
        return found

    @property
    def errors(self) -> list[str]:
        return [event["error"] for event in self.events if event["error"]]


@dataclass(frozen=True)
class Case:
    """A run: its fault and its number of places, and the check of its outcome."""

    name: str
    check: Callable[[Outcome], list[str]]
    fault: Fault = Fault.NONE
    places: int = 1
    is_killed: bool = False  # the worker of matching, after its first matches
    # That it needs on an H100: each start of a worker takes five or more
    seconds: float = 30.0


def undisturbed(outcome: Outcome) -> list[str]:
    lost = ["a job was lost"] if LOST in outcome.text else []
    return [*outcome.problems(), *lost, *outcome.errors[:1]]


def two_places(outcome: Outcome) -> list[str]:
    # A worker that loads late may find no pairs left.
    workers = {event["pid"] for event in outcome.events}
    alone = [] if len(workers) == 2 else [f"{len(workers)} workers were loaded"]
    return [*undisturbed(outcome), *alone]


def one_pair_is_given_up(outcome: Outcome) -> list[str]:
    """The pair gives up its units, with the reason; no place closes, and the CPU runs nothing.

    Both units: without points of stage 1, stage 2 looks at the same whole images.
    """
    problems = outcome.problems(bad=1)
    if not any("device-side assert" in error for error in outcome.errors):
        problems.append("no device-side assert happened")
    # By the exit status and the journal the pair is missing. Its reason is for the user.
    if "device-side assert" not in outcome.text:
        problems.append("the reason is not told")
    return problems


def minibatch_is_halved(outcome: Outcome) -> list[str]:
    lost = ["a job was lost"] if LOST in outcome.text else []
    if not any("out of memory" in error for error in outcome.errors):
        lost.append("the memory was sufficient")
    return [*outcome.problems(), *lost]


def work_is_done_again(outcome: Outcome) -> list[str]:
    workers = {event["pid"] for event in outcome.events if event["call"] == "match"}
    alone = [] if len(workers) > 1 else ["no second worker matched"]
    return [*outcome.problems(), *alone]


CASES = (
    Case("one place", undisturbed),
    Case(
        "device-side assert on one pair, one place",
        one_pair_is_given_up,
        Fault.ASSERT,
        seconds=60.0,
    ),
    Case("worker killed in the middle", work_is_done_again, is_killed=True),
    Case("memory for fewer than eight pairs", minibatch_is_halved, Fault.MEMORY),
    Case("two places on one device", two_places, places=2),
    Case(
        "device-side assert on one pair, two places",
        one_pair_is_given_up,
        Fault.ASSERT,
        places=2,
        seconds=60.0,
    ),
)


def measure(part: Part, setup: Setup) -> None:
    """Add a row for each run."""
    recipe = _recipe(setup)
    limit = 0  # bytes, from the memory of the undisturbed run
    for case in CASES:
        if setup.quick and case.name not in QUICK:
            continue
        part.check_time(needed=case.seconds if setup.is_gpu else 0.0)
        with part.row(run=case.name) as row:
            seconds = LIMIT_S if setup.quick else min(LIMIT_S, part.left())
            outcome = _run(case, recipe, setup, seconds, limit)
            row.update(_facts(outcome))
            limit = limit or _memory_limit(outcome)
            row["verdict"] = "; ".join(case.check(outcome)) or EXPECTED


def _facts(outcome: Outcome) -> dict[str, Any]:
    matches = [event for event in outcome.events if event["call"] == "match"]
    return {
        "seconds": outcome.seconds,
        "exit status": outcome.status,
        "results": f"{outcome.good} of {outcome.wanted}",
        "workers": len({event["pid"] for event in outcome.events}),
        "devices": " ".join(sorted({event["device"] for event in matches})),
        "errors of calls": len(outcome.errors),
        "jobs lost": outcome.text.count(LOST),
    }


def _recipe(setup: Setup) -> Path:
    """Write the recipe of the runs: ALIKED + LightGlue on whole images and on crops."""
    side = QUICK_SIDE if setup.quick else LONG_SIDE
    features = QUICK_FEATURES if setup.quick else FEATURES
    units = [
        f'{{ stage = {n}, matcher = "aliked_lightglue", long_side = {side} }}' for n in (1, 2)
    ]
    text = f"units = [{', '.join(units)}]\n[magsac]\nmax_iterations = 5000\n"
    path = setup.out / "runs.toml"
    path.write_text(f"{text}[matchers.aliked_lightglue]\nfeatures = {features}\n")
    return path


def _run(case: Case, recipe: Path, setup: Setup, seconds: float, limit: int) -> Outcome:
    """Run ``submit`` once; kill its worker on the way if the case says so."""
    home = setup.out / case.name.replace(" ", "-").replace(",", "")
    home.mkdir(parents=True)
    test_dir = setup.demo().test_dir
    output = home / "submission.csv"
    store = WeightStore(setup.weights)
    is_trained = all(store.file_of(slot) is not None for slot in SLOTS)
    words = ["--test-dir", test_dir, "--output", output, "--recipe", recipe, "--no-report"]
    words += ["--no-scenes", "--device", setup.device, "--workers", case.places]
    # The limit only ends a run that hangs.
    words += ["--time-limit", f"{seconds:.0f}s"]
    for directory in setup.weights:
        words += ["--weights", directory]
    layers = 0 if is_trained else QUICK_LAYERS if setup.quick else LAYERS
    command = [
        sys.executable,
        "-m",
        "benchmarks.gpu.submit_with",
        case.fault,
        home,
        limit,
        layers,
    ]
    start = time.monotonic()
    with (home / "log.txt").open("w") as log:
        process = subprocess.Popen(
            [*map(str, command), "submit", *map(str, words)],
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        try:
            if case.is_killed:
                _kill_worker(home, process)
            process.wait(max(1.0, start + seconds + END_S - time.monotonic()))
        except subprocess.TimeoutExpired:
            pass  # the exit status says so
        finally:
            process.kill()
            status = process.wait()
    # The summary names a few faults, and run.log all of them, and the decisions.
    logs = [home / "log.txt", home / "submission.work" / "run.log"]
    text = "\n".join(file.read_text(errors="replace") for file in logs if file.exists())
    pairs = read_test_side(test_dir)
    good: dict[str, int] = {}  # results by pair
    with suppress(KeyError):  # no unit has a result
        units = results(home / "submission.work").units
        counts = units[units["failure"] == ""]["pair"].value_counts()
        good = {str(pair): int(count) for pair, count in counts.items()}
    rows = submission_problem(output, [pair.id for pair in pairs])
    return Outcome(
        status,
        text,
        time.monotonic() - start,
        _events(home),
        good=sum(good.values()),
        wanted=UNITS * len(pairs),
        short=sum(good.get(pair.id, 0) < UNITS for pair in pairs),
        rows_without=rows,
    )


def _kill_worker(home: Path, process: "subprocess.Popen[bytes]") -> None:
    """Kill the worker of matching as soon as it has matched once."""
    while process.poll() is None:
        matched = [event for event in _events(home) if event["call"] == "match"]
        if matched:
            with suppress(ProcessLookupError):
                os.kill(matched[0]["pid"], signal.SIGKILL)
            return
        time.sleep(POLL_S)


def _events(home: Path) -> list[dict[str, Any]]:
    path = home / EVENTS
    if not path.exists():
        return []
    # The last line may be unfinished.
    lines = path.read_text().splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def _memory_limit(outcome: Outcome) -> int:
    """Return the bytes that a minibatch needs a little more than; 0 on a CPU."""
    loaded = max(
        (event["memory"] for event in outcome.events if event["call"] == "loaded"), default=0
    )
    most = max(
        (event["count"] for event in outcome.events if event["call"] == "encode"), default=0
    )
    peaks = [
        event["memory"]
        for event in outcome.events
        if event["call"] == "encode" and event["count"] == most
    ]
    peak = max(peaks, default=0)
    return int(loaded + MEMORY_SHARE * (peak - loaded))
