"""The engine on a virtual clock: random runs without images, and how well each used its time.

The plan and the engine are the real ones. Workers are simulated: what a unit costs is drawn at random, and
drifts, stalls, crashes, hangs and wrong first estimates are thrown in. So are reconstructions of batches, which
crash, run out of memory and hang as well.
"""

import math
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine import costs, losses, plan, scenes
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.engine import Engine
from mkpc_kaggle.engine.jobs import (
    Answer,
    Cause,
    Estimated,
    EstimateJob,
    Failure,
    Found,
    Job,
    Loaded,
    MatchJob,
    Outcome,
    SceneJob,
)
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_reader import to_blob
from mkpc_kaggle.engine.places import Place, Site, Work
from mkpc_kaggle.engine.plan import RESERVE_SHARE
from mkpc_kaggle.engine.request import Ending, Request, RunReport
from mkpc_kaggle.engine.scenes import FORECAST_MARGIN, START_S
from mkpc_kaggle.engine.settings import Settings
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.reconstruct import Solution
from mkpc_kaggle.scene.view_graph import BatchImage

RESTART_S = 8.0
ESTIMATE_S = 0.1  # of a pair
STALL = 20.0  # a unit that stalls takes so many times as long
SIZE = Size(640, 480)
MATCHES = 200  # that a unit finds
POINTS = to_blob(Matches(np.zeros((MATCHES, 2)), np.zeros((MATCHES, 2)), np.zeros(MATCHES)))
SWEEP_SHARE = 0.7  # of the limit, within which the sweep is said to fit

MECHANISMS: dict[str, tuple[tuple[object, str, object], ...]] = {  # what to change to run without each
    "reserve for scenes": ((plan, "RESERVE_SHARE", 0.0),),
    "margin of scenes": ((scenes, "FORECAST_MARGIN", 1.0),),
    "margin of units": ((costs, "MARGIN", 0.0), (costs, "MIN_MARGIN", 0.0)),
    "latest costs": ((costs, "WINDOW", 10**9),),
    "assumed costs": ((costs.Costs, "assume", lambda *_: None),),
    "short jobs": ((plan, "JOB_SHARE", math.inf),),
    "connect share": ((plan, "CONNECT_SHARE", 1.0),),
    "end of patience": ((plan, "HANG_FACTOR", math.inf),),
    "second try": ((losses, "MAX_TRIES", 1),),
    "end of tries": ((plan, "MAX_FAILED_PAIRS", 10**9),),
}


def switch_off(mechanism: str, change: Callable[[object, str, object], None] = setattr) -> None:
    """Run without a mechanism of the plan from now on."""
    for owner, name, value in MECHANISMS[mechanism]:
        change(owner, name, value)


