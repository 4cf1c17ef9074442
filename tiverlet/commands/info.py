"""Print versions, architectures and cores, for bug reports."""

import argparse

ABOUT = "versions, architectures and cores"


def add(parser: argparse.ArgumentParser) -> None:
    """Add no arguments."""


def main(args: argparse.Namespace) -> int:
    """Print the table; return 0."""
    import platform
    from importlib import metadata

    from ..device import runtime
    from ..device.language import NAME
    from ..report.output import machine

    print(f"machine        {machine()}")
    for package in ("tiverlet", "taichi", "quadrants", "numpy", "rerun-sdk", "rich", "matplotlib"):
        try:
            print(f"{package:14} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            print(f"{package:14} not installed")
    print(f"system         {platform.platform()}")
    print(f"architectures  {', '.join(runtime.available())}")
    runtime.ensure_started()
    print(f"{NAME} runs on {runtime.architecture()}, {runtime.threads()} threads")
    return 0
