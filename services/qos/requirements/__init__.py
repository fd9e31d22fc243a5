"""Requirements on a service's quality, by where it runs: the metrics of D3.2's table 2, and its tables as files.

A file is TOML: a `title`, a `description`, where it is from (`source`), the width and height of the images that it is
for (`image`), and a table for each of `robot`, `edge` and `cloud` (section 2.2). A value is a bound ("< 2000", "> 20",
"4" for at least so many cores), a preferred slice, or left out where nothing is asked.
"""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.io import toml

FOLDER = Path(__file__).parent
"""Of the files that come along: those of D3.2's tables 3, 6, 7, 8, 10 and 11."""


class Environment(StrEnum):
    """Where a service runs (D3.2, section 2.2)."""

    ROBOT = "robot"
    """On the robot: no network between camera and model."""
    EDGE = "edge"
    """On site, by Wi-Fi."""
    CLOUD = "cloud"
    """Off site, by a mobile network."""


class Bound(BaseModel):
    """What a value must be.

    Attributes:
        kind: at most, or at least, that much.
        value: in its metric's unit.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["<", ">"]
    value: float = Field(ge=0)

    def met(self, value: float) -> bool:
        """Whether a value is so."""
        return value <= self.value if self.kind == "<" else value >= self.value

    def __str__(self) -> str:
        return f"{'at most' if self.kind == '<' else 'at least'} {self.value:g}"


def _bound(default: Literal["<", ">"]) -> BeforeValidator:
    """Of a text as "< 5"; without a sign it is what the metric goes by."""

    def parsed(given: Any) -> Any:
        if isinstance(given, (Bound, dict)) or given is None:
            return given
        match = re.fullmatch(r"([<>]?)\s*(\d+(?:\.\d+)?)", str(given).strip())
        if not match:
            raise ValueError(f'{given!r} is no bound as "< 5", "> 5" or 5')
        return Bound(kind=match[1] or default, value=float(match[2]))

    return BeforeValidator(parsed)


AtMost = Annotated[Bound | None, _bound("<")]
AtLeast = Annotated[Bound | None, _bound(">")]


class Requirements(BaseModel):
    """What is asked in one environment; None: nothing is. Names, units and meanings are those of D3.2's table 2."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    response_time: AtMost = Field(None, description="ms from sending a request to the first response's coming")
    delay: AtMost = Field(None, description="ms from a block's first bit's emission to its reception")
    jitter: AtMost = Field(None, description="ms by which delays vary")
    data_rate: AtMost = Field(None, description="Mbit/s of the data as encoded")
    bandwidth: AtMost = Field(None, description="Mbit/s that are transferred, overhead and all")
    loss_rate: AtMost = Field(None, description="share of what is sent that doesn't come")
    error_rate: AtMost = Field(None, description="share of what comes that isn't as it was sent")
    slice: Literal["eMBB", "mMTC", "URLLC"] | None = Field(None, description="preferred slice of a 5G network")
    cpu_cores: AtLeast = Field(None, description="cores of the processor")
    cpu_frequency: AtLeast = Field(None, description="MHz of the cores")
    cpu_usage: AtMost = Field(None, description="percent of the processor's capacity")
    gpu_cores: AtLeast = Field(None, description="cores of the graphics processor")
    gpu_frequency: AtLeast = Field(None, description="MHz of the graphics processor")
    gpu_memory: AtLeast = Field(None, description="MB of the graphics processor's memory")
    gpu_usage: AtMost = Field(None, description="percent of the graphics processor's capacity")
    memory: AtMost = Field(None, description="MB of memory that it takes")


NETWORK = ("response_time", "delay", "jitter", "data_rate", "bandwidth", "loss_rate", "error_rate")
"""Metrics of the service over its network."""
MACHINE = tuple(name for name in Requirements.model_fields if name not in (*NETWORK, "slice"))
"""Metrics of the machine that it runs on."""
UNITS = dict.fromkeys(("response_time", "delay", "jitter"), "ms")
UNITS |= dict.fromkeys(("data_rate", "bandwidth"), "Mbit/s")
UNITS |= dict.fromkeys(("cpu_frequency", "gpu_frequency"), "MHz")
UNITS |= dict.fromkeys(("gpu_memory", "memory"), "MB")
UNITS |= dict.fromkeys(("cpu_usage", "gpu_usage"), "%")
"""Of the metrics that have one."""


class Service(BaseModel):
    """A service's requirements, by environment."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str
    description: str
    source: str
    image: tuple[int, int] | None = Field(None, description="Width and height of the images that it is for, pixels.")
    robot: Requirements | None = None
    edge: Requirements | None = None
    cloud: Requirements | None = None

    def of(self, environment: Environment) -> Requirements:
        """In an environment.

        Raises:
            SettingError: it isn't meant to run there.
        """
        found: Requirements | None = getattr(self, environment)
        if found is None:
            there = [one for one in Environment if getattr(self, one)]
            raise SettingError(environment, f"{self.title} has no requirements there", f"Choose {', '.join(there)}")
        return found


def names() -> list[str]:
    """Of the services whose requirements come along."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def read(which: str | Path) -> Service:
    """The requirements of a service that comes along, or of a file.

    Raises:
        InputError: the file can't be read, or says something else.
    """
    path = FOLDER / f"{which}.toml" if str(which) in names() else Path(which)
    try:
        return Service.model_validate(toml.parse(path.read_text("utf-8")))
    except OSError as error:
        cause = f"can't be read ({error.strerror})"
        raise InputError(path, cause, f"Give a file, or one of: {', '.join(names())}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(path, f"{where}: {first['msg']}", "docs/toolboxes.md says what it may hold") from None
    except ValueError as error:
        raise InputError(path, f"is no TOML ({error})", "Mend it") from None