@dataclass(frozen=True)
class Scenario:
    """A run's circumstances. Costs are seconds of a unit on a pair; faults are probabilities a unit on a pair, and
    ``job_faults`` a job: its worker dies as it begins, hangs, or answers late, whatever the job is.

    ``spread`` is the sigma of lognormal costs, ``misses`` the share of pairs whose views are not cached and cost
    ``miss_factor`` times as much, ``warm_up`` what a unit takes the first time on a worker. From ``turn``, a share
    of the limit, on costs are ``drift`` times as high.

    The pairs are in so many ``batches``; 0: there are no scenes. Each image but one is in a single pair, and where
    ``pairs_per_image`` is above 1 others are matched for the scene's sake. A scene takes ``scene_seconds`` a pair
    of its batch, and with the probability ``scene_faults`` it crashes, runs out of memory or hangs.
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
    seed: int = 0
    threshold: float = 0.2  # of MAGSAC
    never: str = ""  # the matcher whose worker dies whenever it runs

    @property
    def recipe(self) -> Recipe:
        count = len(self.costs)
        units = [Unit(1 if number % 2 == 0 else 2, f"m{number}", 100) for number in range(count)]
        scene = SceneConfig(pairs_per_image=self.pairs_per_image) if self.batches else None
        return Recipe(tuple(units), scene=scene)

    @property
    def settings(self) -> Settings:
        names = tuple(unit.name for unit in self.recipe.units)
        return Settings(names, f"estimate {self.threshold}", f"scene {self.threshold}")

    @property
    def work(self) -> float:
        """Seconds that all units take on all pairs and workers, on average and without faults."""
        return self.pairs * sum(self.costs) * self.cached / self.workers

    @property
    def cached(self) -> float:
        """What a unit costs on average, times its cost on a cached view."""
        return 1 + self.misses * (self.miss_factor - 1)

    @property
    def longest_scenes(self) -> float:
        """Seconds that all scenes take on average, if all is slow from the first moment on."""
        return max(1.0, self.drift) * (self.batches * START_S + self.pairs * self.scene_seconds)


def random_scenario(seed: int, pairs: int) -> Scenario:
    """Anything that happens: from an ample limit to a limit that the sweep alone fills."""
    rng = np.random.default_rng(seed)
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
    )


@dataclass
class VirtualClock:
    now: float = 0.0

    def __call__(self) -> float:
        return self.now


class SimulatedSite(Site):
    """Workers that take their time on the virtual clock alone.

    Of their seconds until ``stop``, ``kept`` went into jobs that came back in time. ``faults`` are what injected
    faults take whatever is planned: the unit that a crash cut short, of a hang as long as a stall might have
    taken, which it cannot be told from sooner, a stall that was taken for a hang, and the new worker's start
    after any of these. ``scenes`` are those begun; ``for_scenes`` are the seconds in which workers were idle and a
    scene was under way.
    """

    def __init__(self, scenario: Scenario, clock: VirtualClock, stop: float) -> None:
        super().__init__(clock)
        self.scenario = scenario
        self.clock = clock
        self.stop = stop
        self.kept = self.faults = self.last_job = self.for_scenes = 0.0
        self.scenes: list[SimulatedScene] = []
        self.rng = np.random.default_rng(scenario.seed)
        self.costs = {unit.name: cost for unit, cost in zip(scenario.recipe.units, scenario.costs, strict=True)}
        self.workers: set[SimulatedWorker] = set()
        self.others: set[Simulated] = set()
        self._scene_rng = np.random.default_rng([scenario.seed, 1])
        makers = [(f"place {n}", lambda: SimulatedWorker(self), Work.MATCH) for n in range(scenario.workers)]
        makers.append(("estimates", lambda: SimulatedEstimator(self), Work.LIGHT))
        makers.append(("scenes", self.scene_worker, Work.SCENE))
        self.places = [Place(*maker) for maker in makers]

    def scene_worker(self) -> "SimulatedScene":
        self.scenes.append(SimulatedScene(self, self._scene_rng))
        return self.scenes[-1]

    def wait(self, until: float) -> None:
        running = [scene for scene in self.scenes if not scene.is_over]
        moments = [worker.ready for worker in (*self.workers, *self.others, *running)]
        moment = min([until, *moments])
        assert moment < math.inf, "the engine waits for ever"
        if running:
            idle = sum(place.is_idle for place in self.of(Work.MATCH))
            self.for_scenes += idle * max(0.0, min(moment, self.stop) - self.clock.now)
        self.clock.now = max(self.clock.now, moment)

    def unit_seconds(self, unit: Unit, now: float) -> float:
        scenario, rng = self.scenario, self.rng
        seconds = self.costs[unit.name] * math.exp(scenario.spread * rng.normal() - scenario.spread**2 / 2)
        if rng.random() < scenario.misses:
            seconds *= scenario.miss_factor
        if now > scenario.turn * scenario.limit:
            seconds *= scenario.drift
        return seconds


class Simulated:
    """A worker whose answer is drawn when a job is submitted, and given when its time has come."""

    def __init__(self, site: SimulatedSite) -> None:
        self.ready = math.inf
        self._site = site
        self._answer: Answer | None = None

    def answer(self) -> Answer | None:
        if self._answer is None or self._site.clock.now < self.ready:
            return None
        answer, self._answer, self.ready = self._answer, None, math.inf
        return answer


class SimulatedWorker(Simulated):
    """A matching worker."""

    def __init__(self, site: SimulatedSite) -> None:
        super().__init__(site)
        self.job: Job | None = None
        self._warm: set[str] = set()

    def start(self) -> None:
        self._site.workers.add(self)
        self._answer, self.ready = Loaded(), self._site.clock.now + RESTART_S

    def submit(self, job: Job, seconds: float) -> None:
        assert isinstance(job, MatchJob) and self._answer is None
        now = self._site.clock.now
        self.job = job
        self.ready, self._answer, fault = self._do(job, now, now + seconds)
        self._kept = max(0.0, min(self.ready, self._site.stop) - now)
        if isinstance(self._answer, Failure):
            self._fault, self._begun = fault, now
            if self._answer.cause is Cause.TIMED_OUT:
                self._answer, self.ready = None, math.inf  # the engine has to find out
            else:
                self._note_fault()

    def _note_fault(self) -> None:
        lost = self._fault + RESTART_S * (self._fault > 0)
        self._site.faults += max(0.0, min(lost, self._site.stop - self._begun))
        self._fault = 0.0

    def answer(self) -> Answer | None:
        if (answer := super().answer()) is not None:
            self.job = None
        if isinstance(answer, tuple):
            self._site.kept += self._kept
            self._site.last_job = self._site.clock.now
        return answer

    def kill(self) -> None:
        if self.job is not None and self._answer is None:  # it hangs
            self._fault = min(self._fault, self._site.clock.now - self._begun)
            self._note_fault()
        self._site.workers.discard(self)

    def _do(self, job: MatchJob, begun: float, deadline: float) -> tuple[float, Answer, float]:
        """When the job ends, its answer, and the seconds of it that an injected fault took at most."""
        site, now = self._site, begun
        scenario, expected = site.scenario, dict(zip(job.units, job.expected, strict=True))
        found: list[list[Found]] = [[] for _ in job.indices]
        hung = Failure(Cause.TIMED_OUT)
        if site.rng.random() < scenario.job_faults:
            fate = site.rng.integers(3)
            if fate == 0:
                return now, Failure(Cause.DIED), 1e-9
            if fate == 1:
                return now, hung, sum(self._stall(unit, now) for unit in job.units)
            now += len(job.indices) * sum(site.costs[unit.name] for unit in job.units)
        for unit in sorted(job.units, key=lambda unit: unit.stage):
            for rows in found:
                if now + expected[unit] >= deadline:
                    continue
                stalled = site.rng.random() < scenario.stalls
                usual = site.unit_seconds(unit, now)
                warm_up = unit.name not in self._warm
                self._warm.add(unit.name)
                seconds = usual * (STALL if stalled else 1.0) + scenario.warm_up * warm_up
                fate = site.rng.random()
                if fate < scenario.crashes or unit.matcher == scenario.never:
                    return now + seconds / 2, Failure(Cause.DIED), seconds / 2
                if fate < scenario.crashes + scenario.hangs:
                    return now, hung, self._stall(unit, now)
                now += seconds
                rows.append(Found(unit, MATCHES, POINTS, 0.0, seconds, warm_up=warm_up))
        outcomes = []
        for index, wanted, rows in zip(job.indices, job.pairs, found, strict=True):
            images = tuple(BatchImage(name, name, SIZE) for name in wanted.names)
            outcomes.append(Outcome(index, images, tuple(rows)))
        return now, tuple(outcomes), 0.0

    def _stall(self, unit: Unit, now: float) -> float:
        """Return the seconds that a stall of a unit takes on an uncached view, at the costs of this time."""
        scenario = self._site.scenario
        drift = scenario.drift if now > scenario.turn * scenario.limit else 1.0
        return STALL * self._site.costs[unit.name] * max(1.0, scenario.miss_factor) * drift


class SimulatedEstimator(Simulated):
    """Estimates pairs: each has from 20 to 79 inliers by its number."""

    def start(self) -> None:
        self._site.others.add(self)
        self._answer, self.ready = Loaded(), self._site.clock.now

    def submit(self, job: Job, seconds: float) -> None:
        assert isinstance(job, EstimateJob)
        scenario, rng, now = self._site.scenario, self._site.rng, self._site.clock.now
        self.ready = now + ESTIMATE_S * len(job.pairs)
        inliers = [20 + pair.index % 60 for pair in job.pairs]
        self._answer = tuple(
            Estimated(
                *(pair.index, pair.revisions, (count,) * len(pair.units), FALLBACK_FUNDAMENTAL), seconds=ESTIMATE_S
            )
            for pair, count in zip(job.pairs, inliers, strict=True)
        )
        if rng.random() < scenario.job_faults:
            self._answer = Failure(Cause.DIED)
            self.ready = now if rng.random() < 0.5 else math.inf

    def kill(self) -> None:
        self._site.others.discard(self)


class SimulatedScene(Simulated):
    """A worker for a batch; ``is_over`` when it was killed."""

    def __init__(self, site: SimulatedSite, rng: np.random.Generator) -> None:
        super().__init__(site)
        self.batch = ""
        self.begun = self.seconds = 0.0
        self.is_over = self.is_faulty = False
        self._rng = rng

    def start(self) -> None:
        self._answer, self.ready = Loaded(), self._site.clock.now

    def submit(self, job: Job, seconds: float) -> None:
        assert isinstance(job, SceneJob)
        scenario, rng, self.begun = self._site.scenario, self._rng, self._site.clock.now
        spread = math.exp(0.3 * rng.normal() - 0.3**2 / 2)
        self.batch, self.seconds = job.batch, START_S + spread * scenario.scene_seconds * len(job.pairs)
        if self.begun > scenario.turn * scenario.limit:
            self.seconds *= scenario.drift
        self._answer = Solution((), (Choice(FALLBACK_FUNDAMENTAL, Reason.SCENE),) * len(job.pairs))
        if rng.random() < scenario.scene_faults:
            self.is_faulty = True
            self._answer = Failure(Cause.DIED, "signal SIGSEGV")
            self.seconds *= (0.5, 0.3, math.inf)[rng.integers(3)]
        self.ready = self.begun + self.seconds

    def kill(self) -> None:
        self.is_over = True


def memory_journal() -> Journal:
    """A journal that leaves no file."""
    with TemporaryDirectory() as directory:
        journal = Journal(Path(directory))
        journal.continue_in_memory()
        for connection in (journal._file, journal._lock, journal._db):
            weakref.finalize(journal, connection.close)  # since 3.13, Python warns of open connections
        return journal


@dataclass(frozen=True)
class Ran:
    """What became of a scenario; ``late`` and ``lost`` must be 0.

    ``utilisation`` is what was used of what was given, of a run that did not get all done. Given are the workers'
    seconds from their start to the budget's ``stop_units``, whenever the run ended, without those that injected
    faults take from any planner (see :class:`SimulatedSite`). Used are
    the seconds of jobs whose results came back in time, warm-ups and stalls included. So idle workers, the end of
    a phase, what a lost job had done before, silence longer than a stall's, a slow unit taken to hang, and what
    is still under way at the end all count against the engine. A worker that is idle while a scene is under way is
    used.

    ``lost`` counts pairs without the sweep's F where the sweep fits (see :func:`sweep_seconds`), and versions of
    the submission that lack a row. ``missed`` are batches without a scene that no fault befell; ``scenes_fit``
    says that what is left to scenes at most suffices for all, and that none hung while others waited. ``last_job``
    is when the last job came back. ``stale`` are the batches whose scene is out of date.
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
    stale: set[str]

    @property
    def work_left(self) -> bool:
        return self.report.ending is not Ending.COMPLETE


