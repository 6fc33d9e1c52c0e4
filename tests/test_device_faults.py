"""Devices that fail and memory that is short, injected into real runs."""

import os
from functools import partial
from pathlib import Path

import pytest
from faulty import (
    BrokenDeviceMatcher,
    NarrowMatcher,
    RefusingMatcher,
    pipeline_in_batches,
    pipeline_telling_its_environment,
)
from mkpc_kaggle.engine.pools import pool
from mkpc_kaggle.engine.pools.pool import Pool
from mkpc_kaggle.engine.pools.process import WORKER_ENVIRONMENT
from rectified import THREE_UNITS, RectifiedMatcher, process_place, run, write_pairs

from mkpc_kaggle.cli import main
from mkpc_kaggle.data.competition import Pair, read_test_side, submission_problems
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.engine import session
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.engine import Ending, RunReport
from mkpc_kaggle.engine.session import Interrupt, Session, run_pairs
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline import assembly as assemblies
from mkpc_kaggle.pipeline.assembly import Assembly, assemble
from mkpc_kaggle.pipeline.devices import require_device
from mkpc_kaggle.pipeline.failures import Failure, failure_of, reason_of
from mkpc_kaggle.reporting.summary import trouble

COUNT = 12


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> list[Pair]:
    return write_pairs(tmp_path_factory.mktemp("pairs"), COUNT)


@pytest.fixture(scope="module")
def undisturbed(pairs: list[Pair], tmp_path_factory: pytest.TempPathFactory) -> RunReport:
    return run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path_factory.mktemp("undisturbed"))


def matrices(report: RunReport) -> list[bytes]:
    return [record.pair_fundamental.tobytes() for record in report.records]


def assembly_of(matcher: RectifiedMatcher) -> Assembly:
    return assemble(THREE_UNITS, matchers={matcher.name: matcher}, device="cpu")


def test_what_errors_mean() -> None:
    import torch

    cuda = "CUDA error: {}\nCUDA kernel errors might be asynchronously reported at some other API call"
    told = {
        Failure.OUT_OF_MEMORY: [
            MemoryError(),
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB."),
            RuntimeError(
                "[enforce fail at alloc_cpu.cpp:117] err == 0. DefaultCPUAllocator: can't allocate memory"
            ),
            RuntimeError(cuda.format("out of memory")),
            RuntimeError(cuda.format("CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`")),
            RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED"),
            RuntimeError("cuDNN error: CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED"),
            RuntimeError("FIND was unable to find an engine to execute this computation"),
            RuntimeError("GET was unable to find an engine to execute this computation"),
        ],
        Failure.DEVICE: [
            RuntimeError(cuda.format("an illegal memory access was encountered")),
            RuntimeError(cuda.format("no kernel image is available for execution on the device")),
            RuntimeError(cuda.format("CUBLAS_STATUS_EXECUTION_FAILED when calling `cublasSgemm( handle )`")),
            RuntimeError("cuDNN error: CUDNN_STATUS_EXECUTION_FAILED"),
            RuntimeError("No CUDA GPUs are available"),
        ],
        Failure.ORDINARY: [RuntimeError("shapes differ"), ValueError("no points"), AssertionError()],
    }
    for failure, errors in told.items():
        assert [failure_of(error) for error in errors] == [failure] * len(errors)
    illegal = told[Failure.DEVICE][0]
    illegal.add_note("in 1:loftr@840")
    assert reason_of(illegal) == (
        "RuntimeError: CUDA error: an illegal memory access was encountered, in 1:loftr@840"
    )


def test_a_device_that_fails_once_costs_a_worker_and_no_unit(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path
) -> None:
    matcher = BrokenDeviceMatcher(marker=tmp_path / "broken")
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "work", workers=1)
    assert report.ending is Ending.COMPLETE
    assert [fault.partition(" (")[0] for fault in report.faults] == [
        "a job was lost: the device failed: RuntimeError: CUDA error: an illegal memory access was encountered, "
        "in 1:rectified@96"
    ]
    assert matrices(report) == matrices(undisturbed)
    assert not any(unit.failure for record in report.records for unit in record.units)
    assert trouble(report) == ""


