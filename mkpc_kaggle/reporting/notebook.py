"""A run in a notebook: its results as pandas tables, and the interactive view of its scenes."""

from pathlib import Path

from mkpc_kaggle.engine.store.dataframes import Results, read_results
from mkpc_kaggle.reporting.view import SceneView


class RunResults(Results):
    """The tables ``pairs``, ``units`` and ``cameras`` of a run, which can also show its scenes."""

    directory: Path  # the work directory

    def show(self, root: str | Path | None = None) -> SceneView:
        """Return the view of all scenes, the last value of a notebook's cell.

        ``root`` is the directory of the images: that of ``test.csv``, or DIR of ``reconstruct``.
        Without it, the results of ``reconstruct`` still have their images; other views have none.
        Raises :class:`mkpc_kaggle.errors.UserError` if the journal is missing or damaged.
        """
        from mkpc_kaggle.reporting.report import show_run  # jinja2 is slow to import

        return show_run(self.directory, None if root is None else Path(root))


def results(directory: str | Path) -> RunResults:
    """Return the results in a work directory, during a run or after it.

    Parameters
    ----------
    directory : str or Path
        NAME.work of a submission, ``--work-dir``, or ``work_dir`` of :func:`reconstruct`.

    Returns
    -------
    RunResults
        The DataFrames ``pairs``, ``units`` and ``cameras``, and ``show()``, a view of the scenes.

    Raises
    ------
    UserError
        If the store is missing, damaged, or of another format.

    Examples
    --------
    >>> from mkpc_kaggle import reconstruct, results
    >>> models = reconstruct(["a.jpg", "b.jpg"], "sift", work_dir="work", progress=False)
    >>> tables = results("work")
    >>> tables.pairs[["image0", "image1", "model"]].values.tolist()
    [['a.jpg', 'b.jpg', 'F']]
    """
    found = RunResults(*read_results(directory))
    found.directory = Path(directory)
    return found
