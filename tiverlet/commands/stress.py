"""Run stiff and extreme cases; each passes or fails by its own criterion."""

import argparse

from .measuring import add_workers, measured, output, write

ABOUT = "stiff and extreme cases, with a verdict on each"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("rows", nargs="*", type=int, help="numbers of rows; all without any")
    parser.add_argument("--json", type=output, metavar="FILE", help="write the certificate, for machines")
    add_workers(parser)


def main(args: argparse.Namespace) -> int:
    """Run, print and write the certificate; return 1 if a row fails."""
    from ..report import stress

    certificate = measured(args.workers, stress, rows=args.rows or None)
    write(args.json, certificate.json)
    return 0 if certificate.passed else 1
