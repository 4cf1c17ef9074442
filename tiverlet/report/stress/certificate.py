"""The certificate: every row of the stiff and extreme matrix, with its case, criterion, figure and verdict."""

import json
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ..jobs import done, finishing
from ..output import Report, Table, error_line
from .rows import ROWS

if TYPE_CHECKING:
    from ...world import World

PASSED, KNOWN, FAILED = "passed", "known fault", "FAILED"
COLORS = {PASSED: "", KNOWN: "yellow", FAILED: "red"}


@dataclass(frozen=True)
class Result:
    """The result of one row: case, criterion, figure and verdict. figure: what was seen. failing: what does not hold.

    A known fault counts as passed: it is declared by its row, with the reason, and fails once it no longer shows.
    """

    number: int
    what: str
    criterion: str
    figure: str
    verdict: str
    failing: tuple[str, ...]
    seconds: float

    @property
    def line(self) -> str:
        """The verdict in a line, with what does not hold."""
        return "; ".join([f"{self.number:4} {self.verdict} {self.seconds:5.1f} s  {self.what}", *self.failing])


class Certificate(Report):
    """The results of rows. print() shows a table; see .passed, .markdown(), .json()."""

    width = 160

    def __init__(self, results: Sequence[Result]):
        self.results = sorted(results, key=lambda r: r.number)

    @property
    def passed(self) -> bool:
        """Whether no row has failed."""
        return all(r.verdict != FAILED for r in self.results)

    @property
    def summary(self) -> str:
        """The counts of verdicts, as text."""
        count = Counter(r.verdict for r in self.results)
        known = f"{count[KNOWN]} with a known fault, " * (count[KNOWN] > 0)
        return f"{count[PASSED]} of {len(self.results)} passed, {known}{count[FAILED]} failed."

    def tables(self) -> Iterator[Table]:
        """Yield the table of all rows."""
        rows = [(str(r.number), r.what, r.criterion, r.figure, "; ".join([r.verdict, *r.failing])) for r in self.results]
        heads, styles = ("#", "case", "criterion", "figure", "verdict"), [COLORS[r.verdict] for r in self.results]
        yield Table("Stiff and extreme cases", heads, rows, [self.summary], heads, styles)

    def json(self) -> str:
        """Return the certificate as JSON."""
        return json.dumps({"passed": self.passed, "rows": [asdict(r) for r in self.results]}, indent=1)


def certify(number: int) -> Result:
    """Run one row. Argument and result are plain data, so that any executor can run this function."""
    row, clock, seen, wrong = ROWS[number], perf_counter(), [], []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # extreme scenes cause warnings; rows about warnings catch them
            for what, holds in row.attempt():
                (seen if holds else wrong).append(what)
    except Exception as error:
        wrong.append(error_line(error))
    verdict = FAILED if wrong or not seen else PASSED
    if row.known and wrong:
        verdict, wrong = KNOWN, [row.known, *wrong]
    elif row.known:
        verdict, wrong = FAILED, [f"this fault no longer shows, strike it here: {row.known}"]
    return Result(row.number, row.what, row.criterion, "; ".join(seen), verdict, tuple(wrong), perf_counter() - clock)


def stress(
    world: "World | None" = None, *, rows: Iterable[int] | None = None, executor: Any = None, progress: bool = False, **more
):  # fmt: skip
    """Test stiff and extreme cases: the rows of the matrix, or perturbations of the scene of the user's own world.

    world: None for the matrix; else its scene is perturbed with the further arguments, see perturbed() in robustness.py.
    rows: numbers; None for all. executor: an object with submit(), as in concurrent.futures, whose workers run the rows (start
    method "spawn"). progress: print the verdict on each row as it finishes. Returns a Certificate, in which a row whose worker
    died has failed; or, for a world, an Endurance.
    """
    if world is not None:
        from .robustness import perturbed

        return perturbed(world, **more)
    chosen = sorted(ROWS) if rows is None else list(rows)
    for number in chosen:
        if number not in ROWS:
            raise ValueError(f"stress: rows has {number!r}, but they are {min(ROWS)} to {max(ROWS)}.")
    results = []
    with finishing("stiff and extreme cases", len(chosen), progress) as say:
        for number, result, why in done(certify, chosen, executor):
            row = ROWS[number]
            results.append(result or Result(number, row.what, row.criterion, "", FAILED, (why,), 0.0))
            say(results[-1].line)
    return Certificate(results)
