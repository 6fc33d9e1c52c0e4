"""Which images of a folder are matched with each other, and which of them are turned for it."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.engine import Ending, RunReport
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.session import Session, digest_of_pairs, run_pairs
from mkpc_kaggle.engine.tasks import run_tasks
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.reconstruction import orientation
from mkpc_kaggle.reconstruction.folder import Datasets, Ends
from mkpc_kaggle.reconstruction.likeness import PARTNERS, Partners, compare, local_features, shortlist

MAX_IMAGES = 100  # of which all pairs are matched; above, each image has a shortlist


class RunEndedError(Exception):
    """The run has ended before the pairs were known: ``report`` says how."""

    def __init__(self, ending: Ending, session: Session, faults: tuple[str, ...] = ()) -> None:
        self.report = RunReport((), ending, session.budget.spent(), 0, faults)


def choose_pairs(
    datasets: Datasets,
    assembly: Assembly,
    session: Session,
    journal: Journal,
    *,
    listed: Sequence[Ends] | None,
    rotations: bool,
) -> list[Pair]:
    """The pairs of all datasets: those ``listed``, all of up to ``MAX_IMAGES`` images, or those of a shortlist.

    ``journal`` is that of the images. With ``rotations``, the recipe's first unit tells how images lie. Raises
    :class:`RunEndedError`.
    """
    ends = {
        name: [two for two in listed or () if two[0].parent == files[0].parent] for name, files in datasets.items()
    }
    large = {name for name, files in datasets.items() if listed is None and len(files) > MAX_IMAGES}
    lying = {name for name, files in datasets.items() if rotations and (ends[name] if listed else len(files) > 1)}
    compared = {name: PARTNERS if name in large else orientation.TURN_PARTNERS for name in sorted(large | lying)}
    partners = find_partners(datasets, compared, session, journal)
    near = {name: [others[: orientation.TURN_PARTNERS] for others in partners[name]] for name in sorted(lying)}
    turns = find_turns(datasets, near, assembly, session)
    pairs = []
    for name, files in datasets.items():
        places = shortlist(partners[name]) if name in large else combinations(range(len(files)), 2)
        for a, b in [(files[i], files[j]) for i, j in places] if listed is None else ends[name]:
            turned = (turns.get(a, 0), turns.get(b, 0))
            suffix = f" turned {turned[0]} {turned[1]}" if any(turned) else ""
            pairs.append(Pair(f"{name}/{a.stem}/{b.stem}{suffix}", name, str(a), str(b), turns=turned))
    return pairs


def find_partners(
    datasets: Datasets, counts: Mapping[str, int], session: Session, journal: Journal
) -> dict[str, Partners]:
    """The images that are most like each image, so many of them, by dataset. Raises :class:`RunEndedError`."""
    directory, looks, comparisons = journal.path.parent, dict[str, Callable[[], bytes]](), {}
    for name, count in counts.items():
        keys = [f"{name}/{file.name}" for file in datasets[name]]
        looks |= {key: partial(local_features, file) for key, file in zip(keys, datasets[name], strict=True)}
        comparisons[f"{count} partners, {name}"] = partial(compare, directory, keys, count)
    if not journal.tasks().issuperset(comparisons):
        for phase, tasks in (("look", looks), ("compare", comparisons)):
            if not run_tasks(phase, tasks, journal, session):
                ending = Ending.INTERRUPTED if session.interrupt.is_set() else Ending.TIME_IS_UP
                raise RunEndedError(ending, session)
    answers = {name: journal.task(key) for name, key in zip(counts, comparisons, strict=True)}
    if lost := [f"the images of {name} were not compared" for name, answer in answers.items() if not answer]:
        raise RunEndedError(Ending.NO_WORKER, session, tuple(lost))
    return {name: json.loads(answer) for name, answer in answers.items()}


def find_turns(
    datasets: Datasets, partners: Mapping[str, Partners], assembly: Assembly, session: Session
) -> dict[Path, int]:
    """By how many quarters, counter-clockwise, images are turned. Raises :class:`RunEndedError`."""
    recipe = assembly.recipe
    assembly = replace(assembly, recipe=replace(recipe, units=recipe.units[:1], scene=None))
    found: dict[str, dict[orientation.Key, int]] = {name: {} for name in partners}
    for keys_of in (orientation.upright_keys, orientation.turned_keys):
        keys = [(name, key) for name, near in partners.items() for key in keys_of(near, found[name])]
        pairs = [orientation.pair_of(key, name, datasets[name]) for name, key in keys]
        work_dir = session.work_dir / f"turns-{digest_of_pairs(pairs)[:8]}"
        if pairs:
            report = run_pairs(pairs, assembly, replace(session, work_dir=work_dir, watchdog=None))
            if report.ending is not Ending.COMPLETE:
                raise RunEndedError(report.ending, session, report.faults)
            for (name, key), record in zip(keys, report.records, strict=True):
                found[name][key] = record.inliers
    return {
        datasets[name][i]: times
        for name, near in partners.items()
        for i, times in enumerate(orientation.turns_of(near, found[name]))
    }
