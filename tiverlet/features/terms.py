"""Terms of other programs, and what they are called here, by the class, module or function that is asked for a name.

terms.ini has the rows: names, and the clause that ends the error. Rows of a class hold for its subclasses, too. Names are
compared without case, underscores, and a get or set before them.
"""

from configparser import ConfigParser, ExtendedInterpolation
from functools import cache
from importlib import resources


@cache
def rows() -> dict[str, dict[str, str]]:
    """Return names and clauses by owners, as terms.ini has them."""
    file = ConfigParser(delimiters=(":",), interpolation=ExtendedInterpolation())
    file.optionxform = str  # type: ignore[assignment, method-assign]  # names keep their case
    file.read_string(resources.files("tiverlet.features").joinpath("terms.ini").read_text(encoding="utf-8"))
    return {owners: dict(file[owners]) for owners in file.sections() if owners != "clauses"}


@cache
def terms() -> dict[str, dict[str, str]]:
    """Return the clause of each name, see spelt(), by owner."""
    out: dict[str, dict[str, str]] = {}
    for owners, found in rows().items():
        for owner in owners.split():
            out.setdefault(owner, {}).update((spelt(name), clause) for names, clause in found.items() for name in names.split())
    return out


def spelt(name: str) -> str:
    """Return a name without what differs between styles: case, underscores, and a get or set before it."""
    plain = name.lower()
    for word in ("get_", "set_"):
        plain = plain.removeprefix(word)
    if name[:3] in ("get", "set", "Get", "Set") and name[3:4].isupper():
        plain = plain[3:]
    return plain.replace("_", "")
