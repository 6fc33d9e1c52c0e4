"""The engine on a virtual clock: random runs without images, and how well each used its time.

The plan and the engine are the real ones. Workers are simulated: costs of units are random, with
drifts, stalls, crashes, hangs and wrong first estimates. Reconstructions of batches crash, run out
of memory and hang as well.
"""

import math
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine import budget, plan
from mkpc_kaggle.engine.budget import MAX_SILENCE_S, SCENE_MARGIN, SCENE_START_S, Budget
from mkpc_kaggle.engine.frames import Results
from mkpc_kaggle.engine.keys import Keys
from mkpc_kaggle.engine.places import Kind, Place, Site
from mkpc_kaggle.engine.plan import RESERVE_SHARE
from mkpc_kaggle.engine.request import (
    About,
    Answer,
    Cause,
    Estimated,
    EstimateJob,
    Failure,
    Job,
    Loaded,
    MatchJob,
    Request,
    SceneJob,
)
from mkpc_kaggle.engine.run import Run
from mkpc_kaggle.engine.state import GIVEN_UP, State
from mkpc_kaggle.engine.store import SPARE, Store, connected, create
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.crop_need import CropNeed
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.scene.view_graph import BatchImage
from mkpc_kaggle.setup.console import Progress

RESTART_S = 8.0  # imports and loading of a worker, about as long as with torch
ESTIMATE_S = 0.1  # of a pair
# The longest wait; the real loop wakes every 0.2 s, and may give out other work then
WAKE_S = 1.0
STALL = 20.0  # how many times as long a unit takes that stalls
SIZE = Size(640, 480)
MATCHES = 200  # that a unit finds
POINTS = Matches(np.zeros((MATCHES, 2)), np.zeros((MATCHES, 2)), np.zeros(MATCHES))
# Of bad pairs, with probabilities. A hang takes thirty times as long as a unit.
FATES = {Cause.DEVICE: 0.4, Cause.DIED: 0.3, Cause.OUT_OF_MEMORY: 0.25, Cause.TIMED_OUT: 0.05}
SWEEP_SHARE = 0.7  # of the limit, within which the sweep is said to fit

# Changes that switch each of them off
MECHANISMS: dict[str, tuple[tuple[object, str, object], ...]] = {
    "reserve for scenes": ((plan, "RESERVE_SHARE", 0.0),),
    "margin of scenes": ((budget, "SCENE_MARGIN", 1.0),),
    "margin of units": ((budget, "MARGIN", 0.0),),
    "latest costs": ((budget, "WINDOW", 10**9),),
    "short jobs": ((plan, "JOB_SHARE", math.inf),),
    "connect share": ((plan, "CONNECT_SHARE", 1.0),),
    "time limits": ((budget, "HANG_FACTOR", math.inf),),
}


def switch_off(mechanism: str) -> None:
    """Run without a mechanism of the plan from now on."""
    for owner, name, value in MECHANISMS[mechanism]:
        setattr(owner, name, value)


