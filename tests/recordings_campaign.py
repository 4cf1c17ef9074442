"""Damage and forge recordings at random, and kill and interrupt the processes that write them:

    python -m tests.recordings_campaign [flips] [truncations] [forgeries] [interrupts] [kills] [seed]

By default 1000, 200, 100, 100 and 100. Nothing may end this process, and no damaged recording may pass as intact.
"""

import os
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np

import tiverlet as tv

from .forging import FORGERIES, Forgery

PLACES = {"particles": "world/scene/particles", "positions": "Points2D:positions", "links": "LineStrips2D:strips"}


def scene():
    """Return a world with everything that is drawn, and its gravity."""
    rope = tv.shapes.rope((0.0, 1.0), (1.0, 1.0), 6)
    gravity = tv.Gravity(9.81)
    features = [gravity, tv.Distance(rope.links), tv.Contact(), tv.Box((-2.0, 0.0), (2.0, 3.0))]
    return tv.World(tv.Particles(rope.position, pinned=[0], radius=0.11), features, substeps=4, path="fused"), gravity


def record(path, frames=8):
    """Make a small recording in which a knob changes; return its path."""
    world, gravity = scene()
    with world, tv.Recorder(path, world) as recorder:
        for frame in range(frames):
            if frame == 4:
                gravity.g = 5.0
            world.step(1 / 60)
            recorder.log()
            recorder.flush()
    return pathlib.Path(path)


def judged(path):
    """Return the verdict on a file: its kind, or "refused"."""
    try:
        recording = tv.replay(path)
        return recording.verify().kind if recording.complete else "incomplete"  # verify() never calls these intact
    except ValueError:
        return "refused"


def flips(path, count, rng, folder):
    """Change one byte."""
    whole = path.read_bytes()
    for _ in range(count):
        data = bytearray(whole)
        at = rng.randrange(len(data))
        data[at] ^= rng.randrange(1, 256)
        yield f"byte {at} is {data[at]}", data


def truncations(path, count, rng, folder):
    """Cut the file short."""
    whole = path.read_bytes()
    for _ in range(count):
        at = rng.randrange(len(whole))
        yield f"cut at {at}", whole[:at]


def forgeries(path, count, rng, folder):
    """Change rows, and renew all checksums: first the named forgeries, then numbers at random."""
    names = sorted(FORGERIES)
    for k in range(count):
        forged = Forgery(path)
        if k < len(names):
            FORGERIES[names[k]](forged, PLACES)
            yield names[k], forged.save(folder / "forged.rrd").read_bytes()
            continue
        yield changed(forged, rng), forged.save(folder / "forged.rrd").read_bytes()


def changed(forged, rng):
    """Change one number, text or row of the picture; return a description."""
    while True:
        k = rng.choice([k for k in forged.chunks() if "tiverlet/journal" not in entity(forged, k)])
        batch = forged.messages[k][2]
        columns = [n for n, f in zip(batch.schema.names, batch.schema, strict=True) if f.metadata[b"rerun:kind"] != b"control"]
        column, row = rng.choice(columns), rng.randrange(batch.num_rows)
        if column in ("blueprint", "log_time") or column.endswith("start_time"):
            continue
        values = batch.column(column)
        cells = (values.cast("int64") if str(values.type) == "duration[ns]" else values).to_pylist()
        if isinstance(cells[row], int):
            cells[row] += rng.choice((-1, 1, 1000))
        elif not mutate(cells[row], rng):
            continue
        try:
            forged.set(k, **{column.replace(":", "__"): cells})
        except (ValueError, TypeError, OverflowError, NotImplementedError):
            continue
        return f"{entity(forged, k)} {column} row {row}"


def entity(forged, k):
    """Return the entity whose rows a message has."""
    return forged.messages[k][2].schema.metadata[b"rerun:entity_path"].decode()


