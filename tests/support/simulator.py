"""The engine on a virtual clock: random runs without images, and how well each used its time.

The planner and the engine are the real ones. Workers are simulated: what a unit costs is drawn at random, and
drifts, stalls, crashes, hangs and wrong first estimates are thrown in. So are reconstructions of batches, which
crash, run out of memory and hang as well.
"""

import heapq
import math
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.engine import Ending, Engine, RunReport
from mkpc_kaggle.engine.jobs import Cause, Job, JobFailure, JobResult, Outcome
from mkpc_kaggle.engine.planner import RESERVE_SHARE
from mkpc_kaggle.engine.pools.pool import JOBS_A_WORKER
from mkpc_kaggle.engine.records import NOT_REACHED, PairRecord, SceneRecord, UnitRecord
from mkpc_kaggle.engine.scenes import MARGIN, START_SECONDS, SceneAnswer, SceneJob
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.config import SceneConfig

RESTART_SECONDS = 8.0
STALL = 20.0
"""A unit that stalls takes that many times as long."""
SWEEP_SHARE = 0.7
"""The share of the limit within which the sweep is said to fit."""


@dataclass(frozen=True)
class Scenario:
    """A run's circumstances. Costs are seconds of a unit on a pair; faults are probabilities a unit on a pair.

    ``spread`` is the sigma of lognormal costs, ``misses`` the share of pairs whose views are not cached and cost
    ``miss_factor`` times as much, ``warm_up`` what a unit takes the first time on a worker. From ``turn``, a share
    of the limit, on costs are ``drift`` times as high.

    The pairs are in so many ``batches``; 0: there are no scenes. Each image but one is in a single pair, and where
    ``pairs_per_image`` is above 1 others are matched for the scene's sake. A scene takes ``scene_seconds`` a pair
    of its batch, and with the probability ``scene_faults`` it crashes, runs out of memory or hangs.
    """

    pairs: int
    costs: tuple[float, ...]
    extras: int
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
    batches: int = 0
    pairs_per_image: float = 0.0
    scene_seconds: float = 0.06
    scene_faults: float = 0.0
    seed: int = 0

    @property
    def recipe(self) -> Recipe:
        count = len(self.costs)
        units = [Unit(1 if number % 2 == 0 else 2, f"m{number}", 100) for number in range(count)]
        scene = SceneConfig(pairs_per_image=self.pairs_per_image) if self.batches else None
        return Recipe(tuple(units), scene=scene)

    @property
    def work(self) -> float:
        """Seconds that all regular units take on all pairs and workers, on average and without faults."""
        regular = self.costs[: len(self.costs) - self.extras]
        return self.pairs * sum(regular) * self.cached / self.workers

    @property
    def cached(self) -> float:
        """What a unit costs on average, in terms of one on a cached view."""
        return 1 + self.misses * (self.miss_factor - 1)

    @property
    def longest_scenes(self) -> float:
        """Seconds that all scenes take on average, if all is slow from the first moment on."""
        return max(1.0, self.drift) * (self.batches * START_SECONDS + self.pairs * self.scene_seconds)


def random_scenario(seed: int, pairs: int) -> Scenario:
    """Anything that happens: from an ample limit to one that the sweep alone fills."""
    rng = np.random.default_rng(seed)
    costs = tuple(np.exp(rng.normal(-0.5, 0.8, rng.integers(1, 13))).tolist())
    troubled = rng.random() < 0.5
    scenario = Scenario(
        pairs=int(pairs * rng.uniform(0.5, 1.5)),
        costs=costs,
        extras=int(rng.integers(0, len(costs))),
        workers=int(rng.integers(1, 5)),
        limit=math.inf,
        spread=float(rng.uniform(0.05, 1.0)),
        misses=float(rng.uniform(0, 0.6)),
        miss_factor=float(rng.uniform(1, 5)),
        warm_up=float(rng.uniform(0, 30)),
        drift=float(rng.choice([0.3, 1, 1, 1, 2, 10])),
        turn=float(rng.uniform(0.1, 0.9)),
        seed=seed,
    )
    limit = max(600.0, scenario.work * float(rng.uniform(0.3, 1.3)))
    # Faults a run: some dozens of stalls, a crash or two, now and then a hang. With its extra units a run may do
    # all units on all pairs, if the time suffices.
    seconds = sum(costs) / len(costs) * scenario.cached
    runs = min(scenario.pairs * len(costs), limit * scenario.workers / seconds)
    rates = [float(rng.uniform(0, most)) / runs if troubled else 0.0 for most in (30, 3, 1)]
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
    )