@dataclass(frozen=True)
class Scenario:
    """The circumstances of a run: costs in seconds of a unit on a pair, faults in probabilities per
    unit and pair.

    A worker dies at the start of any job, hangs, or answers late with probability ``job_faults``.
    ``spread`` is the sigma of lognormal costs. Views of a share ``misses`` of the pairs are not
    cached and cost ``miss_factor`` times as much. ``warm_up`` are the extra seconds of a unit's
    first run on a worker. After the share ``turn`` of the limit, costs are ``drift`` times as high.

    With 0 ``batches``, there are no scenes. Each image but one is in a single pair; if ``pairs_per_image`` is
    above 1, the run adds pairs. A scene takes ``scene_seconds`` per pair, for each of up to ``candidates``. It
    crashes, runs out of memory or hangs with probability ``scene_faults``.

    A share ``bad_pairs`` of the pairs, and the pairs of ``bad``, fail in each unit, in a random way.
    The last ``bad_places`` places fail in every job after the share ``broken`` of the limit.
    With ``fallback``, there is another place, where nothing is bad.
    """

    pairs: int
    costs: tuple[float, ...]
    workers: int
    limit: float
    spread: float = 0.3
    misses: float = 0.3
    miss_factor: float = 2.0
    warm_up: float = 5.0
    drift: float = 1.0
    turn: float = 0.5
    stalls: float = 0.0
    crashes: float = 0.0
    hangs: float = 0.0
    job_faults: float = 0.0
    batches: int = 0
    pairs_per_image: float = 0.0
    scene_seconds: float = 0.06
    scene_faults: float = 0.0
    candidates: int = 1
    seed: int = 0
    never: str = ""  # the matcher whose worker dies whenever it runs
    bad_pairs: float = 0.0
    bad: tuple[int, ...] = ()
    bad_places: int = 0
    broken: float = 0.0
    fallback: bool = False
    crop_share: float = 1.0  # of the pairs that need their units of stage 2

    @property
    def recipe(self) -> Recipe:
        count = len(self.costs)
        units = [
            Unit(1 if number % 2 == 0 else 2, f"m{number}", 100) for number in range(count)
        ]
        config = SceneConfig(pairs_per_image=self.pairs_per_image, candidates=self.candidates)
        scene = config if self.batches else None
        return Recipe(tuple(units), scene=scene)

    @property
    def keys(self) -> Keys:
        return Keys(
            tuple(unit.name for unit in self.recipe.units), "mkpc", "estimate", "scene"
        )

    @property
    def fates(self) -> dict[int, Cause]:
        """How each bad pair fails, by its index."""
        rng = np.random.default_rng([self.seed, 2])
        drawn = rng.random(self.pairs)
        kinds = rng.choice(len(FATES), self.pairs, p=tuple(FATES.values()))
        bad = {*self.bad, *np.flatnonzero(drawn < self.bad_pairs).tolist()}
        return {pair: list(FATES)[kinds[pair]] for pair in sorted(bad)}

    @property
    def work(self) -> float:
        """Seconds that the needed units take on all pairs and workers, on average and without faults."""
        units = zip(self.recipe.units, self.costs, strict=True)
        costs = [cost * (self.crop_share if unit.stage == 2 else 1.0) for unit, cost in units]
        return self.pairs * sum(costs) * self.cached / self.workers

    def needs_crops(self, index: int) -> bool:
        # Multiples of the golden ratio spread evenly.
        return index * 0.618034 % 1.0 < self.crop_share

    @property
    def cached(self) -> float:
        """Mean cost of a unit, in multiples of its cost on a cached view."""
        return 1 + self.misses * (self.miss_factor - 1)

    @property
    def longest_scenes(self) -> float:
        """Seconds that all scenes take on average, if all is slow from the first moment on."""
        return max(1.0, self.drift) * (
            self.batches * SCENE_START_S + self.pairs * self.scene_seconds
        )


