"""Devices that fail, memory that is short, workers that are lost: what counts against what, what
takes over.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from faulty import (
    ASSERTED,
    BROKEN,
    FaultyMatcher,
    NarrowMatcher,
    PoisonedMatcher,
    break_device,
    breaks_after,
    exhaust_gpu,
    lack_an_image,
    thread_place,
    use_places,
)
from rectified import SECOND, SWEEP, THIRD, THREE_UNITS, RectifiedMatcher, matrices, run

from mkpc_kaggle.cli import main, options
from mkpc_kaggle.data.competition import read_test_side, submission_problem
from mkpc_kaggle.engine.frames import Results
from mkpc_kaggle.engine.places import Place
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.failures import DeviceError, FailureKind, failure_kind, reason_of
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.setup.assembly import Assembly, assemble

COUNT = 12


VICTIM = 3  # brightness 13


def test_each_error_is_a_kind_of_failure_by_its_text():
    import torch

    # PyTorch has one class, RuntimeError, for most errors of a device: only the text differs.
    cuda = "CUDA error: {}\nCUDA kernel errors might be asynchronously reported at some other API call"
    messages = {
        FailureKind.OUT_OF_MEMORY: [
            "[enforce fail at alloc_cpu.cpp:117] err == 0. DefaultCPUAllocator: can't allocate memory",
            cuda.format("out of memory"),
            "cuDNN error: CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED",
            # cuDNN's words if its workspace does not fit
            "FIND was unable to find an engine to execute this computation",
        ],
        FailureKind.DEVICE: [
            cuda.format("an illegal memory access was encountered"),
            cuda.format("no kernel image is available for execution on the device"),
            cuda.format(
                "CUBLAS_STATUS_EXECUTION_FAILED when calling `cublasSgemm( handle )`"
            ),
            "cuDNN error: CUDNN_STATUS_EXECUTION_FAILED",
            "No CUDA GPUs are available",
        ],
        FailureKind.RAISED: ["shapes differ"],
    }
    for kind, texts in messages.items():
        assert {failure_kind(RuntimeError(text)) for text in texts} == {kind}
    for error in (
        MemoryError(),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB."),
    ):
        assert failure_kind(error) is FailureKind.OUT_OF_MEMORY
    for error in (ValueError("no points"), AssertionError()):
        assert failure_kind(error) is FailureKind.RAISED
    # One line for the report: without CUDA's advice, and with the unit's name.
    illegal = RuntimeError(cuda.format("an illegal memory access was encountered"))
    illegal.add_note("in 1:loftr@840")
    assert reason_of(illegal) == f"RuntimeError: {BROKEN}, in 1:loftr@840"


@pytest.fixture
def run_at(pairs, tmp_path, monkeypatch) -> Callable[..., Results]:
    """A run whose workers are at these places."""

    def run_there(*places: Place, fallback: Sequence[Place] = ()) -> Results:
        use_places(monkeypatch, *places, fallback=fallback)
        return run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")

    return run_there


def assert_as_if_nothing_had_failed(report: Results, undisturbed: Results) -> None:
    assert report.ending is Ending.COMPLETE
    assert matrices(report) == matrices(undisturbed)
    assert set(report.units["failure"]) == {""}


@pytest.mark.parametrize(
    "gpus",
    [
        # A broken CUDA context stays broken: each GPU fails from some pair on.
        [
            RectifiedMatcher(matches=breaks_after(2)),
            RectifiedMatcher(matches=breaks_after(3)),
        ],
        [RectifiedMatcher(matches=lambda _: exhaust_gpu())],
    ],
)
def test_the_cpu_takes_over_when_the_last_gpu_fails_or_has_no_memory_for_any_unit(
    run_at, undisturbed, gpus
):
    places = [thread_place(f"cuda:{number}", matcher) for number, matcher in enumerate(gpus)]
    report = run_at(*places, fallback=[thread_place("cpu", RectifiedMatcher())])
    assert_as_if_nothing_had_failed(report, undisturbed)


def test_a_device_that_fails_once_costs_a_worker_and_no_unit(run_at, undisturbed, tmp_path):
    report = run_at(
        thread_place("cuda:0", FaultyMatcher(fault=break_device, once=tmp_path / "broken"))
    )
    assert report.about.faults == [
        f"a job was lost on cuda:0: the device failed: RuntimeError: {BROKEN}, in 1:rectified@96"
    ]
    assert_as_if_nothing_had_failed(report, undisturbed)


@pytest.mark.parametrize(
    "error",
    [
        "CUDA error: device-side assert triggered",
        "cusolver error: CUSOLVER_STATUS_EXECUTION_FAILED, when calling `cusolverDnSgesvdj(...)`",
    ],
)
@pytest.mark.parametrize("gpus", [1, 2])
def test_a_pair_that_fails_on_each_gpu_costs_its_own_units_and_no_gpu(
    run_at, undisturbed, error, gpus
):
    def fail() -> None:
        raise RuntimeError(error)

    cpu = RectifiedMatcher()
    places = [
        thread_place(f"cuda:{number}", FaultyMatcher(fault=fail, seconds=0.01))
        for number in range(gpus)
    ]
    report = run_at(*places, fallback=[thread_place("cpu", cpu)])
    assert report.ending is Ending.WITH_FAILURES
    assert cpu.calls == []
    assert [place.name for place in places if place.closed] == []
    lost = report.units.query("failure != ''")
    assert lost["unit"].tolist() == [unit.name for unit in THREE_UNITS.units]
    assert set(lost["pair"]) == {report.pairs["pair"][VICTIM]}
    assert lost["failure"].str.startswith(f"the device failed: RuntimeError: {error}").all()
    assert matrices(report)[:VICTIM] == matrices(undisturbed)[:VICTIM]
    assert matrices(report)[VICTIM + 1 :] == matrices(undisturbed)[VICTIM + 1 :]


@pytest.mark.parametrize("first", [ASSERTED, "index 7 is out of bounds"])
@pytest.mark.parametrize(("gpus", "minibatch"), [(1, 1), (2, 8)])
def test_a_pair_that_spoils_its_process_costs_no_other_pair_a_unit(
    run_at, undisturbed, monkeypatch, gpus, minibatch, first
):
    # After a device-side assert, each call in this process fails, also for good pairs.
    monkeypatch.setattr(Assembly, "minibatch", minibatch)

    def started() -> Pipeline:
        matcher = PoisonedMatcher(first=first, seconds=0.002)
        load = {matcher.name: matcher}.__getitem__
        return Pipeline(
            THREE_UNITS, load, minibatch=minibatch, synchronise=matcher.synchronise
        )

    cpu = RectifiedMatcher()
    places = [thread_place(f"cuda:{n}", cpu, pipeline=started) for n in range(gpus)]
    report = run_at(*places, fallback=[thread_place("cpu", cpu)])
    assert (cpu.calls, [place.name for place in places if place.closed]) == ([], [])
    failed = report.units.query("failure != ''")
    assert set(failed["pair"]) == {report.pairs["pair"][VICTIM]}
    reasons = {reason.partition(", in ")[0] for reason in failed["failure"]}
    assert reasons == {f"the device failed: RuntimeError: {ASSERTED}"}
    assert matrices(report)[:VICTIM] == matrices(undisturbed)[:VICTIM]
    assert matrices(report)[VICTIM + 1 :] == matrices(undisturbed)[VICTIM + 1 :]


def test_a_pair_on_which_a_device_failed_is_matched_by_a_healthy_one(run_at, undisturbed):
    broken = RectifiedMatcher(matches=breaks_after(2))
    # Slow enough that the other one gets pairs
    healthy = RectifiedMatcher(seconds=0.02)
    report = run_at(thread_place("cuda:0", broken), thread_place("cuda:1", healthy))
    assert report.about.faults
    assert all("cuda:0: the device failed" in fault for fault in report.about.faults)
    assert_as_if_nothing_had_failed(report, undisturbed)


def test_a_unit_too_large_for_the_memory_is_skipped_on_that_pair_alone_and_tried_by_the_next_run(
    run_at, undisturbed
):
    # Views above 100 pixels of the victim: its sweep at 96 succeeds.
    report = run_at(thread_place("cuda:0", FaultyMatcher(fault=exhaust_gpu, above=100)))
    assert report.ending is Ending.WITH_FAILURES
    victim = report.pairs.loc[VICTIM]
    units = report.units
    failures = units[units["pair"] == victim["pair"]].set_index("unit")["failure"]
    assert failures[SWEEP.name] == ""
    assert failures[[SECOND.name, THIRD.name]].str.startswith("out of memory").all()
    assert victim["inliers"] > 100, "it keeps the F that it has"
    assert matrices(report)[:VICTIM] == matrices(undisturbed)[:VICTIM]
    assert matrices(report)[VICTIM + 1 :] == matrices(undisturbed)[VICTIM + 1 :]
    # Failures are not stored, so a run on a larger GPU tries them.
    again = run_at(thread_place("cuda:0", RectifiedMatcher()))
    assert matrices(again) == matrices(undisturbed)


def test_a_minibatch_too_large_for_the_memory_is_halved_once_and_no_worker_is_lost(
    run_at, undisturbed
):
    matcher = NarrowMatcher(most=2)
    report = run_at(thread_place("cuda:0", matcher, minibatch=8))
    assert report.about.faults == []
    assert_as_if_nothing_had_failed(report, undisturbed)
    # Each further try of the large size would repeat the failure.
    too_large = [size for size in matcher.sizes if size > 2]
    assert len(too_large) == 2 * len(THREE_UNITS.units), (
        "seven or eight, and three or four: once a unit"
    )


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (
            lack_an_image,
            "8 of 8 pairs got no F because of errors; the most frequent (8): KeyError: 'image 7'",
        ),
        (break_device, "no worker left, the faults say why; the same command resumes"),
    ],
)
def test_a_run_that_failed_has_exit_status_one_and_a_line(
    demo, tmp_path, monkeypatch, capsys, fault, told
):
    matcher = RectifiedMatcher(matches=lambda _: fault())
    use_places(monkeypatch, thread_place("this process", matcher))
    made = assemble(THREE_UNITS, matchers={matcher.name: matcher}, device="cpu")
    monkeypatch.setattr(options, "assemble", lambda *_, **__: made)
    output = tmp_path / "submission.csv"
    command = [
        "submit",
        "--test-dir",
        str(demo.test_dir),
        "--output",
        str(output),
        "--no-report",
    ]
    assert main(command) == 1
    assert f"the run failed: {told}" in capsys.readouterr().out
    # Failed, but complete: on Kaggle a file with fallback rows still scores.
    assert (
        submission_problem(output, [pair.id for pair in read_test_side(demo.test_dir)]) == ""
    )


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (DeviceError("cuda:0 cannot be used"), "the device failed: cuda:0 cannot be used"),
        (
            UserError("weights of another network"),
            "the matchers cannot be loaded: weights of another network",
        ),
        (ValueError("no such layer"), "the worker failed: ValueError: no such layer"),
    ],
)
def test_workers_that_cannot_be_loaded_end_the_run_before_any_work(run_at, error, told):
    def fail() -> Any:
        raise error

    with pytest.raises(UserError, match=f"no worker could be started: cpu: {told}"):
        run_at(thread_place("cpu", RectifiedMatcher(), pipeline=fail))


def test_a_matcher_that_a_worker_cannot_load_costs_its_units_alone_and_is_told_once(
    pairs, undisturbed, tmp_path, monkeypatch, capsys
):
    # The parent checks weights without loading them all, so a worker may be the first to see it.
    def load(name: str) -> RectifiedMatcher:
        if name == "broken":
            raise ValueError("no such layer")
        return RectifiedMatcher()

    other = Unit(1, "broken", 120)
    recipe = replace(THREE_UNITS, units=(SWEEP, other, SECOND, THIRD))
    use_places(
        monkeypatch,
        thread_place("cpu", RectifiedMatcher(), pipeline=partial(Pipeline, recipe, load)),
    )
    report = run(
        pairs,
        recipe,
        RectifiedMatcher(),
        tmp_path / "work",
        more=[RectifiedMatcher(name="broken")],
    )
    assert_as_if_nothing_had_failed(report, undisturbed)
    assert report.about.faults == ["broken is left out: ValueError: no such layer"]
    assert capsys.readouterr().err.count("no such layer") == 1
    assert set(report.pairs["units"]) == {3}


def test_a_worker_that_cannot_be_started_again_ends_the_run_with_all_rows(run_at):
    broken = RectifiedMatcher(matches=breaks_after(5))
    made = []

    def once() -> Any:
        made.append(broken)
        if len(made) > 1:
            raise UserError("the weights are gone")
        return Pipeline.of(
            assemble(THREE_UNITS, matchers={broken.name: broken}, device="cpu")
        )

    report = run_at(thread_place("cpu", broken, pipeline=once))
    assert report.ending is Ending.NO_WORKER
    assert "cpu: the matchers cannot be loaded: the weights are gone" in report.about.faults
    assert report.pairs["units"][0] > 0
    assert len(report.pairs) == COUNT
