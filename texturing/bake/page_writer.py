"""Background writer of texture pages: a page is written while the next one is painted."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.texture_page import Page


class PageWriter:
    """Writes pages in a background thread, one at a time, so that at most two pages are in memory."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1)
        self._last: Future[None] | None = None

    def write(self, path: Path, page: Page) -> None:
        """Start writing `path`.png and `path`_seen.png once the previous page is written."""
        self.finish()
        self._last = self._pool.submit(_write, path, page.rgb, page.seen)

    def finish(self) -> None:
        """Wait until the last page is written; raises the error if writing failed."""
        if self._last is not None:
            self._last.result()


def _write(path: Path, rgb: U8, seen: U8) -> None:
    image.write(path.with_name(f"{path.name}.png"), rgb)
    image.write(path.with_name(f"{path.name}_seen.png"), seen)
