"""The path of a recording from rerun to its file."""

import contextlib
import errno
import hashlib
import os
import select
import stat
import threading
import uuid
from collections.abc import Iterator
from time import monotonic, sleep
from typing import Any

from .messages import BATCH, CHUNK, END, HEAD, HEADER, smaller, split, thinned
from .reader import SEAL

WAIT = 10.0  # [s] longest wait for a flush
REST = 1.0  # [s] without a byte after the last message, after which a child process must hold the other end of the pipe
PIECE = 1 << 20  # bytes read at a time
CHECK_INTERVAL = 0.2  # [s] between checks that the file still exists
BACKLOG = 32 << 20  # most bytes waiting to be written
SMALL = 2 << 20  # a file of fewer bytes is rewritten when it is closed: rows take less when put together
TICK = 0.1  # [s] rerun's interval of sending rows older than that, so a row waits for at most two intervals


class Lent:
    """A layout that is lent to rerun (0.41), `with Lent(layout) as lent:`.

    At the end the stream ends that rerun made of it, whose two threads and memory would stay for good.
    """

    def __init__(self, layout: Any):
        self._layout, self._stream = layout.to_blueprint(), None

    def __enter__(self) -> "Lent":
        return self

    def __exit__(self, *exc) -> None:
        if self._stream:
            self._stream.disconnect()

    def to_blueprint(self) -> "Lent":
        """Return itself, as rerun's layouts do."""
        return self

    def _log_to_stream(self, stream: Any) -> None:
        self._stream = stream
        self._layout._log_to_stream(stream)


