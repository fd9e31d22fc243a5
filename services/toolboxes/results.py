"""JSON results of toolboxes. Run as a program, it prints their JSON Schema."""

from __future__ import annotations

import json
from enum import StrEnum
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

SCHEMA = "scan2sim-result-2"
"""Schema identifier; changes whenever a field does."""


class State(StrEnum):
    """Final state of a frame."""

    DONE = "done"
    DROPPED = "dropped"
    """Dropped because newer frames of its source were waiting."""
    LATE = "late"
    """Its deadline had passed, or would have passed before the result."""
    REJECTED = "rejected"
    """Its image could not be decoded."""
    FAILED = "failed"
    """The model failed."""


class ResultModel(BaseModel):
    """Base class of results and their parts."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Detection(ResultModel):
    """An object detected in an image."""

    label: str
    score: float = Field(ge=0, le=1)
    box: tuple[float, float, float, float] = Field(description="Left, top, right, bottom in pixels of the image.")


class Moving(Detection):
    """An object that is tracked through the images of a source."""

    track: int = Field(description="Track number, unique within its source.")
    moving: bool | None = Field(description="Whether it moved in the last second; null: not known yet.")
    speed: float | None = Field(description="Speed relative to the background, pixels per second.")
    detected: bool = Field(True, description="false: not detected in this image, the box follows its tracked corners.")


class Class(ResultModel):
    """A class of an image with its probability."""

    label: str
    score: float = Field(ge=0, le=1)


class Segmentation(ResultModel):
    """Semantic segmentation of an image."""

    labels: tuple[str, ...] = Field(description="Names of the classes, indexed by the values of the mask.")
    shares: dict[str, float] = Field(description="Fraction of the pixels by class, for the classes that occur.")
    mask: str = Field(description="Class indices as an 8-bit greyscale PNG in base64; 255: none.")
    size: tuple[int, int] = Field(description="Width and height of the mask in pixels; it covers the whole image.")


class Body(ResultModel):
    """Output of a model for an image; the toolbox determines which field is set."""

    detections: tuple[Moving | Detection, ...] | None = None
    threshold: float | dict[str, float] | None = Field(
        None, description="Minimum score of a detection; by class if classes differ."
    )
    classes: tuple[Class, ...] | None = None
    segmentation: Segmentation | None = None


class Times(ResultModel):
    """Processing times of a frame in seconds."""

    waited: float = Field(description="Time in the queue.")
    worked: float = Field(description="Time from the queue to the result.")


class Result(ResultModel):
    """Result of a frame.

    Attributes:
        id, source, stamp: those of the frame.
        size: width and height of its image in pixels; None: it was not decoded.
        error: cause if there is no output.
    """

    schema_name: Literal["scan2sim-result-2"] = Field("scan2sim-result-2", alias="schema")
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
        """Serialize as one line of JSON without null fields."""
        return self.model_dump_json(by_alias=True, exclude_none=True)


if __name__ == "__main__":
    print(json.dumps(Result.model_json_schema(), indent=2))
