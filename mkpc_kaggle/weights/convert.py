"""Any checkpoint that can be read, as safetensors with the same names."""

from pathlib import Path

from mkpc_kaggle.data.outputs import require_no_input
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights.checkpoint import load_tensors
from mkpc_kaggle.weights.digests import file_digests
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile, manifest
from mkpc_kaggle.weights.unpacked import digest_of, names_of


def convert(source: Path, target: Path) -> WeightFile:
    """Write the tensors of ``source`` into ``target``, each a contiguous copy; gives the manifest's line for it.

    Raises :class:`UserError` for a source that cannot be read, and a target that cannot be written or whose name
    does not end in ``.safetensors``.
    """
    if target.suffix != ".safetensors":
        raise UserError(f"--out {target}: the name must end in .safetensors")
    require_no_input({"--out": target}, [source])
    tensors = load_tensors(source)
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    partial = target.with_name(f"{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial.unlink(missing_ok=True)  # it may be a link
        # safetensors takes no views and no two tensors that share their bytes.
        save_file({name: tensor.contiguous().clone() for name, tensor in tensors.items()}, partial)
        partial.replace(target)
    except KeyError as error:
        raise UserError(f"{source}: safetensors has no type for tensors of {error}") from error
    except (OSError, SafetensorError) as error:
        raise UserError(f"{target} cannot be written: {error}") from error
    return _line(source, target)


def _line(source: Path, target: Path) -> WeightFile:
    made = file_digests(target)
    digest = digest_of(source) if source.is_dir() else file_digests(source).sha256
    known = next(filter(None, (_known_by_digest(source), _known_by_name(source))), None)
    licence, slot, name = (known.licence, known.slot, known.name) if known else ("?", "?", source.name)
    return WeightFile(
        target.name, made.size, made.sha256, licence, slot, f"{name} ({digest}) with the same tensor names"
    )


def _known_by_digest(source: Path) -> WeightFile | None:
    if source.is_dir():
        return None
    origin = file_digests(source)
    return next((file for file in manifest() if origin.have(file.digest)), None)


def _known_by_name(source: Path) -> WeightFile | None:
    """The line that names the file and has no digest, or that names what was unpacked into the directory."""
    if source.is_dir():
        return next((file for file in manifest() if names_of(source) & {file.name, Path(file.name).stem}), None)
    return next((file for file in manifest() if (file.name, file.digest) == (source.name, UNVERIFIED)), None)