class Sink:
    """A rerun stream into a file, with an error if the file cannot be written.

    With a full disk, rerun's own file writer waits forever when the stream is flushed, and when the process ends. So rerun writes
    into a pipe, and a thread copies messages from there to the file. If that fails, the rest is read and dropped, and `error` is
    set. On the way data are compressed better. rerun's footer is left out, an index of all chunks that takes 90 kB; `rerun rrd
    optimize` makes it again. Without /dev/fd, rerun writes the file itself.

    A file to be overwritten stays as it is until beginning() ends. viewer: the address of a viewer that shows it meanwhile.
    """

    def __init__(
        self, path: str, application: str, blueprint: Any, name: str, overwrite: bool = False, viewer: str | None = None
    ):  # fmt: skip
        import rerun as rr

        self.path, self.bytes, self._watched = path, 0, viewer is not None
        self.flushed, self._checked_at = 0, monotonic()  # bytes logged before the last flush; when check() was called last
        self.error: Exception | None = None
        batches = rr.ChunkBatcherConfig(flush_tick=TICK, flush_num_bytes=BATCH)
        self.stream: Any = rr.RecordingStream(application, recording_id=uuid.uuid4(), batcher_config=batches)
        if not self.stream.is_enabled():
            raise RuntimeError("Recorder: rerun is switched off by RERUN in the environment; unset it to record.")
        self.stream.set_log_time_enabled(False)
        self._pid = os.getpid()
        self._sum = hashlib.sha256()  # of all bytes written
        self._new: str | None = None  # temporary name until keep(), if a file is to be overwritten
        try:
            self._file = self._create(overwrite)
        except OSError as e:
            if isinstance(e, FileExistsError):
                raise
            raise type(e)(e.errno, f"Recorder: {path} cannot be written ({e.strerror}); choose another place") from None
        self._remember_file()
        self._copy: threading.Thread | None = None
        # part of a message; bytes of the header to pass on
        self._partial_message, self._header_left, self._ended = bytearray(), HEADER, False
        self._busy = threading.Lock()
        if os.path.isdir("/dev/fd"):
            self._out, into = os.pipe()
            self._copy = threading.Thread(target=self._copy_messages, daemon=True)
            self._copy.start()
            self._open(f"/dev/fd/{into}", blueprint, viewer)
            os.close(into)
        else:
            self._file.close()
            self._open(path, blueprint, viewer)
        self.stream.send_recording_name(name)

    def _open(self, path: str, blueprint: Any, viewer: str | None) -> None:
        import rerun as rr

        with Lent(blueprint) as lent:
            if viewer is None:
                self.stream.save(path, default_blueprint=lent)
            else:
                self.stream.set_sinks(rr.FileSink(path), rr.GrpcSink(viewer), default_blueprint=lent)

    def _create(self, overwrite: bool) -> Any:
        check_ending(self.path)
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
        os.close(os.open(self.path, os.O_WRONLY))  # raises if the file is not writable
        self._new = self._temporary_name()
        return open(self._new, "xb", buffering=0)

    def _temporary_name(self) -> str:
        """Return a name for a file that will replace the recording's."""
        folder = os.path.dirname(os.path.realpath(self.path))
        return os.path.join(folder, f".recording.{uuid.uuid4().hex[:8]}")  # the name of the recording may be too long for more

    def _remember_file(self) -> None:
        found = os.fstat(self._file.fileno())
        self._regular = stat.S_ISREG(found.st_mode)
        self._file_id = (found.st_dev, found.st_ino)

    @contextlib.contextmanager
    def beginning(self, who: str) -> Iterator[None]:
        """Within this context the first frame is written. Then the file gets its final name.

        After an error the file is closed and, if it is a regular file, removed; one that was to be overwritten stays.
        """
        try:
            yield
            if self.error:
                raise file_error(self.error, f"{who}: nothing could be written to {self.path}")
        except BaseException:
            self.close()
            if self._regular and self._is_own_file(self._new or self.path):
                os.unlink(self._new or self.path)
            raise
        if self._new:
            os.replace(self._new, os.path.realpath(self.path))
            self._new = None

    def _is_own_file(self, path: str) -> bool:
        try:
            found = os.stat(path)
        except OSError:
            return False
        return (found.st_dev, found.st_ino) == self._file_id

    def check(self) -> None:
        """Set `error` if the file was removed or replaced by another one."""
        self._checked_at = monotonic()
        if self._regular and self.error is None and not self._is_own_file(self._new or self.path):
            self.error = FileNotFoundError(errno.ENOENT, "the file was removed or replaced")

    def _copy_messages(self) -> None:
        """Copy messages until the last one. Reading and writing share one lock, so that flush() waits for both.

        After it rerun may write a footer, and prints an error if nobody reads it. Then it closes its end of the pipe, which a
        forked child may keep open.
        """
        while select.select([self._out], [], [], REST if self._ended else None)[0]:
            with self._busy:
                piece = os.read(self._out, PIECE)
                if not piece:
                    break
                if self.error is None:
                    try:
                        self._process(piece)
                    except Exception as e:  # keep reading the pipe, or rerun would wait forever
                        self.error = e
        os.close(self._out)

    def _process(self, piece: bytes) -> None:
        self._partial_message += piece
        at = 0
        while not self._ended:
            if self._header_left:  # the header of the file
                if len(self._partial_message) < self._header_left:
                    return
                self._put(self._partial_message[: self._header_left])
                at, self._header_left = self._header_left, 0
            if len(self._partial_message) - at < HEAD.size:
                break
            kind, length = HEAD.unpack_from(self._partial_message, at)
            if len(self._partial_message) - at - HEAD.size < length:
                break
            if kind == END:
                seal = SEAL + self._sum.digest()
                self._put(HEAD.pack(END, len(seal)) + seal)
                self._ended = True
            else:
                message = bytes(self._partial_message[at + HEAD.size : at + HEAD.size + length])
                message = smaller(message) if kind == CHUNK else message
                self._put(HEAD.pack(kind, len(message)) + message)
                at += HEAD.size + length
        del self._partial_message[: len(self._partial_message) if self._ended else at]

    def _put(self, data: bytes | bytearray) -> None:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]
        self._sum.update(data)
        self.bytes += len(data)

    def show(self, blueprint: Any, at_once: bool = False) -> None:
        """Set the layout in which the recording opens, unless the user has made one; at_once: also if he has."""
        with Lent(blueprint) as lent:
            self.stream.send_blueprint(lent, make_active=at_once)

    def thin(self, stride: int) -> bool:
        """Keep the picture of one of `stride` frames: rewrite the file, and replace the old one by it.

        Call it after flush(). Returns whether the file was replaced.
        """
        if not self._copy or not self._regular or self.error:
            return False
        with self._busy:
            old = os.path.realpath(self.path) if self._new is None else self._new
            with open(old, "rb") as file:
                data = file.read()
            new, whole = self._temporary_name(), hashlib.sha256()
            try:
                with open(new, "xb") as file:
                    os.chmod(new, stat.S_IMODE(os.fstat(self._file.fileno()).st_mode))
                    pieces = (HEAD.pack(kind, len(message)) + message for kind, message in thinned(split(data), stride))
                    for piece in (data[:HEADER], *pieces):
                        file.write(piece)
                        whole.update(piece)
                after = open(new, "ab", buffering=0)
                os.replace(new, old)
            except OSError:  # the folder takes no further file, or there is no space for both
                with contextlib.suppress(OSError):
                    os.unlink(new)
                return False
            self._file.close()
            self._file, self._sum, self.bytes = after, whole, after.tell()
            self._remember_file()
        return True

    def forked(self) -> bool:
        """Whether this is a child of the recording process, where rerun and the copying thread do not work."""
        return self._pid != os.getpid()

    def keep_up(self, logged: int) -> None:
        """Wait if too much is not written yet, and look from time to time whether the file is there. logged: bytes in all."""
        if logged - self.flushed > BACKLOG:
            self.flush(logged)
        if monotonic() - self._checked_at > CHECK_INTERVAL:
            self.check()

    def finish(self, blueprint: Any) -> None:
        """Wait until everything is in the file, which opens with this layout, if one is given. A small file is rewritten."""
        if blueprint:
            self.show(blueprint)
        self.flush()
        self.check()
        if self.bytes < SMALL:
            self.thin(1)

    def flush(self, logged: int = 0) -> None:
        """Wait until everything logged is in the file. logged: bytes in all."""
        self.flushed = logged
        if self.error is None:
            try:
                self.stream.flush(timeout_sec=WAIT)
            except RuntimeError:  # the user closed the viewer, but the file goes on
                if not self._watched:
                    raise
                sleep(3 * TICK)
            self._drain()

    def _drain(self) -> None:
        """Wait until the pipe is empty and its data are written."""
        end = monotonic() + WAIT
        while self._copy and self._copy.is_alive() and monotonic() < end:
            with self._busy:
                try:
                    if not select.select([self._out], [], [], 0)[0]:
                        return
                except (OSError, ValueError):  # the pipe was closed
                    return
            sleep(0.0002)

    def close(self) -> None:
        """End the file. Calling it twice, or in a forked child, does nothing."""
        if self.forked():
            return
        if self.stream is not None:
            import rerun_bindings as rerun

            self.stream.disconnect()
            if self._copy:
                self._copy.join(WAIT)
            self._file.close()
            self.stream = None
            rerun.flush_and_cleanup_orphaned_recordings()  # ends the threads of what Python no longer refers to


