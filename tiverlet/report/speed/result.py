"""The report of measured speeds, as tables, Markdown, JSON and plots."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.jupyter import JupyterMixin

from .. import output


@dataclass(frozen=True)
class Run:
    """The figures of a scene of one size on one number of threads.

    seconds: of a frame, the median of `rounds` runs over the first frames, without the very first. launches: kernels of a frame,
    counted, on average. traffic: bytes moved per particle and substep, by kernel, as counted by counting.py. times: seconds of
    these kernels per particle and substep, on the parallel path and the most threads. memory: of all fields [bytes per particle].
    imported: seconds of the import. cold, warm: seconds from tv.init to the end of the first step, with an empty cache and with
    the cache of an earlier process. overlap: the mean of overlapping pairs [diameters]. residual: the worst relative violation.
    yardstick, yardstick_overlap: seconds of a frame and mean overlap of pile.c; None if it was not run.
    """

    scene: str
    particles: int
    threads: int
    path: str
    substeps: int
    seconds: float
    rounds: int
    launches: float
    traffic: dict[str, float]
    times: dict[str, float]
    memory: float
    imported: float
    cold: float
    warm: float
    overlap: float
    residual: float
    flags: tuple[str, ...]
    yardstick: float | None = None
    yardstick_overlap: float | None = None

    @property
    def rate(self) -> float:
        """Particle-substeps per second."""
        return self.particles * self.substeps / self.seconds

    @property
    def bytes(self) -> float:
        """Bytes moved per particle and substep by all kernels."""
        return sum(self.traffic.values())

    @property
    def ratio(self) -> float | None:
        """The rate over that of pile.c, from medians of alternating runs; None if pile.c was not run."""
        return None if self.yardstick is None else self.yardstick / self.seconds


@dataclass(frozen=True)
class Peer:
    """Another engine on the same scene, with its cheapest setting that is no worse than tiverlet.

    setting: steps of a frame and iterations of each. seconds, ours: of a frame, medians of alternating runs, by the engine and by
    tiverlet. quality, our_quality: the mean overlap [diameters] or the worst strain, in the same frames. met: whether a setting
    is as good as tiverlet; if not, this is the best one.
    """

    peer: str
    scene: str
    particles: int
    threads: int
    setting: tuple[int, int]
    seconds: float
    ours: float
    measure: str
    quality: float
    our_quality: float
    met: bool


@dataclass(frozen=True)
class Absent:
    """A scene run by the package, and by a copy without the files of all features that the scene does not use.

    fields, bytes, launches of a frame, and seconds of a frame (medians of alternating runs): by the package, and by the copy.
    """

    scene: str
    particles: int
    fields: tuple[int, int]
    bytes: tuple[int, int]
    launches: tuple[float, float]
    seconds: tuple[float, float]

    @property
    def ratio(self) -> float:
        """The time with all other features over the time without them: 1 if they cost nothing."""
        return self.seconds[0] / self.seconds[1]


@dataclass(frozen=True)
class Wait:
    """The time of one edit of a pile, with the work that it defers to the next frame [s].

    cold, warm: by tiverlet, without and with kernels that another process has compiled. aim: the target time, or None. peers: the
    times of other engines, by name.
    """

    act: str
    particles: int
    aim: float | None
    cold: float
    warm: float
    peers: dict[str, float]


@dataclass(frozen=True)
class SpeedReport(JupyterMixin):
    """Speed, memory and first steps. print() shows tables; see .run(), .growth(), .scaling(), .json(), .markdown(), .plot().

    arch: as in tv.init. copy: bytes per second that a copy of a large array moves (read and written), by threads; on a GPU, of
    its memory. notes: what was left out, and how pile.c was compiled.
    """

    machine: str
    arch: str
    copy: dict[int, float]
    runs: tuple[Run, ...]
    peers: tuple[Peer, ...]
    absent: tuple[Absent, ...]
    waits: tuple[Wait, ...]
    notes: tuple[str, ...]

    @property
    def missing(self) -> list[str]:
        """The notes on measurements that failed."""
        return [note for note in self.notes if note.startswith("Missing")]

    def run(self, scene: str, particles: int, threads: int) -> Run:
        """Return one run. Raises KeyError if there is none."""
        for r in self.runs:
            if (r.scene, r.particles, r.threads) == (scene, particles, threads):
                return r
        raise KeyError((scene, particles, threads))

    def curves(self) -> Iterator[tuple[str, int, list[Run]]]:
        """Yield scene, threads, and the runs of both, by size."""
        for scene, threads in dict.fromkeys((r.scene, r.threads) for r in self.runs):
            some = [r for r in self.runs if (r.scene, r.threads) == (scene, threads)]
            yield scene, threads, sorted(some, key=lambda r: r.particles)

    def share(self, r: Run) -> float:
        """Return the counted bytes per second as a share of the bandwidth of a copy."""
        return r.rate * r.bytes / self.copy[r.threads]

    def growth(self, scene: str, threads: int, since: int = 10_000) -> float | None:
        """Return the longest time of a particle-substep over the shortest, from `since` particles on; None for one size."""
        rates = [r.rate for r in self.runs if (r.scene, r.threads) == (scene, threads) and r.particles >= 0.9 * since]
        return max(rates) / min(rates) if len(rates) > 1 else None

    def scaling(self, r: Run) -> float | None:
        """Return the speed of a run over that on the fewest threads; None if the run is the one on the fewest."""
        others = [o for o in self.runs if (o.scene, o.particles) == (r.scene, r.particles)]
        least = min(others, key=lambda o: o.threads)
        return None if least.threads == r.threads else least.seconds / r.seconds

    def tables(self) -> Iterator[tuple[str, tuple[str, ...], list[tuple[str, ...]]]]:
        """Yield title, heads and rows of each table, without empty columns."""
        present = {name for w in self.waits for name in w.peers}
        for title, heads, rows in (
            ("Speed", HEADS, [self._cells(r) for r in self.runs]),
            ("Starts, memory, quality", STARTS, [started(r) for r in self.runs]),
            ("Peers, at the same measured quality or better", PEERS, [beside(p) for p in self.peers]),
            ("Features that exist but are not in the scene", ABSENT, [without(a) for a in self.absent]),
            ("Waits of who edits a pile, in ms", WAITS, [waited(w, present) for w in self.waits]),
        ):
            full = [k for k in range(len(heads)) if any(row[k] for row in rows)]
            if full:
                yield title, tuple(heads[k] for k in full), [tuple(row[k] for k in full) for row in rows]

    def lines(self) -> Iterator[str]:
        """Yield the lines below the tables: machine, bandwidths, growth, legends and notes."""
        yield f"Machine: {self.machine}; Taichi on {self.arch}."
        for threads, speed in self.copy.items():
            yield f"A copy of a large array moves {speed / 1e9:.1f} GB/s on {threads} thread{'s' * (threads > 1)}."
        for scene, threads, _ in self.curves():
            growth = self.growth(scene, threads)
            if growth is not None:
                yield f"{scene}, {threads} threads: time per particle-substep within a factor {growth:.2f} from 10 000 on."
        for name in dict.fromkeys(r.scene for r in self.runs):
            r = max((r for r in self.runs if r.scene == name), key=lambda r: r.particles)
            parts = (f"{k} {t * 1e9:.2g} ns, {r.traffic[k]:.0f} bytes" for k, t in sorted(r.times.items(), key=lambda p: -p[1]))
            yield f"{name}, {r.particles:,} particles, by kernel: {'; '.join(parts)}."
        if self.runs:
            yield from LEGEND
        if self.peers:
            yield PEERED
        yield from self.notes

    def _cells(self, r: Run) -> tuple[str, ...]:
        scaling = self.scaling(r)
        return (
            r.scene, f"{r.particles:,}", str(r.threads), f"{1e3 * r.seconds:.3g}", f"{r.rate / 1e6:.3g}",
            "" if r.ratio is None else f"{r.ratio:.2f}", "" if scaling is None else f"{scaling:.2f}", f"{r.launches:.3g}",
            f"{r.bytes:.0f}", f"{100 * self.share(r):.0f}%",
        )  # fmt: skip

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield from output.printed(self.tables(), self.lines(), left=TEXT)

    def __str__(self) -> str:
        return output.text(self, 150)

    def markdown(self) -> str:
        """Return tables and notes as Markdown."""
        return output.markdown(self.tables(), self.lines())

    def json(self) -> str:
        """Return the report as JSON; see of_json()."""
        lists = {k: [output.plain(row) for row in v] for k, v in asdict(self).items() if k in ROWS}
        return json.dumps({**asdict(self), **lists}, indent=1, allow_nan=False)

    @classmethod
    def of_json(cls, text: str) -> "SpeedReport":
        """Return the report that json() wrote."""
        data = json.loads(text)
        copy = {int(k): v for k, v in data["copy"].items()}
        lists = {k: tuple(restored(kind, row) for row in data[k]) for k, kind in ROWS.items()}
        return cls(machine=data["machine"], arch=data["arch"], copy=copy, notes=tuple(data["notes"]), **lists)

    def plot(self, folder) -> list[str]:
        """Plot rates, first steps and memory by size as PNG in `folder`; return their paths. Needs matplotlib (extra "plots")."""
        from .figures import plot

        return plot(self, folder)


ROWS = {"runs": Run, "peers": Peer, "absent": Absent, "waits": Wait}
HEADS = (
    "scene", "particles", "threads", "ms", "Mps/s", "of pile.c", "of 1 thread", "launches", "bytes", "of a copy",
)  # fmt: skip
STARTS = (
    "scene", "particles", "threads", "path", "import", "cold", "warm", "memory", "overlap", "pile.c's", "violation", "flags",
)  # fmt: skip
PEERS = ("peer", "scene", "particles", "threads", "setting", "ms", "ours", "ratio", "measure", "its", "ours", "as good")
ABSENT = ("scene", "particles", "fields", "bytes", "launches", "ms", "ratio")
BESIDE = ("pymunk", "newton")
WAITS = ("act", "particles", "aim", "cold", "warm", *BESIDE)
TEXT = ("path", "flags", "setting", "measure")
LEGEND = (
    "ms: of a frame of 1/60 s, median. Mps/s: millions of particle-substeps per second. launches: kernels of a frame, counted.",
    "bytes: moved for each particle and substep, a count and not a measurement: every loop of every kernel that the parallel "
    "path launches reads and writes each element of the fields it names once, as if nothing stayed in the caches between loops. "
    "More than 100 % of a copy is what the caches gave. By kernel: for each particle and substep too, on the most threads.",
    "import, cold, warm [s]: of the package, and from tv.init to the end of the first step, without and with kernels that "
    "another process has compiled. memory: bytes of all fields per particle. overlap: the mean of pairs that overlap, of a "
    "diameter. violation: the worst of a constraint, relative.",
)
PEERED = (
    "Peers: setting is steps of a frame x iterations, the cheapest that is as good as ours by the one measure named (nothing "
    "else is made equal), or, if none is, the best of those tried; ratio: its time over ours."
)


def restored(kind: type, row: dict[str, Any]) -> Any:
    """Return a row of JSON as an object of `kind`, with tuples for lists, and infinity for numbers that JSON does not have."""
    values = {f.name: np.inf if row[f.name] is None and f.type is float else row[f.name] for f in fields(kind)}
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def percent(share: float | None) -> str:
    """Return a share of a diameter in percent; empty for None and 0."""
    return f"{100 * share:.2g}%" if share else ""


def started(r: Run) -> tuple[str, ...]:
    """Return the table row of a run's first step, memory and quality."""
    return (
        r.scene, f"{r.particles:,}", str(r.threads), r.path, f"{r.imported:.2f}", f"{r.cold:.2f}", f"{r.warm:.2f}",
        f"{r.memory:.0f}", percent(r.overlap), percent(r.yardstick_overlap), f"{r.residual:.1e}" if r.residual else "",
        " ".join(r.flags),
    )  # fmt: skip