def random_scenario(seed: int, pairs: int) -> Scenario:
    """Anything that happens: from an ample limit to a limit that the sweep alone fills."""
    rng = np.random.default_rng(seed)
    # Costs of units differ by a factor of ten and more, as SIFT's and dense networks' do.
    costs = tuple(np.exp(rng.normal(-0.5, 0.8, rng.integers(1, 13))).tolist())
    troubled = rng.random() < 0.5
    scenario = Scenario(
        pairs=int(pairs * rng.uniform(0.5, 1.5)),
        costs=costs,
        workers=int(rng.integers(1, 5)),
        limit=math.inf,
        spread=float(rng.uniform(0.05, 1.0)),
        misses=float(rng.uniform(0, 0.6)),
        miss_factor=float(rng.uniform(1, 5)),
        warm_up=float(rng.uniform(0, 30)),
        drift=float(rng.choice([0.3, 1, 1, 1, 2, 10])),
        turn=float(rng.uniform(0.1, 0.9)),
        seed=seed,
        crop_share=float(np.random.default_rng([seed, 3]).choice([1.0, 1.0, 0.3, 0.05])),
    )
    limit = max(600.0, scenario.work * float(rng.uniform(0.3, 1.3)))
    # Faults a run: some dozens of stalls, a crash or two, now and then a hang.
    seconds = sum(costs) / len(costs) * scenario.cached
    runs = min(scenario.pairs * len(costs), limit * scenario.workers / seconds)
    rates = [float(rng.uniform(0, most)) / runs if troubled else 0.0 for most in (30, 3, 1)]
    jobs = runs / 2  # at least: many are of one pair or of one unit
    return replace(
        scenario,
        limit=limit,
        stalls=rates[0],
        crashes=rates[1],
        hangs=rates[2],
        batches=int(rng.choice([0, 1, 5, 15, 40])),
        pairs_per_image=float(rng.choice([0, 1.5])),
        scene_seconds=float(np.exp(rng.normal(np.log(0.06), 0.8))),
        scene_faults=float(rng.uniform(0, 0.3)) if troubled else 0.0,
        job_faults=float(rng.uniform(0, 3)) / jobs if troubled else 0.0,
        bad_pairs=float(rng.uniform(0, 0.05)) if troubled else 0.0,
        # One place must remain.
        bad_places=int(rng.integers(scenario.workers)) if troubled else 0,
        broken=float(rng.uniform(0, 1)),
    )


@dataclass
class VirtualClock:
    now: float = 0.0

    def __call__(self) -> float:
        return self.now


@dataclass(frozen=True)
class SceneRun:
    """A reconstruction that began; ``seconds`` are infinite if it hangs."""

    batch: str
    begun: float
    seconds: float
    is_faulty: bool


# Seconds until the answer, the answer, seconds of an injected fault
Drawn = tuple[float, Answer, float]


