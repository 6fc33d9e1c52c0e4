"""The standing attack: the real command on hostile inputs, each case in a process of its own (see ``attack``)."""

import shutil
from pathlib import Path

import ends
import fetches
import folders
import images
import journals
import outputs
import pytest
import settings
import tables
import unread
import weight_bombs
from attack import Case, attack
from room import write_template

ALL: list[Case] = [
    case
    for group in (tables, images, outputs, ends, journals, weight_bombs, settings, fetches, folders, unread)
    for case in group.CASES
]
QUICK = (  # these run with the other tests
    "images: png: its first half",
    "images: a pipe",
    "tables: a batch further above",
    "tables: bytes that are not UTF-8",
    "limits: --time-limit nan",
    "outputs: the table",
    "signals: SIGINT after 0.6 s",  # while modules are imported
    "signals: SIGTERM after 1.5 s",
    "signals: SIGINT to all after 3.0 s",
    "journals: its first half, resumed",
    "journals: noise after its head, read",
    "recipes: deep tables",
    "weights: a bytearray of 6 GB",
    "fetches: a redirection to a file",
    "fetches: a link for the part",
    "arguments: check of a submission of NaN",
    "arguments: an owner that is a path",
    "figures: a photograph's name without its suffix",
    "exports: a link to an image",
    "demos: a train side of the user's",
    "unread: submit in a worker: a colour profile that is too short",
    "folders: database.db of the user's",
    "folders: a folder's name: Latin 1",
    "folders: again: an ending that was changed",
)


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_template(tmp_path_factory.mktemp("template") / "room")


@pytest.mark.parametrize(
    "case", [pytest.param(case, id=case.id, marks=() if case.id in QUICK else pytest.mark.slow) for case in ALL]
)
def test_a_hostile_input_is_survived(case, template, tmp_path):
    attack(case, shutil.copytree(template, tmp_path / "room"))


def test_the_names_of_cases_are_unique_and_the_quick_ones_are_among_them():
    names = {case.id for case in ALL}
    assert len(names) == len(ALL)
    assert set(QUICK) <= names
