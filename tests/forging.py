"""Forged recordings for tests: taken apart, changed row by row, and written with valid checksums."""

import hashlib
import json

import pyarrow as pa

import tiverlet as tv
from tiverlet.recording import journal, messages, reader

PARTICLES = "world/scene/particles"
NOT_SHOWN = ("rerun.controls.RowId", "blueprint", "RecordingInfo:start_time")
LAST_ID = 0x7FFFFFFFFFFFFFFFFFFFFFFFFFFFFF00  # an id higher than all others


def record(path, frames=6):
    """Make a small recording of everything that is drawn, in which a knob changes; return its path."""
    rope, gravity = tv.shapes.rope((0.0, 1.0), (1.0, 1.0), 6), tv.Gravity(9.81)
    features = [gravity, tv.Distance(rope.links), tv.Box((-2.0, 0.0), (2.0, 3.0))]
    particles = tv.Particles(rope.position, pinned=[0], radius=0.11)
    with tv.World(particles, features, substeps=4, path="fused") as world, tv.Recorder(path, world) as recorder:
        for frame in range(frames):
            if frame == 4:
                gravity.g = 5.0
            world.step(1 / 60)
            recorder.log()
            recorder.flush()
    return path


def entity_of(rows):
    """Return the path of the entity that rows are of."""
    return rows.schema.metadata[b"rerun:entity_path"].decode().lstrip("/")


class Forgery:
    """A recording as a list of messages, each with its kind, and with the rows of an entity or None."""

    def __init__(self, path):
        data = path.read_bytes()
        self.head, parts = data[: messages.HEADER], messages.split(data)
        self.messages = [(kind, m, messages.rows_of(m) if kind == messages.CHUNK else None) for kind, m in parts if kind]

    def save(self, to, seal=True):
        """Write the recording to `to` and return the path. seal: append a valid end record."""
        out = self.head
        for kind, message, rows in self.messages:
            body = message if rows is None else messages.holding(message, rows)
            out += messages.HEAD.pack(kind, len(body)) + body
        if seal:
            out += messages.HEAD.pack(messages.END, 34) + reader.SEAL + hashlib.sha256(out).digest()
        to.write_bytes(out)
        return to

    def chunks(self, entity):
        """Return the numbers of messages that hold rows of entities whose paths begin with `entity`."""
        return [k for k, (_, _, rows) in enumerate(self.messages) if rows is not None and entity_of(rows).startswith(entity)]

    def rows(self, entity, column):
        """Return where rows of the entity with this column are, except those for all frames: (number of the message, row)."""
        out = []
        for k in self.chunks(entity):
            batch = self.messages[k][2]
            if {column, "frame"} <= {*batch.schema.names}:
                out += [(k, row) for row in range(batch.num_rows) if batch.column(column)[row].is_valid]
        return out

    def set(self, k, **columns):
        """Replace columns given by name, with __ for :. None drops a column."""
        kind, message, batch = self.messages[k]
        for name, values in columns.items():
            at = batch.schema.get_field_index(name.replace("__", ":"))
            if values is None:
                batch = batch.remove_column(at)
            else:
                field = batch.schema.field(at)
                if not isinstance(values, pa.Array):
                    values = pa.array(values, type=field.type)
                batch = batch.set_column(at, field, values)
        self.messages[k] = (kind, message, batch)

    def only(self, k, rows):
        """Keep these rows of a message; without rows, drop the message."""
        kind, message, batch = self.messages[k]
        if len(rows):
            self.messages[k] = (kind, message, batch.take(pa.array(rows)))
        else:
            del self.messages[k]

    def copy(self, k, rows, entity=None, static=False):
        """Insert copies of rows, with ids above all others, before all rows."""
        kind, message, batch = self.messages[k]
        batch = batch.take(pa.array(rows))
        at = batch.schema.get_field_index("rerun.controls.RowId")
        ids = [(LAST_ID + n).to_bytes(16, "big") for n in range(len(rows))]
        batch = batch.set_column(at, batch.schema.field(at), pa.array(ids, type=batch.schema.field(at).type))
        if entity:
            batch = batch.replace_schema_metadata({**batch.schema.metadata, b"rerun:entity_path": f"/{entity}".encode()})
        if static:
            batch = batch.drop_columns([name for name in ("frame", "time") if name in batch.schema.names])
            message = message[:-1] + b"\x01"  # its last field
        self.messages.insert(1 + max(n for n, m in enumerate(self.messages) if m[0] == 1), (kind, message, batch))

    def journal(self, change, seal=True):
        """Replace every journal entry by change(entry), or drop it where that is None. seal: write valid checksums again."""
        mark, serial, empty = "", 0, []
        for k in self.chunks(journal.JOURNAL):
            batch = self.messages[k][2]
            rows, blobs = batch.column("text").to_pylist(), batch.column("blob")
            texts, marks, kept = [], [], []
            for row, (text,) in enumerate(rows):
                lines = [entry for line in text.split("\n") if (entry := change(json.loads(line))) is not None]
                if not lines:
                    continue
                for entry in lines:
                    entry["serial"], serial = serial, serial + 1
                texts.append(["\n".join(map(json.dumps, lines))])
                blob = blobs[row].values.to_numpy().tobytes() if blobs[row].is_valid else b""
                mark = journal.checksum(mark, texts[-1][0], blob)
                marks.append([mark if seal else batch.column("checksum")[row].as_py()[0]])
                kept.append(row)
            if kept:
                self.only(k, kept)
                self.set(k, text=texts, checksum=marks)
            else:
                empty.append(k)
        for k in reversed(empty):
            self.only(k, [])
        return self


