"""Requirements on a service's quality of service and hardware for each environment, with the metrics of D3.2's table 2.

Files are TOML: `title`, `description`, `source`, width and height of the images (`image`), and one table for each of
`robot`, `edge` and `cloud` (section 2.2). A value is a bound ("< 2000", "> 20", "4" for at least 4 cores) or a
preferred slice; metrics without a requirement are omitted.
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
"""Folder of the built-in files: D3.2's tables 3, 6, 7, 8, 10 and 11."""


class Environment(StrEnum):
    """Where a service runs (D3.2, section 2.2)."""

    ROBOT = "robot"
    """On the robot: no network between camera and model."""
    EDGE = "edge"
    """On site, connected by Wi-Fi."""
    CLOUD = "cloud"
    """Off site, connected by a mobile network."""


class Bound(BaseModel):
    """Upper or lower bound of a metric.

    Attributes:
        kind: "<" for at most, ">" for at least.
        value: limit in the metric's unit.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["<", ">"]
    value: float = Field(ge=0)

    def met(self, value: float) -> bool:
        """Whether a value satisfies the bound."""
        return value <= self.value if self.kind == "<" else value >= self.value

    def __str__(self) -> str:
        return f"{'at most' if self.kind == '<' else 'at least'} {self.value:g}"


def _bound(default: Literal["<", ">"]) -> BeforeValidator:
    """Validator that parses text such as "< 5"; `default` is the sign if none is given."""

    def parse(given: Any) -> Any:
        if isinstance(given, (Bound, dict)) or given is None:
            return given
        match = re.fullmatch(r"([<>]?)\s*(\d+(?:\.\d+)?)", str(given).strip())
        if not match:
            raise ValueError(f'{given!r} isn\'t a bound such as "< 5", "> 5" or 5')
        return Bound(kind=match[1] or default, value=float(match[2]))

    return BeforeValidator(parse)


AtMost = Annotated[Bound | None, _bound("<")]
AtLeast = Annotated[Bound | None, _bound(">")]


class Requirements(BaseModel):
    """Requirements in one environment; None: no requirement. Names, units and meanings are those of D3.2's table 2."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    response_time: AtMost = Field(None, description="ms from sending a request to the first response")
    delay: AtMost = Field(None, description="one-way delay in ms")
    jitter: AtMost = Field(None, description="variation of the delay in ms")
    data_rate: AtMost = Field(None, description="Mbit/s of encoded data")
    bandwidth: AtMost = Field(None, description="Mbit/s on the network, including overhead")
    loss_rate: AtMost = Field(None, description="share of sent data that is lost")
    error_rate: AtMost = Field(None, description="share of received data that is corrupted")
    slice: Literal["eMBB", "mMTC", "URLLC"] | None = Field(None, description="preferred slice of a 5G network")
    cpu_cores: AtLeast = Field(None, description="number of CPU cores")
    cpu_frequency: AtLeast = Field(None, description="clock of the CPU in MHz")
    cpu_usage: AtMost = Field(None, description="percentage of the CPU's capacity")
    gpu_cores: AtLeast = Field(None, description="number of GPU cores")
    gpu_frequency: AtLeast = Field(None, description="clock of the GPU in MHz")
    gpu_memory: AtLeast = Field(None, description="memory of the GPU in MB")
    gpu_usage: AtMost = Field(None, description="percentage of the GPU's capacity")
    memory: AtMost = Field(None, description="main memory in MB")


NETWORK_METRICS = ("response_time", "delay", "jitter", "data_rate", "bandwidth", "loss_rate", "error_rate")
"""Metrics of the service and its network."""
MACHINE_METRICS = tuple(name for name in Requirements.model_fields if name not in (*NETWORK_METRICS, "slice"))
"""Metrics of the machine it runs on."""
UNITS = dict.fromkeys(("response_time", "delay", "jitter"), "ms")
UNITS |= dict.fromkeys(("data_rate", "bandwidth"), "Mbit/s")
UNITS |= dict.fromkeys(("cpu_frequency", "gpu_frequency"), "MHz")
UNITS |= dict.fromkeys(("gpu_memory", "memory"), "MB")
UNITS |= dict.fromkeys(("cpu_usage", "gpu_usage"), "%")
"""Units by metric."""


class ServiceRequirements(BaseModel):
    """Requirements of a service by environment."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str
    description: str
    source: str
    image: tuple[int, int] | None = Field(None, description="Width and height of its images in pixels.")
    robot: Requirements | None = None
    edge: Requirements | None = None
    cloud: Requirements | None = None

    def of(self, environment: Environment) -> Requirements:
        """Requirements in an environment.

        Raises:
            SettingError: the service isn't meant for this environment.
        """
        found: Requirements | None = getattr(self, environment)
        if found is None:
            known = [one for one in Environment if getattr(self, one)]
            raise SettingError(
                environment, f"{self.title} has no requirements for it", f"Choose one of: {', '.join(known)}"
            )
        return found


def names() -> list[str]:
    """Names of the services with built-in requirements."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def read(which: str | Path) -> ServiceRequirements:
    """Read built-in requirements or a file.

    Raises:
        InputError: the file can't be read or is invalid.
    """
    path = FOLDER / f"{which}.toml" if str(which) in names() else Path(which)
    try:
        return ServiceRequirements.model_validate(toml.parse(path.read_text("utf-8")))
    except OSError as error:
        cause = f"can't be read ({error.strerror})"
        raise InputError(path, cause, f"Give a file, or one of: {', '.join(names())}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(path, f"{where}: {first['msg']}", "See docs/toolboxes.md for the format") from None
    except ValueError as error:
        raise InputError(path, f"invalid TOML ({error})", "Fix the file") from None