@dataclass
class VirtualClock:
    now: float = 0.0

    def __call__(self) -> float:
        return self.now


class SimulatedPool:
    """Workers that take their time on the virtual clock alone.

    Of their seconds until ``stop``, ``kept`` went into jobs that came back in time. ``faults`` are what injected
    faults take whatever is planned: the unit that a crash cut short, of a hang as long as a stall might have
    taken, which it cannot be told from sooner, a stall that was taken for a hang, and the new worker's start
    after any of these. ``scenes`` are those under way and done; ``for_scenes`` are the workers' seconds in which
    nothing else was under way.
    """

    def __init__(self, scenario: Scenario, clock: VirtualClock, stop: float) -> None:
        self.scenario = scenario
        self.clock = clock
        self.kept = self.faults = 0.0
        self.scenes: list[SimulatedScene] = []
        self.last_job = self.for_scenes = 0.0
        self._rng = np.random.default_rng(scenario.seed)
        self._scene_rng = np.random.default_rng([scenario.seed, 1])
        self._costs = {unit.name: cost for unit, cost in zip(scenario.recipe.units, scenario.costs, strict=True)}
        self._stop = stop
        self._free = [RESTART_SECONDS] * scenario.workers
        self._warm: set[tuple[int, str]] = set()
        self._coming: list[tuple[float, int, float, JobResult | JobFailure]] = []
        self._count = 0

    @property
    def workers(self) -> int:
        return self.scenario.workers

    @property
    def capacity(self) -> int:
        return JOBS_A_WORKER * self.workers

    def start(self) -> str:
        return ""

    def submit(self, job: Job) -> None:
        worker = int(np.argmin(self._free))
        begun = max(self.clock.now, self._free[worker])
        ended, back, fault = self._do(job, worker, begun)
        lost = isinstance(back, JobFailure)
        self._free[worker] = ended + (RESTART_SECONDS if lost else 0.0)
        if lost:
            self.faults += max(0.0, min(fault + RESTART_SECONDS * (fault > 0), self._stop - begun))
            self._warm = {(who, unit) for who, unit in self._warm if who != worker}
        self._count += 1
        kept = 0.0 if lost else min(ended, self._stop) - begun
        heapq.heappush(self._coming, (ended, self._count, kept, back))

    scenes_at_once = 1

    def reconstruct(self, job: SceneJob) -> "SimulatedScene":
        scenario, rng = self.scenario, self._scene_rng
        spread = math.exp(0.3 * rng.normal() - 0.3**2 / 2)
        seconds = START_SECONDS + spread * scenario.scene_seconds * len(job.pairs)
        if self.clock.now > scenario.turn * scenario.limit:
            seconds *= scenario.drift
        answer: SceneAnswer | str
        answer = (), {index: Choice(FALLBACK_FUNDAMENTAL, Reason.SCENE) for index in job.indices}
        if rng.random() < scenario.scene_faults:
            faults = ((seconds / 2, "signal SIGSEGV"), (seconds / 3, "exit status 1"), (math.inf, "it hangs"))
            seconds, answer = faults[rng.integers(len(faults))]
        self.scenes.append(SimulatedScene(self.clock, self.clock.now, seconds, answer, job.batch))
        return self.scenes[-1]

    def next(self, until: float) -> JobResult | JobFailure | None:
        if not self._coming or self._coming[0][0] > until:
            if not self._coming and any(not scene.over for scene in self.scenes):
                self.for_scenes += self.workers * max(0.0, min(until, self._stop) - self.clock.now)
            self.clock.now = max(self.clock.now, until)
            return None
        ended, _, kept, back = heapq.heappop(self._coming)
        self.clock.now = self.last_job = max(self.clock.now, ended)
        self.kept += max(0.0, kept)
        return back

    def stop(self) -> None:
        pass

    def close(self) -> bool:
        return True

    def _do(self, job: Job, worker: int, begun: float) -> tuple[float, JobResult | JobFailure, float]:
        """When the job ends, what comes back, and the seconds of it that an injected fault took."""
        now = begun
        expected = dict(zip(job.units, job.expected, strict=True))
        results: list[list[UnitResult]] = [[] for _ in job.indices]
        for unit in sorted(job.units, key=lambda unit: unit.stage):
            for known, found in zip(job.known, results, strict=True):
                if any(result.unit == unit for result in known) or now + expected[unit] >= job.deadline:
                    continue
                stalled = self._rng.random() < self.scenario.stalls
                usual = self._seconds(unit, now) * job.shrink**2
                warm_up = (worker, unit.name) not in self._warm
                self._warm.add((worker, unit.name))
                seconds = usual * (STALL if stalled else 1.0) + self.scenario.warm_up * warm_up
                fate = self._rng.random()
                if fate < self.scenario.crashes:
                    return now + seconds / 2, JobFailure(job, Cause.DIED), seconds / 2
                if fate < self.scenario.crashes + self.scenario.hangs:
                    return now + job.timeout, JobFailure(job, Cause.HUNG), min(job.timeout, STALL * usual)
                if seconds > job.timeout:
                    return now + job.timeout, JobFailure(job, Cause.HUNG), job.timeout if stalled else 0.0
                now += seconds
                found.append(UnitResult(unit, Matches.empty(), 0.0, seconds, warm_up=warm_up))
        pairs = zip(job.indices, job.known, results, strict=True)
        return now, JobResult(job, tuple(self._outcome(job, *pair) for pair in pairs)), 0.0

    def _seconds(self, unit: Unit, now: float) -> float:
        scenario, rng = self.scenario, self._rng
        seconds = self._costs[unit.name] * math.exp(scenario.spread * rng.normal() - scenario.spread**2 / 2)
        if rng.random() < scenario.misses:
            seconds *= scenario.miss_factor
        if now > scenario.turn * scenario.limit:
            seconds *= scenario.drift
        return seconds

    def _outcome(self, job: Job, index: int, known: tuple[UnitResult, ...], found: list[UnitResult]) -> Outcome:
        if not found:
            return Outcome(PairRecord.untouched(index, NOT_REACHED))
        units = tuple(
            UnitRecord(one.unit.name, one.unit.stage, 200, 20 + index % 60, 0.0, one.seconds, job.note)
            for one in (*known, *found)
        )
        return Outcome(PairRecord(index, FALLBACK_FUNDAMENTAL, "", units), tuple(found))


