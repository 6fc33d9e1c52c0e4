"""The source checkout that this package runs from: only there are the sources of the wheel and the notebooks."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

from mkpc_kaggle.errors import UserError


@dataclass(frozen=True)
class Checkout:
    """A directory with ``pyproject.toml`` and all that belongs to it."""

    root: Path

    @property
    def licence(self) -> Path:
        return self.root / "LICENSE"

    @property
    def pins(self) -> Path:
        """The versions of all dependencies that the tests run with, ``name==version`` a line."""
        return self.root / "requirements-dev.txt"

    @property
    def submission_notebook(self) -> Path:
        return self.root / "notebooks" / "submission.ipynb"

    def licence_text(self, tag: str) -> Path | None:
        """The text of a licence that the manifest names, if the checkout has it: those allow redistribution."""
        path = self.licence if tag == "Apache-2.0" else self.root / "licences" / f"{tag}.txt"
        return path if path.is_file() else None


def find_checkout() -> Checkout:
    """The checkout; :class:`UserError` where the package was installed from a wheel, without its sources."""
    root = Path(__file__).resolve().parents[2]
    try:
        name = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["name"]
    except (OSError, tomllib.TOMLDecodeError, KeyError):
        name = ""
    if name != "mkpc-kaggle":
        raise UserError(
            f"mkpc_kaggle was installed in {root} without its sources, which `package` builds the wheel from: "
            "clone the repository and run `python -m mkpc_kaggle package` in the clone"
        )
    return Checkout(root)
