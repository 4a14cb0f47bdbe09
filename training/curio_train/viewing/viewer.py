"""The page of ``curio-view``: a scene in 3D beside its photograph, its re-rendering and their difference."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import viser
from curio_serve.ports import port_fault

from curio_train.drawing.scenes import Placed, Scene
from curio_train.errors import CurioError, UsageError
from curio_train.geometry import Pose
from curio_train.viewing.comparison import compare
from curio_train.viewing.fitting import walk
from curio_train.viewing.pages import Page
from curio_train.viewing.panel import Panel
from curio_train.viewing.saving import save
from curio_train.viewing.space import Space

_POLL_S = 2.0  # between looks for newer pages
_STEPS_SHOWN = 4  # of a fit: one picture for so many

Reload = Callable[[], Sequence[Page] | None]
"""Newer pages, or None if there are none."""


class Viewer:
    """Shows pages in browsers; all browsers see the same page, and each may edit it.

    Callbacks of browsers run in threads of viser; the renderer is not thread-safe, so one thread draws and fits.
    """

    def __init__(self, pages: Sequence[Page], out: Path, host: str, port: int, reload: Reload = lambda: None) -> None:
        """Start the web server.

        Args:
            pages: At least one.
            out: File that *save the code* appends to.
            host: Address to listen on.
            port: To listen on.
            reload: Called every two seconds by the thread that draws.

        Raises:
            UsageError: The address cannot be listened on.
        """
        if fault := port_fault(host, port):
            raise UsageError(fault)
        self._pages, self._out, self._reload = list(pages), out, reload
        self._number, self._selected = 0, 0
        self._unsaved: set[int] = set()  # pages that were edited since
        self._lock = threading.RLock()
        self._changed, self._fit_asked, self._ended = threading.Event(), threading.Event(), threading.Event()
        self._server = viser.ViserServer(host=host, port=port, label="curio-view", verbose=False)
        self._server.gui.configure_theme(control_width="large", show_share_button=False)
        self._panel = Panel(self._server.gui)
        self._space = Space(self._server, self._drag)
        self._connect()
        self._show_page(0)
        self._worker = threading.Thread(target=self._work, name="curio-view")
        self._worker.start()

    @property
    def page(self) -> Page:
        """The page that is shown, with all edits."""
        return self._pages[self._number]

    def close(self) -> None:
        """End the worker and the web server."""
        self._ended.set()
        self._changed.set()
        self._worker.join()
        self._server.stop()

    def _connect(self) -> None:
        panel = self._panel
        panel.pager.on_update(self._from_browser(lambda: self._show_page(int(panel.pager.value) - 1)))
        panel.objects.on_update(self._from_browser(self._select))
        panel.on_object(self._from_browser(self._edit_object))
        panel.light.on_update(self._from_browser(self._edit_light))
        panel.fit.on_click(self._from_browser(self._ask_for_fit))
        panel.save.on_click(self._from_browser(self._save))

    def _from_browser(self, action: Callable[[], None]) -> Callable[[Any], None]:
        """A callback that ignores our own changes, which have no client."""

        def callback(event: Any) -> None:
            if event.client is not None:
                with self._lock:
                    action()

        return callback

    # Edits; the lock is held.

    def _show_page(self, number: int) -> None:
        self._number, self._selected = number, 0
        self._panel.show_page(number, len(self._pages), self.page.scene)
        self._space.show(self.page)
        self._show_values()
        self._changed.set()

    def _select(self) -> None:
        self._selected = self._panel.objects.options.index(self._panel.objects.value)
        self._show_values()

    def _show_values(self) -> None:
        self._panel.show_values(self.page.scene, self.page.light, self._selected)

    def _edit_object(self) -> None:
        if self.page.scene.objects:
            item = self._panel.edited(self.page.scene.objects[self._selected])
            self._replace_object(self._selected, item)
            self._space.move(self._selected, item.pose)

    def _edit_light(self) -> None:
        self._replace_scene(replace(self.page.scene, light=np.array(self._panel.light.value, dtype=np.float64)))

    def _ask_for_fit(self) -> None:
        self._fit_asked.set()
        self._changed.set()

    def _save(self) -> None:
        try:
            save(self.page, self._out)
        except CurioError as exc:
            self._panel.message(f"**not saved**: {exc}")
        else:
            self._unsaved.discard(self._number)
            self._panel.message(f"saved to {self._out}")

    def _drag(self, number: int, pose: Pose) -> None:
        with self._lock:
            self._selected = number
            self._replace_object(number, replace(self.page.scene.objects[number], pose=pose))
            self._show_values()

    def _replace_object(self, number: int, item: Placed) -> None:
        objects = list(self.page.scene.objects)
        objects[number] = item
        self._replace_scene(replace(self.page.scene, objects=tuple(objects)))

    def _replace_scene(self, scene: Scene) -> None:
        self._pages[self._number] = replace(self.page, scene=scene)
        self._unsaved.add(self._number)
        self._panel.message("edited, not saved yet")
        self._changed.set()

    # The thread that draws.

    def _work(self) -> None:
        while not self._ended.is_set():
            changed = self._changed.wait(_POLL_S)
            self._changed.clear()
            try:
                if not changed:
                    self._look_for_newer_pages()
                elif self._fit_asked.is_set():
                    self._fit_asked.clear()
                    self._fit()
                if changed:
                    self._draw()
            except CurioError as exc:
                self._panel.message(f"**error**: {exc}")
                self._panel.show_photograph(self.page.image)

    def _draw(self) -> None:
        with self._lock:
            page = self.page
        self._panel.show_pictures(compare(page))

    def _look_for_newer_pages(self) -> None:
        """Show what a newer checkpoint reads, but on the pages whose edits are not saved."""
        newer = self._reload()
        if not newer:
            return
        with self._lock:
            kept = {number: self._pages[number] for number in self._unsaved if number < len(newer)}
            self._pages, self._unsaved = list(newer), set(kept)
            for number, page in kept.items():
                self._pages[number] = page
            if self._number in kept:
                self._panel.message("There is a newer checkpoint. This page keeps your edits until you save them.")
            else:
                self._show_page(min(self._number, len(newer) - 1))

    def _fit(self) -> None:
        """Move the selected object by render-and-compare and show every step; another edit ends it."""
        with self._lock:
            page, number = self.page, self._selected
        if not page.scene.objects:
            return
        shown, first = page, None
        for count, step in enumerate(walk(page, number), start=1):
            first = step.loss if first is None else first
            with self._lock:
                if self.page is not shown or self._ended.is_set():
                    self._panel.message("fit: stopped by another change")
                    return
                self._replace_object(number, replace(page.scene.objects[number], pose=step.pose))
                self._space.move(number, step.pose)
                self._show_values()
                shown = self.page
            self._panel.message(f"fit: step {count}, robust residual {first:.3f} → {step.loss:.3f}")
            if count % _STEPS_SHOWN == 0:
                self._draw()
        self._panel.message(f"fit: done, robust residual {first:.3f} → {step.loss:.3f}, not saved yet")
