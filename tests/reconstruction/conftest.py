"""Pages of these runs have one picture: tests/reporting counts pictures."""

from collections.abc import Iterator

import pytest

from mkpc_kaggle.reporting import page


@pytest.fixture(scope="module", autouse=True)
def one_picture() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "MAX_PICTURES", 1)
        yield
