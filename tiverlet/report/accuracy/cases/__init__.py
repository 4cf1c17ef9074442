"""Scenes with known answers: the entries of cases.json, each built only through public names.

To add a case, add one entry to the list CASES of a file in this folder.
"""

import difflib

from . import chains, free, impacts, statics
from .case import FRAME, METHODS, SLACK, Case, Run, entries, known

CASES: dict[str, Case] = {c.name: c for file in (chains, free, statics, impacts) for c in file.CASES}

# Entries of cases.json without a case, and why.
LEFT_OUT = {
    "R04_oscillator_k100_dt0.1": "the same scene as R04_oscillator_k100_dt0.01, at another step",
    "R10_catenary": "a continuum; R10b are the ropes of links that it is the limit of",
    "R20_rolling": "spheres that roll: tests/test_grains.py",
    "R22_packing": "statistics of many contacts: tests/test_grains.py",
    "R23_hard_gas_pressure": "statistics of many contacts: tests/test_grains.py",
    "R24_maxwell": "statistics of many contacts: tests/test_grains.py",
    "R25b_volume": "volumes are held at rest, which tests/test_bodies.py measures",
}


def chosen(names=None) -> list[Case]:
    """Return the cases with these names or beginnings of names; all for None. Raises ValueError for a name that fits none."""
    if names is None:
        return list(CASES.values())
    out: dict[str, Case] = {}
    for name in [names] if isinstance(names, str) else names:
        found = {k: c for k, c in CASES.items() if k == name or k.startswith(name)}
        if not found:
            near = difflib.get_close_matches(name, CASES, n=3, cutoff=0.3) or list(CASES)[:3]
            raise ValueError(f"cases: {name!r} fits no case. Near it: {', '.join(near)}.")
        out.update(found)
    return list(out.values())


__all__ = ["CASES", "FRAME", "LEFT_OUT", "METHODS", "SLACK", "Case", "Run", "chosen", "entries", "known"]