def changed(value):
    """Return another value of the same type."""
    if isinstance(value, dict):
        name = next(name for name in value if value[name] is not None)
        return {**value, name: changed(value[name])}
    if isinstance(value, list):
        return [changed(value[0]), *value[1:]]
    if isinstance(value, str | bool):
        return value + "x" if isinstance(value, str) else not value
    return value ^ 1 if isinstance(value, int) else 1.5 * value + 1


def pictures(original):
    """Yield names and recordings in which each column of the picture, and each twelfth of its layout, has one cell changed.

    In chunks of the scene, rows are also dropped, or others stand before them with later ids, for all frames, or elsewhere: in
    each chunk in two of these ways, in turn.
    """
    for k, (_, _, batch) in enumerate(Forgery(original).messages):
        entity = entity_of(batch) if batch is not None else journal.JOURNAL
        if entity == journal.JOURNAL:
            continue
        for name in [n for n in batch.schema.names if n not in NOT_SHOWN]:
            column = batch.column(name).cast(pa.int64()) if name == "time" else batch.column(name)
            values = column.to_pylist()
            row = max((r for r, value in enumerate(values) if value not in (None, [])), default=None)
            if row is None or ("blueprint" in batch.schema.names and k % 12):
                continue
            forged = Forgery(original)
            forged.set(k, **{name.replace(":", "__"): [*values[:row], changed(values[row]), *values[row + 1 :]]})
            yield f"{entity} {name}", forged
        if "frame" in batch.schema.names and entity.startswith("world/"):
            last, column = batch.num_rows - 1, next(n for n in batch.schema.names if ":" in n).replace(":", "__")
            ways = (
                ("a row less", "only", [range(last)], {}),
                ("no rows", "only", [[]], {}),
                ("a column less", "set", [], {column: None}),
                ("a later row", "copy", [[0]], {}),
                ("a row for all frames", "copy", [[last]], {"static": True}),
                ("a row elsewhere", "copy", [[last]], {"entity": f"{entity}/more"}),
            )
            for name, method, args, more in ways[k % 3 :: 3]:
                forged = Forgery(original)
                getattr(forged, method)(k, *args, **more)
                yield f"{entity} {name}", forged


def _told(kind, change):
    """Change the data of journal entries of one kind."""

    def told(f):
        def entry(e):
            if e["kind"] == kind:
                change(e["data"])
            return e

        f.journal(entry)

    return told


def _gone(kind):
    return lambda f: f.journal(lambda e: None if e["kind"] == kind else e)


def _metadata(f):
    k, _ = f.rows(PARTICLES, "Points2D:positions")[0]
    kind, message, batch = f.messages[k]
    at = batch.schema.get_field_index("Points2D:positions")
    field = batch.schema.field(at)
    field = field.with_metadata({**field.metadata, b"rerun:component_type": b"rerun.components.Color"})
    f.messages[k] = (kind, message, batch.set_column(at, field, batch.column(at)))


def _reordered(f):
    k, _ = f.rows(PARTICLES, "Points2D:positions")[0]
    ids = f.messages[k][2].column("rerun.controls.RowId").to_pylist()
    f.set(k, **{"rerun.controls.RowId": [ids[0], ids[-1], *ids[2:-1], ids[1]]})


def _renamed(f):
    f.messages = [(kind, message.replace(b"tiverlet_", b"tiverless"), rows) for kind, message, rows in f.messages]


FORGERIES = {
    "the type of a column": _metadata,
    "rows in another order": _reordered,
    "rows twice": lambda f: f.messages.append(f.messages[f.rows(PARTICLES, "Points2D:positions")[3][0]]),
    "no layout": lambda f: f.messages.__setitem__(slice(None), [m for m in f.messages if m[0] != 3]),
    "a view less": lambda f: f.only(f.chunks("view/")[1], []),
    "another application": _renamed,
    "the environment": _told("scene", lambda d: d["environment"].update(taichi="1.7.5")),
    "the number of threads": _told("scene", lambda d: d["environment"].update(threads=64)),
    "the number of frames": _told("end", lambda d: d.update(frames=d["frames"] + 1)),
    "the time at the end": _told("end", lambda d: d.update(time=2 * d["time"])),
    "the hash at the end": _told("end", lambda d: d.update(hash="0" * 64)),
    "the time of frames": _told("frame", lambda d: d.update(time=10 * d["time"])),
    "hashes of frames": _told("frame", lambda d: d.update(hash="0" * 64)),
    "checksums of pictures": _told("frame", lambda d: d.update(crc=d["crc"] ^ 1)),
    "how long frames took": _told("frame", lambda d: d.update(seconds=d.get("seconds", 0) / 10)),
    "flags": _told("frame", lambda d: d.update(flags=["stiff-force"], notes=["stiff-force: none"])),
    "what was compiled": _told("scene", lambda d: d.update(explained="nothing")),
    "knobs": _told("turned", lambda d: d["features"].get("0", {}).update(g=3.0)),
    "kernels that there are not": _told("state", lambda d: d.update(once=[["levity"], *d["once"][1:]])),
    "nothing turned": _gone("turned"),
    "no end": _gone("end"),
    "a feature that there is not": _told("scene", lambda d: d["features"][0].update({"class": "Levity"})),
    "an argument that there is not": _told("scene", lambda d: d["features"][0]["arguments"].update(anti=True)),
}