@pytest.mark.parametrize("workers", [0, 1])
def test_a_device_that_fails_for_good_ends_the_run_and_a_healthy_one_goes_on(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int
) -> None:
    monkeypatch.setattr(pool, "MOST_DEVICE_FAILURES", 2)
    matcher = BrokenDeviceMatcher(marker=tmp_path / "broken", for_good=True)
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "work", workers=workers)
    assert report.ending is Ending.NO_WORKER
    assert "the run failed: no worker left" in trouble(report)
    assert 0 < sum(bool(record.units) for record in report.records) < COUNT
    assert not any(unit.failure for record in report.records for unit in record.units)
    resumed = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert resumed.ending is Ending.COMPLETE
    assert matrices(resumed) == matrices(undisturbed)


def test_a_device_without_kernels_leaves_the_work_to_the_cpu_and_a_line(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "MOST_STARTS", 1)
    assembly = assembly_of(RectifiedMatcher()).on("cuda:99")
    plan = Session(tmp_path / "work", Budget(0.0), Interrupt(), progress=False, workers=None)
    told = "no worker could be started but on the CPU: cuda:99 cannot be used"
    with pytest.warns(UserWarning, match=told):
        report, _ = run_pairs(pairs, assembly, plan)
    assert report.ending is Ending.COMPLETE
    assert [told in fault for fault in report.faults] == [True]
    assert matrices(report) == matrices(undisturbed)


def test_a_device_is_tried_before_anything_is_loaded() -> None:
    require_device("cpu")
    with pytest.raises(UserError, match=r"cuda:99 cannot be used \(.*\); on Kaggle choose .* T4 x2"):
        assembly_of(RectifiedMatcher()).on("cuda:99").pipeline()


def test_a_batch_that_memory_is_too_short_for_is_halved_once_and_no_worker_lost(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def in_batches(assembly: Assembly, _: object) -> Pool:
        return Pool([process_place(partial(pipeline_in_batches, assembly, 8))], assembly.recipe)

    monkeypatch.setattr(session, "pool_of", in_batches)
    matcher = NarrowMatcher(most=2, sizes=tmp_path / "sizes")
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "work", workers=1)
    assert report.faults == ()
    assert matrices(report) == matrices(undisturbed)
    sizes = (tmp_path / "sizes").read_text().split()
    # Of the job of eight pairs one runs alone: the first measures a unit's warm-up, the second its cost.
    assert sorted(size for size in sizes if int(size) > 2) == ["3", "3", "3", "7", "7", "7"], "once a unit"


@pytest.mark.parametrize(
    ("broken", "told"),
    [
        (False, "errors left 8 of 8 pairs without an F, 8 of them with this one: ValueError: no such layer"),
        (True, "no worker left, the faults say why; the same command goes on"),
    ],
)
def test_a_run_that_failed_has_exit_status_one_and_a_line(
    demo: DemoSet,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    broken: bool,
    told: str,
) -> None:
    matcher = BrokenDeviceMatcher(marker=tmp_path / "broken", for_good=True) if broken else RefusingMatcher()
    monkeypatch.setattr(assemblies, "assemble", lambda *_, **__: assembly_of(matcher))
    output = tmp_path / "submission.csv"
    command = [
        "submit",
        "--test-dir",
        str(demo.test_dir),
        "--output",
        str(output),
        "--workers",
        "0",
        "--no-report",
    ]
    assert main(command) == 1
    assert f"the run failed: {told}" in capsys.readouterr().out
    assert submission_problems(output, [pair.id for pair in read_test_side(demo.test_dir)]) == []


def test_workers_are_told_not_to_spin_and_to_use_huge_pages_and_nobody_else_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in WORKER_ENVIRONMENT:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("GOMP_SPINCOUNT", "7")
    make = partial(pipeline_telling_its_environment, assembly_of(RectifiedMatcher()), tmp_path / "told")
    pool = Pool([process_place(make)], THREE_UNITS)
    assert pool.start() == ""
    assert pool.close()
    assert (tmp_path / "told").read_text() == "PASSIVE, 7, 1"
    assert {name: os.environ[name] for name in WORKER_ENVIRONMENT if name in os.environ} == {"GOMP_SPINCOUNT": "7"}