@dataclass
class SimulatedScene:
    """A reconstruction that ends by itself; ``seen`` is when somebody asked after that, ``over`` that it ended."""

    clock: VirtualClock
    begun: float
    seconds: float
    found: SceneAnswer | str
    batch: str
    seen: float = field(default=0.0, init=False)
    over: bool = field(default=False, init=False)

    def answer(self) -> SceneAnswer | str | None:
        if self.clock.now < self.begun + self.seconds:
            return None
        self.seen = self.clock.now
        return self.found

    def kill(self) -> None:
        self.over = True


class MemoryJournal:
    """A journal that forgets with the process."""

    def __init__(self) -> None:
        self._results: dict[int, tuple[UnitResult, ...]] = {}

    def forget_changed(self, pairs: Sequence[Pair]) -> int:
        return 0

    def records(self) -> dict[int, PairRecord]:
        return {}

    def results(self, pair: int, units: Mapping[str, Unit]) -> tuple[UnitResult, ...]:
        return self._results.get(pair, ())

    def save(self, outcomes: list[tuple[Outcome, bool]]) -> None:
        for outcome, _ in outcomes:
            index = outcome.record.index
            self._results[index] = self._results.get(index, ()) + outcome.results

    def scenes(self) -> tuple[SceneRecord, ...]:
        return ()

    def save_scene(self, scene: SceneRecord, choices: Mapping[int, Choice]) -> None:
        pass

    def settle(self, records: Iterable[PairRecord]) -> None:
        pass

    def note(self, kind: str, seconds: float, text: str) -> None:
        pass


