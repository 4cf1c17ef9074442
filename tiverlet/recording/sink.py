"""The way of a recording to its file."""

import errno
import os
import select
import stat
import struct
import threading
import uuid
from time import monotonic, sleep
from typing import Any

WAIT = 10.0  # [s] that a flush may take
PIECE = 1 << 20  # bytes that are read at a time
HEADER = 12  # bytes of the file before its first message
HEAD = struct.Struct("<QQ")  # of a message: its kind, and the bytes that follow
END, CHUNK = 0, 2  # kinds: the last message, and one with data
BATCH = 120_000  # bytes that are sent together: LZ4 looks back by 64 kB
LEVEL = 9  # of LZ4: finds the points of lines among those of the particles, at 60 MB/s
PAYLOAD = b"\x2a"  # field 5 of a message with data, its bytes
COMPRESSION, SIZE = 2, 3  # its fields with the kind of compression, and how many bytes there are without it
LZ4 = 2
NOISE = 0.97  # what rerun's faster LZ4 leaves of noise: there is nothing to be found there


class Sink:
    """A rerun stream into a file that says when the file cannot be written.

    rerun's own way to a file ends with a full disk in a wait without end, when the stream is flushed, and when the process ends.
    So rerun writes into a pipe, and a thread copies message by message from there to the file; where that fails, the rest is read
    and dropped, and `error` is set. On the way data is compressed better, and rerun's footer is left out: an index of all chunks,
    which takes 90 kB and which `rerun rrd optimize` makes again. Where there are no pipes by name, rerun writes the file itself.

    A file that is to be overwritten stays as it is until keep().
    """

    def __init__(self, path: str, application: str, blueprint: Any, name: str, overwrite: bool = False):
        import rerun as rr

        self.path, self.bytes = path, 0
        self.error: Exception | None = None
        batches = rr.ChunkBatcherConfig(flush_num_bytes=BATCH)
        self.stream: Any = rr.RecordingStream(application, recording_id=uuid.uuid4(), batcher_config=batches)
        if not self.stream.is_enabled():
            raise RuntimeError("Recorder: rerun is switched off by RERUN in the environment; unset it to record.")
        self.stream.set_log_time_enabled(False)
        self._pid = os.getpid()
        self._new: str | None = None  # the name until keep(), where another file has that of the recording
        try:
            self._file = self._create(overwrite)
        except OSError as e:
            if isinstance(e, FileExistsError):
                raise
            raise type(e)(e.errno, f"Recorder: {path} cannot be written ({e.strerror}); choose another place") from None
        found = os.fstat(self._file.fileno())
        self._regular = stat.S_ISREG(found.st_mode)
        self._same = (found.st_dev, found.st_ino)
        self._copy: threading.Thread | None = None
        self._rest, self._past, self._ended = bytearray(), HEADER, False  # what was read of a message; bytes to pass on
        self._busy = threading.Lock()
        if os.path.isdir("/dev/fd"):
            self._out, into = os.pipe()
            self._copy = threading.Thread(target=self._pump, daemon=True)
            self._copy.start()
            self.stream.save(f"/dev/fd/{into}", default_blueprint=blueprint)
            os.close(into)
        else:
            self._file.close()
            self.stream.save(path, default_blueprint=blueprint)
        self.stream.send_recording_name(name)

    def _create(self, overwrite: bool) -> Any:
        try:
            kind = os.stat(self.path).st_mode
        except FileNotFoundError:
            return open(self.path, "xb", buffering=0)
        if not stat.S_ISREG(kind):  # a device or a pipe
            return open(self.path, "wb", buffering=0)
        if not overwrite:
            what = f"Recorder: {self.path} exists{'' if is_recording(self.path) else ', and is no recording'}. Choose another "
            raise FileExistsError(errno.EEXIST, f"{what}name, or replace it: Recorder(path, world, overwrite=True)")
        if not os.path.isdir("/dev/fd"):
            return open(self.path, "wb", buffering=0)
        folder, name = os.path.split(os.path.realpath(self.path))
        self._new = os.path.join(folder, f".{name}.{uuid.uuid4().hex[:8]}")
        os.close(os.open(self.path, os.O_WRONLY))  # may it be written?
        return open(self._new, "xb", buffering=0)

    def keep(self) -> None:
        """Give the file its name."""
        if self._new:
            os.replace(self._new, os.path.realpath(self.path))
            self._new = None

    def discard(self) -> None:
        """Remove the file, if it is one; one that was to be overwritten stays."""
        if self._regular and self._own(self._new or self.path):
            os.unlink(self._new or self.path)

    def _own(self, path: str) -> bool:
        try:
            found = os.stat(path)
        except OSError:
            return False
        return (found.st_dev, found.st_ino) == self._same

    def check(self) -> None:
        """Set `error` if the file was removed, or another one has its name."""
        if self._regular and self.error is None and not self._own(self._new or self.path):
            self.error = FileNotFoundError(errno.ENOENT, "the file was removed or replaced")

    def _pump(self) -> None:
        """Copy messages until rerun closes the pipe. Reading and writing go under one lock, so that flush() sees both done."""
        while True:
            select.select([self._out], [], [])
            with self._busy:
                piece = os.read(self._out, PIECE)
                if not piece:
                    break
                if self.error is None:
                    try:
                        self._take(piece)
                    except Exception as e:  # the pipe has to be read on, or rerun would wait for ever
                        self.error = e
        os.close(self._out)

    def _take(self, piece: bytes) -> None:
        self._rest += piece
        at = 0
        while not self._ended:
            if self._past:  # the header of the file
                if len(self._rest) < self._past:
                    return
                self._put(self._rest[: self._past])
                at, self._past = self._past, 0
            if len(self._rest) - at < HEAD.size:
                break
            kind, length = HEAD.unpack_from(self._rest, at)
            if kind == END:
                self._put(HEAD.pack(END, 0))
                self._ended = True
            elif len(self._rest) - at - HEAD.size < length:
                break
            else:
                message = bytes(self._rest[at + HEAD.size : at + HEAD.size + length])
                message = smaller(message) if kind == CHUNK else message
                self._put(HEAD.pack(kind, len(message)) + message)
                at += HEAD.size + length
        del self._rest[: len(self._rest) if self._ended else at]

    def _put(self, data: bytes | bytearray) -> None:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]
        self.bytes += len(data)

    def forked(self) -> bool:
        """Whether this is a child of the process that records: rerun does not work there, and nothing is copied."""
        return self._pid != os.getpid()

    def flush(self) -> None:
        """Wait until all that was logged is in the file."""
        if self.error is None:
            self.stream.flush(timeout_sec=WAIT)
            self._drain()

    def _drain(self) -> None:
        """Wait until the pipe is empty, and what came out of it is written."""
        end = monotonic() + WAIT
        while self._copy and self._copy.is_alive() and monotonic() < end:
            with self._busy:
                try:
                    if not select.select([self._out], [], [], 0)[0]:
                        return
                except (OSError, ValueError):  # it was closed
                    return
            sleep(0.0002)

    def close(self) -> None:
        """End the file. Calling it twice, or in a forked child, does nothing."""
        if self.forked():
            return
        stream, self.stream = self.stream, None
        if stream is not None:
            stream.disconnect()
            if self._copy:
                self._copy.join(WAIT)
            self._file.close()


