"""A place: when it is closed, on workers that answer as they are told."""

import os
import threading
from types import SimpleNamespace

import pytest
from store_room import RECIPE

from mkpc_kaggle.engine import places
from mkpc_kaggle.engine.places import Kind, LocalSite, Place
from mkpc_kaggle.engine.process import ThreadWorker
from mkpc_kaggle.engine.request import Cause, Failure, Loaded, MatchJob, MatchPlan
from mkpc_kaggle.engine.store import Source
from mkpc_kaggle.engine.worker import scene_runner
from mkpc_kaggle.pipeline.pair import PairMatch

DONE = (PairMatch(failure="unreadable"),)


def job():
    return MatchJob((), RECIPE, Source(), MatchPlan(0, [0], [], [], 1.0, []))


def place_of(waiting):
    """A place whose workers give these answers."""
    worker = SimpleNamespace(
        start=lambda: None,
        submit=lambda *_: None,
        kill=lambda: None,
        answer=lambda: waiting.pop(0),
    )
    return Place("cpu", lambda: worker)


def test_a_thread_that_cannot_start_is_an_answer(monkeypatch):
    # Containers limit the number of threads. An exception here would end the run.
    def no_thread(_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", no_thread)
    place = Place("scene", lambda: ThreadWorker("scene", scene_runner, lambda: None))
    place.start(0.0)
    assert place.poll(0.0, 9.0) == Failure(Cause.NOT_STARTED, "can't start new thread")


def test_an_answer_that_has_arrived_counts_even_after_its_limit():
    # The loop may have been busy, so the limit is checked only if no answer is waiting.
    place = place_of([Loaded(), DONE])
    place.start(0.0)
    place.poll(0.0, 9.0)
    place.submit(job(), now=0.0)
    assert place.poll(99.0, 10.0) is DONE
    assert place.worker is not None, "it is not killed"


def test_a_worker_that_does_not_answer_in_time_is_ended_and_an_idle_one_may_wait():
    place = place_of([Loaded(), None, None])
    place.start(0.0)
    place.poll(0.0, 9.0)
    assert place.poll(99.0, 9.0) is None
    place.submit(job(), now=100.0)
    assert place.poll(110.0, 9.0) == Failure(Cause.TIMED_OUT, "no answer for 10 s")
    assert place.worker is None


@pytest.mark.parametrize(
    ("devices", "workers", "shares"),
    [
        (("cpu",), None, [1]),
        (("cpu",), 2, [2, 2]),
        (("cuda:0",), None, [1]),
        (("cuda:0", "cuda:1"), None, [2, 2]),
        (("cuda:0", "cuda:1"), 4, [4] * 4),
    ],
)
def test_the_workers_of_a_machine_share_its_cores_on_gpus_too(
    monkeypatch, devices, workers, shares
):
    made = SimpleNamespace(pipeline=None, minibatch=1)
    assembly = SimpleNamespace(devices=devices, on=lambda *_: made, on_cpu=lambda: made)
    worker = lambda name, make, *_: SimpleNamespace(share=make.args[1].keywords["share"])  # noqa: E731
    monkeypatch.setattr(places, "ProcessWorker", worker)
    site = LocalSite(assembly, workers, lambda: 0.0)
    assert [place.make().share for place in site.of(Kind.MATCH)] == shares
    assert [place.make().share for place in site.fallback] == [1] * (devices != ("cpu",))


@pytest.mark.parametrize(
    ("cores", "devices", "workers", "scenes"),
    [
        (8, ("cpu",), None, 1),
        (8, ("cuda:0",), None, 7),
        (8, ("cuda:0", "cuda:1"), None, 6),
        (1, ("cuda:0",), None, 1),
    ],
)
def test_scenes_have_the_cores_that_matching_leaves_free_and_estimates_those_of_the_container(
    monkeypatch, cores, devices, workers, scenes
):
    made = SimpleNamespace(pipeline=None, minibatch=1)
    assembly = SimpleNamespace(devices=devices, on=lambda *_: made, on_cpu=lambda: made)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(os, "cpu_count", lambda: 64)  # of the whole machine
    site = LocalSite(assembly, workers, lambda: 0.0)
    assert site.scenes_beside == scenes
    assert len(site.of(Kind.SCENE)) == cores
    assert len(site.of(Kind.ESTIMATE)) == max(1, cores // 4)


def test_the_cpu_that_takes_over_has_its_own_sizes_and_all_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    gpu = SimpleNamespace(pipeline=None, minibatch=8)
    cpu = SimpleNamespace(pipeline=None, minibatch=1)
    assembly = SimpleNamespace(devices=("cuda:0",), on=lambda *_: gpu, on_cpu=lambda: cpu)
    site = LocalSite(assembly, None, lambda: 0.0)
    assert [place.minibatch for place in site.of(Kind.MATCH)] == [8]
    assert site.scenes_beside == 7
    site.fall_back()
    assert [place.minibatch for place in site.of(Kind.MATCH)] == [1]
    assert site.scenes_beside == 1
    assert site.fallback == []
