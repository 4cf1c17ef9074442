"""Many scenes: structures are drawn and compiled once; events are drawn and shrunk by hypothesis."""

import os
import random
from collections.abc import Iterator
from time import process_time
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.errors import Flaky, FlakyFailure

from . import twins
from .scenes import Event, Set, Step, Structure, happenings, script, structures
from .trials import Find, Refused, Trial

PATIENCE = 1.0  # [s] a scene that takes less is run again
ENOUGH = 15.0  # [s] for all scenes of a structure
QUIET: Any = dict(database=None, deadline=None, suppress_health_check=list(HealthCheck), print_blob=False)


def drawn(number: int, count: int) -> list[Structure]:
    """Return structures, the same for the same number."""
    out: list[Structure] = []

    @seed(number)
    @settings(max_examples=count, phases=[Phase.generate], **QUIET)
    @given(structures())
    def collect(structure):
        out.append(structure)

    collect()
    return out[:count]


class Searcher:
    """Searches scenes of one structure for a find."""

    def __init__(self, structure: Structure, kinds: set[str] | None = None):
        self.structure, self.kinds, self.trial = structure, kinds, None
        self.scenes = self.frames = self.refused = 0
        self.spent = 0.0
        self.last: list[Event] = []  # events of the last scene that was not refused
        self.found: tuple[Find, list[Event]] | None = None

    def scene(self, events: list[Event]) -> None:
        """Run a scene twice. Skip it once other scenes of the structure have taken long."""
        if self.spent > ENOUGH and not self.found:
            return
        self.scenes += 1
        clock = process_time()
        self.frames += sum(isinstance(e, Step) for e in events)
        try:
            self.trial = self.trial or Trial(self.structure)
            first = self.trial.run(events)
            if process_time() - clock < PATIENCE and (again := self.trial.replay(events)) != first:
                raise Find("bits", f"a scene run again ends with another hash: {first[:12]}, {again[:12]}")
            self.last = events
        except Refused:
            self.refused += 1
        finally:
            self.spent += process_time() - clock

    def says(self) -> str:
        """Return what was found, as a script."""
        find, events = self.found or (None, [])
        return f"{find}\n\n{script(self.structure, events)}"

    def search(self, number: int, each: int, way: twins.Way | None = None) -> None:
        """Run scenes until one of them is a find, and shrink it."""

        @seed(number)
        @settings(max_examples=each, phases=[Phase.generate, Phase.shrink], report_multiple_bugs=False, **QUIET)
        @given(happenings(self.structure))
        def test(events):
            try:
                self.scene(events)
            except Find as find:
                if self.kinds is None or find.kind in self.kinds:
                    self.found = (find, events)
                    raise

        try:
            test()
            if self.trial and self.last:
                self.others(way or twins.WAYS[number % len(twins.WAYS)])
        except (Find, Flaky, FlakyFailure):  # flaky: a find that does not recur, as where bits differ
            pass
        finally:
            if self.trial:
                self.trial.close()

    def others(self, way: twins.Way) -> None:
        """Run the last scene again in another way, which is compiled for it."""
        events = [Set(None, e.name, 3) if isinstance(e, Set) and e.name == "substeps" else e for e in self.last]
        try:
            way(self.trial, events)
        except Refused:
            self.refused += 1
        except Find as find:
            if self.kinds is None or find.kind in self.kinds:
                self.found = (find, events)
                raise


def smaller(structure: Structure, events: list[Event], kind: str) -> tuple[Structure, list[Event]]:
    """Leave out features one by one, as long as the find remains."""
    k = len(structure.features) - 1
    while k >= 0:
        less = Structure(structure.particles, structure.features[:k] + structure.features[k + 1 :], structure.settings)
        left = [e for e in events if getattr(e, "of", None) != k]
        left = [type(e)(e.of - 1, e.name, e.value) if getattr(e, "of", None) is not None and e.of > k else e for e in left]
        trial = None
        try:
            trial = Trial(less)
            trial.run(left)
        except Find as find:
            if find.kind == kind:
                structure, events = less, left
        except Refused:
            pass
        finally:
            if trial:
                trial.close()
        k -= 1
    return structure, events


def search(number: int, k: int, each: int, kinds: set[str] | None = None, way: twins.Way | None = None) -> Searcher:
    """Run scenes of structure k of a campaign until one is a find of these kinds (None: any), and the last in another way."""
    structure = drawn(number * 100_003 + k, 8)[random.Random(k).randrange(8) - 8]
    searcher = Searcher(structure, kinds)
    searcher.search(k, each, way)
    return searcher


def campaign(number: int, begin: int, end: int, each: int, folder: str, kinds: set[str] | None) -> Iterator[dict[str, Any]]:
    """Run structures begin ... end - 1 of a campaign. Yields a line with the result of each."""
    for k in range(begin, end):
        yield {"begins": k}
        searcher = search(number, k, each, kinds)
        line = {"structures": 1, "scenes": searcher.scenes, "frames": searcher.frames, "refused": searcher.refused, "finds": []}
        if searcher.found:
            find, events = searcher.found
            small, less = (searcher.structure, events) if find.kind == "twin" else smaller(searcher.structure, events, find.kind)
            path = os.path.join(folder, f"{number}-{k}-{find.kind.replace(', ', '-').replace(' ', '-')}.py")
            with open(path, "w") as file:
                file.write(script(small, less, str(find)))
            line["finds"].append({"kind": find.kind, "structure": k, "says": str(find), "script": path})
        yield line