def simulate(scenario: Scenario, journal: Journal | None = None, until: float = math.inf) -> Ran:
    """Run a scenario through the real engine, until it ends or is interrupted."""
    clock = VirtualClock()
    budget = Budget(0.0, scenario.limit, clock)
    site = SimulatedSite(scenario, clock, budget.stop_units)
    share = max(1, scenario.batches) / scenario.pairs
    pairs = [Pair(str(n), f"{int(n * share):03d}", f"{n:07d}", "b") for n in range(scenario.pairs)]
    published: list[int] = []
    interrupt = threading.Event()
    journal = memory_journal() if journal is None else journal
    nothing = Request((), scenario.recipe, scenario.settings)
    engine = Engine(nothing, site, journal, budget, interrupt=interrupt, progress=False)

    def wait(moment: float) -> None:
        whole_wait(min(moment, until))
        if clock.now >= until:
            interrupt.set()

    whole_wait, site.wait = site.wait, wait
    with engine:
        publish = lambda standing: published.append(len(standing.fundamentals))  # noqa: E731
        engine.ask(replace(nothing, pairs=pairs, publish=publish))
        report = engine.report()
    swept = int(engine.state.had[: scenario.pairs].any(1).sum())
    sweep_fits = sweep_seconds(scenario) < SWEEP_SHARE * scenario.limit
    given = len(site.of(Work.MATCH)) * (site.stop - RESTART_S) - site.faults
    faulty = {scene.batch for scene in site.scenes if scene.is_faulty}
    made = {pairs[record.index].group for record in report.records if record.scene is not None}
    return Ran(
        scenario,
        report,
        (site.kept + site.for_scenes) / given,
        max(0.0, clock.now - scenario.limit),
        sum(length != scenario.pairs for length in published) + (scenario.pairs - swept if sweep_fits else 0),
        len(set(engine.scenes.batches) - faulty - made),
        FORECAST_MARGIN * scenario.longest_scenes < RESERVE_SHARE * scenario.limit
        and not any(math.isinf(scene.seconds) for scene in site.scenes),
        site.last_job,
        tuple(site.scenes),
        set(engine.scenes.batches) - journal.current_scenes(),
    )


def sweep_seconds(scenario: Scenario) -> float:
    """What the sweep takes: with the drift from its first moment on, its stalls, warm-ups, crashes and hangs.

    The faults are those to expect; that there may be more of them is what the rest of the limit is for. Each
    takes a worker's start and warm-up, a hang also as long as a stall would.
    """
    unit = scenario.costs[0] * scenario.cached * max(1.0, scenario.drift)
    start = RESTART_S + scenario.warm_up
    stalls = scenario.stalls * (STALL - 1) * unit
    faults = (scenario.crashes + scenario.hangs) * start + scenario.hangs * STALL * unit
    faults += scenario.job_faults * (start + STALL * unit)
    return start + scenario.pairs * (unit + stalls + faults) / scenario.workers


def without_records(ran: Ran) -> Ran:
    """The run without what it found: kept of a thousand runs, that would slow down all that come after."""
    return replace(ran, report=replace(ran.report, records=()), scenes=())
