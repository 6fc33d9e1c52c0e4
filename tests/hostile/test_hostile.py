"""The standing attack: the real command on hostile inputs, each case in its own process (see
``attack``).
"""

import shutil
from pathlib import Path

import ends
import faults
import files
import folders
import images
import outputs
import pytest
import unread
import weight_bombs
from attack import attack
from room import write_template

SOURCES = (files, images, outputs, ends, faults, weight_bombs, folders, unread)
ALL = [case for source in SOURCES for case in source.CASES]
# The first of each of these groups runs with the other tests, which have more of the other groups.
QUICK = ("signals", "weights")
FIRST = {case.group: case for case in reversed(ALL) if case.group in QUICK}.values()
MARKED = [
    pytest.param(case, id=case.id, marks=() if case in FIRST else pytest.mark.slow)
    for case in ALL
]


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_template(tmp_path_factory.mktemp("template") / "room")


@pytest.mark.parametrize("case", MARKED)
def test_a_hostile_input_is_survived(case, template, tmp_path):
    attack(case, shutil.copytree(template, tmp_path / "room"))
