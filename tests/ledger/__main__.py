"""Run the ledger and compare it with figures.txt, or write that file anew."""

import argparse
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed

from .book import FILE, Book, compare, read, write
from .runs import begin, figures_of, names


def run(some: list[str], jobs: int) -> Book:
    """Return the figures of these cases and scenes, and print a line as each is done."""
    book, spent = Book(), 0.0
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), begin) as pool:
        waiting = {pool.submit(figures_of, name): name for name in some}
        for k, future in enumerate(as_completed(waiting), 1):
            found, seconds = future.result()
            book |= found
            spent += seconds
            print(f"{k:3d} of {len(some)}  {seconds:6.1f} s  {waiting[future]}", flush=True)
    print(f"{sum(map(len, book.values()))} figures in {spent:.0f} CPU seconds")
    return book


def main(words: list[str]) -> int:
    """Run the command. Returns the exit status: 1 where a figure is worse."""
    parser = argparse.ArgumentParser("python -m tests.ledger", description=__doc__)
    parser.add_argument("names", nargs="*", help="beginnings of cases and scenes; all without any")
    parser.add_argument("--write", action="store_true", help="take the new figures; the commit says why they changed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)")
    parser.add_argument("--against", default=FILE, type=type(FILE), metavar="FILE", help="compare with another file")
    args = parser.parse_args(words)
    some = [name for name in names() if not args.names or name.startswith(tuple(args.names))]
    if not some:
        parser.error(f"{', '.join(args.names)} begins no case or scene")
    old, new = read(args.against), run(some, args.jobs)
    kept = {key: row for key, row in old.items() if key[0] not in some}
    changes = list(compare(old, new))
    print(*changes, sep="\n")
    worse, better = (sum(change.worse is so for change in changes) for so in (True, False))
    print(f"{worse} figures are worse, {better} are better")
    if args.write:
        write(kept | new)
        return 0
    if missing := {key[0] for key in new} - {key[0] for key in old}:
        print(f"No figures are kept of {', '.join(sorted(missing))}: run with --write.")
        return 1
    if worse:
        print("Mend the change; or, where this is its price, run with --write, and let the commit say why.")
    elif better:
        print("Run with --write, so that no later change takes this back unseen.")
    return int(worse > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
