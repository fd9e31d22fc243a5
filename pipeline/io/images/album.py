"""Album: images of the report with titles and captions, in a folder with an index."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    pass


@dataclass
class Album:
    """Images with titles and captions for the report, in a folder with an index."""

    folder: Path
    index: list[dict[str, Any]] = field(default_factory=list)

    def add(self, name: str, rgb: U8, role: str, title: str, caption: str, other: U8 | None = None) -> None:
        """Add an image; `other` is the second image of a comparison."""
        entry = {"file": self._write(name, rgb), "role": role, "title": title, "caption": caption}
        if other is not None:
            entry["other"] = self._write(f"{name}_other", other)
        self.index.append(entry)

    def save(self) -> None:
        """Write `index.json` beside the images."""
        (self.folder / "index.json").write_text(json.dumps(self.index, indent=1), encoding="utf-8")

    def _write(self, name: str, rgb: U8) -> str:
        image.write(self.folder / f"{name}.jpg", rgb, quality=88)
        return f"{name}.jpg"
