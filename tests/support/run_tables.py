"""Tables of a run whose pairs a test describes, made as those of a real run."""

from dataclasses import replace

from mkpc_kaggle.engine.store.dataframes import PairTables, database_of, tables_in
from mkpc_kaggle.engine.store.tables import (
    LAYOUTS,
    PairEstimate,
    PublishedPair,
    PublishedRun,
    UnitPoints,
)

UNIT = "1:sift@640"


class Described:
    """A pair of two images with one unit. It was reached unless ``failure`` is ``None``.

    ``error`` is why the unit failed; other values are of its points, and of the pair's estimate.
    """

    def __init__(
        self,
        name: str = "a",
        images: tuple[str, str] = ("0.png", "1.png"),
        group: str = "batch",
        *,
        failure: str | None = "",
        error: str = "",
        source: str = "fallback",
        choice: str = "",
        matches: int = 0,
        inliers: int = 0,
        seconds: float = 0.0,
        **statistics: float,
    ) -> None:
        self.pair = PublishedPair(
            0,
            name,
            group,
            *images,
            points=["points" if matches else ""],
            estimate="" if failure is None else "estimate",
            source=source,
            choice=choice,
            failures={UNIT: error} if error else {},
        )
        self.estimate = PairEstimate(
            "estimate", {"points": inliers}, failure=failure or "", **statistics
        )
        self.points = UnitPoints("points", UNIT, matches, match_seconds=seconds)


def tables_of(*described: Described) -> PairTables:
    """Return the tables of these pairs."""
    rows = {PublishedRun: [PublishedRun(units=[(UNIT, 1)], rows=len(described))]}
    rows |= {PublishedPair: [], PairEstimate: [], UnitPoints: []}
    for number, each in enumerate(described):
        # A key for each pair
        points = [key and f"points {number}" for key in each.pair.points]
        estimate = each.pair.estimate and f"estimate {number}"
        named = {"number": number, "points": points, "estimate": estimate}
        rows[PublishedPair].append(replace(each.pair, **named))
        inliers = {f"points {number}": count for count in each.estimate.inliers.values()}
        key = {"key": f"estimate {number}", "inliers": inliers}
        rows[PairEstimate].append(replace(each.estimate, **key))
        rows[UnitPoints].append(replace(each.points, key=f"points {number}"))
    facts = {kind: map(LAYOUTS[kind].values, some) for kind, some in rows.items()}
    with database_of(facts) as database:
        return tables_in(database)
