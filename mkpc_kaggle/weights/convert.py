"""Checkpoints as safetensors with the same names."""

from pathlib import Path

from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights.checkpoint import load_tensors
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile, digest_of, manifest
from mkpc_kaggle.weights.store import is_unpacked_from


def convert(source: Path, target: Path) -> WeightFile:
    """Write the tensors of ``source`` into ``target``, each a contiguous copy; returns the manifest's line for it.

    Raises :class:`UserError` if the source cannot be read, or if the target cannot be written or does not end in
    ``.safetensors``.
    """
    if target.suffix != ".safetensors":
        raise UserError(f"--out {target}: the name must end in .safetensors")
    require_apart({"--out": target}, [source])
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
    """The target's line, with what the manifest knows of the source: by its digest, or else by its name."""
    digest, lines = digest_of(source), manifest()
    known = [file for file in lines if file.digest == digest]
    known += [file for file in lines if (file.name, file.digest) == (source.name, UNVERIFIED)]
    known += [file for file in lines if source.is_dir() and is_unpacked_from(source, file)]
    licence, slot, name = (known[0].licence, known[0].slot, known[0].name) if known else ("?", "?", source.name)
    origin = f"{name} ({digest}) with the same tensor names"
    return WeightFile(target.name, target.stat().st_size, digest_of(target), licence, slot, origin)
