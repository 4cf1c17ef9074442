"""Run a demo or a script in real time in a browser page, where the mouse can pull its particles."""

import argparse
import runpy
from typing import Any

from .scripts import as_script, color, port

ABOUT = "run a demo or script live, and take it by hand"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the script, and options of the page."""
    parser.add_argument("script", help="a .py file with a function play() or build() that returns a world, or the name of a demo")
    parser.add_argument("--record", metavar="FILE.rrd", help="write what happens, the hand included; replays bit for bit")
    parser.add_argument("--color", type=color, metavar="NAME[,LEAST,MOST]", help="of particles, by a quantity such as speed")
    parser.add_argument("--port", type=port, default=0, help="default: a free one")
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="only print the address")


def main(args: argparse.Namespace) -> int:
    """Serve the page until interrupted; return 0."""
    from ..live import play
    from .run import find

    path = find(args.script)
    with as_script(path):
        world, each_frame = load_world(str(path))
        page = {"title": path.stem, "port": args.port, "browser": args.browser, "color": args.color}
        play(world, record=args.record, each_frame=each_frame, **page)
    return 0


def load_world(script: str) -> tuple[Any, Any]:
    """Return the world of a script's play() or build(), or its variable `world`; and its function each_frame(world) or None."""
    from ..world import World

    found = runpy.run_path(script, run_name="play")
    make = found.get("play", found.get("build"))
    made: Any = make() if callable(make) else found.get("world")
    parts = list(made) if isinstance(made, (tuple, list)) else [made, *vars(made).values()] if hasattr(made, "__dict__") else []
    worlds = [part for part in parts if isinstance(part, World)]
    if not worlds:
        raise ValueError(
            f"{script} has no world to play: give it a function build() that returns a tv.World, alone or among other things."
        )
    return worlds[0], found.get("each_frame")
