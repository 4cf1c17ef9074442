"""Run stiff and extreme cases; each passes or fails by its own criterion."""

import argparse

from .output import output
from .pool import add_workers, workers

ABOUT = "stiff and extreme cases, with a verdict on each"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("rows", nargs="*", type=int, help="numbers of rows; all without any")
    parser.add_argument("--json", type=output, metavar="FILE", help="write the certificate, for machines")
    add_workers(parser)


def main(args: argparse.Namespace) -> int:
    """Run, print and write the certificate; return 1 if a row fails."""
    from rich.console import Console

    from ..report import stress

    console = Console()
    with workers(args.workers) as executor:
        certificate = stress(rows=args.rows or None, executor=executor, progress=console.is_terminal)
    console.print(certificate)
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            file.write(certificate.json())
    return 0 if certificate.passed else 1
