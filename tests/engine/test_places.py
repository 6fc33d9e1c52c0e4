"""A place: when it is closed, on workers that answer as they are told."""

import os
import threading
from types import SimpleNamespace

import pytest
from rectified import THREE_UNITS, RectifiedMatcher, run, write_pairs

from mkpc_kaggle.engine.jobs import Cause, Failure, Loaded, MatchJob, Outcome, Phase
from mkpc_kaggle.engine.workers import places
from mkpc_kaggle.engine.workers.places import LocalSite, Place, Work
from mkpc_kaggle.engine.workers.process import ThreadWorker
from mkpc_kaggle.engine.workers.worker import scene_runner

LOST = Failure(Cause.DIED)
DONE = (Outcome(failure="unreadable"),)
RAISED = Failure(Cause.RAISED)


def job():
    names = (("a.png", "b.png"),)
    return MatchJob(Phase.DEEPEN, (0,), (), (), 1.0, names=names)


def place_of(waiting):
    """A place whose workers give these answers."""
    worker = SimpleNamespace(
        start=lambda: None,
        submit=lambda *_: None,
        kill=lambda: None,
        answer=lambda: waiting.pop(0),
    )
    return Place("cpu", lambda: worker)


@pytest.mark.parametrize(
    ("answers", "is_closed"),
    [
        # A letter is a lost job with this item, for any cause.
        ("AB", False),
        ("ABC", True),
        (["A", "B", DONE, "C", "D"], False),
        # An ordinary error that a worker reports is an answer: its device works.
        (["A", "B", RAISED, "C", "D"], False),
        ([DONE, "A", "B", "C"], True),
        # The same item is one loss, however often, and so is a minibatch with it.
        ("AAAA", False),
        (["A", "AB", "ABC"], False),
        (["AB", "C", "DE"], True),
        # An item at fault says nothing about the place.
        ("ABX", False),
        (["AB", "CX", "DX", "E"], False),
    ],
)
@pytest.mark.parametrize("cause", [Cause.DIED, Cause.TIMED_OUT, Cause.DEVICE, Cause.OUT_OF_MEMORY])
def test_three_different_items_lost_in_a_row_with_no_answer_between_close_a_place(
    answers, is_closed, cause
):
    waiting = []
    place = place_of(waiting)
    for answer in answers:
        if place.worker is None:
            place.start(0.0, 9.0)
            waiting.append(Loaded())
            place.poll(0.0)
        waiting.append(Failure(cause) if isinstance(answer, str) else answer)
        place.submit(job(), 1.0, now=0.0)
        place.poll(0.0)
        if isinstance(answer, str):
            items = [("unit", 0, letter) for letter in answer]
            place.lose(items, Failure(cause), 0.0, given_up={("unit", 0, "X")})
    assert bool(place.closed) == is_closed


def test_a_worker_that_cannot_start_counts_as_a_loss():
    waiting = [Failure(Cause.DEVICE)] * 2
    place = place_of(waiting)
    place.lose([("unit", 0, "A")], LOST, 0.0, ())
    for _ in range(2):
        assert not place.closed
        place.start(0.0, 9.0)
        place.poll(0.0)
    assert place.closed == "cpu: the device failed"


def test_a_thread_that_cannot_start_is_an_answer(monkeypatch):
    # Containers limit the number of threads. An exception here would end the run.
    def no_thread(_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", no_thread)
    place = Place("scene", lambda: ThreadWorker("scene", scene_runner, lambda: None))
    place.start(0.0, 9.0)
    assert place.poll(0.0) == Failure(Cause.NOT_STARTED, "can't start new thread")


def test_an_answer_that_has_arrived_counts_even_after_its_limit():
    # The loop may have been busy, so the limit is checked only if no answer is waiting.
    place = place_of([Loaded(), DONE])
    place.start(0.0, 9.0)
    place.poll(0.0)
    place.submit(job(), 10.0, now=0.0)
    assert place.poll(now=99.0) is DONE
    assert place.worker is not None, "it is not killed"


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
    worker = lambda name, make, ring: SimpleNamespace(share=make.keywords["share"])  # noqa: E731
    monkeypatch.setattr(places, "ProcessWorker", worker)
    site = LocalSite(assembly, workers, lambda: 0.0)
    assert [place.make().share for place in site.of(Work.MATCH)] == shares
    assert [place.make().share for place in site.fallback] == [1] * (devices != ("cpu",))


@pytest.mark.parametrize(
    ("cores", "devices", "workers", "scenes"),
    [
        (8, ("cpu",), None, (1, 8)),
        (8, ("cuda:0",), None, (7, 8)),
        (8, ("cuda:0", "cuda:1"), None, (6, 8)),
        (1, ("cuda:0",), None, (1, 1)),
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
    while_matching = site.scenes_at_a_time(is_matching=True)
    afterwards = site.scenes_at_a_time(is_matching=False)
    assert (while_matching, afterwards) == scenes
    assert len(site.of(Work.SCENE)) == cores
    assert len(site.of(Work.ESTIMATE)) == max(1, cores // 4)


def test_the_cpu_that_takes_over_has_its_own_sizes_and_all_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    gpu = SimpleNamespace(pipeline=None, minibatch=8)
    cpu = SimpleNamespace(pipeline=None, minibatch=1)
    assembly = SimpleNamespace(devices=("cuda:0",), on=lambda *_: gpu, on_cpu=lambda: cpu)
    site = LocalSite(assembly, None, lambda: 0.0)
    assert [place.minibatch for place in site.of(Work.MATCH)] == [8]
    assert site.scenes_at_a_time(is_matching=True) == 7
    site.fall_back()
    assert [place.minibatch for place in site.of(Work.MATCH)] == [1]
    assert site.scenes_at_a_time(is_matching=True) == 1
    assert site.fallback == []


def test_workers_in_threads_leave_the_limits_of_the_users_process_as_they_are(tmp_path):
    import cv2
    from threadpoolctl import threadpool_info, threadpool_limits

    # Numbers that the workers would not set themselves
    former = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        with threadpool_limits(2):
            run(
                write_pairs(tmp_path, 2),
                THREE_UNITS,
                RectifiedMatcher(),
                tmp_path / "work",
                workers=0,
            )
            assert cv2.getNumThreads() == 3
            assert 2 in [pool["num_threads"] for pool in threadpool_info()]
    finally:
        cv2.setNumThreads(former)
