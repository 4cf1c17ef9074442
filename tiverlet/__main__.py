"""The command line: python -m tiverlet run | replay | report | stress | info."""

import argparse
import sys

from .commands import info, replay, report, run, stress

# Each has ABOUT (a line), add(parser) for its arguments, and main(args) -> exit status.
COMMANDS = {"run": run, "replay": replay, "report": report, "stress": stress, "info": info}


def main(words: list[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tiverlet", description="A particle engine on Taichi.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    for name, command in COMMANDS.items():
        command.add(commands.add_parser(name, help=command.ABOUT, description=command.__doc__))
    args = parser.parse_args(words)
    try:
        return COMMANDS[args.command].main(args)
    except (ValueError, TypeError, RuntimeError, OSError) as error:
        print(f"tiverlet {args.command}: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
