"""``mkpc package``: the content of the two folders, and files that must not be in them."""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
import torch
from kaggle_image import UNPACKED, python_version, upload
from shared import contents, run_command
from weight_files import digest_of, line, put

from mkpc_kaggle import __version__
from mkpc_kaggle.cli import weights
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.package import (
    BUNDLED,
    Package,
    build_wheel,
    find_checkout,
    licence_texts,
    make_package,
)
from mkpc_kaggle.weights import load_tensors, store
from mkpc_kaggle.weights.manifest import read_manifest


def checkpoint(number: float) -> bytes:
    stream = io.BytesIO()
    torch.save({"a": torch.full((3,), number)}, stream)
    return stream.getvalue()


DATA = checkpoint(1)
OTHER = checkpoint(2)
# One file that may be published, one that may not, and one that is missing.
FILES = (
    line("free.pt", DATA, slot="free"),
    line("kept.pt", OTHER, slot="kept", licence="Magic-Leap-noncommercial"),
    line("lost.pt", b"lost", slot="lost"),
)


@pytest.fixture(scope="module", autouse=True)
def own_manifest(
    tmp_path_factory: pytest.TempPathFactory, built_once: None
) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MKPC_WEIGHTS", raising=False)
        patch.setattr(store, "KAGGLE_INPUT", tmp_path_factory.mktemp("kaggle"))
        for module in (store, weights):
            patch.setattr(module, "manifest", lambda: FILES)
        yield


def request_of(directory: Path, wheels: Path) -> dict[str, Any]:
    """The arguments of a package."""
    folder = put(put(directory / "weights", "free.pt", DATA), "kept.pt", OTHER)
    return {
        "out": directory / "out",
        "owner": "someone",
        "weights": [folder],
        "pythons": [python_version()],
        "wheels": wheels,
    }


@pytest.fixture
def wanted(tmp_path: Path, wheels: Path) -> dict[str, Any]:
    return request_of(tmp_path, wheels)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, wheels: Path) -> tuple[Path, Package]:
    """The folder of a package that tests only read, and its list of files."""
    request = request_of(tmp_path_factory.mktemp("package"), wheels)
    return request["out"], make_package(**request)


@pytest.fixture(scope="module")
def out(made: tuple[Path, Package]) -> Path:
    return made[0]