class SimulatedSite(Site):
    """Workers that take their time on the virtual clock alone.

    Of their seconds until ``stop``, ``kept`` went into jobs that came back in time. ``faults`` are
    what injected faults take from any plan: the unit that a crash cut short, a hang for as long as
    a stall takes, a stall whose job is ended before its answer, the start of a new worker.
    ``for_scenes`` are the seconds in which workers were idle and a scene was under way.
    """

    def __init__(self, scenario: Scenario, clock: VirtualClock, stop: float) -> None:
        super().__init__(clock)
        self.scenario = scenario
        self.clock = clock
        self.stop = stop
        self.kept = self.faults = self.last_job = self.for_scenes = 0.0
        self.starts = 0  # of workers of matching
        self.scenes: list[SceneRun] = []
        self.workers: set[SimulatedWorker] = set()
        names = [unit.name for unit in scenario.recipe.units]
        self.costs = dict(zip(names, scenario.costs, strict=True))
        # Two generators: the number of scenes must not change the costs of units.
        self.rng = np.random.default_rng(scenario.seed)
        self._scene_rng = np.random.default_rng([scenario.seed, 1])
        self._fates = scenario.fates
        good = scenario.workers - scenario.bad_places
        self.bad_names = [f"place {n}" for n in range(good, scenario.workers)]
        self.on_fallback = 0  # jobs
        makers = [
            (f"place {n}", partial(self.match_worker, is_bad=n >= good), Kind.MATCH)
            for n in range(scenario.workers)
        ]
        makers.append(
            ("estimates", lambda: SimulatedWorker(self, self.estimate), Kind.ESTIMATE)
        )
        makers.append(("scenes 0", self.scene_worker, Kind.SCENE))
        self.places = [Place(*maker) for maker in makers]
        self.matching = self.of(Kind.MATCH)
        if scenario.fallback:
            self.fallback = [Place("cpu", self.fallback_worker)]

    @property
    def scenes_beside(self) -> int:
        return 1

    def match_worker(self, *, is_bad: bool = False) -> "SimulatedWorker":
        return SimulatedWorker(self, partial(self.match_at, is_bad, set()), RESTART_S)

    def fallback_worker(self) -> "SimulatedWorker":
        def match(job: MatchJob) -> Drawn:
            self.on_fallback += 1
            return self.match(warm, job)

        warm: set[str] = set()
        return SimulatedWorker(self, match, RESTART_S)

    def scene_worker(self) -> "SimulatedWorker":
        return SimulatedWorker(self, self.reconstruct)

    def wait(self, until: float) -> None:
        now = self.clock.now
        pauses = [place.since + 1 for place in self.places if not place.worker]
        later = [pause for pause in pauses if pause > now]
        moment = min([until, *later, *(worker.ready for worker in self.workers)])
        # Hung jobs end by their own limits.
        assert moment < math.inf or self.has_jobs, "the engine waits for ever"
        moment = min(moment, self.clock.now + WAKE_S)
        if any(place.job for place in self.of(Kind.SCENE)):
            # After a loss, a place gets another worker only when there is work for it.
            now = self.clock.now
            idle = sum(place.is_idle or place.may_start(now) for place in self.of(Kind.MATCH))
            self.for_scenes += idle * max(0.0, min(moment, self.stop) - now)
        self.clock.now = max(self.clock.now, moment)

    def drift(self, now: float) -> float:
        return self.scenario.drift if now > self.scenario.turn * self.scenario.limit else 1.0

    def unit_seconds(self, unit: Unit, now: float) -> float:
        scenario = self.scenario
        rng = self.rng
        # Lognormal with a mean of 1.
        factor = math.exp(scenario.spread * rng.normal() - scenario.spread**2 / 2)
        seconds = self.costs[unit.name] * factor
        missed = rng.random() < scenario.misses
        return seconds * (scenario.miss_factor if missed else 1.0) * self.drift(now)

    def stall_seconds(self, unit: Unit, now: float) -> float:
        """Return the seconds that a stall of a unit takes on an uncached view, at the costs of this
        time.
        """
        return (
            STALL
            * self.costs[unit.name]
            * max(1.0, self.scenario.miss_factor)
            * self.drift(now)
        )

    def match_at(self, is_bad: bool, warm: set[str], job: MatchJob) -> Drawn:
        """Draw the answer of a place of its own, on which a job may be lost for a reason."""
        scenario = self.scenario
        # The whole time until a loss is a fault: of the place, or of a pair.
        if is_bad and self.clock.now >= scenario.broken * scenario.limit:
            return self.lose(Cause.DEVICE)
        for index in job.indices:
            if index in self._fates:
                return self.lose(self._fates[index])
        return self.match(warm, job)

    def lose(self, cause: Cause) -> Drawn:
        return math.inf if cause is Cause.TIMED_OUT else 0.5, Failure(cause), math.inf

    def match(self, warm: set[str], job: MatchJob) -> Drawn:
        """Draw the answer of a worker that ran the units of ``warm`` before; none begins after
        ``seconds`` of the plan.
        """
        scenario = self.scenario
        rng = self.rng
        begun = self.clock.now
        spent = 0.0
        stalled = 0.0
        expected = dict(zip(job.units, job.plan.expected, strict=True))
        if rng.random() < scenario.job_faults:
            fate = rng.integers(3)
            if fate == 0:
                return 0.0, Failure(Cause.DIED), 0.0
            if fate == 1:
                stall = sum(self.stall_seconds(unit, begun) for unit in job.units)
                return math.inf, Failure(Cause.TIMED_OUT), stall
            spent = len(job.indices) * sum(self.costs[unit.name] for unit in job.units)
        found: list[list[UnitResult]] = [[] for _ in job.indices]
        for number, unit in enumerate(job.units):
            before = {each for each in job.units[:number] if each.stage == 1}
            for index, rows in zip(job.indices, found, strict=True):
                if unit.stage == 2 and not before <= {row.unit for row in rows}:
                    continue  # its crops come from points that there was no time for
                if unit.stage == 2 and not scenario.needs_crops(index):
                    rows.append(UnitResult(unit, Matches.empty(), need=CropNeed(False)))
                    continue
                if spent + expected[unit] >= job.plan.seconds:
                    continue  # as a real worker, which begins no unit that would end too late
                slow = STALL if rng.random() < scenario.stalls else 1.0
                undisturbed = self.unit_seconds(unit, begun + spent)
                stalled += (slow - 1.0) * undisturbed
                took = slow * undisturbed + scenario.warm_up * (unit.name not in warm)
                fate = rng.random()
                if fate < scenario.crashes or unit.matcher == scenario.never:
                    # In the middle of the unit, on average.
                    return spent + took / 2, Failure(Cause.DIED), took / 2
                if fate < scenario.crashes + scenario.hangs:
                    return (
                        math.inf,
                        Failure(Cause.TIMED_OUT),
                        self.stall_seconds(unit, begun + spent),
                    )
                spent += took
                rows.append(
                    UnitResult(unit, POINTS, 0.0, took, warm_up=unit.name not in warm)
                )
                warm.add(unit.name)
        return spent, tuple(map(PairMatch, map(tuple, found))), stalled

    def estimate(self, job: EstimateJob) -> Drawn:
        """Draw an answer: each pair has from 20 to 79 inliers by its number."""
        rng = self.rng
        if rng.random() < self.scenario.job_faults:
            return 0.0 if rng.random() < 0.5 else math.inf, Failure(Cause.DIED), 0.0
        estimates = []
        for pair in job.pairs:
            inliers = dict.fromkeys(pair.points.values(), 20 + pair.index % 60)
            estimates.append(Estimated(facts_of(inliers), ESTIMATE_S))
        return ESTIMATE_S * len(estimates), tuple(estimates), 0.0

    def reconstruct(self, job: SceneJob) -> Drawn:
        scenario = self.scenario
        rng = self._scene_rng
        begun = self.clock.now
        spread = math.exp(0.3 * rng.normal() - 0.3**2 / 2)
        spent = (
            SCENE_START_S + spread * scenario.scene_seconds * len(job.pairs)
        ) * self.drift(begun)
        # By the key, so that a scene that is made again has the same value
        disagreement = int(job.key[:4], 16) / 65536
        choices = (Choice(FALLBACK_FUNDAMENTAL, Reason.SCENE),) * len(job.pairs)
        answer: Answer = Solution((), choices, disagreement)
        if is_faulty := rng.random() < scenario.scene_faults:
            answer = Failure(Cause.DIED, "signal SIGSEGV")
            spent *= (0.5, 0.3, math.inf)[rng.integers(3)]
        self.scenes.append(SceneRun(job.batch, begun, spent, is_faulty))
        return spent, answer, 0.0


