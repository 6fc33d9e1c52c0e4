"""Time limits of workers: the seconds after which a worker that starts, or computes a job, counts as hung.

The loop asks again at every turn while a job runs, because costs become known. :func:`time_limit` adds the
silence that is always allowed, 2 % of the limit of the run but 5 to 60 s, to:

- Matching: 30 times the mean seconds of the job's units, for each pair, and their longest warm-up once. Until all
  are measured: a quarter of the time that is left, an hour at most. A feature of an image always has that quarter.
- Estimates: 30 times the mean; until it is known, 30 s a pair, and no more than that quarter.
- A scene: 30 times the seconds expected from other scenes, at least of 3 s and 0.5 ms per match.

A start (:func:`start_limit`) has 300 s for matchers; other workers have that quarter, at least the silence and at
most 300 s.

:meth:`mkpc_kaggle.engine.workers.places.Place.poll` ends a worker that has not answered by then: its process
gets SIGKILL (a Ray actor is killed by Ray), and its job is lost. A worker in a thread of the user's process
cannot be killed: the run continues without its answer. At the end of the run's time
(``Budget.stop_waiting``) and after Ctrl-C, the loop ends all workers, whether they hang or not.
"""

from mkpc_kaggle.engine.jobs import EstimateJob, FeatureJob, Job, MatchJob, SceneJob
from mkpc_kaggle.engine.plan.budget import ESTIMATE, SCENE_MATCH_S, SCENE_START_S, Budget, Costs

# A job that takes this multiple of its measured cost hangs. Stalls of twenty times the cost, as in the
# simulator, must not cost a worker.
HANG_FACTOR = 30.0
# A job of unknown cost that takes longer than this share of the time left hangs. A first job may be
# slow (a warm-up, a slow disk), but the rest of the run must be able to make up for it.
UNKNOWN_SHARE = 0.25
MAX_UNKNOWN_S = 3600.0  # without a limit, no share is finite
# Expected seconds of an estimate that was not measured yet: eight permutations of 50,000 iterations
# of MAGSAC take 0.7 s, and a busy machine is slower.
UNMEASURED_ESTIMATE_S = 1.0
MATCHERS_START_S = 300.0  # for a worker to load its matchers, which is slow from a network disk


def time_limit(job: Job, costs: Costs, budget: Budget, since: float) -> float:
    """Return the seconds after ``since``, the beginning of a job, within which its worker must answer.

    See the head of this module. :attr:`Budget.silence` is added.
    """
    match job:
        case MatchJob():
            seconds = unknown_seconds(budget, since)
            # A warm-up alone says little: it may take a hundred times as long as a later run, or less.
            if all(costs.is_known(unit.name) for unit in job.units):
                of_pair = sum(costs.mean(unit.name) for unit in job.units)
                seconds = HANG_FACTOR * len(job.indices) * of_pair + costs.warm_up(job.units)
        case EstimateJob():
            of_pair = costs.mean(ESTIMATE)
            seconds = HANG_FACTOR * len(job.pairs) * (of_pair or UNMEASURED_ESTIMATE_S)
            # A hung first estimate must not use up a short limit.
            if not of_pair:
                seconds = min(seconds, unknown_seconds(budget, since))
        case SceneJob():
            # Small scenes measured so far say little about the time of a large one.
            unmeasured = SCENE_START_S + SCENE_MATCH_S * job.matches
            seconds = HANG_FACTOR * max(costs.scene(job.matches), unmeasured)
        case FeatureJob():
            # An arbitrary function
            seconds = unknown_seconds(budget, since)
    return budget.silence + seconds


def start_limit(budget: Budget, now: float, *, loads_matchers: bool) -> float:
    """Return the seconds within which a worker must have started."""
    if loads_matchers:
        return MATCHERS_START_S
    return min(MATCHERS_START_S, max(budget.silence, unknown_seconds(budget, now)))


def unknown_seconds(budget: Budget, since: float) -> float:
    """Return the seconds that work of unknown cost may take from ``since``."""
    left = max(0.0, budget.stop_units - since)
    return min(MAX_UNKNOWN_S, UNKNOWN_SHARE * left)
