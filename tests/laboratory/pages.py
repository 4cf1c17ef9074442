"""Tables on pages that show results. The paragraph above such a table names its command, `python -m tests.laboratory NAME`.

Who writes a page types the heads and the first cell of each row. The other cells are those of the table in the command's section
of RESULTS.md that has these heads and rows, and so never differ from it.
"""

import re
from collections.abc import Iterator

from .results import FILE, sections

ROOT = FILE.parents[2]
PAGES = [ROOT / "README.md", *ROOT.glob("demos/*.md"), *ROOT.glob("tiverlet/**/*.md"), FILE.with_name("README.md")]
TABLE = re.compile(r"^\|.*\|\n\|[-:|]+\|\n(?:\|.*\|\n)*", re.M)
COMMAND = re.compile(r"`python -m tests\.laboratory (\w+)")
# What is measured or computed, not counted or named: a number with a point, an exponent or a comma, alone or with words behind;
# or any number alone, or with a unit.
FIGURE = re.compile(
    r"[-+<>~]?(?:\d[\d,]*\.\d|\d{1,3},\d{3}|\d+e[-+]?\d).*"
    r"|[-+<>~]?\d+(?:\s?(?:%|(?:[mun]?s|min|[ckm]?m|[kMG]?B|bytes|times)\b).*)?"
)


def cells(line: str) -> list[str]:
    """Return the cells of a row."""
    return [cell.strip() for cell in line.strip()[1:-1].split("|")]


def above(text: str, found: re.Match[str]) -> str:
    """Return the paragraph above a table."""
    return text[: found.start()].rstrip().rpartition("\n\n")[2]


def tables(text: str) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Yield (the paragraph above, heads, rows) of each table."""
    for found in TABLE.finditer(text):
        heads, _, *rows = found[0].splitlines()
        yield above(text, found), cells(heads), [cells(row) for row in rows]


def unwritten(text: str) -> list[str]:
    """Return the cells with figures in tables that no command writes."""
    free = [row for near, _, rows in tables(text) if not COMMAND.search(near) for row in rows]
    return [cell for row in free for cell in row if FIGURE.fullmatch(cell)]


def filled(text: str, results: str) -> str:
    """Return a page with its tables filled from the text of RESULTS.md. Raises LookupError where it has no such table or row."""
    parts = sections(results)

    def fill(found: re.Match[str]) -> str:
        if not (command := COMMAND.search(above(text, found))):
            return found[0]
        _, heads, rows = next(tables(found[0]))
        keys = [row[0] for row in rows]
        for _, all_heads, all_rows in tables(parts.get(command[1], "")):
            if set(heads) <= set(all_heads):
                columns = [all_heads.index(head) for head in heads]
                known = {row[columns[0]]: [row[c] for c in columns] for row in all_rows}
                if set(keys) <= known.keys() and len(known) == len(all_rows):
                    lines = found[0].splitlines()[:2] + ["| " + " | ".join(known[key]) + " |" for key in keys]
                    return "\n".join(lines) + "\n"
        raise LookupError(f"{FILE.name} has in its section {command[1]} no table with the heads {heads} and the rows {keys}.")

    return TABLE.sub(fill, text)


def write() -> None:
    """Fill the tables of all pages."""
    for page in PAGES:
        if (new := filled(old := page.read_text(), FILE.read_text())) != old:
            page.write_text(new)
            print(f"Written: {page.relative_to(ROOT)}")
