"""``mkpc package``: the content of the two folders, and files that must not be in them."""

import io
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
import torch
from checkpoints import FILES as FILES_OF_PAPER
from checkpoints import write_checkpoints
from kaggle_image import UNPACKED, environment, python_version, upload
from shared import contents, run_command
from weight_files import digest_of, line, put

from mkpc_kaggle import __version__
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.package import package
from mkpc_kaggle.package.files import licence_text
from mkpc_kaggle.package.package import Package, PackageRequest, find_checkout, make_package
from mkpc_kaggle.package.wheels import BUNDLED, build_wheel, install_lines, pins
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
    replace(line("kept.pt", OTHER, slot="kept"), licence="Magic-Leap-noncommercial"),
    line("lost.pt", b"lost", slot="lost"),
)


@pytest.fixture(scope="module", autouse=True)
def own_manifest(tmp_path_factory: pytest.TempPathFactory, built_once: None) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MKPC_WEIGHTS", raising=False)
        patch.setattr(store, "KAGGLE_INPUT", tmp_path_factory.mktemp("kaggle"))
        patch.setattr(store, "manifest", lambda: FILES)
        yield


def request_of(directory: Path, wheels: Path) -> PackageRequest:
    # Renamed files are packaged under the manifest's name.
    weights = put(directory / "weights", "another_name.pt", DATA)
    put(weights, "kept.pt", OTHER)
    return PackageRequest(directory / "out", "someone", (weights,), (python_version(),), wheels)


@pytest.fixture
def wanted(tmp_path: Path, wheels: Path) -> PackageRequest:
    return request_of(tmp_path, wheels)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, wheels: Path) -> tuple[Path, Package]:
    """The folder of a package that tests only read, and its list of files."""
    request = request_of(tmp_path_factory.mktemp("package"), wheels)
    return request.out, make_package(request)


@pytest.fixture(scope="module")
def out(made: tuple[Path, Package]) -> Path:
    return made[0]


def metadata_of(out: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    dataset = (out / "dataset" / "dataset-metadata.json").read_text()
    kernel = (out / "kernel" / "kernel-metadata.json").read_text()
    return json.loads(dataset), json.loads(kernel)


def test_a_licence_tag_names_a_text_of_licences_and_no_other_file():
    # Tags come from a manifest that anybody may have written; the dataset may be public.
    checkout = find_checkout()
    assert licence_text(checkout, "MIT") == checkout / "licences" / "MIT.txt"
    assert licence_text(checkout, "Apache-2.0") == checkout / "LICENSE"
    absolute = str(checkout / "licences" / "MIT")
    for tag in ("../requirements-dev", "../licences/MIT", absolute, "", "no-such"):
        assert licence_text(checkout, tag) is None


def test_the_dataset_holds_wheels_weights_and_their_licences(made):
    out, package = made
    dataset = out / "dataset"
    names = {path.name for path in dataset.iterdir()}
    assert {"LICENSE", "README.md", "MIT.txt", "weights_manifest.txt", "requirements.txt"} <= names
    wheels = {name.partition("-")[0] for name in names if name.endswith(".whl")}
    assert wheels == {"mkpc_kaggle", "kornia", "pycolmap", "kornia_rs", "safetensors"}
    assert torch.equal(load_tensors(dataset / "free.pt.safetensors")["a"], torch.ones(3))
    assert not [name for name in names if name.startswith("kept.pt")]
    assert [item.name for item in package.restricted] == ["kept.pt"]
    assert "MIT" in metadata_of(out)[0]["description"]
    # The version: two attached datasets differ at a glance.
    assert metadata_of(out)[0]["title"] == f"MKPC Kaggle {__version__}"
    assert {item.name: item.licence for item in package.dataset}["free.pt.safetensors"] == "MIT"


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
    assert (told.size, told.digest) == (len(data), digest_of(data))
    assert (told.licence, told.slot) == ("MIT", "free")
    verify = ["weights", "verify", "--weights", tmp_path / "input"]
    verify += ["--manifest", mount / "weights_manifest.txt"]
    assert run_command(*verify) == 0
    assert "1 file, 0 refused, 0 missing" in capsys.readouterr().out
    (mount / "free.pt.safetensors").unlink()
    assert run_command(*verify) == 1
    assert "missing" in capsys.readouterr().out


def test_a_package_of_the_image_stays_if_its_version_fits_even_without_a_wheel_for_its_python(
    out, tmp_path
):
    dataset = out / "dataset"
    lines = (dataset / "requirements.txt").read_text().splitlines()
    assert lines[0].startswith("mkpc-kaggle==")
    assert not [line for line in lines[1:] if "==" in line], "ranges, not pins"
    assert "kornia>=0.8.3" in lines
    # kornia is installed here, so its wheel is not needed.
    for path in dataset.glob("[!k]*.whl"):  # all but kornia and kornia-rs
        (tmp_path / path.name).symlink_to(path)
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--no-index", "--no-deps"]
    command += ["--find-links", str(tmp_path), *lines[1:]]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment())
    assert done.returncode == 0, done.stderr