def checked_place(who: str, path: str | os.PathLike) -> tuple[str, str]:
    """Return the path of a new recording and its title; raise ValueError if the folder is missing."""
    folder, (title, _) = os.path.dirname(os.path.abspath(path)), os.path.splitext(os.path.basename(path))
    if not os.path.isdir(folder):
        raise ValueError(f"{who}: the folder {folder} does not exist. Make it first: os.makedirs({folder!r}).")
    return os.fspath(path), title


def is_recording(path: str) -> bool:
    """Whether a file begins like a recording; an empty one counts."""
    with open(path, "rb") as file:
        return file.read(4) in (b"RRF2", b"")


def check_ending(path: str | os.PathLike) -> None:
    """Raise ValueError for a name with another ending than .rrd: neither the viewer nor a player of films would open the file."""
    name = os.fspath(path)
    stem, ending = os.path.splitext(name)
    if ending not in ("", ".rrd"):
        raise ValueError(
            f"{name} ends in {ending!r}, but a recording is an .rrd file. Write {stem + '.rrd'!r}; of that, "
            f"tv.replay({stem + '.rrd'!r}).export(path) makes films, meshes and tables, in the format of the ending of path."
        )


def check_replaceable(path: str | os.PathLike) -> None:
    """Raise ValueError for an existing file that is no recording, which no command replaces, and for a name of other files."""
    check_ending(path)
    if os.path.isfile(path) and not is_recording(os.fspath(path)):
        raise ValueError(f"{os.fspath(path)} is no recording, and is not replaced. Give another name, or remove it first.")


def file_error(error: Exception, what: str, rest: str = "") -> OSError:
    """Return the error of a file with an explanation."""
    if isinstance(error, OSError):
        return type(error)(error.errno, f"{what} ({error.strerror}){rest}")
    return OSError(errno.EIO, f"{what} ({error!r}){rest}")
