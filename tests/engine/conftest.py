"""Fixtures of the tests of the store: a run whose answers are given by the test."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from rectified import SECOND, SWEEP
from store_room import Room

from mkpc_kaggle.engine.store import Store


@pytest.fixture
def room(tmp_path: Path) -> Iterator[Room]:
    with Store.open(tmp_path) as store:
        yield Room(store)


@pytest.fixture
def whole(room: Room) -> Room:
    """Two of three pairs with points, estimates and a scene."""
    for index in (0, 1):
        room.match(index, SWEEP, SECOND)
        room.estimate(index)
    room.reconstruct()
    room.publish()
    return room
