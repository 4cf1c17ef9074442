"""Run a demo or your own script, and record what its Recorder writes or, if it has none, its first world."""

import argparse
import contextlib
import os
import pathlib
import runpy
import sys
from collections.abc import Iterator
from typing import Any

from .scripts import as_script, color

ABOUT = "run a demo or script, and record it"
# The folder beside the package in a checkout, or in the installed package.
DEMOS = next((p / "demos" for p in pathlib.Path(__file__).parents[1:3] if (p / "demos").is_dir()), pathlib.Path("demos"))


def add(parser: argparse.ArgumentParser) -> None:
    """Add the script, and where to record it."""
    parser.add_argument("script", help="a .py file, or the name of a demo")
    parser.add_argument("--out", metavar="FILE.rrd", help="default: the name of the script, here")
    parser.add_argument("--live", nargs="?", const=True, default=False, choices=("web",), help="watch it meanwhile")
    parser.add_argument("--color", type=color, metavar="NAME[,LEAST,MOST]", help="of particles, by a quantity such as speed")
    parser.add_argument("arguments", nargs="*", help="passed on to the script")


def main(args: argparse.Namespace) -> int:
    """Run and record the script; return its exit status."""
    from ..recording import replay
    from ..recording.sink import check_replaceable

    path = find(args.script)
    out = args.out or f"{path.stem}.rrd"
    check_replaceable(out)
    if not os.path.isdir(os.path.dirname(os.path.abspath(out))):
        raise FileNotFoundError(f"The folder of {out} does not exist.")
    with recording(out, args.live, args.color) as made:
        status = execute(path, args.arguments)
    if made:
        print(f"{replay(out).text} {os.path.getsize(out)} bytes.")
    else:
        print(f"{path.name} made no step, so nothing was recorded.", file=sys.stderr)
    return status


def execute(path: pathlib.Path, arguments: list[str]) -> int:
    """Run a script as Python would; return its exit status."""
    try:
        with as_script(path, arguments):
            runpy.run_path(str(path), run_name="__main__")
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def find(name: str) -> pathlib.Path:
    """Return the path of a script, or of the demo of that name."""
    for path in (pathlib.Path(name), DEMOS / f"{name}.py"):
        if path.is_file():
            return path.resolve()
    demos = ", ".join(sorted(p.stem for p in DEMOS.glob("*.py"))) or "none are installed"
    raise ValueError(f"There is no file {name}, and no demo of that name ({demos}).")


@contextlib.contextmanager
def recording(out: str, live: bool | str = False, color: Any = None) -> Iterator[list[Any]]:
    """Redirect the first Recorder to `out` while the context lasts.

    A world that is stepped before any Recorder exists gets its own. live, color: see Recorder.
    """
    import tiverlet

    from ..world import World

    made: list[Any] = []
    given: dict[str, Any] = {"overwrite": True, "live": live} | ({"color": color} if color else {})
    step, recorder = World.step, tiverlet.Recorder

    class Redirected(recorder):
        """A Recorder that writes to the file of the command, and is listed in `made`."""

        def __init__(self, path, *args, **kwargs):
            super().__init__(path if made else out, *args, **(kwargs if made else kwargs | given))
            made.append(self)

    def stepped(world: World, *args, **kwargs):
        """Run World.step(), and record it if the script makes no Recorder."""
        if not made:
            made.append(recorder(out, world, **given))
        report = step(world, *args, **kwargs)
        if made and type(made[0]) is recorder and made[0].world is world:
            made[0].log()
        return report

    tiverlet.Recorder, World.step = Redirected, stepped  # type: ignore[misc]
    try:
        yield made
    finally:
        tiverlet.Recorder, World.step = recorder, step  # type: ignore[misc]
        for one in made:
            one.close()