def metadata_of(out: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    dataset = (out / "dataset" / "dataset-metadata.json").read_text()
    kernel = (out / "kernel" / "kernel-metadata.json").read_text()
    return json.loads(dataset), json.loads(kernel)


def test_the_dataset_holds_wheels_weights_and_their_licences(made):
    out, package = made
    dataset = out / "dataset"
    names = {path.name for path in dataset.iterdir()}
    assert {
        "LICENSE",
        "README.md",
        "MIT.txt",
        "weights_manifest.txt",
        "requirements.txt",
    } <= names
    wheels = {name.partition("-")[0] for name in names if name.endswith(".whl")}
    assert wheels == {"mkpc_kaggle", "kornia", "pycolmap", "kornia_rs", "safetensors"}
    assert torch.equal(load_tensors(dataset / "free.pt.safetensors")["a"], torch.ones(3))
    assert not [name for name in names if name.startswith("kept.pt")]
    assert [file.name for file in package.restricted] == ["kept.pt"]
    assert licence_texts(find_checkout())["Apache-2.0"].name == "LICENSE"
    assert "MIT" in metadata_of(out)[0]["description"]
    # The version: two attached datasets differ at a glance.
    assert metadata_of(out)[0]["title"] == f"MKPC Kaggle {__version__}"
    assert [(file.name, file.licence) for file in package.weights] == [
        ("free.pt.safetensors", "MIT")
    ]
    lines = (dataset / "requirements.txt").read_text().splitlines()
    assert lines[0] == f"mkpc-kaggle=={__version__}"
    names = [line.partition("==")[0].replace("_", "-") for line in lines[1:]]
    assert sorted(names) == sorted(BUNDLED)


def test_weights_survive_the_upload_and_are_held_against_the_datasets_manifest(
    out, tmp_path, capsys
):
    dataset = out / "dataset"
    # Kaggle unpacks archives, and a torch checkpoint is one.
    assert not [path for path in dataset.iterdir() if path.suffix in UNPACKED]
    mount = tmp_path / "input" / "datasets" / "someone" / "mkpc-kaggle"
    upload(dataset, mount)
    (told,) = read_manifest(mount / "weights_manifest.txt")
    data = (mount / "free.pt.safetensors").read_bytes()
    assert told.name == "free.pt.safetensors"
    assert (told.size, told.sha256) == (len(data), digest_of(data))
    assert (told.licence, told.slot) == ("MIT", "free")
    verify = ["weights", "verify", "--weights", tmp_path / "input"]
    assert run_command(*verify) == 0
    assert "1 file, 0 refused, 0 missing" in capsys.readouterr().out
    (mount / "free.pt.safetensors").unlink()
    assert run_command(*verify) == 1
    assert "missing" in capsys.readouterr().out


def test_the_kernel_runs_on_a_gpu_without_internet_on_the_latest_image(out):
    dataset, kernel = metadata_of(out)
    assert kernel["docker_image_pinning_type"] == "latest"
    # Kaggle's limits
    assert 6 <= len(dataset["title"]) <= 50 and 20 <= len(dataset["subtitle"]) <= 80
    assert (kernel["enable_gpu"], kernel["enable_internet"]) == (True, False)
    assert kernel["model_sources"] == []
    assert kernel["dataset_sources"] == [dataset["id"]] == ["someone/mkpc-kaggle"]
    assert kernel["id"] == "someone/" + kernel["title"].lower().replace(" ", "-")
    code = (out / "kernel" / kernel["code_file"]).read_bytes()
    assert code == (find_checkout() / "notebooks" / "submission.ipynb").read_bytes()


def test_the_same_request_gives_the_same_bytes(wanted, out):
    make_package(**wanted)
    assert contents(wanted["out"]) == contents(out)
    (wanted["out"] / "dataset" / "free.pt.safetensors").write_bytes(b"broken off")
    make_package(**wanted)
    assert contents(wanted["out"]) == contents(out)


def test_a_private_package_has_all_weights_and_a_public_one_is_not_written_over_it(
    wanted, capsys
):
    arguments = ["package", "--owner", "someone", "--out", wanted["out"]]
    arguments += ["--python", python_version()]
    arguments += ["--wheels", wanted["wheels"], "--weights", wanted["weights"][0]]
    assert run_command(*arguments, "--private") == 0
    printed = capsys.readouterr().out
    assert "kaggle datasets create" in printed
    out = " ".join(printed.split())
    assert "private on Kaggle, do not share it" in out
    assert "kept.pt (Magic-Leap-noncommercial)" in out
    kept = wanted["out"] / "dataset" / "kept.pt.safetensors"
    assert torch.equal(load_tensors(kept)["a"], torch.full((3,), 2.0))
    assert run_command(*arguments) == 2
    assert "kept.pt.safetensors. Remove them" in capsys.readouterr().err
    # The folder is uploaded as it is: a restricted file that stays there would be published.
    kept.unlink()
    assert run_command(*arguments) == 0
    assert "Left out" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore:passed over")
def test_bad_requests_are_refused_before_anything_is_written(wanted, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    unread = put(tmp_path / "unread", "unread.pt", b"cut off")
    bad = {
        "cannot be a Kaggle user name": {"owner": "some one"},
        "no such directory": {"wheels": tmp_path / "nowhere"},
        f"for Python {python_version()}": {"wheels": empty},
        "--python '2.7': expected versions such as": {"pythons": ["2.7"]},
        "unread.pt cannot be read as a checkpoint": {"weights": [unread]},
    }
    (unread / "weights_manifest.txt").write_text(
        '["unread.pt"]\nslot = "x"\nlicence = "MIT"\n'
    )
    for told, other in bad.items():
        with pytest.raises(UserError, match=told):
            make_package(**wanted | other)
    assert not wanted["out"].exists()


def test_the_wheel_holds_what_a_run_needs(tmp_path):
    wheels = []
    # Times or the order of files would make each upload a new version of the dataset.
    for folder in ("one", "other"):
        build_wheel(find_checkout(), tmp_path / folder)
        wheels += (tmp_path / folder).glob("mkpc_kaggle-*.whl")
    wheel, again = wheels
    assert wheel.read_bytes() == again.read_bytes()
    names = ZipFile(wheel).namelist()
    assert {
        "mkpc_kaggle/weights_manifest.txt",
        "mkpc_kaggle/recipes/auto.toml",
        "mkpc_kaggle/package/page.md",
    } <= set(names)
    assert not [name for name in names if name.startswith(("tests/", "notebooks/"))]
