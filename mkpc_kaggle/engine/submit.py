"""From a test directory to ``submission.csv``."""

from collections.abc import Sequence
from pathlib import Path

from mkpc_kaggle.data.competition import Pair, write_submission
from mkpc_kaggle.engine.engine import RunReport
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.assembly import Assembly


def submit(pairs: Sequence[Pair], assembly: Assembly, session: Session, output: Path) -> tuple[RunReport, bool]:
    """Match all pairs and keep ``output`` whole from the start: one row a pair, the fallback where no F is known.

    Returns the report, and whether every thread has come to rest. Raises
    :class:`mkpc_kaggle.errors.UserError` where ``output`` cannot be written, before any work.
    """

    def publish(records: Sequence[PairRecord]) -> None:
        write_submission(
            output, {pair.id: record.fundamental for pair, record in zip(pairs, records, strict=True)}
        )

    require_writable(output)
    return run_pairs(pairs, assembly, session, publish)


def require_writable(output: Path) -> None:
    """Make the file's directory if need be; :class:`UserError` where the file cannot be written."""
    probe = output.with_name(f".{output.name}.probe")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise UserError(f"--output {output} cannot be written: {error.strerror}") from error