def mutate(cell, rng):
    """Change one value in lists of lists; return whether there was one."""
    if not isinstance(cell, list) or not cell:
        return False
    k = rng.randrange(len(cell))
    if isinstance(cell[k], list):
        return mutate(cell[k], rng)
    if isinstance(cell[k], bool):
        cell[k] = not cell[k]
    elif isinstance(cell[k], int):
        cell[k] ^= 1
    elif isinstance(cell[k], float):
        cell[k] = (
            float(np.nextafter(np.float32(cell[k]), np.float32(1e30))) if cell[k] == np.float32(cell[k]) else 2 * cell[k] + 1
        )
    elif isinstance(cell[k], str):
        cell[k] += "?"
    else:
        return False
    return True


def interrupted(count, rng, folder):
    """Interrupt loops of steps by Ctrl-C at random moments; yield the verdicts."""
    world, _ = scene()
    with world:
        world.step(1 / 60)
        for k in range(count):
            path = folder / f"i{k % 4}.rrd"
            timer = threading.Timer(rng.uniform(0.001, 0.1), os.kill, (os.getpid(), signal.SIGINT))
            came = False
            try:
                with tv.Recorder(path, world, overwrite=True) as recorder:
                    timer.start()
                    for _ in range(100_000):
                        world.step(1 / 600)
                        recorder.log()
            except KeyboardInterrupt:
                came = True
            timer.join()
            yield f"interrupt {k}", tv.replay(path).verify().kind if came else "no interrupt"


KILLED = """
import sys, time
sys.path.insert(0, {root!r})
import tiverlet as tv
from tests.recordings_campaign import scene
tv.init(threads=1)
world, _ = scene()
world.step(1 / 60)
with tv.Recorder({path!r}, world) as recorder:
    print(0, time.time(), flush=True)
    for k in range(100_000):
        world.step(1 / 600)
        recorder.log()
        print(k + 1, time.time(), flush=True)
        time.sleep(0.002)
"""


def killed(count, rng, folder):
    """Kill processes by SIGKILL at random moments; yield the verdicts, and how much was lost [s]."""
    script, path = folder / "killed.py", folder / "k.rrd"
    script.write_text(KILLED.format(root=str(pathlib.Path(__file__).parents[1]), path=str(path)))
    for k in range(count):
        path.unlink(missing_ok=True)
        process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
        assert process.stdout
        lines = [process.stdout.readline()]
        timer = threading.Timer(rng.uniform(0.0, 1.5), process.kill)
        timer.start()
        lines += process.stdout.readlines()
        end = time.time()
        process.wait()
        times = [float(line.split()[1]) for line in lines if line.endswith("\n")]
        verdict = tv.replay(path).verify()
        lost = min(end, times[-1]) - times[min(verdict.frames, len(times)) - 1] if verdict.frames else float("inf")
        yield f"kill {k}: {verdict.frames} of {len(times)} frames, {lost:.3f} s lost", verdict.kind, lost


def campaign(counts, seed, folder, say=print):
    """Do `counts` of each; return what went wrong."""
    rng, wrong, path = random.Random(seed), [], record(folder / "original.rrd")
    assert judged(path) == "intact"
    for make, count in zip((flips, truncations, forgeries), counts, strict=False):
        seen: dict[str, int] = {}
        for what, data in make(path, count, rng, folder):
            other = folder / "other.rrd"
            other.write_bytes(data)
            verdict = judged(other)
            seen[verdict] = seen.get(verdict, 0) + 1
            if verdict == "intact":
                wrong.append(f"{make.__name__}: {what}")
        say(f"{make.__name__}: {count}: {seen}")
    verdicts = list(interrupted(counts[3], rng, folder))
    wrong += [f"{what}: {kind}" for what, kind in verdicts if kind != "intact"]
    say(f"interrupts: {len(verdicts)}: {sum(kind == 'intact' for _, kind in verdicts)} intact")
    ends = list(killed(counts[4], rng, folder))
    wrong += [f"{what}: {kind}" for what, kind, lost in ends if kind != "incomplete" or lost > 0.3]
    if ends:
        say(f"kills: {len(ends)}: at most {max(lost for *_, lost in ends):.3f} s lost")
    return wrong


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:]]
    numbers = [*given, *(1000, 200, 100, 100, 100, 0)[len(given) :]]
    with tempfile.TemporaryDirectory() as place:
        found = campaign(numbers[:5], numbers[5], pathlib.Path(place))
    print(*found, sep="\n")
    sys.exit(bool(found))
