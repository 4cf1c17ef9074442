"""Measure speed, memory and start-up of scenes with 10 to a million particles, beside a pile in C and other engines."""

import argparse

from .output import output

ABOUT = "speed, memory and starts; beside a pile in C, and other engines"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "scenes", nargs="*", help="pile, settled, rough, spheres, cloth, ropes, rope, mixed; none: all; or worlds"
    )
    parser.add_argument("--sizes", type=int, nargs="+", metavar="N", help="numbers of particles; default: a ladder of each scene")
    parser.add_argument("--threads", type=int, nargs="+", metavar="T", help="numbers of CPU threads; default 1, 2, 4, ... all")
    parser.add_argument("--arch", default="cpu", help="cpu, cuda, metal or vulkan (default cpu)")
    parser.add_argument("--list", action="store_true", help="list the scenes and their sizes")
    parser.add_argument("--quick", action="store_true", help="two small sizes of each, and few runs")
    parts = {"yardstick": "pile.c", "peers": "other engines", "absent": "the package without unused files", "waits": "edits"}
    for name, what in parts.items():
        parser.add_argument(f"--no-{name}", dest=name, action="store_false", help=f"without {what}")
    parser.add_argument("--compilers", action="store_true", help="Taichi beside Quadrants, and nothing else")
    parser.add_argument("--json", type=output, metavar="FILE", help="write everything, for machines")
    parser.add_argument("--markdown", type=output, metavar="FILE", help="write the tables")
    parser.add_argument("--plot", metavar="FOLDER", help="write plots (needs matplotlib)")


def main(args: argparse.Namespace) -> int:
    """Measure, print and write the report; return 1 if something could not be measured."""
    from rich.console import Console

    from ..report import SpeedReport, speed
    from ..report.speed import SCENES
    from ..report.speed.worlds import TITLE, worlds

    console = Console()
    if args.list:
        for name, scene in SCENES.items():
            sizes = ", ".join(f"{n:,}" for n in scene.sizes)
            console.print(f"{name:8} {scene.title}, {scene.substeps} substeps; {sizes} particles", highlight=False)
        console.print(f"{'worlds':8} {TITLE}", highlight=False)
        return 0
    if args.compilers:
        from ..report.speed.compilers import SIZES, compilers

        console.print(compilers(tuple(args.sizes or SIZES)))
        return 0
    report = worlds(tuple(args.threads or ()), args.quick, args.peers) if args.scenes == ["worlds"] else speed(
        args.scenes or None, sizes=args.sizes, threads=args.threads, arch=args.arch, quick=args.quick, yardstick=args.yardstick,
        peers=args.peers, absent=args.absent, waits=args.waits, progress=console.is_terminal,
    )  # fmt: skip
    console.print(report)
    for path, text in ((args.json, report.json), (args.markdown, report.markdown)):
        if path:
            with open(path, "w", encoding="utf-8") as file:
                file.write(text())
    if args.plot and isinstance(report, SpeedReport):
        report.plot(args.plot)
    return 1 if report.missing else 0
