"""Results: what a toolbox says of an image, as JSON. Run as a program, it prints the schema."""

from __future__ import annotations

import json
from enum import StrEnum
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

SCHEMA = "scan2sim-result-1"
"""Changes when a field does."""


class State(StrEnum):
    """What became of a frame."""

    DONE = "done"
    DROPPED = "dropped"
    """Newer frames of its source had to wait."""
    LATE = "late"
    """Its deadline had passed, or would have."""
    REFUSED = "refused"
    """Its image can't be used."""
    FAILED = "failed"
    """The model failed."""


class Told(BaseModel):
    """Base of all that results are made of."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Detection(Told):
    """A thing in an image."""

    label: str
    score: float = Field(ge=0, le=1)
    box: tuple[float, float, float, float] = Field(description="Left, top, right, bottom: pixels of the image.")


class Moving(Detection):
    """A thing that was followed through a source's images."""

    track: int = Field(description="Number of the thing, of its source alone.")
    moving: bool | None = Field(description="Over the last second; null: it isn't known yet.")
    speed: float | None = Field(description="Pixels a second, of its corners against the background's.")
    detected: bool = Field(True, description="false: missed in this image; the box is where the thing's corners went.")


class Class(Told):
    """What an image may show."""

    label: str
    score: float = Field(ge=0, le=1)


class Segmentation(Told):
    """Classes of an image's pixels."""

    labels: tuple[str, ...] = Field(description="Names of the classes, by the mask's value.")
    shares: dict[str, float] = Field(description="Share of the pixels, of classes that are there.")
    mask: str = Field(description="8-bit grey PNG of the classes' numbers, base64.")
    size: tuple[int, int] = Field(description="Width and height of the mask, pixels; it shows the whole image.")


class Body(Told):
    """What a model says of an image: one of these, by the toolbox."""

    detections: tuple[Moving | Detection, ...] | None = None
    classes: tuple[Class, ...] | None = None
    segmentation: Segmentation | None = None


class Times(Told):
    """Seconds that a frame took."""

    waited: float = Field(description="In the queue.")
    worked: float = Field(description="From the queue to the result.")


class Result(Told):
    """What became of a frame.

    Attributes:
        id, source, stamp: the frame's.
        size: width and height of its image, pixels; None: it was never decoded.
        error: why there is no result.
    """

    schema_name: Literal["scan2sim-result-1"] = Field("scan2sim-result-1", alias="schema")
    toolbox: str
    model: str
    id: str
    source: str
    stamp: int | None
    state: State
    size: tuple[int, int] | None = None
    body: Body | None = None
    times: Times | None = None
    error: str | None = None

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    def json_line(self) -> str:
        """As one line of JSON; what is null is left out."""
        return self.model_dump_json(by_alias=True, exclude_none=True)


if __name__ == "__main__":
    print(json.dumps(Result.model_json_schema(), indent=2))