def test_the_kernel_runs_on_a_gpu_without_internet_on_the_latest_image_or_one_by_its_digest(
    out, wanted
):
    dataset, kernel = metadata_of(out)
    assert kernel["docker_image_pinning_type"] == "latest"
    assert not kernel.get("docker_image")
    image = f"gcr.io/kaggle/python@sha256:{'0a' * 32}"
    make_package(replace(wanted, image=image))
    pinned = metadata_of(wanted.out)[1]
    assert pinned["docker_image_pinning_type"] == "original"
    assert pinned["docker_image"] == image
    # Kaggle's limits
    assert 6 <= len(dataset["title"]) <= 50 and 20 <= len(dataset["subtitle"]) <= 80
    assert (kernel["enable_gpu"], kernel["enable_internet"]) == (True, False)
    assert kernel["model_sources"] == []
    assert kernel["dataset_sources"] == [dataset["id"]] == ["someone/mkpc-kaggle"]
    assert kernel["id"] == "someone/" + kernel["title"].lower().replace(" ", "-")
    code = (out / "kernel" / kernel["code_file"]).read_bytes()
    assert code == (find_checkout() / "notebooks" / "submission.ipynb").read_bytes()


def test_without_weights_the_notebook_asks_for_no_gpu(wanted):
    # Hours of GPU are limited, and RootSIFT uses none.
    make_package(replace(wanted, weights=()))
    kernel = metadata_of(wanted.out)[1]
    assert kernel["enable_gpu"] is False
    assert "machine_shape" not in kernel


def test_matchers_may_come_from_kaggle_models(wanted):
    make_package(replace(wanted, weights=(), models=True))
    kernel = metadata_of(wanted.out)[1]
    assert kernel["model_sources"] == [
        "oldufo/aliked/pyTorch/aliked-n16/1",
        "oldufo/lightglue/pyTorch/aliked/1",
    ]
    assert kernel["enable_gpu"] is True


def test_the_page_of_the_dataset_has_no_relative_links(out):
    # It was the README, with broken pictures and links.
    page = (out / "dataset" / "README.md").read_text(encoding="utf-8")
    assert "Licences of the weights: MIT." in page
    assert "](" not in page


def test_the_same_request_gives_the_same_bytes_and_leaves_files_alone(wanted, out):
    make_package(wanted)
    assert contents(wanted.out) == contents(out)
    former = {path: path.stat().st_mtime_ns for path in wanted.out.rglob("*") if path.is_file()}
    (wanted.out / "dataset" / "free.pt.safetensors").write_bytes(b"broken off")
    make_package(wanted)
    written = []
    # Weights are gigabytes: a file with the right bytes is not written again.
    for path, modified in former.items():
        if path.stat().st_mtime_ns != modified:
            written.append(path.name)
    assert written == ["free.pt.safetensors"]
    assert contents(wanted.out) == contents(out)


def test_a_private_package_has_all_weights_and_a_public_one_is_not_written_over_it(wanted, capsys):
    arguments = ["package", "--owner", "someone", "--out", wanted.out, "--python", python_version()]
    arguments += ["--wheels", wanted.wheels, "--weights", wanted.weights[0]]
    assert run_command(*arguments, "--private") == 0
    printed = capsys.readouterr().out
    assert "kaggle datasets create" in printed
    assert "kaggle datasets version" not in printed, "nothing was uploaded before"
    out = " ".join(printed.split())
    assert "private on Kaggle, do not share it" in out
    assert "kept.pt (Magic-Leap-noncommercial)" in out
    kept = wanted.out / "dataset" / "kept.pt.safetensors"
    assert torch.equal(load_tensors(kept)["a"], torch.full((3,), 2.0))
    assert run_command(*arguments) == 2
    assert "kept.pt.safetensors. Remove them" in capsys.readouterr().err
    # The folder is uploaded as it is: a restricted file that stays there would be published.
    kept.unlink()
    assert run_command(*arguments) == 0
    printed = capsys.readouterr().out
    assert "Left out" in printed
    assert f"  kaggle datasets version -p {wanted.out}/dataset" in printed, "the second upload"


