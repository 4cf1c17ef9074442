"""Fields: declared together, placed in one tree, or two, freed together.

Taichi 1.7.4 ends the process, without an exception, when a field outlives its runtime, when 512 trees of fields are
alive, when a field has no elements or when a child made by fork launches a kernel. The checks here turn each of
these into an error that says what to do, so that no other module has to know.
"""

import ctypes
import weakref
from typing import Any

import numpy as np
import taichi as ti

from . import runtime
from .host_copy import Entry, Places, Transfer, chain
from .patches import inside
from .patches.compiler import FEW, Compiler

GROUP = 16  # fields that one transfer kernel serves; Taichi unrolls the loop over them
MAX_TREES = 400  # Taichi holds at most 511 trees of fields and does not check; the rest is left to the user's own fields.


class Memory:
    """The fields of one world: declared first, then placed together, freed together.

    `real` is ti.f32 or ti.f64; particles: how many the world has, see Compiler. Every method that touches the fields checks first
    that they still exist.
    """

    def __init__(self, real, particles: int = FEW):
        if runtime.trees >= MAX_TREES:
            raise RuntimeError(
                f"So many worlds are alive that they have {runtime.trees} trees of fields, and Taichi crashes near 512. "
                "Close worlds that you no longer need: world.close(), or `with tv.World(...) as world:`."
            )
        self.real = real
        self.compiler = Compiler(real, particles)
        self.entries: list[Entry] = []
        self._later: list[tuple[Entry, np.ndarray]] = []
        self._apart = not aligned()
        self._builders: dict[bool, Any] = {}  # of the trees, by whether what they hold stands apart
        self._trees: list = []
        self._runtime = inside.current()
        self._transfers: dict[tuple, Transfer] = {}  # compiled once, since that costs more than running them
        self._views: dict[int, np.ndarray] | None = None  # see _seen()
        self._address = 0  # of the first element of the first field

    def field(self, name: str, length: int | None, *, width: int = 0, kind=None, values=None, state: bool = False) -> Any:
        """Declare a field of `length` elements (None: a single one, of 0 dimensions) and give it its first values."""
        kind = self.real if kind is None else kind
        made = ti.Vector.field(width, kind) if width else ti.field(kind)
        apart = self._apart and kind == ti.f64
        if apart not in self._builders:
            self._builders[apart] = ti.FieldsBuilder()
        if length is None:
            self._builders[apart].place(made)
        else:
            self._builders[apart].dense(ti.i, max(1, length)).place(made)  # a field of 0 elements poisons the runtime
        same = sum(e.name == name or e.name.startswith(f"{name} #") for e in self.entries)
        name = f"{name} #{same + 1}" if same else name  # two batches of a kind
        entry = Entry(name, made, width, 0 if length is None else max(1, length), np.dtype(_NUMPY[kind]), state)
        self.entries.append(entry)
        if values is not None and np.size(values):
            self._later.append((entry, np.asarray(values, dtype=np.float64)))
        return made

    def place(self) -> None:
        """Allocate what was declared and write the first values (everything else is zero)."""
        self._finish()
        if self._later:
            self._load([entry for entry, _ in self._later], [values for _, values in self._later])
            self._later.clear()

    def _finish(self) -> None:
        self._trees = [builder.finalize() for builder in self._builders.values()]
        runtime.trees += len(self._trees)
        _unseen[self] = None

    def _seen(self) -> dict[int, np.ndarray]:
        """Arrays that are the fields, by the id of the entry; none where the host cannot see them.

        Reading and writing fields by kernels takes longer to compile than all else takes to run.
        """
        if self._views is None:
            self._views = self._look() if runtime.architecture() == "cpu" and not self._apart else {}
        return self._views

    def _look(self) -> dict[int, np.ndarray]:
        if self in _unseen:  # for all that wait for it by one kernel, since that takes as long as for one
            waiting = [m for m in _unseen if m._trees and m._runtime is self._runtime]
            addresses = np.zeros(len(waiting), dtype=np.uint64)
            with self.compiler():
                Places([m.entries[0] for m in waiting]).find(addresses)
            for memory, address in zip(waiting, addresses.tolist(), strict=True):
                memory._address = address
            _unseen.clear()
        (start, *_), tree = chain(self.entries[0].field)
        memory, out = (ctypes.c_char * tree.cell_size_bytes).from_address(self._address - start), {}
        for e in self.entries:
            offsets, _ = chain(e.field)
            cell = e.field.parent().ptr.cell_size_bytes
            steps = (cell, offsets[1] - offsets[0] if e.width > 1 else e.kind.itemsize)
            if any(b - a != steps[1] for a, b in zip(offsets, offsets[1:], strict=False)):
                return {}  # laid out as never seen yet: by kernels, then
            out[id(e)] = np.ndarray(e.shape, e.kind, memory, offsets[0], steps[: 1 + bool(e.width)])
        return out

    def abandon(self) -> None:
        """Give up before place(): a builder that is never finished would poison everything that Taichi does later.

        So would fields that are gone before Taichi has looked at them, which it does before the next kernel.
        """
        if not self._trees:
            self._finish()
            self.destroy()

    def check(self) -> None:
        """Raise RuntimeError when the fields are gone or belong to a runtime that is."""
        if inside.current() is not self._runtime:
            raise RuntimeError(
                "Taichi was started again after this world was built, which destroyed its fields. Build the world anew."
            )
        if not self._trees:
            raise RuntimeError("This world is closed; build a new one.")
        if runtime.forked():
            raise RuntimeError('This world was built before a fork and cannot run in the child; use "spawn".')

    def destroy(self) -> None:
        """Free the fields. Calling it twice, or after another ti.init, does nothing."""
        if self._trees and inside.current() is self._runtime and not runtime.forked():
            self._runtime.materialize()  # see abandon(); no kernel may have run since place()
            for tree in self._trees:
                tree.destroy()
            runtime.trees -= len(self._trees)
        self._trees = []
        self._views = None

    def write(self, field, values) -> None:
        """Overwrite a whole field."""
        self.check()
        if np.size(values):
            self._load([self._find(field)], [np.asarray(values, dtype=np.float64)])

    def read(self, field) -> np.ndarray:
        """A copy of a whole field, in its own type."""
        self.check()
        entry = self._find(field)
        return self._dump([entry])[0]

    def state(self) -> dict[str, np.ndarray]:
        """Copies of the fields that make up the exact state, by name."""
        self.check()
        chosen = [e for e in self.entries if e.state]
        return dict(zip((e.name for e in chosen), self._dump(chosen), strict=True))

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Write back what state() returned, bit for bit; 0 to fields that were not there then."""
        self.check()
        chosen = [e for e in self.entries if e.state]
        if chosen:
            self._load(chosen, [state.get(e.name, np.zeros(1)) for e in chosen])

    def _find(self, field) -> Entry:
        return next(e for e in self.entries if e.field is field)

    def _load(self, entries: list[Entry], arrays: list[np.ndarray]) -> None:
        views = self._seen()
        if views:
            for e, a in zip(entries, arrays, strict=True):
                views[id(e)][...] = np.broadcast_to(a, e.shape)
            return
        # Every number that we hold (f32, f64, i32) is exact in f64, so one kernel and one flat array serve all.
        for k in range(0, len(entries), GROUP):
            some = entries[k : k + GROUP]
            parts = [np.broadcast_to(a, e.shape).ravel() for e, a in zip(some, arrays[k : k + GROUP], strict=True)]
            with self.compiler():
                self._transfer(some).load(np.concatenate(parts).astype(np.float64))

    def _dump(self, entries: list[Entry]) -> list[np.ndarray]:
        views = self._seen()
        if views:
            return [views[id(e)].copy() for e in entries]
        out = []
        for k in range(0, len(entries), GROUP):
            some = entries[k : k + GROUP]
            sizes = [e.bytes // e.kind.itemsize for e in some]
            flat = np.empty(sum(sizes), dtype=np.float64)
            with self.compiler():
                self._transfer(some).dump(flat)
            parts = np.split(flat, np.cumsum(sizes)[:-1])
            out += [p.astype(e.kind).reshape(e.shape) for p, e in zip(parts, some, strict=True)]
        return out

    def _transfer(self, entries: list[Entry]) -> Transfer:
        key = tuple(id(e) for e in entries)
        if key not in self._transfers:
            self._transfers[key] = Transfer(entries)
        return self._transfers[key]


_unseen: weakref.WeakKeyDictionary[Memory, None] = weakref.WeakKeyDictionary()  # placed, nobody knows where
_NUMPY = {ti.f32: np.float32, ti.f64: np.float64, ti.i32: np.int32, ti.u32: np.uint32}


def aligned() -> bool:
    """Whether a field of f64 may stand in one tree with others.

    LLVM lays out trees so that all is aligned. Elsewhere Taichi 1.7.4 puts one field behind the other, the
    smallest first, and finds an f64 by its address divided by 8: of a tree of 3 i32 and 4 f64, the first f64 begins at byte 12
    and is written to byte 8, over the last i32. Alone in their tree all f64 are aligned.
    """
    return runtime.architecture() in runtime.LLVM
