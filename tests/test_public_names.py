"""The names of ``mkpc_kaggle``: documented in sections, with examples that run."""

import doctest

import pytest
from pictures import write_two_views

import mkpc_kaggle

# The names that programs build with; the others are parts of their results and arguments.
DOCUMENTED = [
    "Box",
    "MatcherSpec",
    "Matches",
    "MkpcConfig",
    "PairMatch",
    "PairwiseMatcher",
    "Recipe",
    "TwoStageMatcher",
    "Unit",
    "critical_region",
    "reconstruct",
    "results",
]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The folder of all examples: that of ``results`` continues the run of ``reconstruct``."""
    directory = tmp_path_factory.mktemp("examples")
    write_two_views(directory)
    return directory


@pytest.mark.parametrize("name", DOCUMENTED)
def test_the_examples_of_a_public_name_run(name, home, monkeypatch):
    monkeypatch.chdir(home)
    public = getattr(mkpc_kaggle, name)
    (examples,) = doctest.DocTestFinder(recurse=False).find(public, name, globs={})
    assert examples.examples
    said = []
    result = doctest.DocTestRunner().run(examples, out=said.append)
    assert result.failed == 0, "".join(said)


def test_every_public_name_exists_and_is_listed_for_completion():
    assert sorted(mkpc_kaggle.__all__) == sorted({*mkpc_kaggle._MODULES, "__version__"})
    for name in mkpc_kaggle.__all__:
        assert getattr(mkpc_kaggle, name) is not None
    assert {*mkpc_kaggle.__all__} <= {*dir(mkpc_kaggle)}
