"""Shared fixtures: a small rendered data set, and a matcher whose answers are known."""

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from genuine import why_not_there
from hypothesis import HealthCheck, settings
from kaggle_image import pack_wheel
from shared import write_small_recipe

from mkpc_kaggle import package
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.demo import DemoSet, write_demo
from mkpc_kaggle.engine.frames import Results
from mkpc_kaggle.weights import store as weight_store

# Before torch is imported, here and in the processes of the tests: their tensors are small, and on
# a busy machine threads wait for each other more than they work.
os.environ.setdefault("OMP_NUM_THREADS", "1")


# A shell that starts the tests in the background lets them ignore Ctrl-C, and so would each program
# that they start. Tests send it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """A test that leaves Ctrl-C ignored would break later ones, in some orders of files."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    after = [signal.getsignal(number) for number in numbers]
    for number, handler, left in zip(numbers, before, after, strict=True):
        if left is not handler:
            signal.signal(number, handler)
    assert after == before, "the test has changed the handlers of signals"


# How long an example takes is the machine's affair; tests that are about time measure it.
settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--slow", action="store_true", help="also run the tests that take minutes"
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    reasons = {"genuine": why_not_there()}
    if not config.getoption("--slow"):
        reasons["slow"] = "takes minutes; run with --slow"
    for item in items:
        for marker, reason in reasons.items():
            if reason and marker in item.keywords:
                item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> DemoSet:
    """One scene of the demo at 40 % of its size: 7 images, 8 test pairs."""
    return write_demo(tmp_path_factory.mktemp("demo"), scenes=["courtyard"], image_scale=0.4)


@pytest.fixture(scope="session")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> "list[Pair]":
    """Twelve pairs of flat images. The matcher of :mod:`rectified` knows them by their brightness."""
    from rectified import write_pairs

    return write_pairs(tmp_path_factory.mktemp("pairs"), 12)


@pytest.fixture(scope="session")
def undisturbed(pairs: "list[Pair]", tmp_path_factory: pytest.TempPathFactory) -> "Results":
    """A run over these pairs in which nothing goes wrong."""
    from rectified import THREE_UNITS, RectifiedMatcher, run

    return run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path_factory.mktemp("undisturbed"))


@pytest.fixture(scope="session")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheels that a package for Kaggle bundles."""
    directory = tmp_path_factory.mktemp("wheels")
    for name in package.BUNDLED:
        pack_wheel(name, directory)
    return directory


@pytest.fixture(scope="module")
def built_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let all packages of a module have one wheel of ours: pip takes seconds to build it."""
    built = tmp_path_factory.mktemp("own")
    package.build_wheel(package.find_checkout(), built)

    def copied(_: Path, directory: Path) -> None:
        shutil.copytree(built, directory, dirs_exist_ok=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(package, "build_wheel", copied)
        yield


@pytest.fixture
def small_recipe(tmp_path: Path) -> Path:
    return write_small_recipe(tmp_path)


@pytest.fixture
def clean_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("MKPC_WEIGHTS", raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def nowhere_else(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Weights are searched only in the directories that a test names."""
    monkeypatch.delenv("MKPC_WEIGHTS", raising=False)
    monkeypatch.setattr(weight_store, "KAGGLE_INPUT", tmp_path / "no kaggle")