class SimulatedWorker:
    """A worker whose answer is drawn when a job is submitted, and given when its time has come."""

    def __init__(
        self, site: SimulatedSite, draw: Callable[[Any], Drawn], start_s: float = 0.0
    ) -> None:
        self.ready = math.inf
        self._site = site
        self._draw = draw
        self._start_s = start_s
        self._answer: Answer = Loaded()
        self._is_loaded = False
        self._waiting: Job | None = None  # until then
        self._begun = self._fault = 0.0

    def start(self) -> None:
        site = self._site
        site.workers.add(self)
        self.ready = site.clock.now + self._start_s
        if self._start_s:
            site.starts += 1
        # The first starts are no fault.
        if site.starts > site.scenario.workers:
            site.faults += max(0.0, min(self._start_s, site.stop - site.clock.now))

    def submit(self, job: Job) -> None:
        if not self._is_loaded:
            self._waiting = job
            return
        self._begun = self._site.clock.now
        taken, self._answer, self._fault = self._draw(job)
        self.ready = self._begun + taken

    def answer(self) -> Answer | None:
        site = self._site
        if site.clock.now < self.ready:
            return None
        if self._start_s and isinstance(self._answer, tuple):
            site.kept += max(0.0, min(self.ready, site.stop) - self._begun)
            site.last_job = self.ready
        self.ready = math.inf
        answer = self._answer
        self._is_loaded = True
        if self._waiting is not None:
            job, self._waiting = self._waiting, None
            self.submit(job)
        return answer

    def kill(self) -> None:
        """End the worker, which died, hangs, or computes."""
        site = self._site
        site.workers.discard(self)
        # A job that is ended before its answer may stall.
        is_stalled = self._fault > 0 and self.ready < math.inf
        if self._start_s and (is_stalled or isinstance(self._answer, Failure)):
            lost = min(self._fault, site.clock.now - self._begun)
            site.faults += max(0.0, min(lost, site.stop - self._begun))


