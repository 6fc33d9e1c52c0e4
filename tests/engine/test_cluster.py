"""What --workers means, and what it says where Ray cannot be had."""

import sys
from pathlib import Path

import pytest
from rectified import THREE_UNITS, RectifiedMatcher, run, write_pairs

from mkpc_kaggle.cli.options import parse_workers
from mkpc_kaggle.errors import UserError


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("0", 0),
        ("12", 12),
        ("ray", "ray"),
        ("ray://10.0.0.1:6379", "ray://10.0.0.1:6379"),
    ],
)
def test_the_forms_of_the_option_are_read(text: str, meant: int | str) -> None:
    assert parse_workers(text) == meant


@pytest.mark.parametrize(
    "text",
    ["-1", "1000", "two", "ray:", "ray://", "ray://host", "ray://host:port", "ssh://host:1"],
)
def test_other_forms_are_refused_with_the_known_ones(text: str) -> None:
    with pytest.raises(UserError) as refusal:
        parse_workers(text)
    told = str(refusal.value)
    for form in ("a number of processes", "ray (", "ray://HOST:PORT"):
        assert form in told


def test_without_ray_the_message_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As if it were not installed: the import fails.
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r'pip install "mkpc-kaggle\[ray\]"'):
        run(
            write_pairs(tmp_path, 1),
            THREE_UNITS,
            RectifiedMatcher(),
            tmp_path / "w",
            workers="ray",
        )
