"""``curio-train capture --assistant``: photographs from a camera, and a page on loopback that says what is missing."""

import contextlib
import json
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from curio_serve.imaging.video import open_video

from curio_train.capture.calibration import Board
from curio_train.capture.options import AssistantCommand
from curio_train.data.photographs import FEWEST_TO_LEARN_FROM, Photographs, read_photograph
from curio_train.doctor.assistant import Assistant, Judgement
from curio_train.errors import UsageError
from curio_train.learning.runs.interruption import Interruption

_BOARDS = 20
_SQUARE_M = 0.03  # any: only whether the board is seen counts here
_HOST = "127.0.0.1"
_SHOWN_PX = 960
_PAGE = b"""<!doctype html><meta charset="utf-8"><title>curio-train capture --assistant</title>
<style>body{font:16px sans-serif;margin:1em}img{max-width:100%}#said{font-size:1.6em}</style>
<div id="said">waiting for the first frame</div><img id="frame" alt=""><pre id="more"></pre>
<script>setInterval(async () => {
  const now = await (await fetch("status")).json();
  document.getElementById("said").textContent = now.said;
  document.getElementById("more").textContent = now.more;
  document.getElementById("frame").src = "frame.jpg?" + now.frame;
}, 300)</script>
"""


class Page:
    """The newest frame and what is said about it, for browsers on this machine."""

    def __init__(self, port: int) -> None:
        """Begin to listen for browsers.

        Raises:
            UsageError: The port is taken.
        """
        self._content: dict[str, tuple[str, bytes]] = {"": ("text/html", _PAGE), "status": _status("", "", 0)}
        content = self._content

        class Answer(BaseHTTPRequestHandler):
            def handle(self) -> None:
                with contextlib.suppress(ConnectionError):  # the browser is gone, or has turned to another page
                    super().handle()

            def do_GET(self) -> None:
                kind, body = content.get(self.path.strip("/").partition("?")[0], ("", b""))
                self.send_response(HTTPStatus.OK if kind else HTTPStatus.NOT_FOUND)
                self.send_header("Content-Type", kind or "text/plain")
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing: the terminal is for what is said about the frames."""

        try:
            self._server = ThreadingHTTPServer((_HOST, port), Answer)
        except (OSError, OverflowError) as exc:
            raise UsageError(f"--port {port}: cannot be listened on ({exc}); choose another") from exc
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)
        self.address = f"http://{_HOST}:{self._server.server_address[1]}/"
        """The page's URL."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._server.shutdown()
        self._server.server_close()

    def show(self, pixels: np.ndarray, text: str, more: str, number: int) -> None:
        """Replace what is shown."""
        scale = min(1.0, _SHOWN_PX / max(pixels.shape[:2]))
        small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else pixels
        _, encoded = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR))
        self._content["frame.jpg"] = ("image/jpeg", encoded.tobytes())
        self._content["status"] = _status(text, more, number)


def run(command: AssistantCommand, interruption: Interruption, report: Callable[[str], None]) -> int:
    """Take photographs until there are enough; the exit status is 1 where the frames end before.

    Raises:
        UsageError: The source cannot be opened, or a flag is out of range.
        DataError: A folder or a file cannot be used.
        CameraError: There is no such board.
    """
    board = None
    for flag, given in {"--marker-mm": command.marker_mm, "--dictionary": command.dictionary}.items():
        if command.board is None and given not in (None, AssistantCommand.dictionary):
            raise UsageError(f"{flag} {given} has no effect without --board; add that, or leave it out")
    if command.board is not None:
        marker_m = None if command.marker_mm is None else command.marker_mm / 1000
        board = Board(*command.board, _SQUARE_M, marker_m, command.dictionary)
    enough = command.count if command.count is not None else _BOARDS if board else FEWEST_TO_LEARN_FROM
    if enough < 1:
        raise UsageError(f"--count {enough}: expected at least 1")
    frames = _frames(command.video)
    assistant, faults = Assistant(command.out, board, command.background), Counter[str]()
    with Page(command.port) as page, interruption.deferred():
        report(f"{page.address} shows the frames; {assistant.num_kept} of {enough} photographs are in {command.out}")
        if assistant.wants_background:
            report(f"first the empty scene, for {command.background}: leave the part away")
        for number, pixels in enumerate(frames, 1):
            if _is_done(assistant, enough) or interruption.signum is not None:
                break
            before, was_background = assistant.num_kept, assistant.wants_background
            found = assistant.take(pixels)
            if was_background and not found.fault:
                report(f"{command.background}: the empty scene; now put the part into it")
            faults[found.fault] += 1
            if assistant.num_kept > before:
                report(f"{assistant.num_kept} of {enough} kept")
            text = f"{assistant.num_kept} of {enough} kept; this frame: {found.fault or 'kept'}"
            page.show(pixels, text, _more(found), number)
    if _is_done(assistant, enough):
        print(f"{command.out}: {assistant.num_kept} photographs, enough")
        return 0
    (worst, count), *_ = [*faults.most_common(1), ("", 0)]
    hint = f"; {count} frames were {worst}" if worst else ""
    if assistant.wants_background:
        hint = f", {command.background} was not taken{hint}"
    print(f"{command.out}: {assistant.num_kept} of {enough} photographs{hint}; the same command goes on")
    return 1 if interruption.signum is None else 128 + interruption.signum


def _is_done(assistant: Assistant, enough: int) -> bool:
    return assistant.num_kept >= enough and not assistant.wants_background


def _frames(source: str) -> Iterator[np.ndarray]:
    """uint8 RGB frames of a camera, a video file or a folder, opened now.

    Raises:
        UsageError: It cannot be opened.
        DataError: A photograph cannot be read.
    """
    if os.path.isdir(source):
        return (read_photograph(path) for path in Photographs(Path(source)).paths)
    capture = open_video(source)
    if not capture.isOpened():
        raise UsageError(f"--video {source}: cannot be opened; expected a camera's number, a video file or a folder")
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # of a camera, the newest frame; other sources ignore it
    return _read(capture)


def _read(capture: cv2.VideoCapture) -> Iterator[np.ndarray]:
    while True:
        is_read, pixels = capture.read()
        if not is_read:
            capture.release()
            return
        yield cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def _more(found: Judgement) -> str:
    return "\n".join(
        f"{name:11}{value:.3g}" if isinstance(value, float) else f"{name:11}{'yes' if value else 'no'}"
        for name, value in asdict(found).items()
        if value is not None and name != "fault"
    )


def _status(text: str, more: str, number: int) -> tuple[str, bytes]:
    return "application/json", json.dumps({"said": text, "more": more, "frame": number}).encode()