def memory_store(directory: Path = Path()) -> Store:
    """A store that leaves no file."""
    store = Store(directory, connected(":memory:"))
    create(store.db)
    store.db.executescript(SPARE)
    return store


def facts_of(
    inliers: dict[str, int], F: Any = FALLBACK_FUNDAMENTAL, magsac: Any = None
) -> dict[str, object]:
    """The facts of an estimate."""
    magsac = None if magsac is None else magsac.ravel().tolist()
    return {"F": F.ravel().tolist(), "failure": "", "magsac": magsac, "inliers": inliers}


@dataclass(frozen=True)
class Ran:
    """The outcome of a scenario; ``late`` and ``lost`` must be 0.

    ``utilisation`` is the used share of the workers' time from their start to ``stop_units``, without injected
    faults. Used are the seconds of jobs that came back in time, and of idle workers while a scene is under way
    (see :class:`SimulatedSite`).

    ``lost`` counts pairs without the sweep's F where the sweep fits (see :func:`sweep_seconds`), and versions of
    the submission with a missing row. ``missed`` are batches with matches, without a scene and without a fault;
    ``unmatched`` are batches that the sweep did not reach. ``scenes_fit`` states that the largest reserve suffices
    for all scenes, and that none hung while others waited. ``stale`` are the batches whose scene is out of date.
    ``closed`` are places, and ``wrongly_closed`` the good ones of them. ``on_fallback`` counts jobs on the place
    that takes over. ``work_left`` states that the run ended before all work was done: a unit of a good pair, or a
    scene. Without it, a run has used what it needed, even if it waited for a bad pair until its end.
    """

    scenario: Scenario
    report: Results
    utilisation: float
    late: float
    lost: int
    missed: int
    unmatched: int
    scenes_fit: bool
    last_job: float
    scenes: tuple[SceneRun, ...]
    stale: set[str]
    keys: list[list[str]]  # of the points and the estimate of each pair
    closed: tuple[str, ...] = ()
    wrongly_closed: tuple[str, ...] = ()
    on_fallback: int = 0
    given_up: tuple[tuple[Any, ...], ...] = ()  # pairs and units
    work_left: bool = False


