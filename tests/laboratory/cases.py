"""All cases with known answers, beside the article's scheme and textbook XPBD: the table of `tiverlet report --markdown`."""

from collections.abc import Iterator

from tiverlet.report import error_vs_time
from tiverlet.report.output import Table


def main(args) -> Iterator[Table]:
    """Yield the table of all columns."""
    yield error_vs_time(args.parts or None, quick=args.quick, progress=True).wide()
