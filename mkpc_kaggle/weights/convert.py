"""Checkpoints as safetensors with the same names."""

from pathlib import Path

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights.checkpoint import load_tensors
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile, directory_digest, file_digest, manifest
from mkpc_kaggle.weights.store import names_of_unpacked


def convert(source: Path, target: Path) -> WeightFile:
    """Write the tensors of ``source`` into ``target``, each a contiguous copy; returns the manifest's line for it.

    Raises :class:`UserError` if the source cannot be read, or if the target cannot be written or does not end in
    ``.safetensors``.
    """
    if target.suffix != ".safetensors":
        raise UserError(f"--out {target}: the name must end in .safetensors")
    tensors = load_tensors(source)
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    part = target.with_name(f"{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        part.unlink(missing_ok=True)  # it may be a link
        # safetensors takes no views and no two tensors that share their bytes.
        save_file({name: tensor.contiguous().clone() for name, tensor in tensors.items()}, part)
        part.replace(target)
    except KeyError as error:
        raise UserError(f"{source}: safetensors has no type for tensors of {error}") from error
    except (OSError, SafetensorError) as error:
        raise UserError(f"{target} cannot be written: {error}") from error
    return _line(source, target)


def _line(source: Path, target: Path) -> WeightFile:
    digest = directory_digest(source) if source.is_dir() else file_digest(source)
    known = _line_of(source, digest)
    licence, slot, name = (known.licence, known.slot, known.name) if known else ("?", "?", source.name)
    source_note = f"{name} ({digest}) with the same tensor names"
    return WeightFile(target.name, target.stat().st_size, file_digest(target), licence, slot, source_note)


def _line_of(source: Path, digest: str) -> WeightFile | None:
    """The manifest's line of the source: by its digest, or by its name if no digest can be compared."""
    lines = manifest()
    if source.is_dir():
        names = names_of_unpacked(source)
        return next((file for file in lines if names & {file.name, Path(file.name).stem}), None)
    by_name = [file for file in lines if (file.name, file.digest) == (source.name, UNVERIFIED)]
    return next(iter([file for file in lines if file.digest == digest] + by_name), None)