def simulate(scenario: Scenario, store: Store | None = None, until: float = math.inf) -> Ran:
    """Run a scenario through the real engine, until it ends or is interrupted."""
    clock = VirtualClock()
    time = Budget(0.0, scenario.limit, clock)
    site = SimulatedSite(scenario, clock, time.stop_units)
    share = max(1, scenario.batches) / scenario.pairs
    pairs = [
        Pair(str(n), f"{int(n * share):03d}", f"{n:07d}", "b") for n in range(scenario.pairs)
    ]
    names = {name for pair in pairs for name in (pair.file0, pair.file1)}
    published: list[int] = []
    interrupt = threading.Event()
    if store is None:
        store = memory_store()
        weakref.finalize(
            store, store.db.close
        )  # since 3.13, Python warns of open connections
    publish = lambda state: published.append(len(state.written[1]))  # noqa: E731
    about = About({"scene": {}} if scenario.batches else {})
    request = Request(pairs, scenario.recipe, scenario.keys, about=about, publish=publish)
    state = State(request, {name: BatchImage(name, name, SIZE) for name in names})
    state.restore(store)
    run = Run(state, site, store, time, interrupt, Progress(is_shown=False))

    def wait(moment: float) -> None:
        whole_wait(min(moment, until))
        if clock.now >= until:
            interrupt.set()

    whole_wait = site.wait
    site.wait = wait
    report = run.run()
    # A bad pair can have no F, except on the place that takes over.
    bad = list(scenario.fates)
    swept = state.used[: scenario.pairs].any(1)
    swept[bad] = True
    lacks_units = state.missing[: scenario.pairs].any(1)
    lacks_units[bad] = False
    closed = [place for place in site.matching if place.closed]
    # A place that is closed has no time to use.
    site.faults += sum(max(0.0, site.stop - place.since) for place in closed)
    sweep_fits = sweep_seconds(scenario) < SWEEP_SHARE * scenario.limit
    given = scenario.workers * (site.stop - RESTART_S) - site.faults
    faulty = {scene.batch for scene in site.scenes if scene.is_faulty}
    matches = zip(state.batches, state.by_batch(state.matches.sum(1)), strict=True)
    matched = {batch for batch, count in matches if count}
    made = set(report.pairs.query("choice != ''")["group"])
    missed = matched - faulty - made
    return Ran(
        scenario,
        report,
        (site.kept + site.for_scenes) / given,
        max(0.0, clock.now - scenario.limit),
        sum(length != scenario.pairs for length in published)
        + (scenario.pairs - int(swept.sum()) if sweep_fits else 0),
        len(missed),
        len(state.batches) - len(matched),
        SCENE_MARGIN * scenario.longest_scenes < RESERVE_SHARE * scenario.limit
        and not any(math.isinf(scene.seconds) for scene in site.scenes),
        site.last_job,
        tuple(site.scenes),
        {
            batch
            for batch, number in state.batches.items()
            if (made := state.made[number, 0]) is None
            or made.key != state.scene_inputs(number)[1]
        },
        [
            [*points, key]
            for points, key in zip(
                state.points.tolist(), state.estimate.tolist(), strict=True
            )
        ],
        tuple(place.name for place in closed),
        tuple(place.name for place in closed if place.name not in site.bad_names),
        site.on_fallback,
        tuple(map(tuple, np.argwhere(state.losses >= GIVEN_UP).tolist())),
        bool(lacks_units.any() or missed),
    )


def sweep_seconds(scenario: Scenario) -> float:
    """Return the expected seconds of the sweep, with its drift, stalls, warm-ups, crashes and
    hangs.

    The rest of the limit is for more faults than expected. A fault takes a worker's start and
    warm-up, and a hang also takes as long as a stall.
    """
    unit = scenario.costs[0] * scenario.cached * max(1.0, scenario.drift)
    start = RESTART_S + scenario.warm_up
    stalls = scenario.stalls * (STALL - 1) * unit
    faults = (scenario.crashes + scenario.hangs) * start + scenario.hangs * STALL * unit
    faults += scenario.job_faults * (start + STALL * unit)
    hang = FATES[Cause.TIMED_OUT] * (budget.HANG_FACTOR * unit + MAX_SILENCE_S)
    faults += scenario.bad_pairs * GIVEN_UP * (start + hang)
    workers = max(1, scenario.workers - scenario.bad_places)
    return start + scenario.pairs * (unit + stalls + faults) / workers


def without_tables(ran: Ran) -> Ran:
    """Return the run without its tables: a thousand runs with theirs would fill the memory."""
    report = ran.report
    nothing = replace(report, pairs=report.pairs[:0], units=report.units[:0])
    return replace(ran, report=nothing, scenes=(), keys=[])
