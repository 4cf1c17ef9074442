"""Observes a world and writes the journal of its recording."""

import contextlib
import copy
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..step import checkpoint
from ..step.step_report import StepReport
from . import scene
from .journal import FORMAT, PARTED, Entry, checksum, flags_to_record

if TYPE_CHECKING:
    from ..world import World

Write = Callable[[str, np.ndarray, str], None]


class Journal:
    """Writes an entry for every change of the world that it observes."""

    def __init__(self, world: "World", write: Write, picture_settings: dict[str, Any]):
        self._picture_settings = picture_settings  # what the picture contains beyond scene and steps
        self.world, self.frame, self.bytes = world, 0, 0
        self.worst: StepReport | None = None  # the worst report of the whole recording
        self.recent: StepReport | None = None  # the worst report since the last frame
        self.changed_features: set[int]  # features whose knobs were set since the last frame
        self._write, self._serial, self._sum = write, 0, ""
        self._steps: list[list] = []
        self.scenes = self.size = 0  # the number of scenes, and the size of the last state [bytes]
        self._last: list | None = None
        self.regrouped()
        world._watchers.append(self)

    def regrouped(self) -> None:
        """Write the scene and its state: at the begin, and when the user has added or removed particles or features."""
        data, arrays = scene.describe(self.world)
        self._known = [copy.deepcopy(scene.knobs(f)) for f in self.world.features]
        self.put("scene", {"format": FORMAT, **data, **self._picture_settings}, arrays)
        self.size = self.state()
        self.scenes += 1
        self.changed_features = set(range(len(self.world.features)))  # draw all features

    def put(self, kind: str, data: dict[str, Any], arrays: dict[str, np.ndarray] | None = None) -> int:
        """Write an entry; return its size [bytes]."""
        now = self._now()
        if now != self._last:
            data["now"], self._last = now, now
        text, blob = Entry(kind, self.frame, data, arrays or {}, self._steps).pack(self._serial)
        blob = blob or bytes(not self._serial)  # rerun knows the type of a column only from the first value that is not empty
        self._sum = checksum(self._sum, text, blob)
        self._write(text, np.frombuffer(blob, dtype=np.uint8), self._sum)
        self._serial, self._steps = self._serial + 1, []
        self.bytes += len(text) + len(blob)
        return len(text) + len(blob)

    def rounded(self) -> StepReport | None:
        """Return the worst report since the last frame, with its seconds rounded to three digits."""
        if self.recent:
            self.recent = replace(self.recent, seconds=float(f"{self.recent.seconds:.3g}"))
        return self.recent

    def frame_drawn(self, data: dict[str, Any]) -> None:
        """Write the entry of a frame that was drawn."""
        took = {"seconds": self.recent.seconds} if self.recent else {}
        self.put("frame", {**data, **took, **flags_to_record(self.recent)})
        self.recent = None
        self.changed_features.clear()

    def _now(self) -> list:
        """Return the user's settings for the next step, and the memory of the controller."""
        settings = self.world.settings
        return [settings["substeps"], settings["iterations"], list(self.world._controller.memory)]

    def state(self, kind: str = "state") -> int:
        """Write the exact state; return the size of the entry [bytes]."""
        kept, world = checkpoint.keep(self.world), self.world
        more = {"flags": checkpoint.flags(world), "reach": world._runner.scene.multipliers_per_newton}
        more["once"] = [sorted(f.compiled_so_far) for f in world.features]
        parted = kept.clock.velocity_override
        working = {name: rows for name, rows in checkpoint.working_fields(world).items() if rows.dtype.kind == "f"}
        arrays = kept.values | working | ({} if parted is None else {PARTED: np.asarray(parted)})
        return self.put(kind, {"clock": kept.clock.named() | {"_parted": None}, **more}, arrays)

    def before(self) -> None:
        """Before a step: write the knobs that were set since the last one."""
        arrays: dict[str, np.ndarray] = {}
        changed = {}
        for k, feature in enumerate(self.world.features):
            if feature.changed:
                now, known = scene.knobs(feature), self._known[k]
                # A force that was changed and changed back counts: what it acts on was started anew.
                forced = {name for name in now if feature.new_force and getattr(type(feature), name).force}
                new = {name: v for name, v in now.items() if name in forced or name not in known or not _same(v, known[name])}
                changed[k] = {name: scene.encode(v, f"{k}.{name}", arrays, scene.Needs()) for name, v in new.items()}
                known.update(copy.deepcopy(new))
        if changed:
            self.changed_features.update(changed)
            self.put("turned", {"features": changed}, arrays)

    def after(self, dt: float, report: StepReport) -> None:
        """After a step: record it."""
        step = [dt, report.substeps, report.iterations, self.world._adapted]
        if self._steps and self._steps[-1][:-1] == step:
            self._steps[-1][-1] += 1
        else:
            self._steps.append([*step, 1])
        self.worst = report if self.worst is None else self.worst.worse(report)
        self.recent = report if self.recent is None else self.recent.worse(report)

    def broken_off(self) -> None:
        """After a step that ended in an exception: write the state."""
        with contextlib.suppress(RuntimeError):  # a world whose fields were freed has no state
            self.state("taken")

    def assigned(self, name: str, value: np.ndarray) -> None:
        """Write an array that the user assigned: positions, velocities or spins."""
        self.put("assigned", {"name": name}, {"value": value})

    def close(self) -> None:
        """Stop observing the world."""
        if self in self.world._watchers:
            self.world._watchers.remove(self)


def _same(value: Any, known: Any) -> bool:
    """Whether two settings are equal, including the signs of zeros: 0 and -0 have different bits in kernels and hashes."""
    if not np.array_equal(value, known):
        return False
    return np.asarray(value).dtype.kind != "f" or np.array_equal(np.signbit(value), np.signbit(known))
