"""What each feature costs: the scene of demos/pay.py, which has one feature more in each row."""

from collections.abc import Iterator

import tiverlet as tv
from demos.pay import priced
from tiverlet.report.output import Table

HEADS = ("scene", "fields", "bytes per particle", "ms per frame")


def main(args) -> Iterator[Table]:
    """Yield the price list."""
    tv.init(threads=1)
    yield price_list(10 if args.quick else 60)


def price_list(frames: int) -> Table:
    """Return the table; without frames, the times are not measured."""
    rows = [(name, str(fields), f"{size:.0f}", f"{ms:.2f}") for name, fields, size, ms in priced(frames)]
    notes = ["Medians of CPU time; compare the times with each other only."]
    return Table("4000 discs in 2D, f32, 20 substeps, one thread", HEADS, rows, notes)
