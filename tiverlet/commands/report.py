"""Measure error against run time on scenes with known answers, beside the article's scheme and textbook XPBD."""

import argparse

from .measuring import add_workers, measured, output, write

ABOUT = "error against run time on scenes with known answers"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("cases", nargs="*", help="names or beginnings of names, such as D01 or S; all without any")
    parser.add_argument("--list", action="store_true", help="list the cases")
    parser.add_argument("--quick", action="store_true", help="a few substeps and one timed run of each")
    parser.add_argument("--json", type=output, metavar="FILE", help="write all points, for machines")
    parser.add_argument("--markdown", type=output, metavar="FILE", help="write all columns, and all points of each case")
    parser.add_argument("--plot", metavar="FOLDER", help="write a log-log plot of each case (needs matplotlib)")
    add_workers(parser)


def main(args: argparse.Namespace) -> int:
    """Measure, print and write the report; return 1 if a case fails its criterion."""
    from ..report import CASES, error_vs_time

    if args.list:
        for name, case in CASES.items():
            print(f"{name:36} {case.title}")
        return 0
    report = measured(args.workers, error_vs_time, args.cases or None, quick=args.quick)
    write(args.json, report.json)
    write(args.markdown, report.markdown)
    if args.plot:
        report.plot(args.plot)
    return 1 if report.failures else 0
