"""Conversion of checkpoints to safetensors with the same tensor names."""

from pathlib import Path

from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights.checkpoint import load_tensors
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile, digest_of, manifest
from mkpc_kaggle.weights.store import is_unpacked_from


def convert(source: Path, target: Path, known: WeightFile | None = None) -> WeightFile:
    """Write contiguous copies of the tensors of ``source`` to ``target``; return its line of a manifest.

    ``known`` is the manifest's line of the source; by default it is found by digest, then by name. Raises
    :class:`UserError` if the source cannot be read, the target cannot be written, or its name does not end in
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
        # safetensors refuses views and tensors that share their bytes.
        save_file({name: tensor.contiguous().clone() for name, tensor in tensors.items()}, part)
        part.replace(target)
    except KeyError as error:
        raise UserError(f"{source}: safetensors has no type for tensors of {error}") from error
    except (OSError, SafetensorError) as error:
        raise UserError(f"{target} cannot be written: {error}") from error
    known = known or _line_of(source) or WeightFile(source.name, -1, UNVERIFIED, "?", "?", "")
    origin = f"{known.name} ({digest_of(source)}) with the same tensor names"
    return WeightFile(target.name, target.stat().st_size, digest_of(target), known.licence, known.slot, origin)


def _line_of(source: Path) -> WeightFile | None:
    digest, lines = digest_of(source), manifest()
    known = [file for file in lines if file.digest == digest]
    known += [file for file in lines if (file.name, file.digest) == (source.name, UNVERIFIED)]
    known += [file for file in lines if source.is_dir() and is_unpacked_from(source, file)]
    return next(iter(known), None)