def beside(p: Peer) -> tuple[str, ...]:
    """Return the table row of a peer."""
    steps, iterations = p.setting
    return (
        p.peer, p.scene, f"{p.particles:,}", str(p.threads), f"{steps} x {iterations}", f"{1e3 * p.seconds:.3g}",
        f"{1e3 * p.ours:.3g}", f"{p.seconds / p.ours:.3g}", p.measure, f"{p.quality:.2e}", f"{p.our_quality:.2e}",
        "yes" if p.met else "no",
    )  # fmt: skip


def without(a: Absent) -> tuple[str, ...]:
    """Return the table row of a scene with and without the other features."""
    pairs = (f"{x:g} / {y:g}" for x, y in (a.fields, a.bytes, a.launches))
    times = f"{1e3 * a.seconds[0]:.4g} / {1e3 * a.seconds[1]:.4g}"
    return (a.scene, f"{a.particles:,}", *pairs, times, f"{a.ratio:.3f}")


def waited(w: Wait, present: set[str]) -> tuple[str, ...]:
    """Return the table row of an edit. present: the peers that were measured."""
    times = [w.aim, w.cold, w.warm, *(w.peers.get(name) for name in BESIDE)]
    cells = ["" if t is None else f"{1e3 * t:.3g}" for t in times]
    theirs = [cell if name in present else "not there" for name, cell in zip(BESIDE, cells[3:], strict=True)]
    return (w.act, f"{w.particles:,}", *cells[:3], *theirs)
