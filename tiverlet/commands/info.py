"""Print versions, architectures, cores and patches, for bug reports."""

import argparse

ABOUT = "versions, architectures, cores and patches"


def add(parser: argparse.ArgumentParser) -> None:
    """Add no arguments."""


def main(args: argparse.Namespace) -> int:
    """Print the table; return 0."""
    import platform
    from importlib import metadata

    from ..device import runtime
    from ..device.language import NAME
    from ..device.patches import PATCHES, enabled
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
    for name, (what, _) in PATCHES.items():
        print(f"patch          {name:10} {'on ' if name in enabled else 'off'}  {what}  (TIVERLET_PATCHES=-{name})")
    return 0
