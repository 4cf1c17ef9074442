"""How much memory the system has left, so that what does not fit is refused before it is allocated.

Linux gives addresses for more memory than it has, and ends a process that uses them.
"""

import math
from collections.abc import Iterator
from pathlib import Path

from . import runtime

SMALL = 1 << 26  # [bytes] what takes less is not compared with what is free, which takes up to a millisecond to read
GROUPS = {  # of control groups, by version: where they are, and their files with the limit and the use [bytes]
    2: ("/sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"),
    1: ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}


def refuse_beyond(wanted: float, what: str, instead: str) -> None:
    """Raise MemoryError if `wanted` bytes are more than are free. what: takes them, and has a verb. instead: what to do."""
    if wanted > SMALL and runtime.architecture() == "cpu" and wanted > (free := free_memory()):
        raise MemoryError(f"{what} {wanted / 1e9:.3g} GB of memory, and {free / 1e9:.3g} GB are free. {instead}")


def free_memory() -> float:
    """Return how much memory this process can still take [bytes]; infinite where the system does not tell, as only Linux does."""
    free = [1024.0 * int(line.split()[1]) for line in _lines("/proc/meminfo") if line.startswith("MemAvailable:")]
    return min([math.inf, *free, *_free_of_groups()])


def _free_of_groups() -> Iterator[float]:
    """Yield how much memory the control groups of this process, as of a container, can still take [bytes]."""
    for line in _lines("/proc/self/cgroup"):
        _, names, path = line.split(":", 2)
        if names == "" or "memory" in names.split(","):
            root, limit, used, cached = GROUPS[1 if names else 2]
            own = Path(root + path)
            for group in (own, *own.parents):
                most, now = _lines(group / limit), _lines(group / used)
                if most and now and most[0] != "max":
                    spare = [int(line.split()[1]) for line in _lines(group / "memory.stat") if line.startswith(f"{cached} ")]
                    yield float(int(most[0]) - int(now[0]) + sum(spare))


def _lines(path: str | Path) -> list[str]:
    """Return the lines of a file of the system; none where it cannot be read."""
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []
