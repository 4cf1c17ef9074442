"""Count what a frame does: kernels launched, the time that they take, and the bytes that their loops read and write."""

from ...device.layout import unshared
from ...device.patches.tracing import Launches, Tracer, launches
from ...device.thread_team import launching

DT = 1 / 60  # [s] of a frame


def traffic(world, frames: int) -> dict[str, tuple[float, float]]:
    """Return the bytes and seconds of each kernel in a frame on the parallel path, averaged over `frames` frames.

    Bytes are a model, not measured. For every launch of a kernel, every loop in it reads each element of each field that it names
    once, and writes it once if it assigns it. Of neighbour lists, only entries in use count. So this is the traffic if nothing
    stayed in the caches between loops, if gathered data of other particles were fetched once, and if every branch were taken. The
    fields are those that the kernels name while they are translated.
    """
    tracer, known, count = Tracer(), -1, Launches()
    with tracer.watching(), launching(), unshared(), world.clone(path="parallel") as clone:
        while known < len(tracer.sweeps):  # until no kernel is compiled meanwhile
            known = len(tracer.sweeps)
            with launches(timed=True) as count:
                for _ in range(frames):
                    clone.step(DT)
        main, *stores = clone._runner.memories
        lengths = {id(e.field): (max(1, e.length), e.bytes // max(1, e.length)) for e in main.entries}
        if stores:
            listed = int(main.read(clone._runner.search.list.number).sum())
            lengths |= {id(e.field): (min(e.length, listed), e.bytes // e.length) for m in stores for e in m.entries}
        moved = {name: k * sum(s.bytes(lengths) for s in tracer.sweeps.get(name, ())) for name, k in count.items()}
        return {name: (moved[name] / frames, count.seconds[name] / frames) for name in count}
