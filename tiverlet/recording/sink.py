"""The way of a recording to its file."""

import os
import threading
import uuid
from typing import Any

WAIT = 10.0  # [s] that a flush may take
PIECE = 1 << 20  # bytes that are copied at a time


class Sink:
    """A rerun stream into a file that says when the file cannot be written.

    rerun's own way to a file ends with a full disk in a wait without end, when the stream is flushed, and when the process ends.
    So rerun writes into a pipe, and a thread copies from there to the file; where that fails, the rest is read and dropped, and
    `error` is set. Where there are no pipes by name, rerun writes the file itself.
    """

    def __init__(self, path: str, application: str, blueprint: Any, name: str):
        import rerun as rr

        self.bytes = 0
        self.error: OSError | None = None
        self.stream: Any = rr.RecordingStream(application, recording_id=uuid.uuid4())
        if not self.stream.is_enabled():
            raise RuntimeError("Recorder: rerun is switched off by RERUN in the environment; unset it to record.")
        try:
            self._file = open(path, "wb", buffering=0)
        except OSError as e:
            raise type(e)(e.errno, f"Recorder: {path} cannot be written ({e.strerror}); choose another place") from None
        self._copy: threading.Thread | None = None
        if os.path.isdir("/dev/fd"):
            out, into = os.pipe()
            self._copy = threading.Thread(target=self._pump, args=(out,), daemon=True)
            self._copy.start()
            self.stream.save(f"/dev/fd/{into}", default_blueprint=blueprint)
            os.close(into)
        else:
            self._file.close()
            self.stream.save(path, default_blueprint=blueprint)
        self.stream.send_recording_name(name)

    def _pump(self, out: int) -> None:
        while piece := memoryview(os.read(out, PIECE)):
            self.bytes += len(piece)
            while piece and self.error is None:
                try:
                    piece = piece[self._file.write(piece) :]
                except OSError as e:
                    self.error = e
        os.close(out)

    def flush(self) -> None:
        """Wait until all that was logged is in the file."""
        if self.error is None:
            self.stream.flush(timeout_sec=WAIT)

    def close(self) -> None:
        """End the file with its summary. Calling it twice does nothing."""
        stream, self.stream = self.stream, None
        if stream is not None:
            stream.disconnect()
            if self._copy:
                self._copy.join(WAIT)
            self._file.close()