@dataclass(frozen=True)
class Ran:
    """What became of a scenario; ``late`` and ``lost`` must be 0.

    ``utilisation`` is what was used of what was given. Given are the workers' seconds from their start to the
    budget's stop, without those that injected faults take from any planner (see :class:`SimulatedPool`). Used are
    the seconds of jobs whose results came back in time, warm-ups and stalls included. So idle workers, the end of
    a phase, what a lost job had done before, silence longer than a stall's, a slow unit taken to hang, and what
    is still under way at the end all count against the engine. Workers' time while nothing but scenes is under way
    is used.

    ``lost`` counts pairs without the sweep's F where the sweep fits (see :func:`sweep_seconds`), and versions of
    the submission that lack a row. ``missed`` are batches without a scene that no fault befell; ``scenes_fit``
    says that what is left to scenes at most suffices for all, and that none hung while others waited. ``last_job``
    is when the last job came back.
    """

    scenario: Scenario
    report: RunReport
    utilisation: float
    late: float
    lost: int
    missed: int
    scenes_fit: bool
    last_job: float
    scenes: tuple[SimulatedScene, ...]
    jobs: int
    planning: float

    @property
    def work_left(self) -> bool:
        return self.report.ending is not Ending.COMPLETE


def simulate(scenario: Scenario) -> Ran:
    """Run one scenario through the real engine."""
    clock = VirtualClock()
    budget = Budget(0.0, scenario.limit, clock)
    pool = SimulatedPool(scenario, clock, budget.stop)
    share = max(1, scenario.batches) / scenario.pairs
    pairs = [Pair(str(n), f"{int(n * share):03d}", f"{n:07d}", "b") for n in range(scenario.pairs)]
    published: list[int] = []
    engine = Engine(
        pairs,
        scenario.recipe,
        pool,
        MemoryJournal(),
        budget,
        publish=lambda records: published.append(len(records)),
        interrupt=threading.Event(),
        progress=False,
    )
    planning, jobs = 0.0, 0
    plan_next = engine.planner.next

    def timed(now: float) -> Job | None:
        nonlocal planning, jobs
        start = time.thread_time()  # whatever else the machine does
        plan = plan_next(now)
        planning += time.thread_time() - start
        jobs += plan is not None
        return plan

    engine.planner.next = timed  # type: ignore[method-assign]
    report = engine.run()
    swept = sum(record.matches > 0 for record in report.records)
    sweep_fits = sweep_seconds(scenario) < SWEEP_SHARE * scenario.limit
    given = pool.workers * (min(budget.stop, clock.now) - RESTART_SECONDS) - pool.faults
    faulty = {scene.batch for scene in pool.scenes if isinstance(scene.found, str)}
    made = {pairs[record.index].group for record in report.records if record.scene is not None}
    return Ran(
        scenario,
        report,
        (pool.kept + pool.for_scenes) / given,
        max(0.0, clock.now - scenario.limit),
        sum(length != scenario.pairs for length in published) + (scenario.pairs - swept if sweep_fits else 0),
        len(set(engine.scenes.batches) - faulty - made),
        MARGIN * scenario.longest_scenes < RESERVE_SHARE * scenario.limit and not any(map(_hangs, pool.scenes)),
        pool.last_job,
        tuple(pool.scenes),
        jobs,
        planning / max(1, jobs),
    )


def _hangs(scene: SimulatedScene) -> bool:
    return math.isinf(scene.seconds)


def sweep_seconds(scenario: Scenario) -> float:
    """What the sweep takes: with the drift from its first moment on, its stalls, warm-ups, crashes and hangs.

    The faults are those to expect; that there may be more of them is what the rest of the limit is for. Each
    takes a worker's start and warm-up, a hang also as long as a stall would.
    """
    unit = scenario.costs[0] * scenario.cached * max(1.0, scenario.drift)
    start = RESTART_SECONDS + scenario.warm_up
    stalls = scenario.stalls * (STALL - 1) * unit
    faults = (scenario.crashes + scenario.hangs) * start + scenario.hangs * STALL * unit
    return start + scenario.pairs * (unit + stalls + faults) / scenario.workers


def without_records(ran: Ran) -> Ran:
    """The run without what it found: kept of a thousand runs, that would slow down all that come after."""
    return replace(ran, report=replace(ran.report, records=()), scenes=())
