"""Names of files that a command writes once it is done."""

import argparse
import pathlib


def output(name: str) -> str:
    """Return the name of a file that can be written: the `type` of an argument, so that a command fails before it measures."""
    path = pathlib.Path(name)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{name} is a folder, but the name of a file is needed.")
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"the folder {path.parent} of {name} does not exist; make it first.")
    return name