def is_recording(path: str) -> bool:
    """Whether a file begins as recordings do; so does an empty one."""
    with open(path, "rb") as file:
        return file.read(4) in (b"RRF2", b"")


def smaller(message: bytes) -> bytes:
    """A message with data, compressed better than rerun does it in its hurry; as it is where there is nothing to gain."""
    import pyarrow as pa

    at, values, begin = 0, {}, None
    while at < len(message):
        start = at
        key, at = _varint(message, at)
        number, at = _varint(message, at)
        if key & 7 == 2:
            if message[start : start + 1] == PAYLOAD:
                begin, body = start, (at, at + number)
            at += number
        elif key & 7:
            raise ValueError("a message of rerun is not as expected")
        values[key >> 3] = number
    if begin is None or values.get(COMPRESSION) != LZ4 or body[1] - body[0] > NOISE * values[SIZE]:
        return message
    plain = pa.decompress(message[slice(*body)], values[SIZE], codec="lz4_raw")
    packed = pa.Codec("lz4_raw", compression_level=LEVEL).compress(plain).to_pybytes()
    if len(packed) >= body[1] - body[0]:
        return message
    return b"".join([message[:begin], PAYLOAD, _as_varint(len(packed)), packed, message[body[1] :]])


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of seven bits to a byte, and where the next begins."""
    number = shift = 0
    while True:
        byte = data[at]
        number, shift, at = number | (byte & 127) << shift, shift + 7, at + 1
        if byte < 128:
            return number, at


def _as_varint(number: int) -> bytes:
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])