def test_bad_requests_are_refused_before_anything_is_written(wanted, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    other_image = "python@sha256:12"
    damaged = put(tmp_path / "damaged", "free.pt", DATA[:-1])
    long = f"3.{'9' * 100}"
    bad = {
        "cannot be a Kaggle user name": replace(wanted, owner="some one"),
        "give latest, original, or an image as NAME@sha256:DIGEST": replace(
            wanted, image=other_image
        ),
        "no such directory": replace(wanted, wheels=tmp_path / "nowhere"),
        f"for Python {python_version()}": replace(wanted, wheels=empty),
        "--python '2.7': expected versions of Python 3": replace(wanted, pythons=("2.7",)),
        f"--python '3.{'9' * 18}': expected": replace(wanted, pythons=(long,)),
        "truncated": replace(wanted, weights=(damaged,)),
    }
    for told, request in bad.items():
        with pytest.raises(UserError, match=told):
            make_package(request)
    assert not wanted.out.exists()


def test_weights_that_no_network_takes_are_refused_and_others_named_with_their_matchers(
    wanted, monkeypatch
):
    (weights,) = wanted.weights
    (weights / "kept.pt").unlink()
    lines = write_checkpoints(weights, FILES_OF_PAPER[:2])
    monkeypatch.setattr(store, "manifest", lambda: lines)
    package = make_package(replace(wanted, private=True))
    notes = {item.name: item.note for item in package.dataset}
    assert [notes[f"{file.name}.safetensors"] for file in lines] == ["fits superglue"] * 2
    misfit = line("free.pt", DATA, slot="dkm-outdoor")
    monkeypatch.setattr(store, "manifest", lambda: (*lines, misfit))
    says = r"another_name\.pt: the weights for 'dkm-outdoor' do not fit the network: .* also has a"
    # Before the upload of gigabytes, and not in the kernel's log.
    with pytest.raises(UserError, match=says):
        make_package(replace(wanted, private=True))


def test_the_wheel_holds_what_a_run_needs_and_asks_for_what_is_bundled(tmp_path, wheels):
    wheel = build_wheel(find_checkout(), tmp_path / "one")
    # Times or the order of files would make each upload a new version of the dataset.
    again = build_wheel(find_checkout(), tmp_path / "other")
    assert wheel.read_bytes() == again.read_bytes()
    lines = install_lines(wheel, wheels.iterdir())
    asked = [line.replace("_", "-").partition(">=")[0] for line in lines]
    pinned = [pin.partition("==") for pin in pins(find_checkout())]
    bundled = sorted(name.replace("_", "-") for name, _, version in pinned if version)
    assert sorted(asked[1:]) == sorted(BUNDLED) == bundled
    names = ZipFile(wheel).namelist()
    assert {"mkpc_kaggle/weights_manifest.txt", "mkpc_kaggle/recipes/auto.toml"} <= set(names)
    assert not [name for name in names if name.startswith(("tests/", "notebooks/"))]


def test_an_installed_copy_packages_the_clone_that_it_is_called_in(tmp_path, monkeypatch):
    clone = find_checkout()
    site = tmp_path / "site-packages"
    monkeypatch.setattr(package, "__file__", str(site / "mkpc_kaggle" / "package" / "package.py"))
    monkeypatch.chdir(clone)
    assert find_checkout() == clone
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="run `mkpc package` in a clone"):
        find_checkout()
    # A clone that was updated after the installation
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "notebooks" / "submission.ipynb").touch()
    (tmp_path / "mkpc_kaggle").mkdir()
    (tmp_path / "mkpc_kaggle" / "version.py").write_text('__version__ = "99.0"\n')
    with pytest.raises(UserError, match="another version"):
        find_checkout()
