"""List the demos: what each shows, and how to run, play or read it."""

import argparse
import ast
import pathlib

ABOUT = "list the demos"


def add(parser: argparse.ArgumentParser) -> None:
    """Add no arguments."""


def main(args: argparse.Namespace) -> int:
    """Print one line per demo; return 0."""
    from .run import DEMOS

    found = sorted(DEMOS.glob("*.py"))
    width = max((len(path.stem) for path in found), default=0)
    for path in found:
        print(f"{path.stem:{width}}  {first_sentence(path)}")
    print(f"\ntiverlet play NAME takes one by hand, tiverlet run NAME records it; they are in {DEMOS}")
    return 0


def first_sentence(path: pathlib.Path) -> str:
    """Return the first paragraph of a script's docstring, on one line."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n\n")[0].replace("\n", " ")
