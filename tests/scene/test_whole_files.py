"""A file of COLMAP that is cut off is noticed, where it is written and before it is used."""

import errno
import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from benchmarks.synthetic_scene import synthetic_scene
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.export import (
    DATABASE,
    MODEL_FILES,
    HeldDirectory,
    has_files,
    require_on_disk,
)
from mkpc_kaggle.scene.sfm import reconstruct_batch
from mkpc_kaggle.scene.whole_files import is_whole_model_file

LIMIT_BYTES = 20_000


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    pairs = synthetic_scene(5, points=600).pairs
    reconstruct_batch(pairs, SceneConfig(), export=HeldDirectory.of(folder))
    return folder


@contextmanager
def small_disk() -> Iterator[None]:
    """No file may grow beyond ``LIMIT_BYTES``, as on a full disk."""
    former, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT_BYTES, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (former, most))


@pytest.mark.parametrize("name", [DATABASE, *(f"models/0/{name}" for name in MODEL_FILES)])
def test_files_that_end_too_early_are_no_files_of_a_scene(written, tmp_path, name):
    shutil.copytree(written, tmp_path, dirs_exist_ok=True)
    assert has_files(tmp_path, 1)
    path = tmp_path / name
    data = path.read_bytes()
    for size in {0, 4, 8, len(data) // 2, len(data) - 8, len(data) - 1}:
        path.write_bytes(data[:size])
        assert not has_files(tmp_path, 1), f"{size} of {len(data)} bytes"


@pytest.mark.parametrize("name", MODEL_FILES)
def test_a_damaged_count_of_records_takes_no_time(tmp_path, name):
    (tmp_path / name).write_bytes((2**60).to_bytes(8, "little") + bytes(80))
    assert not is_whole_model_file(tmp_path / name)


def test_a_full_disk_that_pycolmap_does_not_report_is_an_error(written, tmp_path):
    import pycolmap

    model = pycolmap.Reconstruction(written / "models" / "0")
    model.write(tmp_path)
    require_on_disk(tmp_path)
    with small_disk():
        model.write(tmp_path)
    assert (tmp_path / "points3D.bin").stat().st_size == LIMIT_BYTES
    with pytest.raises(OSError, match="No space left") as raised:
        require_on_disk(tmp_path)
    assert raised.value.errno == errno.ENOSPC
