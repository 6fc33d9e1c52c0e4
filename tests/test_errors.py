"""Texts for users."""

import pytest

from mkpc_kaggle.errors import UserError, temporary_directory


def test_the_errors_of_the_interface_have_a_name_in_it():
    import mkpc_kaggle

    with pytest.raises(mkpc_kaggle.UserError, match=r"has no journal\.sqlite"):
        mkpc_kaggle.results("nowhere")


def test_a_machine_without_a_place_for_temporary_files_is_told_in_one_line(monkeypatch):
    def none(*_: object, **__: object) -> None:
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    monkeypatch.setattr("tempfile._get_default_tempdir", none)
    monkeypatch.setattr("tempfile.tempdir", None)
    with (
        pytest.raises(UserError, match=r"no temporary directory: No usable.*set TMPDIR"),
        temporary_directory(),
    ):
        raise AssertionError
