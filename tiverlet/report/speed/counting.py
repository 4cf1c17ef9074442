"""What a frame does, seen at Taichi's door: kernels launched, the time they take, and bytes that their loops read and write."""

from ...device.layout import unshared
from ...device.patches.tracing import Launches, Tracer, launches
from ...device.thread_team import launching

DT = 1 / 60  # [s] of a frame


def traffic(world, frames: int) -> dict[str, tuple[float, float]]:
    """Bytes that each kernel moves in a frame on the parallel path, and seconds that it takes, on average of so many frames.

    Bytes are a model, not measured: every launch of a kernel is counted, and every loop in it reads each element of each field it
    names once, and writes it once if it assigns it; of the lists of neighbours, the entries that are in use. So it is what would
    cross the bus if nothing stayed in the caches from one loop to the next, if what particles read of each other (gathers) were
    fetched once, and if every branch were taken. The fields are those that the kernels name while they are translated.
    """
    tracer, known, count = Tracer(), -1, Launches()
    with tracer.watching(), launching(), unshared(), world.clone(path="parallel") as clone:
        while known < len(tracer.sweeps):  # until no kernel was compiled on the way
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
