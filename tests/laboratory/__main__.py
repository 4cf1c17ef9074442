"""Run one experiment of the laboratory, print its tables and, with --write, keep them in RESULTS.md and on pages."""

import argparse
import shlex
import sys
from importlib import import_module

from rich.console import Console

from . import pages
from .results import write

# Each module has main(args) -> an iterator over tables.
EXPERIMENTS = {
    "cases": "error against run time of all scenes with known answers (parts: beginnings of cases)",
    "speed": "frames, starts and memory of scenes of 10 to 1e6 particles, beside the pile in C (parts: scenes)",
    "peers": "pymunk and Newton on the same scenes, at the same quality (parts: scenes)",
    "edits": "first steps, copies and edits of a pile, beside pymunk and Newton",
    "worlds": "many worlds in one launch, beside one world, MuJoCo and Newton (parts: its tables)",
    "compilers": "Taichi and Quadrants, with patches and without",
    "steps": "error with up to 5120 substeps, in every precision and order (parts: beginnings of cases)",
    "granular": "piles, elastic gases and packings beside what is known of them (parts: its tables)",
    "periodic": "gases and shear flows in periodic boxes beside what is known of them",
    "rolling": "one or two spinning spheres beside pymunk, Box2D, LAMMPS and Newton",
    "gpu": "what runs on a GPU, with which bits, how fast, and how often the host waits (parts: its tables)",
    "piles": "piles of discs and boxes beside Box2D and pymunk, in turns (parts: discs, equal discs, boxes, towers)",
    "structures": "ladders, bridges, wheels, tents on ropes: strain against run time, by solver and load",
    "schedules": "which passive scenes gain energy in uneven frames and under changes of substeps, by solver (parts: scenes)",
    "pay": "what each feature costs: fields, bytes and time of the scene of demos/pay.py",
    "mutations": "faults of the past, put back one by one: which tests notice (parts: beginnings of commits)",
    "grains": "heaps, drums and silos of spinning grains, beside LAMMPS (parts: its tables)",
}


def main(words: list[str]) -> None:
    """Run an experiment."""
    shown = "\n".join(f"  {name:10} {what}" for name, what in EXPERIMENTS.items())
    parser = argparse.ArgumentParser(
        "python -m tests.laboratory", description=__doc__, epilog=shown, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=EXPERIMENTS, metavar="NAME", help="an experiment, see below")
    parser.add_argument("parts", nargs="*", help="some of its scenes, cases or tables; all without any")
    parser.add_argument("--sizes", type=int, nargs="+", default=(), metavar="N", help="numbers of particles")
    parser.add_argument("--threads", type=int, nargs="+", default=(), metavar="T", help="numbers of CPU threads")
    parser.add_argument("--pythons", nargs="+", default=(), metavar="PATH", help="other Pythons in which to look for engines")
    parser.add_argument("--quick", action="store_true", help="small sizes and few runs")
    parser.add_argument("--write", action="store_true", help="replace its section of RESULTS.md, and what pages show of it")
    args = parser.parse_args(words)
    tables, console = [], Console(width=None if sys.stdout.isatty() else 150)
    for table in import_module(f"tests.laboratory.{args.name}").main(args):
        console.print(*table.shown(), sep="\n", end="\n\n")
        tables.append(table)
    if args.write:
        write(args.name, f"python -m tests.laboratory {shlex.join(w for w in words if w != '--write')}", tables)
        pages.write()


if __name__ == "__main__":
    main(sys.argv[1:])
